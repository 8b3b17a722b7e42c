"""Evidence beyond keypoints: sizes, heights, depth images, few keypoints in many views."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.scenes import (
    CAMERA,
    around,
    depth_image,
    in_camera,
    keypoints,
    rig,
    seen,
    truth_of,
    turned,
)

from cadalign import Alignment, Model, ShapeModel, Size, View, align
from cadalign.estimation.estimates import estimate_box
from cadalign.estimation.options import FitOptions
from cadalign.estimation.pack import evidence_of
from cadalign.estimation.prior import Lenses, ShapePrior, prior_of, redundancy_of
from cadalign.estimation.result import Result
from cadalign.shapes.parts import BoxMargins
from cadalign.solvers.joint.evidence import Evidence, State


def box_of(points: np.ndarray, truth: Alignment) -> np.ndarray:
    """Lengths (3,) of the object's box."""
    return np.ptp(points, axis=0) * truth.scale


def height_of(points: np.ndarray, truth: Alignment) -> float:
    """Height of the camera above the plane of the object's lowest face."""
    camera = -truth.rotation.T @ truth.translation
    return float(camera[1] - truth.scale[1] * points[:, 1].min())


def similar(count: int = 12) -> ShapeModel:
    rng = np.random.default_rng(3)
    modes = rng.normal(size=(2, count, 3))
    return ShapeModel.from_basis(
        keypoints(count), modes, [0.02, 0.02], residual_sigma=1e-3, up_axis="y"
    )


@pytest.mark.parametrize("shape_sigma", [None, 0.01])
def test_the_summary_of_keypoints_has_their_residuals_in_pixels(shape_sigma: float | None) -> None:
    points, rng, views = keypoints(), np.random.default_rng(0), []
    for angle in (0, 25):
        exact = np.asarray(seen(points, truth_of(), around(angle)).points_2d)
        views.append(View(CAMERA, exact + rng.normal(0, 1, exact.shape)))
    result = align(Model(points_3d=points, shape_sigma=shape_sigma), views)
    found = [each for each in result.evidence if each.kind == "keypoints"]
    for summary, view in zip(found, result.views, strict=True):
        assert summary.unit == "px"
        lengths = np.linalg.norm(view.residuals, axis=1)
        assert summary.rms == pytest.approx(np.sqrt((lengths**2).mean()), rel=0.02)


class TestSize:
    @pytest.mark.parametrize("name", ["width", "height", "length"])
    def test_one_length_determines_all_scales(self, name: str) -> None:
        points, truth = keypoints(), truth_of()
        axis = ("width", "height", "length").index(name)
        size = Size(**{name: box_of(points, truth)[axis]})
        result = align(Model(points_3d=points), seen(points, truth, np.eye(4)), size=size)
        assert np.allclose(result.alignment.scale, truth.scale, rtol=1e-4)
        assert np.allclose(result.alignment.translation, truth.translation, rtol=1e-4)
        assert 0.009 < result.std.scale[axis] < 0.0101

    def test_three_lengths_sharpen_the_rotation(self) -> None:
        points, truth, rng = keypoints(6), truth_of(), np.random.default_rng(0)
        view = seen(points, truth, np.eye(4), rng)
        w, h, d = box_of(points, truth)
        result = align(Model(points_3d=points), view, size=Size(w, h, d, sigma=0.002))
        assert result.std.rotation_deg < align(Model(points_3d=points), view).std.rotation_deg

    def test_a_learned_shape_takes_the_size(self) -> None:
        model, truth = similar(), truth_of((2.0, 2.0, 2.0))
        points = model.components[0].mean[:-2]
        box = np.ptp(model.components[0].mean[-2:], axis=0)
        size = Size(length=2 * box[2], sigma=0.001)
        result = align(model, seen(points, truth, np.eye(4)), size=size)
        assert np.allclose(result.alignment.translation, truth.translation, rtol=0.01)


class TestCameraHeight:
    def test_it_determines_the_size(self) -> None:
        points, truth = keypoints(), truth_of()
        up = truth.rotation[:, 1]
        view = seen(points, truth, np.eye(4), up=up, camera_height=height_of(points, truth))
        result = align(Model(points_3d=points), view)
        assert np.allclose(result.alignment.scale, truth.scale, rtol=1e-4)
        assert 0.01 < result.std.scale[0] < 0.03

    def test_it_works_in_a_view_of_a_rig(self) -> None:
        points, truth = keypoints(), truth_of()
        poses = [around(0), around(40)]
        moved = Alignment(
            poses[1][:3, :3] @ truth.rotation,
            poses[1][:3, :3] @ truth.translation + poses[1][:3, 3],
            truth.scale,
        )
        height = {"camera_height": height_of(points, moved), "camera_height_sigma": 1e-3}
        views = rig(points, truth, [0])
        views.append(seen(points, truth, poses[1], cam_from_rig=poses[1], **height))
        result = align(Model(points_3d=points), views)
        assert np.allclose(result.alignment.scale, truth.scale, rtol=1e-4)
        assert {each.kind for each in result.evidence} == {"keypoints", "camera height"}
        assert result.warnings == ()


