"""The placed model over its photo: silhouette, opacity, box, axes, and refusals."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import trimesh

from cadalign import Camera, Mesh, datasets
from cadalign.errors import InputError
from cadalign.render import (
    Scene,
    cast_geometry,
    look_at,
    overlay_model,
)
from cadalign.render.drawing.canvas import linear_from_bytes
from cadalign.render.drawing.overlay import AXIS_COLORS, EST_COLOR

pytestmark = pytest.mark.long

CAMERA = Camera.from_fov(640, 480, fov_x=50)
BENT = Camera(640, 480, 600.0, 600.0, 319.5, 239.5, (-0.25, 0.05, 0, 0))
POSE = look_at(azimuth=35, elevation=30, distance=5, scale=(1, 1.8, 0.6))


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


def cover_of(camera, mesh, pose):
    """Share of each pixel that the shaded model covers: what shows on white and not on black."""
    black, white = (
        linear_from_bytes(overlay_model(plain(camera, value), camera, mesh, pose))
        for value in (0, 255)
    )
    return 1 - (white - black).mean(axis=2)


def has_color(image, color):
    return (np.abs(image.astype(int) - color) <= 60).all(axis=2)


@pytest.mark.parametrize("camera", [CAMERA, BENT])
def test_the_shaded_silhouette_is_that_of_ray_casting(camera):
    mask = cast_geometry(Scene(MESH), camera, POSE).mask
    covered = cover_of(camera, MESH, POSE) > 0.3
    assert (covered & mask).sum() >= 0.99 * mask.sum()


def test_the_model_covers_its_share_and_box_and_axes_are_drawn():
    mask = cast_geometry(Scene(MESH), CAMERA, POSE).mask
    assert np.median(cover_of(CAMERA, MESH, POSE)[mask]) == pytest.approx(0.6, abs=0.01)
    picture = overlay_model(plain(CAMERA, 0), CAMERA, MESH, POSE)
    for color in (EST_COLOR, *AXIS_COLORS):
        assert has_color(picture, color).any()
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
            covered = cover_of(photo.camera, mesh, pose) > 0.3
            assert (covered & mask).sum() >= 0.97 * mask.sum()
