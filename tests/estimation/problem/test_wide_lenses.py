"""Estimates with fisheye lenses: objects beside and behind the camera's plane too."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.stats import chi2

from cadalign import (
    Alignment,
    Camera,
    Mesh,
    Model,
    RansacOptions,
    Result,
    ShapeModel,
    View,
    align,
    fit,
    fit_batch,
)
from cadalign.annotate.photos import PhotoFile, camera_of
from cadalign.errors import DataError
from cadalign.geometry.rotations import rotation_from_vector, vector_from_rotation
from cadalign.render import Scene, cast_geometry

FISHEYE = Camera(
    1000, 1000, 280.0, 285.0, 499.5, 498.0, (0.01, -0.003, 0.0005, 0.0), lens="fisheye"
)
NARROWER = Camera(1000, 1000, 280.0, 285.0, 499.5, 498.0, (-0.03, 0.002, 0.0, 0.0), lens="fisheye")
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
_FREE = [0, 1, 2, 3, 4, 5, 7, 8]


def towards(angle: float, *, distance: float = 5.0, about: float = 1.0) -> np.ndarray:
    """The position at an angle from the optical axis [degrees]."""
    theta = np.radians(angle)
    across = np.sin(theta) * np.array([np.cos(about), np.sin(about)])
    return distance * np.append(across, np.cos(theta))


def placed(angle: float, seed: int = 0, scale: tuple[float, ...] = (1, 1.2, 0.8)) -> Alignment:
    turn = rotation_from_vector(np.random.default_rng(seed).normal(size=3))
    return Alignment(turn, towards(angle), scale)


def points_of(seed: int, count: int = 20) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (count, 3))


def errors_of(result: Result, truth: Alignment) -> np.ndarray:
    """Errors (9,) in the order of a result's covariance."""
    turn = vector_from_rotation(result.alignment.rotation @ truth.rotation.T)
    shift = result.alignment.translation - truth.translation
    return np.concatenate([turn, shift, np.log(result.alignment.scale / truth.scale)])


def degrees_off(result: Result, truth: Alignment) -> float:
    return float(np.degrees(np.linalg.norm(errors_of(result, truth)[:3])))


@pytest.mark.parametrize("angle", [0, 70, 90, 110])
@pytest.mark.parametrize("camera", [FISHEYE, NARROWER], ids=["fisheye", "narrower"])
def test_fit_recovers_exact_keypoints(camera: Camera, angle: float) -> None:
    points, truth = points_of(1), placed(angle)
    pixels = camera.project(truth.apply(points))
    for method in ("optimal", "aepnp", "aepnp-paper"):
        result = fit(points, pixels, camera, method=method)
        np.testing.assert_allclose(errors_of(result, truth), 0, atol=1e-6)
        assert result.camera == camera
        assert result.rms < 1e-6


def test_the_projection_of_a_fisheye_with_a_narrow_field_is_a_pinholes_estimate() -> None:
    """With equal noise of rays, pinhole and fisheye have equal covariances."""
    points, truth = points_of(2), placed(10)
    pinhole = Camera(1000, 1000, 280, 280, 499.5, 499.5)
    wide = Camera(1000, 1000, 280, 280, 499.5, 499.5, lens="fisheye")
    noisy = pinhole.project(truth.apply(points)) + np.random.default_rng(0).normal(size=(20, 2))
    rays = pinhole.unproject(noisy)
    slopes = wide.projection_slopes(rays)[:, :, :2]  # of pixels by (u, v), at other depths
    to_wide = slopes * rays[:, 2, None, None] / 280
    covariances = to_wide @ to_wide.swapaxes(1, 2)
    first = fit(points, noisy, pinhole)
    second = fit(points, wide.project(rays), wide, sigma=covariances)
    np.testing.assert_allclose(errors_of(second, first.alignment), 0, atol=1e-4)
    assert first.covariance is not None
    assert second.covariance is not None
    np.testing.assert_allclose(second.covariance, first.covariance, rtol=0.05, atol=1e-4)