class TestDepth:
    def test_an_array_determines_the_size(self) -> None:
        points, truth = keypoints(), truth_of()
        view = seen(points, truth, np.eye(4), depth=depth_image(points, truth))
        result = align(Model(points_3d=points), view)
        assert np.allclose(result.alignment.scale, truth.scale, rtol=0.01)
        assert [(each.kind, each.count) for each in result.evidence] == [
            ("keypoints", 10),
            ("depth", 10),
        ]

    def test_a_file_has_a_scale(self, tmp_path: Path) -> None:
        points, truth = keypoints(), truth_of()
        image = np.round(depth_image(points, truth) * 2000).astype(np.uint16)
        cv2.imwrite(str(tmp_path / "depth.png"), image)
        path = tmp_path / "depth.png"
        view = seen(points, truth, np.eye(4), depth=path, depth_scale=1 / 2000)
        result = align(Model(points_3d=points), view)
        assert np.allclose(result.alignment.scale, truth.scale, rtol=0.01)
        in_millimetres = seen(points, truth, np.eye(4), depth=str(path))
        assert np.isclose(np.nanmax(in_millimetres.depth_image), 18.0)
        assert np.nanmax(replace(view, sigma=2.0).depth_image) == np.nanmax(view.depth_image)

    @pytest.mark.parametrize("count", [1, 3])
    def test_millimetres_beside_known_motion_in_metres_are_named(self, count: int) -> None:
        points, truth = keypoints(9), truth_of()
        depth = 1000 * in_camera(points, truth, np.eye(4))[:, 2]
        others = rig(points, truth, [30, 60, 90][:count], np.random.default_rng(1))
        motion = {"cam_from_rig": np.eye(4), "depth": depth}
        view = seen(points, truth, np.eye(4), np.random.default_rng(0), **motion)
        texts = [each.text for each in align(Model(points_3d=points), [view, *others]).warnings]
        assert any("`depth`" in text and "in another unit" in text for text in texts)

    def test_depths_at_keypoints_determine_the_size(self) -> None:
        points, truth = keypoints(), truth_of()
        depth = in_camera(points, truth, np.eye(4))[:, 2]
        depth[3] = np.nan
        told = {"sigma": 0.01, "depth": depth, "depth_sigma": 0.005}
        result = align(Model(points_3d=points), seen(points, truth, np.eye(4), **told))
        assert np.allclose(result.alignment.scale, truth.scale, rtol=1e-4)
        assert result.std.scale[0] == pytest.approx(0.005 / np.sqrt(9), rel=0.02)

    def test_what_hides_keypoints_does_not_harm(self) -> None:
        points, truth, rng = keypoints(12), truth_of(), np.random.default_rng(0)
        image = depth_image(points, truth)
        pixels = CAMERA.project(truth.apply(points)).round().astype(int)
        for x, y in pixels[:2]:
            image[y - 9 : y + 10, x - 9 : x + 10] = 3.0
        image[pixels[2, 1] - 9 : pixels[2, 1] + 10] = 0.0
        view = seen(points, truth, np.eye(4), rng, depth=image, depth_sigma=0.005)
        result = align(Model(points_3d=points), view)
        error = np.log(result.stretch / truth.scale)
        assert (np.abs(error) < 4 * np.array(result.std.scale)).all()
        assert result.std.scale[0] < 0.02


class TestFewKeypoints:
    @pytest.mark.parametrize("per_view", [1, 2])
    def test_many_views_of_one_or_two_suffice(self, per_view: int) -> None:
        points, truth, rng = keypoints(12), truth_of(), np.random.default_rng(1)
        angles = [-50, -30, -10, 10, 30, 50]
        views = []
        for number, angle in enumerate(angles):
            ids = [(number * per_view + k) % 12 for k in range(per_view)]
            pose = around(angle)
            views.append(seen(points[ids], truth, pose, rng, ids=ids, cam_from_rig=pose))
        result = align(Model(points_3d=points), views)
        likely = [result.alignment, *(other.alignment for other in result.alternatives)]
        errors = [np.abs(np.log(each.scale / truth.scale)).max() for each in likely]
        assert min(errors) < (0.03 if per_view == 2 else 0.2)

    def test_an_initial_alignment_starts_where_keypoints_do_not(self) -> None:
        points, truth = keypoints(), truth_of((1.0, 1.0, 1.0))
        model = Model(points_3d=points, stretch="none")
        up = {"up": truth.rotation[:, 1], "up_sigma_deg": 0.5}
        view = seen(points[:2], truth, np.eye(4), ids=[0, 1], **up)
        start = Alignment(truth.rotation, truth.translation + 0.1, np.ones(3))
        result = align(model, view, init=start)
        assert result.rms < 1e-3
        assert np.isclose(result.alignment.rotation[:, 1] @ truth.rotation[:, 1], 1, atol=1e-6)


