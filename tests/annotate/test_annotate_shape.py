"""The annotator with a learned shape."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.annotating import Case, agree_with_fit, place_all

from cadalign import Alignment, CadalignError, ShapeModel
from cadalign.annotate.actions import perform
from cadalign.annotate.files import SessionOptions
from cadalign.annotate.keypoints import ObjectShape
from cadalign.annotate.page_state import page_state
from cadalign.annotate.session import LiveAlignment, Session, open_session
from cadalign.cli import main
from cadalign.cli.example import write_example
from cadalign.datasets import KeypointNet, ModelKeypoints
from cadalign.datasets.model_keypoints import ModelKeypoint
from cadalign.io.observation import Observation
from cadalign.shapes.examples import Example

pytestmark = pytest.mark.long

LACKING = 2  # keypoints of the model that the learned shape does not know


def learn(points: np.ndarray, ids: list[Any]) -> ShapeModel:
    """Learn the shape of stretched and distorted copies."""
    rng = np.random.default_rng(0)
    models = []
    for row in range(60):
        own = points * rng.normal(1, 0.08, 3) + rng.normal(0, 0.005, points.shape)
        models.append(Example(f"chair {row}", ids, own, np.stack([own.min(0), own.max(0)])))
    return ShapeModel.learn(models, category="chair", up_axis="y")


@pytest.fixture(scope="module")
def shape_file(sample_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shape of chairs; two of the sample chair's keypoints were not learned, one is new."""
    keypoints = KeypointNet(sample_root)["chair", "sample_chair_000"].keypoints
    points = np.concatenate([keypoints.xyz[LACKING:], [[0.0, 0.1, 0.0]]])
    ids = [*keypoints.ids[LACKING:].tolist(), 77]
    path = tmp_path_factory.mktemp("shapes") / "chair.shape"
    learn(points, ids).save(path)
    return path


def live_shape(session: Session) -> LiveAlignment:
    live = session.live(session.photos[0])
    assert isinstance(live, LiveAlignment)
    return live


@pytest.mark.parametrize(("weighted", "count"), [(False, None), (True, 6)])
def test_fit_of_the_observation_gives_the_pages_numbers(
    case: Case,
    capsys: pytest.CaptureFixture[str],
    shape_file: Path,
    count: int | None,
    *,
    weighted: bool,
) -> None:
    instance = case.instance
    keep = slice(None if count is None else count + LACKING)
    ids = instance.ids[keep]
    sigma = np.random.default_rng(0).uniform(0.5, 2, len(ids)) if weighted else None
    of_model = {
        each.semantic_id: each.xyz for each in ModelKeypoints.load(case.keypoints).keypoints
    }
    points = np.array([of_model[number] for number in ids.tolist()])
    given = Observation(points, instance.points_2d[keep], instance.camera, sigma, ids)
    given.save(case.observation)
    session = case.open(shape=shape_file)
    perform(session, 0, {"do": "move", "pair": 2, "uv": instance.points_2d[1].tolist()})
    agree_with_fit(session, case, capsys)


def test_page_shows_box_lines_keypoints_and_regions(case: Case, shape_file: Path) -> None:
    session = case.open(shape=shape_file)
    state = place_all(session, case)
    drawn = state["alignment"]
    shape = ShapeModel.open(shape_file)
    assert state["shape"] == {"category": "chair", "missing": [77]}
    used = {number for number, _ in case.clicks} & set(shape.ids)
    # All keypoints except the one that the model lacks.
    assert len(drawn["unmarked"]) == len(drawn["regions"]) == len(shape.ids) - len(used) - 1
    assert len(drawn["lines"]) > 100
    assert len(drawn["box"]) > 4 * 16
    labels = [fact["label"] for fact in drawn["facts"]]
    assert labels[:5] == [*(f"Length {axis}" for axis in "xyz"), "Rotation", "Distance"]


def test_points_that_the_shape_lacks_do_not_count(case: Case, shape_file: Path) -> None:
    """They are kept in the file."""
    session = case.open(shape=shape_file)
    state = place_all(session, case)
    lacking = [pair for pair in state["pairs"] if not pair["counts"]]
    known = set(ShapeModel.open(shape_file).ids)
    assert {pair["keypoint"] for pair in lacking} == {n for n, _ in case.clicks} - known
    assert lacking
    assert all(pair["residual"] is None for pair in lacking)
    assert f"{len(lacking)} pair" in " ".join(state["alignment"]["notes"])
    observation = Observation.load(case.observation)
    assert observation.shape is not None
    assert observation.shape.samefile(shape_file)
    assert set(observation.ids.tolist()) <= known  # type: ignore[union-attr]
    again = page_state(case.open(shape=shape_file), 0)["pairs"]
    both = ({(p["keypoint"], tuple(p["uv"])) for p in pairs} for pairs in (state["pairs"], again))
    assert next(both) == next(both)


