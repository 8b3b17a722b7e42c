"""`align` with a depth image over the surface inside a mask."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cadalign import Alignment, Camera, Mesh, Model, View, align
from cadalign.estimation.view import without_keypoints
from cadalign.metrics import rotation_error
from cadalign.render import Scene, cast_geometry

CAMERA = Camera(640, 480, 900, 900, 319.5, 239.5)


@cache  # silhouettes are known by the mesh
def wedge() -> Mesh:
    """A box of which one side leans, so that no turn of it looks like another."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.4, 0.4) for z in (-0.3, 0.3)])
    top = corners[:, 1] > 0
    corners[top] = [0.6, 1.0, 0.8] * corners[top] + [0.2, 0.0, 0.06]
    faces = [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ]  # fmt: skip
    return Mesh(corners, np.array(faces))


def case_of(seed: int, scale: tuple[float, float, float]) -> tuple[Model, View, View, Alignment]:
    """A model, its views with keypoints alone and with mask and depth (0.5 %), and the truth."""
    rng = np.random.default_rng(seed)
    mesh = wedge()
    turn = Rotation.from_euler("yx", [rng.uniform(-40, 40), 150 + rng.uniform(-15, 15)], True)
    truth = Alignment(turn.as_matrix(), [0.1, 0.0, 4.0], scale)
    points = np.asarray(mesh.vertices)
    pixels = CAMERA.project(truth.apply(points)) + rng.normal(0, 1, (len(points), 2))
    seen = cast_geometry(Scene(mesh), CAMERA, truth)
    noise = 1 + 0.005 * rng.normal(size=seen.depth.shape)
    depth = np.where(seen.mask, seen.depth * noise, 6.0)
    model = Model(points_3d=points, mesh=mesh)
    told = {"mask": seen.mask, "depth": depth, "depth_sigma": 0.005}
    return model, View(CAMERA, pixels), View(CAMERA, pixels, **told), truth


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_depth_over_the_surface_sharpens_all_scales(seed: int) -> None:
    model, _, view, truth = case_of(seed, (1.5, 0.8, 1.2))
    result = align(model, view)
    error = np.log(result.stretch / truth.scale)
    assert np.abs(error).max() < 0.01
    depth = next(each for each in result.evidence if each.kind == "depth")
    assert depth.count > 50
    assert 0.7 < depth.rms_sigmas < 1.5
    at_keypoints = align(model, View(CAMERA, view.points_2d, depth=view.depth, depth_sigma=0.005))
    assert result.std.scale[0] < 0.7 * at_keypoints.std.scale[0]


@pytest.mark.slow
def test_contributions_tell_mask_and_depth_apart() -> None:
    model, _, view, _ = case_of(0, (1.5, 0.8, 1.2))
    result = align(model, view)
    found = {each.name: each.without for each in result.contributions()}
    assert list(found) == ["views[0].points_2d", "views[0].mask", "views[0].depth"]
    assert np.isinf(found["views[0].depth"].scale[0])
    assert not any("contradict" in text for text in result.warnings)


class TestWithoutKeypoints:
    """The outline gives the pose, the depths inside of it the size."""

    @pytest.mark.long
    @pytest.mark.parametrize("seed", [1, 2])
    def test_mask_and_depth_image(self, seed: int) -> None:
        model, _, view, truth = case_of(seed, (1.5, 0.8, 1.2))
        result = align(model, replace(without_keypoints(view), depth=view.depth))
        found = [result.alignment, *(each.alignment for each in result.alternatives)]
        assert min(rotation_error(est=each, gt=truth) for each in found) < 1.0
        error = np.log(result.stretch / truth.scale)
        assert np.abs(error).max() < 0.02
        assert {each.kind for each in result.evidence} == {"mask", "depth"}

    @pytest.mark.long
    def test_the_camera_of_a_rig(self) -> None:
        model, _, view, truth = case_of(0, (1.5, 0.8, 1.2))
        rig = np.eye(4)
        rig[:3, :3] = Rotation.from_euler("y", 40, True).as_matrix()
        rig[:3, 3] = [0.5, -0.2, 0.3]
        own = replace(without_keypoints(view), depth=view.depth, cam_from_rig=rig)
        result = align(model, own)
        assert np.abs(np.log(result.stretch / truth.scale)).max() < 0.02
        assert result.alignment.translation == pytest.approx(truth.translation, rel=0.02, abs=0.02)

    @pytest.mark.slow
    def test_photo_and_depth_image_from_a_start(self) -> None:
        model, _, view, truth = case_of(1, (1.5, 0.8, 1.2))
        colors = np.where(view.mask[..., None], [190, 120, 60], [60, 90, 140])
        noise = np.random.default_rng(0).normal(0, 12, colors.shape)
        photo = (colors + noise).clip(0, 255).astype(np.uint8)
        seen = View(CAMERA, image=photo, depth=view.depth, depth_sigma=0.005)
        near = Rotation.from_rotvec([0.04, -0.05, 0.03]).as_matrix() @ truth.rotation
        init = Alignment(near, 1.05 * truth.translation, 1.04 * truth.scale)
        result = align(model, seen, init=init)
        assert rotation_error(est=result.alignment, gt=truth) < 0.7
        assert np.abs(np.log(result.stretch / truth.scale)).max() < 0.02
        assert {each.kind for each in result.evidence} == {"photo", "depth"}