class TestUp:
    def test_an_isotropic_covariance_equals_the_deviation(self) -> None:
        points, truth, rng = keypoints(6), truth_of(), np.random.default_rng(0)
        up = turned(truth.rotation[:, 1], 1.0, rng)
        across = np.eye(3) - np.outer(up, up)
        view = seen(points, truth, np.eye(4), rng, up=up, up_sigma_deg=0.02)
        same = View(CAMERA, view.points_2d, up=up, up_sigma_deg=4e-4 * across)
        first, second = (align(Model(points_3d=points), each) for each in (view, same))
        assert np.allclose(first.alignment.rotation, second.alignment.rotation, atol=1e-7)
        variance = np.trace(across @ first.covariance[:3, :3] @ across) / 2
        assert np.degrees(np.sqrt(variance)) == pytest.approx(0.02, rel=0.03)


def test_each_piece_adds_and_is_printed() -> None:
    points, truth, rng = keypoints(6), truth_of(), np.random.default_rng(0)
    up = truth.rotation[:, 1]
    depth = in_camera(points, truth, np.eye(4))[:, 2]
    told = {"up": up, "up_sigma_deg": 0.2, "depth": depth}
    view = seen(points, truth, np.eye(4), rng, **told)
    size = Size(width=box_of(points, truth)[0])
    result = align(Model(points_3d=points), view, size=size)
    names = ["views[0].points_2d", "views[0].depth", "views[0].up", "size"]
    assert [each.name for each in result.evidence] == names
    lines = [line for line in str(result).splitlines() if line.startswith("  evidence ")]
    assert lines == [f"  evidence     {each}" for each in result.evidence]
    without_up = align(Model(points_3d=points), replace(view, up=None), size=size)
    assert without_up.std.rotation_deg > 1.2 * result.std.rotation_deg
    without_size = align(Model(points_3d=points), view)
    assert without_size.std.scale[0] > 1.05 * result.std.scale[0]


def test_the_rig_frame_is_that_of_the_cameras() -> None:
    points, truth = keypoints(), truth_of()
    world = np.eye(4)
    world[:3, :3] = around(70)[:3, :3]
    world[:3, 3] = [3.0, -1.0, 2.0]
    views = [
        seen(points, truth, around(a), cam_from_rig=around(a) @ np.linalg.inv(world))
        for a in (0, 30)
    ]
    result = align(Model(points_3d=points), views)
    expected = truth.apply(points) @ world[:3, :3].T + world[:3, 3]
    assert np.allclose(result.rig_from_model.apply(points), expected, atol=1e-5)
    again = Result.from_dict(json.loads(json.dumps(result.to_dict())))
    assert again.rig_from_model == result.rig_from_model
    assert again.evidence == result.evidence


def plain_evidence(prior: ShapePrior, views: list[View]) -> Evidence:
    """Evidence for the first component, with known cameras without turns."""
    given = {
        "options": FitOptions(),
        "lenses": Lenses.from_views(views, "known", None),
        "noise": 1.0,
    }
    turns = [np.eye(3)] * len(views)
    return evidence_of(prior, prior.components[0], views, None, turns=turns, **given)


def test_equations_beyond_the_unknowns_are_counted() -> None:
    points, truth = keypoints(12), truth_of()
    views = [seen(points, truth, np.eye(4)), seen(points, truth, np.eye(4))]
    prior = prior_of(Model(points_3d=points))
    for poses in (1, 2):
        assert redundancy_of(plain_evidence(prior, views[:poses])) == 24 * poses - 6 * poses - 2


def test_points_that_are_no_keypoints_end_no_box() -> None:
    prior = prior_of(similar())
    views = [seen(keypoints(12), truth_of((1, 1, 1)), np.eye(4))]
    evidence = plain_evidence(prior, views)
    modes, mean = evidence.shape.modes, evidence.shape.mean
    pose = truth_of((1, 1, 1)).vector[None, :12]
    state = State(pose, np.zeros(0), np.zeros(3), np.zeros(len(modes)), np.zeros_like(mean))
    margins = BoxMargins(np.full((2, 3), 0.01), np.full((2, 3), 9.0))
    farthest = int(mean[2:12, 0].argmax()) + 2
    some = replace(prior, ids=prior.ids[:farthest], has_box=True, box_margins=margins)
    placed, _ = estimate_box(evidence, state, some)
    known = mean[:farthest]
    expected = [known.min(axis=0) - 0.01, known.max(axis=0) + 0.01]
    np.testing.assert_allclose(placed.shape.mean[-2:], expected)
