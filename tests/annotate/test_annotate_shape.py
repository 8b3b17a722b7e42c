"""The annotator with a learned shape."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.annotating import Case, agree_with_fit, place_all

from cadalign import CadalignError, ShapeModel
from cadalign.annotate.actions import perform
from cadalign.annotate.page_state import page_state
from cadalign.annotate.session import LiveAlignment, Session
from cadalign.datasets import KeypointNet, ModelKeypoints
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
    assert len(drawn["box"]) == 12 * 16
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
    written = ModelKeypoints.load(session.model.keypoints_path)
    assert 77 in written.ids
    perform(session, 0, {"do": "undo"})
    assert not page_state(session, 0)["pairs"][0]["counts"]


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
