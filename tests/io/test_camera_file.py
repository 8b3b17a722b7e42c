"""Files of one camera: calibration matrices and COLMAP's form."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from cadalign import Camera, Observation
from cadalign.errors import DataError, InputError
from cadalign.io.observation import read_camera

MATRIX = [[500.0, 0.0, 319.5], [0.0, 510.0, 239.5], [0.0, 0.0, 1.0]]
CAMERA = Camera(640, 480, 500, 510, 319.5, 239.5)


def write(path: Path, content: object) -> Path:
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("K.txt", "500 0 319.5\n0 510 239.5\n0 0 1\n"),
        ("K.csv", "500, 0, 319.5\n0, 510, 239.5\n0, 0, 1\n"),
        ("K.json", {"matrix": MATRIX}),
        ("K.json", {"matrix": MATRIX, "width": 640, "height": 480, "pixel_origin": "center"}),
        ("camera.json", CAMERA.to_dict()),
    ],
)
def test_all_forms_give_the_same_camera(tmp_path: Path, name: str, content: object) -> None:
    path = write(tmp_path / name, content)
    assert read_camera(path, size=(640, 480)) == CAMERA


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("K.txt", "500 0 319.5", "not a calibration matrix"),
        ("K.txt", "a b c", "not a calibration matrix"),
        ("cameras.txt", "1 PINHOLE 640 480 935 935 320 240", "COLMAP's list of cameras, not one"),
        ("K.json", {"matrix": [1, 2]}, "matrix: shape .* expected"),
        ("K.json", MATRIX, "camera: expected an object, got list"),
        ("camera.txt", CAMERA.to_dict(), "not a calibration matrix"),
        ("K.json", 3, "camera: expected an object, got int"),
        ("K.txt", "500 3 319 0 510 239 0 0 1", "matrix: .* is not of the form"),
        ("K.json", {"matrix": MATRIX, "pixel_origin": "middle"}, "not a place of pixel"),
    ],
)
def test_malformed_files_are_refused_by_name(
    tmp_path: Path, name: str, content: object, message: str
) -> None:
    path = write(tmp_path / name, content)
    with pytest.raises(DataError, match=message) as found:
        read_camera(path, size=(640, 480))
    assert name in str(found.value)


def test_matrix_alone_needs_a_size(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="the size of the image is unknown"):
        read_camera(write(tmp_path / "K.json", {"matrix": MATRIX}))


@pytest.mark.parametrize(("origin", "cx"), [("center", 319.5), ("corner", 319.0)])
def test_matrix_states_its_pixel_origin(origin: str, cx: float) -> None:
    camera = Camera.from_matrix(MATRIX, 640, 480, pixel_origin=origin)  # type: ignore[arg-type]
    assert camera.cx == cx
    assert camera.matrix[0, 2] == cx


def test_matrix_is_checked() -> None:
    with pytest.raises(InputError, match="pixel_origin: 'top' is not a place of pixel"):
        Camera.from_matrix(MATRIX, 640, 480, pixel_origin="top")  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"matrix: .* is not of the form"):
        Camera.from_matrix(np.array(MATRIX).T, 640, 480)


@pytest.mark.parametrize(("origin", "uv"), [("center", 350.0), ("corner", 349.5)])
def test_keypoints_of_an_observation_state_their_origin(origin: str, uv: float) -> None:
    keypoints = [{"xyz": [0, 0, 0], "uv": [350.0, 200.0]}]
    data = {"camera": CAMERA.to_dict(), "pixel_origin": origin, "keypoints": keypoints}
    assert Observation.from_dict(data).points_2d[0, 0] == uv
