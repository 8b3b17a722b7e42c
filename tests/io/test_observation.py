"""Observation files: round trip and errors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.files import replaced, write_json

from cadalign import Camera
from cadalign.errors import DataError, InputError
from cadalign.io.observation import Observation

CAMERA = Camera(640, 480, 500.0, 510.0, 319.5, 239.5, (-0.1, 0.02, 0.001, 0.0))
POINTS_3D = np.random.default_rng(0).uniform(-1, 1, (7, 3))
POINTS_2D = np.random.default_rng(1).uniform(0, 480, (7, 2))

DATA: dict[str, Any] = {
    "camera": {"model": "PINHOLE", "width": 640, "height": 480, "params": [500, 500, 320, 240]},
    "keypoints": [
        {"xyz": [0.1 * i, 0.2, -0.3 * i], "uv": [10.0 * i, 20], "sigma": 1 + i, "semantic_id": i}
        for i in range(6)
    ],
    "image": "photo.png",
    "model": "models/chair.obj",
}


def changed(path: str, value: Any) -> dict[str, Any]:
    """The data with the entry at a dotted path replaced; removed where the value is `...`."""
    return replaced(DATA, path, value)


def test_fields_are_read() -> None:
    observation = Observation.from_dict(DATA)
    assert observation.points_3d.tolist() == [k["xyz"] for k in DATA["keypoints"]]
    assert observation.points_2d.tolist() == [k["uv"] for k in DATA["keypoints"]]
    assert observation.camera == Camera(640, 480, 500, 500, 319.5, 239.5)
    assert observation.sigma is not None
    assert observation.ids is not None
    assert observation.sigma.tolist() == [1, 2, 3, 4, 5, 6]
    assert observation.ids.tolist() == [0, 1, 2, 3, 4, 5]
    assert observation.image == Path("photo.png")
    assert observation.model == Path("models/chair.obj")


def test_paths_are_relative_to_the_file(tmp_path: Path) -> None:
    observation = Observation.load(write_json(tmp_path / "chair.json", DATA))
    assert observation.image == tmp_path / "photo.png"
    assert observation.model == tmp_path / "models" / "chair.obj"
    absolute = write_json(tmp_path / "chair.json", DATA | {"image": "/elsewhere/photo.png"})
    assert Observation.load(absolute).image == Path("/elsewhere/photo.png")


def test_options_of_the_fit_are_kept(tmp_path: Path) -> None:
    """An explicit null, which estimates sigma, differs from a missing one."""
    options = {"sigma": None, "loss": "cauchy", "stretch": "y", "stretch_sigma": 0.3}
    observation = Observation.from_dict(DATA | {"fit": options})
    assert observation.fit_options == options
    observation.save(tmp_path / "chair.json")
    assert Observation.load(tmp_path / "chair.json").fit_options == options
    assert Observation.from_dict(DATA).fit_options == {}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sigma": [1.0]}, r"fit\.sigma: 1 numbers for 6 keypoints; give one for each"),
        ({"sigma": [1.0, -1.0]}, r"fit\.sigma\[1\]: -1\.0 is not a positive number"),
        ({"sigma": 0}, r"fit\.sigma: 0 is not a positive number"),
        ({"noise": 1}, r"fit: .*noise"),
        ({"focal": "guess"}, r"fit\.focal"),
    ],
)
def test_wrong_options_of_the_fit_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(DataError, match=message):
        Observation.from_dict(DATA | {"fit": options})


@pytest.mark.parametrize("extras", [True, False])
def test_load_undoes_save_exactly(tmp_path: Path, extras: bool) -> None:
    written = Observation(
        POINTS_3D,
        POINTS_2D,
        CAMERA,
        sigma=np.linspace(0.5, 2, 7) if extras else None,
        ids=np.arange(7) if extras else None,
    )
    written.save(tmp_path / "observation.json")
    read = Observation.load(tmp_path / "observation.json")
    assert (read.points_3d == POINTS_3D).all()
    assert (read.points_2d == POINTS_2D).all()
    assert read.camera == CAMERA
    if extras:
        assert (read.sigma == written.sigma).all()
        assert (read.ids == written.ids).all()
    else:
        assert read.sigma is None
        assert read.ids is None
    data = written.to_dict()
    assert read.to_dict() == data
    assert (data["pixel_origin"], data["camera"]["pixel_origin"]) == ("center", "corner")


@pytest.mark.parametrize(
    ("data", "text"),
    [
        ([1], "{path}: [1] is not an object"),
        (changed("camera", ...), "{path}: camera: missing"),
        (
            changed("keypoints", ...),
            "{path}: keypoints: missing; give keypoints, `mask` or `init`",
        ),
        (changed("keypoints", {}), "{path}: keypoints: {{}} is not a list"),
        (
            DATA | {"cameras": 3},
            "{path}: top level: unknown field 'cameras', did you mean 'camera'?; "
            "known are cam_from_rig, camera, camera_height, camera_height_sigma, depth_sigma, fit, "
            "image, init, keypoints, mask, mask_sigma, model, "
            "object, pixel_origin, shape, size, symmetry, unfinished, up, up_axis, up_sigma_deg, "
            "views",
        ),
        (
            changed("keypoints.2.xyz", ...),
            "{path}: keypoints[2].xyz: missing; give it, or name a category as `shape`",
        ),
        (
            changed("keypoints.2.uvw", 3),
            "{path}: keypoints[2]: unknown field 'uvw', did you mean 'uv'?; "
            "known are depth, name, score, semantic_id, sigma, uv, xyz",
        ),
        (changed("keypoints.2.xyz", [1, 2]), "{path}: keypoints[2].xyz: [1, 2] is not a list of 3"),
        (changed("keypoints.2.uv", [1]), "{path}: keypoints[2].uv: [1] is not a list of 2"),
        (
            changed("keypoints.4.xyz", [1, float("nan"), 2]),
            "{path}: keypoints[4].xyz[1]: nan is not a finite number",
        ),
        (changed("keypoints.1.sigma", 0), "{path}: keypoints[1].sigma: 0 is not a positive number"),
        (
            changed("keypoints.1.sigma", ...),
            "{path}: keypoints[1].sigma: missing, though other keypoints have it; "
            "give it for all keypoints or for none",
        ),
        (
            changed("keypoints.5.semantic_id", True),
            "{path}: keypoints[5].semantic_id: True is not a whole number",
        ),
        (changed("image", 5), "{path}: image: 5 is not a path"),
        (
            changed("camera.params.0", 0),
            "{path}: camera.fx: the focal length is 0; give the calibrated one in pixels",
        ),
        ('{\n"camera": ', "{path}, line 2: not valid JSON: Expecting value"),
        ("null", "{path}: None is not an object"),
    ],
)
def test_malformed_files_are_refused_by_file_and_field(
    tmp_path: Path, data: Any, text: str
) -> None:
    path = write_json(tmp_path / "observation.json", data)
    with pytest.raises(DataError) as caught:
        Observation.load(path)
    assert str(caught.value) == text.format(path=path)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"points_2d": POINTS_2D[:5]}, "points_2d: shape (5, 2), expected (7, 2)"),
        ({"points_3d": POINTS_3D[:, :2]}, "points_3d: shape (7, 2), expected (n, 3)"),
        ({"sigma": np.ones(3)}, "sigma: shape (3,), expected (7)"),
        (
            {"points_3d": np.full((7, 3), np.nan)},
            "points_3d: NaN or infinite values in rows 0, 1, 2, 3, 4, ...; remove or repair these",
        ),
    ],
)
def test_arrays_that_do_not_match_are_refused(change: dict[str, Any], text: str) -> None:
    arguments = {"points_3d": POINTS_3D, "points_2d": POINTS_2D, "camera": CAMERA} | change
    with pytest.raises(InputError) as caught:
        Observation(**arguments)
    assert str(caught.value) == text


@pytest.mark.parametrize("absolute", [False, True])
@pytest.mark.parametrize("file", ["photos/p.json", "deep/er/p.json", "p.json", "linked/p.json"])
def test_saved_paths_outside_the_files_folder_name_the_same_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, file: str, absolute: bool
) -> None:
    monkeypatch.chdir(tmp_path)
    for folder in ("photos", "deep/er", "models/b", "elsewhere/far/off"):
        Path(folder).mkdir(parents=True)
    Path("linked").symlink_to("elsewhere/far/off")
    model, image = Path("models/b/model.obj"), Path("photos/p.jpg")
    given = (tmp_path / model, tmp_path / image) if absolute else (model, image)
    Observation(POINTS_3D, POINTS_2D, CAMERA, model=given[0], image=given[1]).save(file)
    loaded = Observation.load(file)
    assert loaded.model is not None
    assert loaded.image is not None
    assert loaded.model.resolve() == tmp_path / model
    assert loaded.image.resolve() == tmp_path / image
    written = json.loads(Path(file).read_text())
    assert not Path(written["model"]).is_absolute()
    assert not Path(written["image"]).is_absolute()


@pytest.mark.parametrize(
    ("name", "content", "text"),
    [
        ("gone.json", None, "no such file"),
        ("o.json", b"\xff\xfe\x00", "cannot be read as text: byte 0 is not UTF-8"),
        ("", None, "cannot be read (Is a directory)"),
    ],
)
def test_missing_and_binary_files_are_refused(
    tmp_path: Path, name: str, content: bytes | None, text: str
) -> None:
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DataError) as caught:
        Observation.load(path)
    assert str(caught.value) == f"{path}: {text}"


def test_save_cut_short_leaves_the_file_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    path = write_json(tmp_path / "p.json", DATA)
    before = path.read_bytes()
    with monkeypatch.context() as patched:
        patched.setattr("os.replace", full)
        with pytest.raises(DataError, match="cannot be written"):
            Observation(POINTS_3D, POINTS_2D, CAMERA).save(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