def test_a_batch_is_each_fit() -> None:
    cameras = [FISHEYE, NARROWER, Camera(640, 480, 500, 500, 319.5, 239.5)]
    angles = [95, 60, 3]
    points = [points_of(seed) for seed in range(3)]
    rng = np.random.default_rng(0)
    pixels = [
        camera.project(placed(angle).apply(own)) + rng.normal(size=(20, 2))
        for camera, angle, own in zip(cameras, angles, points, strict=True)
    ]
    batch = fit_batch(points, pixels, cameras)
    for k, own in enumerate(batch):
        single = fit(points[k], pixels[k], cameras[k])
        np.testing.assert_array_equal(own.alignment.vector, single.alignment.vector)
        np.testing.assert_allclose(batch.rotation[k], single.alignment.rotation)
        assert own.covariance is not None
        assert single.covariance is not None
        np.testing.assert_allclose(own.covariance, single.covariance)


def test_robust_fit_rejects_keypoints_all_over_the_field() -> None:
    points, truth = points_of(3, 30), placed(95)
    rng = np.random.default_rng(1)
    pixels = FISHEYE.project(truth.apply(points)) + rng.normal(size=(30, 2))
    pixels[:12] = rng.uniform(150, 850, (12, 2))
    result = fit(points, pixels, FISHEYE, ransac=RansacOptions(max_reproj_error=5.0))
    assert result.inliers[12:].all()
    assert result.inliers[:12].sum() <= 1
    assert degrees_off(result, truth) < 2
    np.testing.assert_allclose(
        result.residuals, FISHEYE.project(result.alignment.apply(points)) - pixels
    )


def view_of(camera: Camera, points: np.ndarray, seed: int, **more: object) -> View:
    noise = np.random.default_rng(seed).normal(size=(len(points), 2))
    return View(camera, camera.project(points) + noise, **more)


@pytest.mark.parametrize("angle", [30, 98])
def test_align_exact_similar_and_learned_shapes(angle: float) -> None:
    truth = placed(angle, scale=(1, 1, 1))
    points = np.concatenate([CORNERS, points_of(5, 8)])
    view = view_of(FISHEYE, truth.apply(points), 0)
    models = (
        Model(points_3d=points),
        Model(points_3d=points, shape_sigma=0.02),
        ShapeModel.from_basis(points, [points * [1, 0, 0], points * [0, 1, 0]], [0.1, 0.1]),
    )
    for model in models:
        result = align(model, view)
        assert degrees_off(result, truth) < 3
        assert result.camera == FISHEYE
        errors = errors_of(result, truth)[:6]
        square = errors @ np.linalg.solve(result.covariance[:6, :6], errors)
        assert square < 22.5  # 99.9 %
        assert result.rms < 2
        again = Result.from_dict(result.to_dict())
        assert again.camera == FISHEYE
        np.testing.assert_allclose(again.alignment.vector, result.alignment.vector)


def test_robust_alignment_of_a_learned_shape() -> None:
    truth = placed(95, scale=(1, 1, 1))
    points = np.concatenate([CORNERS, points_of(5, 12)])
    clean = view_of(FISHEYE, truth.apply(points), 0)
    pixels = np.array(clean.points_2d)
    pixels[:4] = [[150, 500], [850, 480], [500, 200], [480, 800]]
    model = ShapeModel.from_basis(points, [points * [1, 0, 0], points * [0, 1, 0]], [0.1, 0.1])
    result = align(model, replace(clean, points_2d=pixels), ransac=RansacOptions())
    assert not result.inliers[:4].any()
    assert result.inliers[4:].sum() >= 14
    assert degrees_off(result, truth) < 4


def motion(turn: tuple[float, float, float], shift: tuple[float, float, float]) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation_from_vector(np.array(turn)), shift
    return matrix


