"""From a detector's file and a photo to an alignment: `cadalign observe`, then `cadalign fit`."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from support.files import TETRAHEDRON
from support.refusals import refusal_line

from cadalign import Alignment, Camera, FocalPrior, Result, fit
from cadalign.cli import main
from cadalign.datasets import ModelKeypoint, ModelKeypoints
from cadalign.evaluation.simulation import SimulatedProblem, random_rotation
from cadalign.io.observation import Observation

TRUE = Camera(640, 480, 620.0, 620.0, 319.5, 239.5)
ALIGNMENT = Alignment(random_rotation(np.random.default_rng(5)), [0.1, -0.2, 4.0], [1, 1.3, 0.8])
POINTS_3D = np.random.default_rng(1).uniform(-1, 1, (24, 3)) / ALIGNMENT.scale
POINTS_2D = TRUE.project(ALIGNMENT.apply(POINTS_3D)) + np.random.default_rng(2).normal(
    scale=0.3, size=(24, 2)
)
PROBLEM = SimulatedProblem(POINTS_3D, POINTS_2D, TRUE, ALIGNMENT, None)
NAMES = [f"corner {n}" for n in range(24)]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A photo with EXIF, a detector's file, and the model's keypoints."""
    photo = Image.new("RGB", (480, 640), (90, 120, 150))
    exif = photo.getexif()
    exif[0x0112] = 6  # held upright, stored on its side: 640 x 480 when turned
    exif[0x8769] = {0xA405: 34}
    photo.save(tmp_path / "photo.jpg", exif=exif)
    scores = np.random.default_rng(0).uniform(0.3, 1, 24)
    flat = np.column_stack([POINTS_2D, scores]).ravel().tolist()
    (tmp_path / "found.json").write_text(
        json.dumps([{"image_id": 1, "category_id": 1, "keypoints": flat, "score": 0.9}])
    )
    rows = zip(NAMES, POINTS_3D.tolist(), strict=True)
    ModelKeypoints(tuple(ModelKeypoint(name, tuple(xyz)) for name, xyz in rows)).save(
        tmp_path / "model.keypoints.json"
    )
    return tmp_path


def observing(folder: Path, *options: str) -> list[str]:
    found, model = folder / "found.json", folder / "model.keypoints.json"
    return ["observe", str(found), str(model), *options]


def observe(folder: Path, *options: str) -> int:
    return main(observing(folder, *options))


def fitted(folder: Path, name: str, *options: str) -> Result:
    assert main(["fit", str(folder / f"{name}.json"), *options]) == 0
    return Result.load(folder / f"{name}_fit" / "fit.json")


