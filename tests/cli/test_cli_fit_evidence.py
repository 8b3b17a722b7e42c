"""`cadalign fit` with several views and evidence beyond keypoints: numbers, table, pictures."""

from __future__ import annotations

import json
import sys
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image
from support.refusals import refusal_line
from support.scenes import CAMERA, around, in_camera, keypoints, truth_of

from cadalign import Alignment, Camera, Model, Result, Size, View, align
from cadalign.cli import main
from cadalign.datasets import load_mesh
from cadalign.io.evidence import ImageEvidence, ObservedImage
from cadalign.io.observation import Observation
from cadalign.render import Scene, cast_geometry
from cadalign.render.overlay import EST_COLOR

POINTS = keypoints()
CONTOUR_COLOR = (70, 190, 250)
TRUTH = truth_of()
UP = TRUTH.rotation[:, 1]


def observed(angle: float = 0.0, rows: slice = slice(None), **evidence: Any) -> ObservedImage:
    """An image of keypoints from an angle around the object, with 0.5 px of noise."""
    noise = np.random.default_rng(int(angle)).normal(0, 0.5, POINTS.shape[:1] + (2,))
    pixels = CAMERA.project(in_camera(POINTS, TRUTH, around(angle))) + noise
    ids = np.arange(len(POINTS))[rows]
    return ObservedImage(
        POINTS[rows], pixels[rows], CAMERA, ids=ids, evidence=ImageEvidence(**evidence)
    )


def write(folder: Path, *images: ObservedImage, **fields: Any) -> Path:
    first, *others = images
    Observation(**vars(first), others=tuple(others), **fields).save(folder / "a.json")
    return folder / "a.json"


def result_in(folder: Path) -> Result:
    return Result.from_dict(json.loads((folder / "a_fit" / "fit.json").read_text()))


