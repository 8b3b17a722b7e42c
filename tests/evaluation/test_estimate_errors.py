"""Errors of many estimates at once, and alignments of a model's box to an estimated box."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cadalign import metrics
from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA, Instance
from cadalign.evaluation.instances.record import box_alignment
from cadalign.evaluation.metrics.errors import estimate_errors
from cadalign.geometry.alignment import Alignment, Box
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.geometry.symmetry import Symmetry

NO_SYMMETRY = Symmetry.none()
HALF_TURN = Symmetry.around((0, 1, 0), fold=2)


def alignment(rng: np.random.Generator) -> Alignment:
    rotation = rotation_from_vector(rng.normal(size=3))
    return Alignment(rotation, rng.normal(size=3) * 0.1 + [0, 0, 4], rng.uniform(0.5, 2, 3))


def instance(rng: np.random.Generator, gt: Alignment, extents: FloatArray) -> Instance:
    points = rng.uniform(-0.5, 0.5, (int(rng.integers(6, 20)), 3)) * extents
    return Instance(
        camera=KEYPOINT_CAMERA,
        cam_from_model=gt,
        points_3d=points,
        points_2d=KEYPOINT_CAMERA.project(gt.apply(points)) + rng.normal(size=(len(points), 2)),
        ids=np.arange(len(points)),
        bounds=np.array([-0.5, 0.5])[:, None] * extents,
        gt=gt,
        visibility="hull",
        scene=None,
        diagonal=float(rng.uniform(1, 2)),
    )


def test_errors_of_many_are_those_of_each_bit_for_bit() -> None:
    rng = np.random.default_rng(0)
    estimates = [alignment(rng) for _ in range(65)]
    instances = [instance(rng, alignment(rng), rng.uniform(0.2, 1, 3)) for _ in estimates]
    symmetries = [NO_SYMMETRY, HALF_TURN] * 32 + [NO_SYMMETRY]
    rows = estimate_errors(estimates, instances, symmetries)
    for est, each, symmetry, row in zip(estimates, instances, symmetries, rows, strict=True):
        truths = {"": each.gt, "sym_": symmetry.nearest_pose(each.gt, est.rotation)}
        for prefix, gt in truths.items():
            boxes = {"est": Box.from_model(each.bounds, est), "gt": Box.from_model(each.bounds, gt)}
            expected = {
                "rotation_error_deg": metrics.rotation_error(est=est, gt=gt),
                "translation_error": metrics.translation_error(est=est, gt=gt) / each.diagonal,
                "box_iou": metrics.box_iou(**boxes),
            }
            assert isinstance(row, dict)
            assert {name: row[f"{prefix}{name}"] for name in expected} == expected
        _, scale_y, scale_z = metrics.scale_error(est=est, gt=each.gt).tolist()
        assert (row["scale_y_error"], row["scale_z_error"]) == (scale_y, scale_z)
        up_to_scale = metrics.translation_error_up_to_scale(est=est, gt=each.gt)
        assert row["translation_error_up_to_scale"] == up_to_scale / each.diagonal
        gaps = each.camera.project(est.apply(each.points_3d)) - each.points_2d
        rms = np.sqrt((gaps**2).sum(axis=1).mean())
        assert row["rms_px"] == pytest.approx(rms, rel=1e-12)
    different = [row["rotation_error_deg"] != row["sym_rotation_error_deg"] for row in rows]
    assert any(different[1::2])
    assert not any(different[::2])


def test_flat_models_have_no_overlap_and_estimates_that_are_not_finite_no_errors() -> None:
    rng = np.random.default_rng(1)
    gt = alignment(rng)
    flat = instance(rng, gt, np.array([1.0, 0.0, 1.0]))
    solid = instance(rng, gt, np.ones(3))
    broken = Alignment(gt.rotation, np.array([0, 0, np.nan]), gt.scale, is_valid=True)
    symmetries = [HALF_TURN, HALF_TURN, NO_SYMMETRY]
    first, second, third = estimate_errors([gt, broken, gt], [flat, solid, solid], symmetries)
    assert isinstance(first, dict)
    assert isinstance(third, dict)
    assert first["box_iou"] is None
    assert first["sym_box_iou"] is None
    assert first["rotation_error_deg"] == 0
    assert isinstance(second, InputError)
    assert "NaN" in str(second)
    assert third["box_iou"] == pytest.approx(1)


@pytest.mark.slow
@given(seed=st.integers(0, 10_000))
def test_box_alignment_gives_the_same_box(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=seed).as_matrix()
    found = Alignment(rotation, rng.normal(size=3), rng.uniform(0.5, 2, 3))
    bounds, own = (np.sort(rng.normal(size=(2, 3)), axis=0) for _ in range(2))
    own[1] += 0.1
    bounds[1] += 0.1
    box = Box.from_model(own, box_alignment(found, bounds, model_bounds=own))
    wanted = Box.from_model(bounds, found)
    np.testing.assert_allclose(box.corners, wanted.corners, atol=1e-9)