def test_photo_and_detection_become_an_observation(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert observe(folder, "--image", str(folder / "photo.jpg")) == 0
    out = folder / "found.observation.json"
    assert capsys.readouterr().out == f"24 of 24 keypoints: {out}\n"
    observation = Observation.load(out)
    assert observation.camera == Camera.from_size(640, 480)
    assert observation.names == tuple(NAMES)
    np.testing.assert_allclose(observation.points_2d, POINTS_2D)
    assert observation.scores is not None
    assert observation.scores.min() >= 0.3
    assert observation.image == folder / "photo.jpg"
    assert json.loads(out.read_text())["image"] == "photo.jpg"


def test_the_detectors_file_is_not_written_over(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found, photo = folder / "found.json", folder / "photo.jpg"
    before = found.read_bytes()
    line = refusal_line(capsys, *observing(folder, "--image", str(photo), "--out", str(found)))
    assert line == f"{found}: this file is an input and would be overwritten; give another name"
    assert found.read_bytes() == before


@pytest.mark.slow
def test_fit_of_a_photo_without_focal_length_takes_exif_into_account(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    observe(folder, "--image", str(folder / "photo.jpg"))
    capsys.readouterr()
    result = fitted(folder, "found.observation")
    captured = capsys.readouterr()
    focal = 34 / np.hypot(36, 24) * 800
    assert f"with the prior {focal:.4g} px +- 5 %, the photo's EXIF data" in captured.err
    assert "  focal length " in captured.out
    prior = FocalPrior.from_exif(folder / "photo.jpg")
    expected = fit(
        POINTS_3D, POINTS_2D, Camera.from_size(640, 480), focal="estimate", focal_prior=prior
    )
    assert result.camera.fx == pytest.approx(expected.camera.fx, rel=1e-9)
    assert result.camera.fx == pytest.approx(620, rel=0.03)
    assert result.focal_prior == prior
    path = folder / "found.observation.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"fit": {"focal_prior": None}}))
    assert fitted(folder, "found.observation").focal_prior is None


def test_known_focal_length_can_be_estimated_all_the_same(folder: Path) -> None:
    wrong = TRUE.replace_focal(900.0)
    Observation(POINTS_3D, POINTS_2D, wrong).save(folder / "known.json")
    assert fitted(folder, "known").camera == wrong
    estimated = fitted(folder, "known", "--focal", "estimate", "--json")
    assert estimated.camera.fx == pytest.approx(620, rel=0.1)
    assert estimated.covariance is not None
    assert estimated.covariance.shape == (10, 10)


def test_focal_length_is_given_in_the_command(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    observe(folder, "--image", str(folder / "photo.jpg"))
    result = fitted(folder, "found.observation", "--focal", "620")
    assert (result.focal, result.camera) == ("known", TRUE)
    observe(folder, "--image", str(folder / "photo.jpg"), "--focal", "620")
    assert Observation.load(folder / "found.observation.json").camera == TRUE
    capsys.readouterr()
    assert main(["fit", str(folder / "found.observation.json"), "--focal", "-3"]) == 1
    assert "camera.fx: the focal length is -3" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (
            [],
            "{folder}/found.json: [0]: the photo's size is unknown; give the photo, or the camera",
        ),
        (["--image", "{folder}/none.jpg"], "{folder}/none.jpg: no such file"),
        (
            ["--image", "{folder}/found.json"],
            "{folder}/found.json: a detector's keypoints, not a photo; give a picture",
        ),
        (
            ["--camera", "{folder}/found.json"],
            "{folder}/found.json: a detector's keypoints, not a camera; give 3 x 3 numbers",
        ),
        (
            ["--image", "{folder}/photo.jpg", "--object", "3"],
            "--object: there is no object 3 of 1; ",
        ),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(
    folder: Path, capsys: pytest.CaptureFixture[str], options: list[str], text: str
) -> None:
    given = [option.format(folder=folder) for option in options]
    line = refusal_line(capsys, *observing(folder, *given))
    assert line.startswith(text.format(folder=folder))


# --- evidence beyond keypoints -----------------------------------------------------------------


@pytest.fixture
def masked(folder: Path) -> Path:
    """The folder with a camera, a model's mesh, and a square mask in the detector's file."""
    (folder / "camera.json").write_text(json.dumps(TRUE.to_dict()))
    (folder / "model.obj").write_text(TETRAHEDRON)
    keypoints = ModelKeypoints.load(folder / "model.keypoints.json")
    replace(keypoints, model=folder / "model.obj").save(folder / "model.keypoints.json")
    found = json.loads((folder / "found.json").read_text())
    found[0]["segmentation"] = [[100, 50, 300, 50, 300, 250, 100, 250]]
    (folder / "found.json").write_text(json.dumps(found))
    return folder


def test_mask_is_written_beside_the_observation(
    masked: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert observe(masked, "--camera", str(masked / "camera.json")) == 0
    path = masked / "found.observation.mask.png"
    assert capsys.readouterr().out.endswith(f"; mask: {path}\n")
    evidence = Observation.load(masked / "found.observation.json").evidence
    assert evidence.mask == path
    assert json.loads((masked / "found.observation.json").read_text())["mask"] == path.name
    with Image.open(path) as mask:
        pixels = np.asarray(mask)
    expected = np.zeros((480, 640), dtype=np.uint8)
    expected[50:250, 100:300] = 255
    np.testing.assert_array_equal(pixels, expected)


def test_mask_that_a_fit_cannot_use_is_left_out(
    masked: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert observe(masked, "--image", str(masked / "photo.jpg")) == 0
    assert capsys.readouterr().err == "The mask is left out: a fit to it needs --camera.\n"
    assert Observation.load(masked / "found.observation.json").is_plain


def coco(folder: Path, **changes: Any) -> Path:
    """Write COCO annotations of the photo, with changed fields of image and object."""
    flat = np.column_stack([POINTS_2D, np.full(24, 2)]).ravel().tolist()
    image = {"id": 1, "file_name": "photo.jpg", "width": 640, "height": 480}
    entry = {"id": 1, "image_id": 1, "category_id": 1, "keypoints": flat}
    names = {"id": 1, "keypoints": NAMES}
    image |= {name: changes.pop(name) for name in ("width", "height") if name in changes}
    path = folder / "coco.json"
    data = {"images": [image], "annotations": [entry | changes], "categories": [names]}
    path.write_text(json.dumps(data))
    return path


def mesh_of_keypoints(folder: Path) -> dict[str, Any]:
    """Write a mesh whose vertices are the keypoints; returns the content of the keypoint file."""
    vertices = "".join(f"v {x} {y} {z}\n" for x, y, z in POINTS_3D.tolist())
    corners = " ".join(map(str, range(1, 25)))
    (folder / "model.obj").write_text(f"{vertices}f {corners}\n")
    data: dict[str, Any] = json.loads((folder / "model.keypoints.json").read_text())
    return data | {"model": "model.obj"}


@pytest.mark.parametrize(
    ("size", "says_exif"), [((1280, 960), False), ((480, 640), True)], ids=["other", "as stored"]
)
def test_observe_and_fit_refuse_a_photo_of_another_size_alike(
    folder: Path, capsys: pytest.CaptureFixture[str], size: tuple[int, int], says_exif: bool
) -> None:
    found, model = coco(folder, width=size[0], height=size[1]), folder / "model.keypoints.json"
    photo = folder / "photo.jpg"
    line = refusal_line(capsys, "observe", str(found), str(model), "--image", str(photo))
    what = f"the image has {size[0]} x {size[1]} pixels, but {photo} has 640 x 480"
    assert line.startswith(f"{found}: annotations[0]: {what}")
    assert ("by its EXIF orientation" in line) == says_exif
    assert main(["fit", str(found), "--model", str(model), "--no-picture"]) == 1
    assert line in capsys.readouterr().err


def test_a_flawed_mask_leaves_the_keypoints(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = folder / "model.keypoints.json"
    path.write_text(json.dumps(mesh_of_keypoints(folder)))
    np.savetxt(folder / "K.txt", TRUE.matrix)
    found = coco(folder, segmentation={"size": [480, 640], "counts": [5]})
    arguments = ["--image", str(folder / "photo.jpg"), "--camera", str(folder / "K.txt")]
    assert main(["observe", str(found), str(path), *arguments]) == 0
    said = capsys.readouterr()
    assert f"{found}: annotations[0]: the mask is left out: segmentation.counts: " in said.err
    assert said.out.startswith("24 of 24 keypoints: ")


def test_keypoints_that_were_not_found_are_counted(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flat = np.column_stack([POINTS_2D, np.full(24, 0.4)])
    flat[[3, 20], :2] = 0
    found, model = folder / "found.json", folder / "model.keypoints.json"
    found.write_text(json.dumps([{"image_id": 1, "keypoints": flat.ravel().tolist()}]))
    text = "2 of 24 keypoints are not found and left out (rows 3, 20)"
    assert observe(folder, "--image", str(folder / "photo.jpg")) == 0
    said = capsys.readouterr()
    assert said.out.startswith("22 of 24 keypoints: ")
    assert text in said.err
    (folder / "K.json").write_text(json.dumps(TRUE.to_dict()))
    camera = ["--camera", str(folder / "K.json")]
    assert main(["fit", str(found), "--model", str(model), *camera, "--no-picture"]) == 0
    assert text in (folder / "found_fit" / "results.csv").read_text()


def test_messages_name_keypoints_as_the_file_does(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Keypoints before the wrong one are left out; without names, it is row 9 of the file."""
    pixels = POINTS_2D.copy()
    pixels[[2, 5]] = 0
    pixels[9] += 80
    keypoints = [
        {"name": name, "xyz": xyz, "uv": uv}
        for name, xyz, uv in zip(NAMES, POINTS_3D.tolist(), pixels.tolist(), strict=True)
    ]
    for is_named, called in ((True, "'corner 9'"), (False, "9")):
        kept = [
            {field: value for field, value in each.items() if is_named or field != "name"}
            for each in keypoints
        ]
        data = {"camera": TRUE.to_dict(), "keypoints": kept}
        (folder / "seen.json").write_text(json.dumps(data))
        assert main(["fit", str(folder / "seen.json"), "--no-picture"]) == 0
        assert f"keypoint {called} (" in capsys.readouterr().out


def test_keypoints_and_mesh_of_different_units_are_refused_by_observe_and_fit(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, path = mesh_of_keypoints(folder), folder / "model.keypoints.json"
    for keypoint in data["keypoints"]:
        keypoint["xyz"] = [1000 * value for value in keypoint["xyz"]]
    path.write_text(json.dumps(data))
    photo = ["--image", str(folder / "photo.jpg")]
    line = refusal_line(capsys, "observe", str(folder / "found.json"), str(path), *photo)
    assert line.startswith(f"{path}: keypoints.xyz: the keypoints span ")
    assert line.endswith("multiply the keypoints by 0.001")
    seen = Observation(1000 * POINTS_3D, POINTS_2D, TRUE, model=folder / "model.obj")
    seen.save(folder / "seen.json")
    line = refusal_line(capsys, "fit", str(folder / "seen.json"), "--no-picture")
    assert line.startswith(f"{folder / 'seen.json'}: keypoints.xyz: the keypoints span ")
    assert line.endswith("multiply the keypoints by 0.001")
