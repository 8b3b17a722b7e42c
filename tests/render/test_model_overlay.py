"""The placed model over its photo: silhouette, opacity, lines, box, axes, and refusals."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import trimesh

from cadalign import Camera, Mesh, datasets
from cadalign.errors import InputError
from cadalign.render import (
    OverlayStyle,
    Scene,
    cast_geometry,
    feature_lines,
    look_at,
    overlay_model,
)
from cadalign.render.drawing.canvas import linear_from_bytes
from cadalign.render.drawing.overlay import AXIS_COLORS, EST_COLOR

pytestmark = pytest.mark.long

CAMERA = Camera.from_fov(640, 480, fov_x=50)
BENT = Camera(640, 480, 600.0, 600.0, 319.5, 239.5, (-0.25, 0.05, 0, 0))
POSE = look_at(azimuth=35, elevation=30, distance=5, scale=(1, 1.8, 0.6))
BARE = {"lines": False, "box": False, "axes": False}


def chair():
    """A seat, a back and a leg."""
    parts = [
        trimesh.creation.box((1, 0.2, 1)),
        trimesh.creation.box((1, 0.8, 0.1)).apply_translation((0, 0.5, -0.45)),
        trimesh.creation.cylinder(0.1, 0.8).apply_translation((0.1, -0.1, -0.3)),
    ]
    whole = trimesh.util.concatenate(parts)
    return Mesh(np.asarray(whole.vertices), np.asarray(whole.faces))


MESH = chair()


def plain(camera, value):
    return np.full((camera.height, camera.width, 3), value, dtype=np.uint8)


def cover_of(camera, mesh, pose, *, opacity=1.0):
    """Share of each pixel that the shaded model covers: what shows on white and not on black."""
    style = OverlayStyle(opacity=opacity, **BARE)
    black, white = (
        linear_from_bytes(overlay_model(plain(camera, value), camera, mesh, pose, style=style))
        for value in (0, 255)
    )
    return 1 - (white - black).mean(axis=2)


def iou(first, second):
    return (first & second).sum() / (first | second).sum()


def has_color(image, color):
    return (np.abs(image.astype(int) - color) <= 60).all(axis=2)


@pytest.mark.parametrize("camera", [CAMERA, BENT])
def test_the_shaded_silhouette_is_that_of_ray_casting(camera):
    mask = cast_geometry(Scene(MESH), camera, POSE).mask
    assert iou(cover_of(camera, MESH, POSE) > 0.5, mask) >= 0.99


@pytest.mark.parametrize("opacity", [0.0, 0.3, 1.0])
def test_the_opacity_is_the_share_of_the_model(opacity):
    mask = cast_geometry(Scene(MESH), CAMERA, POSE).mask
    cover = cover_of(CAMERA, MESH, POSE, opacity=opacity)
    assert np.median(cover[mask]) == pytest.approx(opacity, abs=0.01)
    assert np.median(cover[~mask]) == pytest.approx(0, abs=0.01)


def test_lines_lie_on_outline_and_creases():
    style = OverlayStyle("lines", box=False, axes=False)
    drawn = overlay_model(plain(CAMERA, 0), CAMERA, MESH, POSE, style=style)
    lines = feature_lines(cast_geometry(Scene(MESH), CAMERA, POSE))
    assert iou(drawn[:, :, 0] > 60, lines) > 0.95


def test_box_and_axes_are_drawn_where_they_are_asked_for():
    def drawn(**style):
        picture = overlay_model(plain(CAMERA, 0), CAMERA, MESH, POSE,
                                style=OverlayStyle("box", **style))  # fmt: skip
        return [bool(has_color(picture, color).any()) for color in (EST_COLOR, *AXIS_COLORS)]

    assert drawn() == [True] * 4
    assert drawn(axes=False) == [True, False, False, False]
    axes = overlay_model(plain(CAMERA, 0), CAMERA, MESH, POSE,
                         style=OverlayStyle("lines", lines=False, box=False))  # fmt: skip
    assert all(has_color(axes, color).any() for color in AXIS_COLORS)


def test_what_is_no_style_is_refused():
    with pytest.raises(InputError, match=r"mode: unknown mode 'solid'; known are shaded"):
        OverlayStyle("solid")
    with pytest.raises(InputError, match=r"opacity: 1.5 is not from 0 to 1"):
        OverlayStyle(opacity=1.5)
    with pytest.raises(InputError, match="the camera's image"):
        overlay_model(np.zeros((4, 4, 3), np.uint8), CAMERA, MESH, POSE)


def test_true_models_of_real_photos_cover_their_masks():
    """The drawn silhouette of every placed model is its ray-cast one."""
    data = os.environ.get("CADALIGN_DATA")
    if data is None:
        pytest.skip("CADALIGN_DATA is not set: no real data to test on")
    source = datasets.open(Path(data) / "real" / "scan2cad")
    for photo in [next(iter(source))]:
        for each in photo.objects:
            pose = each.truth.cam_from_model
            mesh = each.model.load_mesh()
            mask = cast_geometry(Scene(mesh), photo.camera, pose).mask
            if mask.sum() < 500:
                continue
            assert iou(cover_of(photo.camera, mesh, pose) > 0.5, mask) >= 0.97