@pytest.mark.parametrize("is_known", [True, False], ids=["known motion", "unknown motion"])
def test_several_views_of_wide_lenses_and_pinholes(is_known: bool) -> None:
    truth, points = placed(95), points_of(4, 14)
    in_rig = truth.apply(points)
    pinhole = Camera(1000, 800, 700, 700, 499.5, 399.5)
    look = -towards(95)
    look = -look / np.linalg.norm(look)
    across = np.cross([0, 1, 0], look)
    across /= np.linalg.norm(across)
    facing = np.eye(4)
    facing[:3, :3] = [across, np.cross(look, across), look]
    facing[:3, 3] = [0.3, 0.1, 0.5]
    rigs = [np.eye(4), motion((0.2, -0.4, 0.1), (1.0, 0.2, 0.0)), facing]
    cameras = [FISHEYE, NARROWER, pinhole]
    views = [
        view_of(
            camera,
            in_rig @ rig[:3, :3].T + rig[:3, 3],
            number,
            cam_from_rig=rig if is_known else None,
        )
        for number, (camera, rig) in enumerate(zip(cameras, rigs, strict=True))
    ]
    result = align(Model(points_3d=points), views)
    assert result.cameras == tuple(cameras)
    assert degrees_off(result, truth) < 2
    for rig, pose in zip(rigs, result.poses, strict=True):
        seen = pose.apply(points)
        if is_known:
            np.testing.assert_allclose(seen, in_rig @ rig[:3, :3].T + rig[:3, 3], atol=0.1)
    if is_known:
        np.testing.assert_allclose(result.rig_from_model.apply(points), in_rig, atol=0.1)
    assert result.rms < 2
    for view, own in zip(views, result.views, strict=True):
        predicted = own.camera.project(own.alignment.apply(points))
        np.testing.assert_allclose(own.residuals, predicted - view.points_2d, atol=1e-9)


def test_gravity_is_told_in_the_lenses_frame() -> None:
    truth = placed(95)
    points = points_of(6, 6)
    view = view_of(FISHEYE, truth.apply(points), 3)
    up = truth.rotation @ [0, 1, 0]
    model = Model(points_3d=points)
    plain, told = align(model, view), align(model, replace(view, up=up, up_sigma_deg=0.1))
    assert degrees_off(told, truth) < 4
    tilt = np.degrees(np.arccos(np.clip(told.alignment.rotation @ [0, 1, 0] @ up, -1, 1)))
    assert tilt < 0.4
    assert told.std.rotation_deg < plain.std.rotation_deg


def test_a_start_is_given_in_the_lenses_frame() -> None:
    truth = placed(95, scale=(1, 1, 1))
    points = np.concatenate([CORNERS, points_of(5, 8)])
    model = Model(points_3d=points, shape_sigma=0.02)
    view = view_of(FISHEYE, truth.apply(points), 0)
    assert degrees_off(align(model, view, init=truth), truth) < 3


def test_misfit_and_warnings_are_those_of_pixels() -> None:
    truth, points = placed(95), points_of(4, 12)
    pixels = np.array(view_of(FISHEYE, truth.apply(points), 0).points_2d)
    pixels[3] += [40, -30]
    result = fit(points, pixels, FISHEYE)
    assert [each.keypoints for each in result.warnings if each.kind == "outlier"] == [(3,)]


