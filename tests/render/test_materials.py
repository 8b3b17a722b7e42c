"""Rendered colours of files with every kind of material."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from support.renderers import renderer_or_skip
from trimesh.visual.material import PBRMaterial

from cadalign import Camera
from cadalign.datasets import load_mesh
from cadalign.render import Scene, frame_object, look_at, make_renderer

CAMERA = Camera.from_fov(320, 240, fov_x=45)


@pytest.fixture(params=["raycast", "open3d", "pyrender"])
def renderer(request):
    return renderer_or_skip(request.param)


def _plain(color):
    return PBRMaterial(baseColorFactor=color, metallicFactor=0.0, roughnessFactor=0.8)


def write_glass_glb(path: Path) -> Path:
    """An orange ball in a bluish glass box, whose floor is a textured tile."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    ball.visual = trimesh.visual.TextureVisuals(material=_plain([250, 130, 20, 255]))
    box = trimesh.creation.box((1.6, 1.6, 1.6))
    glass = PBRMaterial(baseColorFactor=[120, 170, 255, 70], alphaMode="BLEND")
    box.visual = trimesh.visual.TextureVisuals(material=glass)
    floor = trimesh.Trimesh(
        [[-1, -0.85, 1], [1, -0.85, 1], [1, -0.85, -1], [-1, -0.85, -1]],
        [[0, 1, 2], [0, 2, 3]],
        process=False,
    )
    tiles = np.kron(np.indices((6, 6)).sum(axis=0) % 2, np.ones((8, 8)))
    image = np.where(tiles[:, :, None] > 0, (235, 235, 235), (60, 60, 60)).astype(np.uint8)
    floor.visual = trimesh.visual.TextureVisuals(
        uv=np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]),
        material=PBRMaterial(baseColorTexture=Image.fromarray(image), metallicFactor=0.0),
    )
    trimesh.Scene({"ball": ball, "box": box, "floor": floor}).export(path)
    return path


def _drawn(renderer, path, *, azimuth=30.0, elevation=20.0):
    scene = Scene(load_mesh(path))
    rotation = look_at(azimuth=azimuth, elevation=elevation, distance=3).rotation
    pose = frame_object(scene.bounds, CAMERA, rotation=rotation, fill=0.9)
    return scene, pose, renderer.render(scene, CAMERA, pose)


def _color_at(frame, pose, point):
    """The colour around where a model point is seen, (3,) int."""
    column, row = np.rint(CAMERA.project(pose.apply([point]))[0]).astype(int)
    part = frame.color[row - 1 : row + 2, column - 1 : column + 2]
    assert (part[:, :, 3] == 255).all()
    return part[:, :, :3].reshape(-1, 3).mean(axis=0)


def test_objects_behind_glass_are_visible(renderer, tmp_path):
    scene, pose, frame = _drawn(renderer, write_glass_glb(tmp_path / "glass.glb"))
    assert not scene.surface.opaque
    ball = _color_at(frame, pose, (0.1, 0.2, 0.4))
    assert ball[0] > ball[2] + 20
    corner = _color_at(frame, pose, (0.8, -0.7, 0.8))
    assert corner[2] >= corner[0]


@pytest.mark.long
def test_renderers_agree_on_real_models(renderer):
    data = os.environ.get("CADALIGN_DATA")
    if not data:
        pytest.skip("set CADALIGN_DATA to the real data")
    paths = sorted(Path(data, "keypointnet", "models").glob("*/*/models/model_normalized.obj"))
    assert len(paths) == 10
    truth = make_renderer("raycast")
    for path in paths:
        scene, pose, frame = _drawn(renderer, path)
        expected = truth.render(scene, CAMERA, pose)
        both = (frame.color[:, :, 3] == 255) & (expected.color[:, :, 3] == 255)
        assert both.sum() > 500
        difference = frame.color[both][:, :3].astype(int) - expected.color[both][:, :3]
        # OpenGL's lights have no size, and it filters textures differently.
        assert np.abs(difference).mean() < 20, path