def test_points_of_the_model_can_be_identified(
    case: Case, shape_file: Path, sample_root: Path
) -> None:
    """A new point gets an id of the shape only if the user asks for it."""
    session = case.open(shape=shape_file)
    perform(session, 0, {"do": "pick", "origin": [0, 0.05, -3], "direction": [0, 0, 1]})
    (pair,) = page_state(session, 0)["pairs"]
    assert not pair["counts"]
    assert pair["keypoint"] > 77
    with pytest.raises(CadalignError, match="not a keypoint of the shape"):
        perform(session, 0, {"do": "identify", "pair": pair["pair"], "label": 99})
    with pytest.raises(CadalignError, match="already has a keypoint 5"):
        perform(session, 0, {"do": "identify", "pair": pair["pair"], "label": 5})
    perform(session, 0, {"do": "identify", "pair": pair["pair"], "label": 77})
    state = page_state(session, 0)
    assert state["pairs"][0]["counts"]
    assert state["pairs"][0]["keypoint"] == 77
    assert state["shape"]["missing"] == []
    written = ModelKeypoints.load(case.folder / "sample_chair_000.keypoints.json")
    assert 77 in written.ids
    perform(session, 0, {"do": "undo"})
    assert not page_state(session, 0)["pairs"][0]["counts"]


def test_keypoints_of_the_model_count_by_name_or_id(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_example(tmp_path)
    clicks, given = tmp_path / "clicks.json", tmp_path / "chair.keypoints.json"
    model, seen = ModelKeypoints.load(given), Observation.load(clicks)
    assert seen.names is not None
    points = [
        replace(each, name="a")  # known by its id alone, the others by their names
        if each.name == seen.names[0]
        else replace(each, semantic_id=None)
        for each in model.keypoints
    ]
    replace(model, keypoints=tuple(points)).save(given)
    photo, mesh = tmp_path / "photo.jpg", tmp_path / "chair.obj"
    options = SessionOptions(image=photo, model=mesh, observation=clicks, shape=Path("chair"))
    session = open_session(options)
    session.warm_up()
    perform(session, 0, {"do": "move", "pair": 1, "uv": seen.points_2d[0].tolist()})
    state = page_state(session, 0)
    assert all(pair["counts"] and pair["residual"] for pair in state["pairs"])
    assert len(Observation.load(clicks).points_2d) == len(seen.points_2d)
    assert main(["fit", str(clicks), "--json", "--no-picture", "--out", str(tmp_path / "x")]) == 0
    live, fitted = live_shape(session).result, json.loads(capsys.readouterr().out)
    assert live is not None
    found = Alignment.from_dict(fitted["alignment"])
    np.testing.assert_allclose(found.translation, live.alignment.translation, rtol=1e-6)
    assert [pair["name"] for pair in state["pairs"]] == ["a", *seen.names[1:]]


def test_only_the_first_of_two_points_of_one_learned_keypoint_counts() -> None:
    shape = ObjectShape.open(Path("chair"))
    assert shape.learned is not None
    point = ModelKeypoint(shape.learned.names[2], (0.0, 0.0, 0.0))
    same = replace(point, name="", semantic_id=int(shape.ids[2]))
    assert shape.knows([point, same, replace(point, name="x")]).tolist() == [True, False, False]


def test_unknown_focal_length_is_estimated_with_the_shape(
    case: Case, capsys: pytest.CaptureFixture[str], shape_file: Path
) -> None:
    session = case.open(shape=shape_file, camera=None)
    shown = place_all(session, case)["alignment"]
    (fact,) = (fact for fact in shown["facts"] if fact["label"] == "Focal length")
    found = live_shape(session).result
    assert found is not None
    assert found.std is not None
    assert found.focal == "estimate"
    assert found.focal_prior == session.photos[0].photo.likely_focal
    assert fact["note"] == "estimated"
    assert fact["value"].startswith(f"{found.camera.fx:.0f} ± ")
    off = np.log(found.camera.fx / case.instance.camera.fx)
    assert abs(off) < 3 * found.std.focal
    assert not Observation.load(case.observation).camera.focal_known
    agree_with_fit(session, case, capsys, rtol=1e-6)
    perform(session, 0, {"do": "focal", "pixels": 900})
    assert Observation.load(case.observation).camera.focal_known
    known = live_shape(session).result
    assert known is not None
    assert known.focal == "known"


def test_contradicting_pair_is_named(case: Case, shape_file: Path) -> None:
    session = case.open(shape=shape_file)
    place_all(session, case)
    pairs = page_state(session, 0)["pairs"]
    assert not [pair for pair in pairs if pair["off"] is not None]
    wrong = next(pair for pair in pairs[3:] if pair["counts"])
    u, v = wrong["uv"]
    perform(session, 0, {"do": "move", "pair": wrong["pair"], "uv": [u - 60, v + 40]})
    off = {pair["pair"]: pair["off"] for pair in page_state(session, 0)["pairs"] if pair["off"]}
    assert list(off) == [wrong["pair"]]
    assert off[wrong["pair"]] == pytest.approx(72, abs=20)


def test_a_stored_shape_is_named_where_it_is_not_used(
    case: Case, shape_file: Path, caplog: pytest.LogCaptureFixture
) -> None:
    place_all(case.open(shape=shape_file), case)
    case.open(shape=shape_file)
    assert caplog.text == ""
    case.open()
    assert "fits without the stored shape" in caplog.text