class TestPictures:
    """Masks, photos and depths of a body without symmetry, through a fisheye."""

    CAMERA = Camera(480, 480, 140.0, 140.0, 239.5, 239.5, (0.01, -0.003, 0.0, 0.0), lens="fisheye")

    def seen(self, angle: float, *names: str, keypoints: bool = True) -> tuple[View, Alignment]:
        """A view of the body with one kind of evidence, and its pose."""
        rng = np.random.default_rng(3)
        truth = Alignment(placed(angle, 4).rotation, towards(angle, distance=2.5), (1, 1.2, 0.8))
        frame = cast_geometry(Scene(self.mesh()), self.CAMERA, truth)
        mask = frame.mask
        rows, columns = np.nonzero(mask)
        rays = self.CAMERA.unproject(np.stack([columns, rows], axis=1).astype(float))
        given: dict[str, Any] = {}
        if "mask" in names:
            given["mask"] = mask
        if "image" in names:
            colors = np.where(mask[..., None], [190, 120, 60], [60, 90, 140])
            photo = colors + rng.normal(0, 12, colors.shape)
            given["image"] = photo.clip(0, 255).astype(np.uint8)
        if "depth" in names:
            given["depth"] = np.full(mask.shape, np.nan)
            noise = 1 + 0.005 * rng.normal(size=len(rows))
            given["depth"][rows, columns] = frame.depth[rows, columns] * rays[:, 2] * noise
            given["depth"][given["depth"] <= 0] = np.nan
            given["depth_sigma"] = 0.005
        if keypoints:
            pixels = self.CAMERA.project(truth.apply(self.mesh().vertices))
            given["points_2d"] = pixels + rng.normal(size=pixels.shape)
        return View(self.CAMERA, **given), truth

    @staticmethod
    @cache  # silhouettes are known by the mesh
    def mesh() -> Mesh:
        """Two blocks: a seat and a back."""
        blocks = [trimesh.creation.box([1.0, 0.2, 0.6]), trimesh.creation.box([0.3, 0.6, 0.2])]
        blocks[1].apply_translation([0.3, 0.35, -0.2])
        joined = trimesh.util.concatenate(blocks)
        return Mesh(np.asarray(joined.vertices), np.asarray(joined.faces))

    def model(self) -> Model:
        return Model(points_3d=self.mesh().vertices, mesh=self.mesh())

    @pytest.mark.parametrize("angle", [60, 100])
    @pytest.mark.parametrize("names", [["mask"], ["image"], ["mask", "depth"]], ids="+".join)
    def test_sharpen_the_estimate(self, angle: float, names: list[str]) -> None:
        if angle > 80 and "depth" in names:  # whose depths are nowhere known
            names = ["mask"]
        view, truth = self.seen(angle, *names)
        alone, _ = self.seen(angle)
        found, before = align(self.model(), view), align(self.model(), alone)
        share = 0.85 if "image" in names else 0.6
        assert found.std.rotation_deg < share * before.std.rotation_deg
        errors, covariance = errors_of(found, truth)[_FREE], found.covariance[np.ix_(_FREE, _FREE)]
        assert errors @ np.linalg.solve(covariance, errors) < chi2.ppf(0.999, 8)
        assert found.camera == self.CAMERA
        assert {each.kind for each in found.evidence} >= {names[0].replace("image", "photo")}

    def test_a_mask_alone(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(TestPictures, "CAMERA", self.CAMERA.resize(320, 320))
        view, truth = self.seen(95, "mask", keypoints=False)
        found = align(self.model(), view)
        assert degrees_off(found, truth) < 2.5 * found.std.rotation_deg < 5.0

    def test_a_mask_of_the_other_camera_of_a_rig(self) -> None:
        view, truth = self.seen(30, "mask", keypoints=False)
        pinhole = Camera(480, 480, 400, 400, 239.5, 239.5)
        motion = np.eye(4)
        motion[:3, :3] = rotation_from_vector([0.0, -np.radians(20), 0.0])
        motion[:3, 3] = [-0.3, 0.0, 0.2]
        pose = Alignment(
            motion[:3, :3] @ truth.rotation,
            motion[:3, :3] @ truth.translation + motion[:3, 3],
            truth.scale,
        )
        pixels = pinhole.project(pose.apply(self.mesh().vertices))
        views = [
            View(pinhole, pixels, cam_from_rig=motion),
            replace(view, cam_from_rig=np.eye(4)),
        ]
        found = align(self.model(), views)
        assert found.alignment.scale == pytest.approx(truth.scale, rel=0.02)

    def test_depths_at_keypoints(self) -> None:
        rng = np.random.default_rng(1)
        points, truth = points_of(1), placed(60)
        in_camera = truth.apply(points)
        pixels = FISHEYE.project(in_camera) + rng.normal(size=(20, 2))
        depth = in_camera[:, 2] * (1 + 0.005 * rng.normal(size=20))
        depth[depth < 0.3] = np.nan
        model = Model(points_3d=points, shape_sigma=0.01)
        found = align(model, View(FISHEYE, pixels, depth=depth, depth_sigma=0.005))
        assert found.std.scale[0] > 0  # the size is estimated
        assert found.alignment.scale == pytest.approx(truth.scale, abs=4 * max(found.std.scale))


def test_the_annotator_takes_no_wide_lens(tmp_path) -> None:
    fix = "undistort the photo, or crop it to a pinhole's view"
    Image.new("RGB", (1000, 1000)).save(tmp_path / "photo.png")
    with pytest.raises(
        DataError, match=rf"photo.png.*: the annotator does not support fisheye lenses; {fix}$"
    ):
        camera_of(PhotoFile.open(tmp_path / "photo.png"), NARROWER)
