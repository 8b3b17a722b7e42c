"""`cadalign fit` of a symmetric model, and its overlay of the model over the photo."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from support.refusals import refusal_line

from cadalign import Alignment, Camera
from cadalign.cli import main
from cadalign.geometry.rotations import angles_between, rotation_from_vector
from cadalign.geometry.symmetry import FACING
from cadalign.io.images import write_image
from cadalign.io.observation import Observation

UP = np.array([0.0, 1.0, 0.0])
CAMERA = Camera(320, 240, 450.0, 450.0, 159.5, 119.5)
HALF = np.array([0.5, 0.8, 0.5])
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * HALF
TILTED = FACING @ rotation_from_vector(np.array([0.5, 0.0, 0.0]))
TRUTH = Alignment(TILTED @ rotation_from_vector(0.4 * UP), [0.1, 0.0, 5.0], [1.0, 1.2, 1.0])
QUARTER = rotation_from_vector(np.pi / 2 * UP)


def write_observation(folder: Path, name: str = "box.json", **fields: Any) -> Path:
    """Write an observation of a box with a square base: grey photo, exact keypoints."""
    trimesh.creation.box(2 * HALF).export(folder / "box.obj")
    write_image(folder / "photo.png", np.full((240, 320, 3), 90, np.uint8))
    points = fields.pop("points", CORNERS)
    given: dict[str, Any] = {
        "model": folder / "box.obj",
        "image": folder / "photo.png",
        "fit_options": {"stretch": "y"},
        **fields,
    }
    Observation(points, CAMERA.project(TRUTH.apply(CORNERS)), CAMERA, **given).save(folder / name)
    return folder / name


def with_symmetry(path: Path, symmetry: Any) -> Path:
    path.write_text(json.dumps({**json.loads(path.read_text()), "symmetry": symmetry}))
    return path


@pytest.mark.long
@pytest.mark.parametrize("flags", [[], ["--shape-sigma", "0.02"]])
def test_turned_labels_give_the_same_alignment(tmp_path: Path, flags: list[str]) -> None:
    rotations = []
    for name, points in (("a.json", CORNERS), ("b.json", CORNERS @ QUARTER.T)):
        path = with_symmetry(
            write_observation(tmp_path, name, points=points), {"axis": [0, 1, 0], "fold": 4}
        )
        assert main(["fit", str(path), *flags]) == 0
        fit = json.loads((tmp_path / f"{path.stem}_fit" / "fit.json").read_text())
        rotations.append(np.array(fit["alignment"]["rotation"]))
    assert angles_between(*rotations) < 0.01
    assert angles_between(rotations[0], TRUTH.rotation) < 0.5


def test_what_is_no_symmetry_is_refused_by_file_and_field(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = with_symmetry(write_observation(tmp_path), {"axis": [0, 1, 0], "fold": -1})
    line = refusal_line(capsys, "fit", path)
    assert "box.json" in line
    assert "symmetry.fold: '-1' is not a number of rotations" in line
