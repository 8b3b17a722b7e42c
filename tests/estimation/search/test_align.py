"""`align`: exact, stretched and similar models, several views, depth, gravity, outliers."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest
from support.scenes import CAMERA, around, keypoints

from cadalign import Alignment, Camera, Model, RansacOptions, Size, View, align, align_batch, fit
from cadalign.errors import DegenerateError, InputError, NoConsensusError
from cadalign.estimation.result import Result
from cadalign.metrics import rotation_error
from cadalign.shapes.model import ShapeModel
from cadalign.shapes.parts import BoxMargins, FewKeypoints

LOOK = np.array([[0.8, 0.0, 0.6], [0.36, -0.8, -0.48], [0.48, 0.6, -0.64]])


def truth_of(scale: Any = (1.0, 1.3, 0.8)) -> Alignment:
    return Alignment(LOOK, [0.1, -0.05, 5.0], scale)


def seen(points: np.ndarray, truth: Alignment, motion: np.ndarray, **options: Any) -> View:
    in_rig = truth.apply(points)
    in_camera = in_rig @ motion[:3, :3].T + motion[:3, 3]
    noise = options.pop("noise", np.zeros((len(points), 2)))
    return View(CAMERA, CAMERA.project(in_camera) + noise, **options)


def spreads(deviation: float, count: int = 10, modes: int = 3) -> ShapeModel:
    rng = np.random.default_rng(3)
    mean = keypoints(count)
    directions = rng.normal(size=(modes, count, 3))
    return ShapeModel.from_basis(mean, directions, np.full(modes, deviation), residual_sigma=0.0)


class TestExactModel:
    @pytest.mark.parametrize("focal", ["known", "estimate"])
    def test_equals_fit_bit_for_bit(self, focal: Literal["known", "estimate"]) -> None:
        points, rng = keypoints(), np.random.default_rng(1)
        view = seen(points, truth_of(), np.eye(4), noise=rng.normal(0, 1, (10, 2)))
        if focal == "estimate":
            view = replace(view, camera=Camera.from_size(640, 480))
        result = align(Model(points_3d=points), view, focal=focal)
        expected = fit(points, view.points_2d, view.camera, focal=focal)
        assert result.alignment == expected.alignment
        assert result.camera == expected.camera
        for name in ("covariance", "fisher_covariance", "points_covariance"):
            np.testing.assert_array_equal(getattr(result, name), getattr(expected, name))
        assert result.std == expected.std
        assert result.warnings == expected.warnings
        assert str(result) == str(expected)
        assert result.evidence == expected.evidence

    def test_a_shape_without_deviations_equals_the_rigid_fit(self) -> None:
        rng = np.random.default_rng(1)
        truth = truth_of((1.0, 1.0, 1.0))
        view = seen(keypoints(), truth, np.eye(4), noise=rng.normal(0, 1, (10, 2)))
        result = align(spreads(0.0), view)
        expected = fit(keypoints(), view.points_2d, CAMERA, stretch="none")
        assert np.allclose(result.alignment.rotation, expected.alignment.rotation, atol=1e-9)
        assert np.allclose(result.alignment.translation, expected.alignment.translation, atol=1e-8)
        assert np.allclose(result.covariance[:6, :6], expected.covariance[:6, :6], rtol=1e-5)

    def test_ids_say_which_keypoints_a_view_shows(self) -> None:
        points = keypoints()
        names = [f"corner {i}" for i in range(10)]
        chosen = [7, 2, 9, 4, 0, 5, 1]
        view = View(
            CAMERA,
            CAMERA.project(truth_of().apply(points[chosen])),
            ids=[names[i] for i in chosen],
        )
        result = align(Model(points_3d=points, ids=names), view)
        assert np.allclose(result.alignment.scale, truth_of().scale, atol=1e-6)
        assert np.allclose(result.points_3d, points)


class TestSimilarModel:
    def test_shape_errors_widen_the_uncertainty(self) -> None:
        points, rng = keypoints(14), np.random.default_rng(5)
        moved = points + rng.normal(0, 0.03, points.shape)
        view = seen(moved, truth_of(), np.eye(4), noise=rng.normal(0, 1, (14, 2)))
        naive = align(Model(points_3d=points), view)
        honest = align(Model(points_3d=points, shape_sigma=0.03), view)
        assert honest.std.rotation_deg > 3 * naive.std.rotation_deg
        assert not any(each.kind == "misfit" for each in honest.warnings)

    def test_inflation_widens_the_deviations_alone(self) -> None:
        model = spreads(0.05)
        view = seen(keypoints() + 0.02, truth_of((1.0, 1.0, 1.0)), np.eye(4))
        plain, wide = align(model, view), align(replace(model, inflation=1.5), view)
        assert np.allclose(wide.alignment.rotation, plain.alignment.rotation, atol=1e-12)
        assert np.allclose(wide.points_3d, plain.points_3d, atol=1e-12)
        assert wide.std.rotation_deg > plain.std.rotation_deg
        growth = np.trace(wide.points_covariance, axis1=1, axis2=2)
        growth /= np.trace(plain.points_covariance, axis1=1, axis2=2)
        assert (growth > 1).all()
        assert (growth < 1.5**2 + 1e-9).all()

    def test_few_keypoints_need_less_inflation(self) -> None:
        model = replace(spreads(0.05), inflation=1.5)
        less = replace(model, few_keypoints=FewKeypoints(typical=40.0, share=0.7))
        view = seen(keypoints() + 0.02, truth_of((1.0, 1.0, 1.0)), np.eye(4))
        for views in (view, [view, view]):  # two without motion take the way of any evidence
            wide, narrow = align(model, views), align(less, views)
            assert narrow.std.rotation_deg < wide.std.rotation_deg
            assert np.allclose(narrow.points_3d, wide.points_3d, atol=1e-12)

    def test_heavy_tails_change_the_regions_and_not_the_estimate(self) -> None:
        model = spreads(0.05)
        view = seen(keypoints() + 0.02, truth_of((1.0, 1.0, 1.0)), np.eye(4))
        plain, tails = align(model, view), align(replace(model, degrees_of_freedom=4.0), view)
        assert (tails.covariance == plain.covariance).all()
        assert plain.radius(0.95) == pytest.approx(1.96, abs=1e-3)
        assert tails.radius(0.999, dimension=3) > plain.radius(0.999, dimension=3)
        assert tails.radius(0.5) < plain.radius(0.5)
        read = Result.from_dict(json.loads(json.dumps(tails.to_dict())))
        assert read.degrees_of_freedom == 4

    @pytest.mark.parametrize("views", [1, 2])
    def test_a_box_that_is_not_given_is_the_extent_of_all_keypoints(self, views: int) -> None:
        """Standard deviations of the box agree with its errors."""
        model, errors = spreads(0.05), []
        component = model.components[0]
        for seed in range(40):
            rng = np.random.default_rng(seed)
            shape = component.mean + np.tensordot(rng.normal(size=3), component.modes, 1)
            some = np.sort(rng.permutation(10)[:7])  # others than these may be the outermost
            given = [
                seen(
                    shape[some],
                    truth_of((1.0, 1.0, 1.0)),
                    around(30.0 * number),
                    noise=rng.normal(0, 1, (7, 2)),
                    ids=some.tolist(),
                )
                for number in range(views)
            ]
            result = align(model, given)
            assert np.allclose(result.bounds[0], result.points_3d.min(axis=0))
            assert np.allclose(result.bounds[1], result.points_3d.max(axis=0))
            lengths, true = np.ptp(result.bounds, axis=0), np.ptp(shape[:-2], axis=0)
            errors.append(np.log(lengths / true) / np.sqrt(result.covariance.diagonal()[6:]))
        assert 0.75 < np.sqrt(np.mean(np.square(errors))) < 1.25

    def test_the_box_ends_at_keypoints_that_its_faces_are_near(self) -> None:
        model = replace(spreads(0.05), has_box=True)
        view = seen(model.components[0].mean[:-2], truth_of((1.0, 1.0, 1.0)), np.eye(4))
        near = BoxMargins(np.full((2, 3), 0.01), np.full((2, 3), 9.0))
        result = align(replace(model, box_margins=near), view)
        points = result.points_3d
        assert np.allclose(result.bounds, [points.min(0) - 0.01, points.max(0) + 0.01])
        far = BoxMargins(np.full((2, 3), -9.0), np.zeros((2, 3)))
        assert np.allclose(
            align(replace(model, box_margins=far), view).bounds, align(model, view).bounds
        )
        tall = Size(height=float(np.ptp(points[:, 1])) + 0.2, sigma=0.001)
        sized = align(replace(model, box_margins=near), view, size=tall)
        assert np.allclose(sized.bounds, align(model, view, size=tall).bounds)

    def test_a_learned_shape_comes_nearer_than_its_mean(self) -> None:
        model, rng = spreads(0.05), np.random.default_rng(2)
        component = model.components[0]
        truth = truth_of((1.0, 1.0, 1.0))
        shape = component.mean[:-2] + np.tensordot([1.5, -1.0, 0.5], component.modes, 1)[:-2]
        view = seen(shape, truth, np.eye(4), noise=rng.normal(0, 0.5, (10, 2)))
        result = align(model, view)
        rigid = fit(component.mean[:-2], view.points_2d, CAMERA, stretch="none")
        assert np.abs(result.points_3d - shape).max() < 0.02
        error = rotation_error(est=result.alignment, gt=truth)
        assert error < rotation_error(est=rigid.alignment, gt=truth) / 5


class TestSeveralViews:
    def test_known_motion_determines_all_three_scales(self) -> None:
        points, truth = keypoints(), truth_of((1.4, 0.7, 1.9))
        poses = [np.eye(4), around(25)]
        views = [seen(points, truth, pose, cam_from_rig=pose) for pose in poses]
        result = align(Model(points_3d=points), views)
        assert np.allclose(result.alignment.scale, truth.scale, rtol=1e-5)
        assert np.allclose(result.alignment.translation, truth.translation, atol=1e-5)

    def test_a_view_with_two_keypoints_sharpens_the_estimate(self) -> None:
        points, truth = keypoints(), truth_of((1.0, 1.0, 1.0))
        first = seen(points, truth, np.eye(4), cam_from_rig=np.eye(4))
        second = seen(points[:2], truth, around(40), ids=[0, 1], cam_from_rig=around(40))
        two = align(Model(points_3d=points), [first, second])
        alone = align(Model(points_3d=points), View(CAMERA, first.points_2d))
        assert two.std.scale[1] < alone.std.scale[1]
        assert two.std.scale[0] > 0  # metric: the known poses tell the size

    def test_unknown_motion_shares_the_stretch(self) -> None:
        points, truth = keypoints(), truth_of()
        rng = np.random.default_rng(4)
        views = [
            seen(points, truth, around(angle), noise=rng.normal(0, 1, (10, 2)))
            for angle in (0, 30, 60)
        ]
        together = align(Model(points_3d=points), views)
        alone = align(Model(points_3d=points), views[0])
        assert together.std.scale[1] < 0.8 * alone.std.scale[1]
        assert len(together.poses) == 3
        motion = together.poses[1].rotation @ together.poses[0].rotation.T
        assert np.abs(motion - around(30)[:3, :3]).max() < 0.02


class TestUnknowns:
    def test_views_share_a_focal_length_where_they_share_a_camera(self) -> None:
        model, truth = spreads(0.02), truth_of((1.0, 1.0, 1.0))
        wide = Camera(800, 600, 700.0, 700.0, 399.5, 299.5)
        views = []
        for camera, angle in ((CAMERA, 0.0), (wide, 30.0), (CAMERA, -30.0)):
            motion = around(angle)
            in_camera = truth.apply(keypoints()) @ motion[:3, :3].T + motion[:3, 3]
            unknown = Camera.from_size(camera.width, camera.height)
            views.append(View(unknown, camera.project(in_camera), sigma=0.2))
        result = align(model, views, focal="estimate")
        assert result.cameras[0] == result.cameras[2]
        focal_lengths = [camera.fx for camera in result.cameras]
        assert focal_lengths == pytest.approx([900.0, 700.0, 900.0], rel=0.1)
        assert result.std.focal == pytest.approx(np.sqrt(result.covariance[9, 9]))

    def test_noise_that_is_not_given_is_that_of_the_residuals(self) -> None:
        """The redundancy counts the unknowns of each pose and of two stretches."""
        points, rng = keypoints(), np.random.default_rng(4)
        views = [
            seen(points, truth_of(), around(angle), noise=rng.normal(0, 3, (10, 2)), sigma=None)
            for angle in (0, 30, 60)
        ]
        result = align(Model(points_3d=points), views)
        square = sum(float((view.residuals**2).sum()) for view in result.views)
        assert result.sigma == pytest.approx(np.sqrt(square / (3 * (20 - 6) - 2)), rel=1e-3)
        learned = align(spreads(0.05), views[0])
        assert 1.0 < learned.sigma < 6.0

    def test_every_view_may_have_a_start(self) -> None:
        points, truth = keypoints(), truth_of()
        views = [seen(points, truth, around(angle)) for angle in (0, 30)]
        expected = align(Model(points_3d=points), views)
        for start in ([None, expected.poses[1]], [truth, None]):
            result = align(Model(points_3d=points), views, init=start)
            assert rotation_error(est=result.poses[1], gt=expected.poses[1]) < 1e-3


class TestOutliers:
    def test_replaced_keypoints_are_left_out(self) -> None:
        model = spreads(0.03, count=16)
        component = model.components[0]
        shape = component.mean[:-2] + np.tensordot([1.0, -1.0, 0.5], component.modes, 1)[:-2]
        truth, rng = truth_of((1.0, 1.0, 1.0)), np.random.default_rng(7)
        view = seen(shape, truth, np.eye(4), noise=rng.normal(0, 1, (16, 2)))
        pixels = np.array(view.points_2d)
        pixels[[1, 5, 11, 12]] = rng.uniform(0, 480, (4, 2))
        result = align(model, View(CAMERA, pixels), ransac=RansacOptions(max_reproj_error=4.0))
        assert np.flatnonzero(~result.inliers).tolist() == [1, 5, 11, 12]
        assert rotation_error(est=result.alignment, gt=truth) < 2.0

    @pytest.mark.parametrize("minimal", ["ap4p", "aepnp"])
    def test_samples_follow_confidences(self, minimal: Literal["ap4p", "aepnp"]) -> None:
        model, wrong = spreads(0.01, count=16), [0, 3, 5, 8, 11]
        pixels = CAMERA.project(truth_of((1.0, 1.0, 1.0)).apply(keypoints(16)))
        pixels[wrong] += np.random.default_rng(0).uniform(60, 120, (5, 2))
        scores = np.where(np.isin(np.arange(16), wrong), 0.1, 0.9)
        view = View(CAMERA, pixels, sigma=0.5, scores=scores)
        result = align(model, view, ransac=RansacOptions(minimal=minimal))
        assert np.flatnonzero(~result.inliers).tolist() == wrong
        order = np.random.default_rng(1).permutation(16)
        mixed = View(
            CAMERA, pixels[order], ids=order.tolist(), sigma=0.5, scores=scores[order].tolist()
        )
        again = align(model, mixed, ransac=RansacOptions(minimal=minimal))
        np.testing.assert_array_equal(again.alignment.vector, result.alignment.vector)

    def test_confidences_are_not_negative(self) -> None:
        pixels = CAMERA.project(truth_of((1.0, 1.0, 1.0)).apply(keypoints(16)))
        view = View(CAMERA, pixels, scores=[-1.0] + [1.0] * 15)
        with pytest.raises(InputError, match="keypoint 0 has the score -1"):
            align(spreads(0.01, count=16), view, ransac=RansacOptions())

    def test_inliers_are_in_the_order_of_the_view(self) -> None:
        model = spreads(0.01, count=16)
        truth, order = truth_of((1.0, 1.0, 1.0)), np.random.default_rng(0).permutation(16)
        pixels = CAMERA.project(truth.apply(keypoints(16)[order]))
        pixels[3] += 150
        view = View(CAMERA, pixels, ids=order.tolist())
        result = align(model, view, ransac=RansacOptions())
        assert np.flatnonzero(~result.inliers).tolist() == [3]

    def test_as_many_samples_are_drawn_as_the_probability_asks_for(self) -> None:
        model, truth = spreads(0.01, count=16), truth_of((1.0, 1.0, 1.0))
        pixels = CAMERA.project(truth.apply(keypoints(16)))
        pixels[:7] = np.random.default_rng(2).uniform(0, 480, (7, 2))
        options = RansacOptions(min_iterations=0)
        result = align(model, View(CAMERA, pixels), ransac=options)
        assert np.flatnonzero(~result.inliers).tolist() == list(range(7))

    def test_keypoints_scattered_at_random_have_no_consensus(self) -> None:
        model, rng = spreads(0.01, count=16), np.random.default_rng(1)
        for views in (1, 2):
            scattered = [View(CAMERA, rng.uniform(0, 480, (16, 2))) for _ in range(views)]
            count = f"of {16 * views} keypoints"
            with pytest.raises(NoConsensusError, match=f"no alignment is supported.*{count}"):
                align(model, scattered, ransac=RansacOptions())


def test_a_batch_is_its_single_results_and_keeps_errors() -> None:
    model = spreads(0.03)
    views = [seen(keypoints(), truth_of((1, 1, 1)), around(angle)) for angle in (0, 5, 10)]
    too_few = View(CAMERA, [[100.0, 100.0]], ids=[0])
    batch = align_batch(model, [*views, too_few], workers=2)
    assert isinstance(batch[3], DegenerateError)
    for view, result in zip(views, batch, strict=False):
        assert result.alignment == align(model, view).alignment


def test_a_batch_takes_a_size_and_a_start_for_each_object() -> None:
    model = spreads(0.03)
    views = [seen(keypoints(), truth_of((1, 1, 1)), around(angle)) for angle in (0, 5)]
    size = Size(width=3.0)
    four, two = (
        seen(keypoints()[:count], truth_of((1, 1, 1)), np.eye(4), ids=range(count))
        for count in (4, 2)
    )
    start = truth_of((1, 1, 1))
    batch = align_batch(
        model, [*views, four, two], size=[None, size, None, None], init=[None, None, start, start]
    )
    alone = (
        align(model, views[0]),
        align(model, views[1], size=size),
        align(model, four, init=start),
    )
    for result, expected in zip(batch, alone, strict=False):
        assert result.alignment == expected.alignment
    assert isinstance(batch[3], DegenerateError)  # two keypoints, whatever the start
    for result in align_batch(model, views, size=size, workers=2):
        width = result.alignment.scale[0] * np.ptp(result.bounds[:, 0])
        assert width == pytest.approx(3.0, rel=0.1)


def test_a_start_does_not_change_what_the_keypoints_tell() -> None:
    model, truth = spreads(0.03), truth_of((1, 1, 1))
    view = seen(keypoints(), truth, np.eye(4))
    alone, started = align(model, view), align(model, view, init=truth)
    assert rotation_error(est=started.alignment, gt=alone.alignment) < 1e-3


def test_three_keypoints_suffice_with_a_prior() -> None:
    model = spreads(0.01)
    pixels = CAMERA.project(truth_of((1, 1, 1)).apply(keypoints()[:3]))
    view = View(CAMERA, pixels, ids=range(3))
    result = align(model, view)
    likely = [result.alignment, *(other.alignment for other in result.alternatives)]
    truth = truth_of((1, 1, 1))
    assert min(rotation_error(est=each, gt=truth) for each in likely) < 5


def test_keypoint_that_contradicts_a_learned_shape_is_named() -> None:
    model, rng = spreads(0.01), np.random.default_rng(0)
    noise = rng.normal(0, 1, (10, 2))
    right = align(model, seen(keypoints(), truth_of((1, 1, 1)), np.eye(4), noise=noise))
    assert not right.warnings
    noise[4] += (30, 20)
    (warning,) = align(
        model, seen(keypoints(), truth_of((1, 1, 1)), np.eye(4), noise=noise)
    ).warnings
    assert "keypoint 4 (36.2 px) does not fit the others" in warning.text
    assert (warning.kind, warning.view, warning.keypoints) == ("outlier", 0, (4,))


def test_a_blade_whose_edge_may_be_its_back_has_both_poses() -> None:
    places = [
        [0, 0.6, 0],
        [0, -0.3, 0],
        [0, 0.1, 0.05],
        [0, 0.1, -0.05],
        [0, 0, 0.02],
        [0, 0, -0.02],
    ]
    mean = np.array(places, float)
    model = ShapeModel.from_basis(mean, [mean * [0, 0, 1]], [1.2], residual_sigma=0.001)
    truth = truth_of((1.0, 1.0, 1.0))
    result = align(model, seen(mean, truth, np.eye(4)))
    assert rotation_error(est=result.alignment, gt=truth) < 5
    behind = Alignment(LOOK @ np.diag([-1.0, 1.0, -1.0]), truth.translation, np.ones(3))
    assert sum(other.relative_likelihood for other in result.alternatives) > 1 / 9
    assert any(each.kind == "alternative" for each in result.warnings)
    others = [each.alignment for each in result.alternatives]
    assert min(rotation_error(est=each, gt=behind) for each in others) < 5


def test_a_batch_takes_any_iterable_of_objects() -> None:
    points = keypoints()
    view, model = seen(points, truth_of(), np.eye(4)), Model(points_3d=points)
    assert len(align_batch(model, (each for each in [view, view]))) == 2


def test_a_standard_deviation_that_all_keypoints_share_is_stated() -> None:
    points = keypoints()
    view = replace(seen(points, truth_of(), np.eye(4)), sigma=2.0)
    each = replace(view, sigma=np.linspace(1.0, 2.0, len(points)))
    for model in (Model(points_3d=points, shape_sigma=0.01), Model(points_3d=points)):
        assert align(model, view, size=Size(width=1.0)).sigma == 2.0
        assert align(model, [view, view]).sigma == 2.0
        assert align(model, [view, each]).sigma is None
