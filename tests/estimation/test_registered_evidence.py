"""A kind of evidence that is registered: a wall beside the object, at a known distance."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.scenes import CAMERA, keypoints, truth_of

from cadalign import Model, View, align
from cadalign.cli import main
from cadalign.errors import DataError, InputError
from cadalign.estimation.evidence_kinds import (
    EvidenceKind,
    KnownDistance,
    register_evidence,
    remove_evidence,
)
from cadalign.io.documents import Positive
from cadalign.io.evidence import EvidenceField, ImageEvidence, ObservedImage
from cadalign.io.observation import Observation

POINTS, TRUTH = keypoints(), truth_of()
DISTANCE = float(-(TRUTH.rotation.T @ TRUTH.translation)[0])  # of the camera along the model's x


def _wall(given: Any, prior: Any) -> list[KnownDistance]:
    """The camera's place along x, from the first keypoint, which touches the wall."""
    sigma = given.get("wall_sigma", 0.01)
    return [
        KnownDistance((0, KnownDistance.CAMERA), np.array([1.0, 0.0, 0.0]), given["wall"], sigma)
    ]


def _finite(value: Any) -> float:
    if not np.isfinite(value):
        raise InputError(f"{value} is not finite", where="wall", fix="give the distance")
    return float(value)


WALL = EvidenceKind(
    "wall",
    "wall",
    _wall,
    (
        EvidenceField("wall", float, "Distance of the wall.", float, check=_finite),
        EvidenceField("wall_sigma", Positive, "Its standard deviation.", float, refines="wall"),
    ),
)


@pytest.fixture(autouse=True)
def wall() -> Iterator[None]:
    register_evidence(WALL)
    yield
    remove_evidence("wall")


def seen(rng: np.random.Generator, **more: Any) -> View:
    pixels = CAMERA.project(TRUTH.apply(POINTS)) + rng.normal(size=(len(POINTS), 2))
    return View(CAMERA, pixels, more=more)


def measured() -> float:
    """The wall's distance as the true pose has it."""
    return DISTANCE - float(TRUTH.scale[0] * POINTS[0, 0])


def test_it_changes_the_estimate() -> None:
    """The object is 1.4 times as large as the model, which the wall alone tells."""
    views = [seen(np.random.default_rng(3), **more) for more in ({}, {"wall": measured()})]
    alone, with_wall = (align(Model(points_3d=POINTS), view) for view in views)
    distance = np.linalg.norm(TRUTH.translation)
    assert np.linalg.norm(alone.alignment.translation) == pytest.approx(distance / 1.4, rel=0.03)
    assert np.linalg.norm(with_wall.alignment.translation) == pytest.approx(distance, rel=0.03)
    np.testing.assert_allclose(with_wall.alignment.scale, TRUTH.scale, rtol=0.05)


def test_it_shows_in_the_result() -> None:
    result = align(Model(points_3d=POINTS), seen(np.random.default_rng(0), wall=measured()))
    (piece,) = [each for each in result.evidence if each.kind == "wall"]
    assert (piece.view, piece.count, piece.name) == (0, 1, "views[0].wall")
    assert piece.rms_sigmas < 4
    assert "wall" in {each.kind for each in result.contributions()}


def test_a_contradiction_names_it() -> None:
    walls = [measured() + 1.0, measured(), measured()]
    views = [seen(np.random.default_rng(k), wall=wall) for k, wall in enumerate(walls)]
    warnings = align(Model(points_3d=POINTS), views).warnings
    assert any("views[0].wall" in each for each in warnings)


def observed() -> Observation:
    view = seen(np.random.default_rng(0))
    return Observation(POINTS, np.asarray(view.points_2d), CAMERA)


def test_it_stands_in_observation_files(tmp_path: Path) -> None:
    path = tmp_path / "photo.json"
    data = observed().to_dict() | {"wall": 1.5, "wall_sigma": 0.02}
    path.write_text(json.dumps(data))
    observation = Observation.load(path)
    assert observation.evidence.more == {"wall": 1.5, "wall_sigma": 0.02}
    assert observation.to_dict() == data
    assert not observation.is_plain
    path.write_text(json.dumps({"views": [data, data]}))
    assert Observation.load(path).others[0].evidence.more["wall"] == 1.5
    for wrong, message in (
        ({"wall_sigma": 0.02}, "wall_sigma: given without wall; give wall, too"),
        ({"wall": "near"}, "wall: 'near' is not a finite number"),
        ({"wall": 1.0, "wall_sigma": 0}, "wall_sigma: 0 is not a positive number"),
    ):
        path.write_text(json.dumps(observed().to_dict() | wrong))
        with pytest.raises(DataError, match=message):
            Observation.load(path)


def test_it_is_an_option_of_the_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "photo.json"
    observed().save(path)
    assert main(["fit", str(path), "--wall", str(measured()), "--json", "--no-picture"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert "wall" in {each["kind"] for each in found["evidence"]}
    with pytest.raises(SystemExit):
        main(["fit", "--help"])
    assert "Distance of the wall." in capsys.readouterr().out
    assert main(["fit", str(path), "--wall-sigma", "1"]) == 1
    assert "--wall-sigma: given without wall" in capsys.readouterr().err


def test_bad_values_and_kinds_are_refused() -> None:
    with pytest.raises(InputError, match="wall: nan is not finite; give the distance"):
        seen(np.random.default_rng(0), wall=np.nan)
    with pytest.raises(InputError, match="wall: nan is not finite"):
        ImageEvidence(more={"wall": np.nan})
    with pytest.raises(InputError, match="more: unknown evidence 'floor'; known are wall"):
        seen(np.random.default_rng(0), floor=1.0)
    with pytest.raises(InputError, match="name: 'mask' is a kind of its own"):
        register_evidence(EvidenceKind("mask", "wall", _wall, WALL.fields))
    with pytest.raises(InputError, match="field: 'floor' is not among the kind's fields"):
        register_evidence(EvidenceKind("floor", "floor", _wall, WALL.fields))


def test_it_is_gone_once_removed(tmp_path: Path) -> None:
    remove_evidence("wall")
    path = tmp_path / "photo.json"
    path.write_text(json.dumps(observed().to_dict() | {"wall": 1.5}))
    with pytest.raises(DataError, match="unknown field 'wall'"):
        Observation.load(path)
    image = ObservedImage(POINTS, POINTS[:, :2], CAMERA)
    assert image.evidence.given == {}