def test_gravity_and_size_are_used_as_by_align(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    height = float(np.ptp(POINTS[:, 1]) * TRUTH.scale[1])
    path = write(tmp_path, observed(up=UP, up_sigma_deg=2.0), size=Size(height=height))
    assert main(["fit", str(path)]) == 0
    view = View(CAMERA, observed().points_2d, up=UP, up_sigma_deg=2.0)
    expected = align(Model(points_3d=POINTS), view, size=Size(height=height))
    assert result_in(tmp_path).alignment == expected.alignment
    assert capsys.readouterr().out == f"{expected}\n"
    names = [each.name for each in expected.evidence]
    assert names == ["views[0].points_2d", "views[0].up", "size"]
    assert all(f"  evidence     {each}\n" in f"{expected}\n" for each in expected.evidence)
    assert str(expected.evidence[-1]) == "size: sets the unit of lengths"


@pytest.mark.slow
def test_views_of_a_rig_share_the_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    places = (0.0, 20.0, 40.0)
    rows = (slice(0, 6), slice(3, 9), slice(9, 10))
    images = [
        observed(angle, row, cam_from_rig=around(angle))
        for angle, row in zip(places, rows, strict=True)
    ]
    path = write(tmp_path, *images)
    assert main(["fit", str(path), "--sigma", "0.5"]) == 0
    found = result_in(tmp_path)
    views = [
        View(CAMERA, image.points_2d, ids=range(10)[row], sigma=0.5, cam_from_rig=around(angle))
        for image, angle, row in zip(images, places, rows, strict=True)
    ]
    assert found.alignment == align(Model(points_3d=POINTS), views).alignment
    np.testing.assert_allclose(found.alignment.scale, TRUTH.scale, rtol=0.03)
    names = ["overlay.png", "overlay_1.png", "overlay_2.png"]
    assert sorted(each.name for each in (tmp_path / "a_fit").iterdir()) == ["fit.json", *names]
    pictures = [cv2.imread(str(tmp_path / "a_fit" / name)) for name in names]
    for picture in pictures:
        assert picture is not None
        near = np.abs(picture[..., ::-1].astype(int) - EST_COLOR).max(axis=2) < 40
        assert near.sum() > 20
    assert (pictures[0] != pictures[1]).any()
    captured = capsys.readouterr()
    assert "evidence     views[2].points_2d: rms " in captured.out
    assert f"Pictures: {tmp_path / 'a_fit' / 'overlay.png'}, " in captured.err


def test_keypoints_without_ids_are_the_same_at_the_same_point(tmp_path: Path) -> None:
    images = [replace(observed(angle), ids=None) for angle in (0.0, 25.0)]
    images[1] = replace(
        images[1], points_3d=images[1].points_3d[::-1], points_2d=images[1].points_2d[::-1]
    )
    assert main(["fit", str(write(tmp_path, *images))]) == 0
    views = [View(CAMERA, observed(angle).points_2d) for angle in (0.0, 25.0)]
    expected = align(Model(points_3d=POINTS), views).alignment
    found = result_in(tmp_path).alignment
    np.testing.assert_allclose(found.rotation, expected.rotation, atol=1e-6)
    np.testing.assert_allclose(found.scale, expected.scale, rtol=1e-6)


def drop_focal(path: Path) -> Path:
    """Remove the focal lengths from the cameras of a file."""
    data = json.loads(path.read_text())
    for image in data.get("views", [data]):
        image["camera"] = {"width": 640, "height": 480}
    path.write_text(json.dumps(data))
    return path


def test_unknown_focal_length_of_two_views_is_estimated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = drop_focal(write(tmp_path, observed(0.0), observed(25.0)))
    assert main(["fit", str(path)]) == 0
    unknown = Camera.from_size(640, 480)
    views = [View(unknown, observed(angle).points_2d) for angle in (0.0, 25.0)]
    expected = align(Model(points_3d=POINTS), views, focal="estimate")
    found = result_in(tmp_path)
    assert found.cameras == expected.cameras
    assert found.alignment == expected.alignment
    assert found.std is not None
    assert abs(np.log(found.camera.fx / CAMERA.fx)) < 4 * found.std.focal
    assert capsys.readouterr().out == f"{expected}\n"


def test_prior_of_the_photo_is_used(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photo = tmp_path / "photo.jpg"
    exif = Image.Exif()
    exif[0x8769] = {0xA405: 28}  # focal length in 35 mm film
    Image.new("RGB", (640, 480)).save(photo, exif=exif)
    images = [replace(observed(turn), image=photo) for turn in (0.0, 25.0)]
    path = drop_focal(write(tmp_path, *images))
    assert main(["fit", str(path), "--no-picture"]) == 0
    assert "+- 5 %, the photo's EXIF data" in capsys.readouterr().err
    path.write_text(json.dumps(json.loads(path.read_text()) | {"fit": {"focal_prior": "usual"}}))
    assert main(["fit", str(path), "--no-picture"]) == 0
    assert "EXIF" not in capsys.readouterr().err


def write_box(folder: Path, truth: Alignment) -> np.ndarray:
    """Write box.obj and the mask.png of its pose; returns its corners (8, 3)."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float) - 0.5
    quads = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
    lines = [f"v {x} {y} {z}" for x, y, z in corners]
    lines += [f"f {a} {b} {c} {d}" for a, b, c, d in quads]
    (folder / "box.obj").write_text("\n".join(lines) + "\n")
    mask = cast_geometry(Scene(load_mesh(folder / "box.obj")), CAMERA, truth).mask
    cv2.imwrite(str(folder / "mask.png"), np.where(mask, 255, 0).astype(np.uint8))
    return corners


def _note_opened(opened: list[str], folder: str, event: str, arguments: Any) -> None:
    # open() calls os.open(), for which the mode is None.
    is_first = event == "open" and arguments[1] is not None
    if is_first and str(arguments[0]).startswith(folder):
        opened.append(str(arguments[0]))


def test_every_file_is_read_once(tmp_path: Path) -> None:
    write_box(tmp_path, TRUTH)
    cv2.imwrite(str(tmp_path / "photo.png"), np.full((480, 640, 3), 90, dtype=np.uint8))
    seen = replace(observed(), image=tmp_path / "photo.png")
    path = write(tmp_path, seen, model=tmp_path / "box.obj")
    opened: list[str] = []
    sys.addaudithook(partial(_note_opened, opened, str(tmp_path)))
    assert main(["fit", str(path), "--out", str(tmp_path / "out")]) == 0
    counts = Counter(Path(each).name for each in opened)
    assert counts["a.json"] == counts["box.obj"] == counts["photo.png"] == 1


def test_mask_is_drawn_and_an_inverted_one_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = truth_of((1.0, 0.7, 1.5))
    corners = write_box(tmp_path, truth)
    inverted = 255 - cv2.imread(str(tmp_path / "mask.png"), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(tmp_path / "mask.png"), inverted)
    inner = corners.mean(axis=0) + 0.9 * (corners - corners.mean(axis=0))
    evidence = ImageEvidence(mask=tmp_path / "mask.png")
    seen = ObservedImage(inner, CAMERA.project(truth.apply(inner)), CAMERA, evidence=evidence)
    assert main(["fit", str(write(tmp_path, seen, model=tmp_path / "box.obj"))]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "8 of 8 keypoints lie off it: it may be inverted, or another object's" in said
    picture = cv2.imread(str(tmp_path / "a_fit" / "overlay.png"))
    assert (np.abs(picture[..., ::-1].astype(int) - CONTOUR_COLOR).max(axis=2) < 40).sum() > 100


def test_mask_alone_is_an_observation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = truth_of((1.0, 0.7, 1.5))
    write_box(tmp_path, truth)
    nothing, evidence = np.empty((0, 3)), ImageEvidence(mask=tmp_path / "mask.png")
    image = ObservedImage(nothing, nothing[:, :2], CAMERA, evidence=evidence)
    path = write(tmp_path, image, model=tmp_path / "box.obj")
    assert main(["fit", str(path), "--no-picture"]) == 0
    assert "  evidence     views[0].mask: rms " in capsys.readouterr().out
    found = result_in(tmp_path).alignment
    shown, expected = (
        cast_geometry(Scene(load_mesh(tmp_path / "box.obj")), CAMERA, pose).mask
        for pose in (found, truth)
    )
    assert (shown & expected).sum() > 0.95 * (shown | expected).sum()


def test_photo_is_evidence_where_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_box(tmp_path, TRUTH)
    mask = cv2.imread(str(tmp_path / "mask.png"), cv2.IMREAD_GRAYSCALE)[:, :, None]
    photo = np.where(mask > 0, [200, 60, 40], [60, 90, 160]).astype(np.uint8)
    Image.fromarray(photo).save(tmp_path / "photo.png")
    seen = replace(observed(), image=tmp_path / "photo.png")
    for asked, flags, stored in (
        (False, [], {}),
        (True, ["--use-photo"], {}),
        (True, [], {"image": True}),
    ):
        path = write(tmp_path, seen, model=tmp_path / "box.obj", fit_options=stored)
        assert main(["fit", str(path), "--no-picture", *flags]) == 0
        kinds = [each.kind for each in result_in(tmp_path).evidence]
        assert kinds == ["keypoints", *(["photo"] if asked else [])]
    capsys.readouterr()
    path = write(tmp_path, observed(), model=tmp_path / "box.obj")
    line = refusal_line(capsys, "fit", str(path), "--use-photo")
    assert "--use-photo: the observation names no photo" in line


# --- refusals ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("second", "text"),
    [
        ({"mask": "mask.png"}, "mask: the mask is 8 x 6, the camera 640 x 480; "),
        ({"cam_from_rig": 2 * np.eye(4)}, "cam_from_rig: not a rigid motion; "),
        ({}, "cam_from_rig: only some views have a known pose"),
    ],
)
def test_evidence_of_a_view_is_refused_by_its_field(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], second: dict[str, Any], text: str
) -> None:
    cv2.imwrite(str(tmp_path / "mask.png"), np.full((6, 8), 255, dtype=np.uint8))
    if "mask" in second:
        second = {"mask": tmp_path / "mask.png", "cam_from_rig": np.eye(4)}
    path = write(tmp_path, observed(cam_from_rig=np.eye(4)), observed(25.0, **second))
    assert refusal_line(capsys, "fit", path).startswith(f"{path}: views[1].{text}")


def test_one_keypoint_at_two_points_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    moved = replace(observed(25.0), points_3d=POINTS + [[0, 0, 1e-3]])
    path = write(tmp_path, observed(), moved)
    assert refusal_line(capsys, "fit", path) == (
        f"{path}: views[1].keypoints[0].xyz: differs from the xyz of keypoint 0 in an earlier "
        "view; give the same xyz in all views"
    )


def test_options_without_effect_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path, observed(up=UP))
    refusal = (
        "--method: has no effect together with evidence beyond the keypoints of one image; "
        "leave out one of the two"
    )
    assert refusal_line(capsys, "fit", path, "--method", "aepnp") == refusal
    path = write(tmp_path, observed())
    path.write_text(json.dumps(json.loads(path.read_text()) | {"fit": {"image": True}}))
    assert refusal_line(capsys, "fit", path, "--method", "aepnp") == refusal
