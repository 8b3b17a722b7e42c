"""Metrics: perfect scores, closed forms and independent computations."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection
from scipy.spatial.transform import Rotation

from cadalign import Alignment, Box
from cadalign.errors import InputError
from cadalign.evaluation.simulation import random_rotation
from cadalign.metrics import (
    box_iou,
    box_iou_up_to_scale,
    rotation_error,
    scale_error,
    translation_error,
    translation_error_up_to_scale,
)

SEEDS = st.integers(0, 2**32 - 1)
BOUNDS = np.array([[-0.5, -0.3, -0.2], [0.4, 0.3, 0.35]])


def random_alignment(seed: int) -> Alignment:
    rng = np.random.default_rng(seed)
    translation = [*rng.uniform(-1, 1, 2), rng.uniform(4, 8)]
    return Alignment(random_rotation(rng), translation, [1.0, *rng.uniform(0.5, 2, 2)])


def rotation_about(angle_deg: float, axis: Any = (0, 0, 1)) -> np.ndarray:
    axis = np.asarray(axis, dtype=float)
    vector = np.radians(angle_deg) * axis / np.linalg.norm(axis)
    return Rotation.from_rotvec(vector).as_matrix()


# --- pose and scale --------------------------------------------------------------------------


@given(seed=SEEDS)
def test_perfect_estimate_scores_perfectly(seed: int) -> None:
    gt = random_alignment(seed)
    est = Alignment.from_dict(gt.to_dict())
    # Only the rounding error of the truth's matrix is allowed.
    assert rotation_error(est=est, gt=gt) < 1e-12
    assert translation_error(est=est, gt=gt) == 0.0
    assert translation_error_up_to_scale(est=est, gt=gt) == 0.0
    assert scale_error(est=est, gt=gt).tolist() == [0.0, 0.0, 0.0]
    box = Box.from_model(BOUNDS, gt)
    assert box_iou(est=box, gt=box) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (1, -2, 3)])
@pytest.mark.parametrize(
    "angle", [0.0, 1e-13, 1e-9, 1e-5, 0.1, 45.0, 90.0, 135.0, 179.0, 180 - 1e-5, 180.0]
)
def test_rotation_error_is_the_angle_from_tiny_to_half_a_turn(
    axis: tuple[int, ...], angle: float
) -> None:
    base = rotation_about(77, (3, 1, 2))
    est = Alignment(rotation_about(angle, axis) @ base, np.zeros(3), np.ones(3))
    gt = Alignment(base, np.zeros(3), np.ones(3))
    # Rounding errors of 1e-16 are 1e-14 degrees, or near 180 degrees their square root.
    tolerance = 3e-14 if angle < 170 else 2e-6
    assert rotation_error(est=est, gt=gt) == pytest.approx(angle, rel=1e-9, abs=tolerance)


def test_scale_error_is_relative_and_per_axis() -> None:
    est = Alignment(np.eye(3), np.zeros(3), [1.0, 1.5, 1.0])
    gt = Alignment(np.eye(3), np.zeros(3), [1.0, 1.0, 2.0])
    assert scale_error(est=est, gt=gt).tolist() == [0.0, 0.5, 0.5]
    assert scale_error(est=gt, gt=est) == pytest.approx([0.0, 1 / 3, 1.0])


# --- boxes -----------------------------------------------------------------------------------

CUBE = Box([0, 0, 0], np.eye(3), [1, 1, 1])


@pytest.mark.parametrize(
    ("est", "expected"),
    [
        (Box([0.5, 0, 0], np.eye(3), [1, 1, 1]), 1 / 3),  # half of it
        (Box([0.5, 0.5, 0], np.eye(3), [1, 1, 1]), 1 / 7),
        (Box([0.5, 0.5, 0.5], np.eye(3), [1, 1, 1]), 1 / 15),
        (Box([0.3, -0.2, 0.1], np.eye(3), [1, 1, 1]), 0.504 / 1.496),
        (Box([0, 0, 0], np.eye(3), [0.5, 0.5, 0.5]), 1 / 8),  # contained
        (Box([0.2, 0.1, 0], rotation_about(30, (1, 1, 0)), [0.2, 0.3, 0.1]), 0.006),
        (Box([0, 0, 0], np.eye(3), [3, 0.5, 0.5]), 0.25 / 1.5),  # runs through
        (Box([0, 0, 0], rotation_about(90), [1, 1, 1]), 1.0),  # the same box with other axes
        (Box([0, 0, 0], rotation_about(120, (1, 1, 1)), [1, 1, 1]), 1.0),
        (Box([1, 0, 0], np.eye(3), [1, 1, 1]), 0.0),  # touches in a face
        (Box([1, 1, 0], np.eye(3), [1, 1, 1]), 0.0),  # in an edge
        (Box([1, 1, 1], np.eye(3), [1, 1, 1]), 0.0),  # in a corner
        (Box([0.5 + np.sqrt(0.5), 0, 0], rotation_about(45), [1, 1, 1]), 0.0),  # its edge in a face
        (Box([1.001, 0, 0], np.eye(3), [1, 1, 1]), 0.0),  # apart
        (Box([50, 60, 70], rotation_about(30, (1, 2, 3)), [1, 1, 1]), 0.0),
    ],
)
def test_box_iou_of_known_pairs(est: Box, expected: float) -> None:
    assert box_iou(est=est, gt=CUBE) == pytest.approx(expected, abs=1e-12)
    assert box_iou(est=CUBE, gt=est) == pytest.approx(expected, abs=1e-12)


def overlapping_boxes(seed: int) -> tuple[Box, Box]:
    rng = np.random.default_rng(seed)
    first = Box(rng.uniform(-1, 1, 3), random_rotation(rng), rng.uniform(0.3, 2, 3))
    shift = rng.uniform(-0.8, 0.8, 3)
    return first, Box(first.center + shift, random_rotation(rng), rng.uniform(0.3, 2, 3))


def halfspaces(box: Box) -> np.ndarray:
    """Rows (n, d) with n x + d <= 0 inside the box."""
    normals = np.vstack([box.rotation.T, -box.rotation.T])
    half = np.concatenate([box.extents, box.extents]) / 2
    return np.column_stack([normals, -half - normals @ box.center])


def volume_by_duality(first: Box, second: Box) -> float:
    """Volume of the intersection from half-spaces, about its Chebyshev centre."""
    planes = np.vstack([halfspaces(first), halfspaces(second)])
    bound = np.column_stack([planes[:, :3], np.ones(len(planes))])
    found = linprog([0, 0, 0, -1], bound, -planes[:, 3], bounds=[(None, None)] * 3 + [(0, None)])
    if not found.success or found.x[3] < 1e-9:
        return 0.0
    corners = HalfspaceIntersection(planes, found.x[:3]).intersections
    return float(ConvexHull(corners).volume)


@pytest.mark.slow
@given(seed=SEEDS)
def test_box_iou_agrees_with_the_intersection_of_half_spaces(seed: int) -> None:
    est, gt = overlapping_boxes(seed)
    intersection = volume_by_duality(est, gt)
    expected = intersection / (est.volume + gt.volume - intersection)
    assert box_iou(est=est, gt=gt) == pytest.approx(expected, abs=1e-9)


@pytest.mark.slow
@given(seed=SEEDS, frame=SEEDS)
def test_box_iou_is_symmetric_and_does_not_depend_on_frame_or_unit(seed: int, frame: int) -> None:
    est, gt = overlapping_boxes(seed)
    expected = box_iou(est=est, gt=gt)
    assert 0.0 <= expected <= 1.0
    assert box_iou(est=gt, gt=est) == pytest.approx(expected, abs=1e-12)
    rng = np.random.default_rng(frame)
    rotation, shift, unit = random_rotation(rng), rng.uniform(-5, 5, 3), 10 ** rng.uniform(-6, 6)
    moved = [
        Box(unit * (rotation @ b.center + shift), rotation @ b.rotation, unit * b.extents)
        for b in (est, gt)
    ]
    assert box_iou(est=moved[0], gt=moved[1]) == pytest.approx(expected, abs=1e-9)


@given(seed=SEEDS, angle=st.sampled_from([1e-12, 1e-10, 1e-8, 1e-6, 1e-4]))
def test_box_iou_is_continuous_at_a_perfect_estimate(seed: int, angle: float) -> None:
    gt, _ = overlapping_boxes(seed)
    axis = np.random.default_rng(seed).standard_normal(3)
    est = Box(gt.center, rotation_about(np.degrees(angle), axis) @ gt.rotation, gt.extents)
    # A rotation moves a face by at most half a diagonal times the angle.
    largest = 4 * angle * np.linalg.norm(gt.extents) / gt.extents.min()
    assert 1 - box_iou(est=est, gt=gt) <= largest + 1e-11


@pytest.mark.parametrize(("name", "flat_first"), [("est", True), ("gt", False)])
def test_box_iou_refuses_flat_boxes(name: str, flat_first: bool) -> None:
    flat = Box([0, 0, 0], np.eye(3), [1, 0, 1])
    est, gt = (flat, CUBE) if flat_first else (CUBE, flat)
    with pytest.raises(InputError) as caught:
        box_iou(est=est, gt=gt)
    assert str(caught.value) == (
        f"{name}: the box [1.0, 0.0, 1.0] has no volume; leave flat models out of volume metrics"
    )


def boxes_before_the_camera(seed: int) -> tuple[Box, Box]:
    """Two boxes near the optical axis, usually in nearly the same direction."""
    rng = np.random.default_rng(seed)
    gt = Box([*rng.uniform(-0.5, 0.5, 2), 3.0], random_rotation(rng), rng.uniform(0.3, 1.5, 3))
    factor = np.exp(rng.uniform(-2, 2))
    center = factor * (gt.center + rng.uniform(-0.5, 0.5, 3))
    return Box(center, random_rotation(rng), factor * rng.uniform(0.3, 1.5, 3)), gt


def scaled_box(box: Box, factor: float) -> Box:
    return Box(factor * box.center, box.rotation, factor * box.extents)


@pytest.mark.long
@settings(max_examples=30)
@given(seed=SEEDS)
def test_box_iou_up_to_scale_is_the_largest_over_all_factors(seed: int) -> None:
    est, gt = boxes_before_the_camera(seed)
    found = box_iou_up_to_scale(est=est, gt=gt)
    factors = np.exp(np.linspace(-4, 4, 161))
    best = max(box_iou(est=scaled_box(est, float(factor)), gt=gt) for factor in factors)
    # The grid's next factor is 2.5 % off, which changes volumes by at most 8 %.
    assert best - 1e-6 <= found <= best + 0.16


@pytest.mark.long
@given(seed=SEEDS, logarithm=st.floats(-3, 3))
def test_box_iou_up_to_scale_is_invariant_to_scale_and_order(seed: int, logarithm: float) -> None:
    est, gt = boxes_before_the_camera(seed)
    found = box_iou_up_to_scale(est=est, gt=gt)
    factor = float(np.exp(logarithm))
    assert box_iou_up_to_scale(est=scaled_box(est, factor), gt=gt) == pytest.approx(found, abs=1e-6)
    assert box_iou_up_to_scale(est=gt, gt=est) == pytest.approx(found, abs=1e-6)
    assert box_iou_up_to_scale(est=scaled_box(gt, factor), gt=gt) == pytest.approx(1, abs=1e-9)


def test_box_iou_up_to_scale_of_boxes_in_other_directions_is_zero() -> None:
    ahead, left = Box([0, 0, 5], np.eye(3), [1, 1, 1]), Box([-5, 0, 5], np.eye(3), [1, 1, 1])
    assert box_iou_up_to_scale(est=ahead, gt=left) == 0.0
    behind = Box([0, 0, -5], np.eye(3), [1, 1, 1])
    assert box_iou_up_to_scale(est=behind, gt=ahead) == 0.0


@given(first=SEEDS, second=SEEDS)
def test_translation_error_up_to_scale_is_the_distance_from_the_ray(
    first: int, second: int
) -> None:
    est, gt = random_alignment(first), random_alignment(second)
    found = translation_error_up_to_scale(est=est, gt=gt)
    direction = est.translation / np.linalg.norm(est.translation)
    assert found == pytest.approx(np.linalg.norm(np.cross(direction, gt.translation)), abs=1e-9)
    nearer = Alignment(est.rotation, 0.3 * est.translation, est.scale)
    assert translation_error_up_to_scale(est=nearer, gt=gt) == pytest.approx(found, abs=1e-9)
    turned_away = Alignment(est.rotation, -est.translation, est.scale)
    whole = np.linalg.norm(gt.translation)
    assert translation_error_up_to_scale(est=turned_away, gt=gt) == pytest.approx(whole)


@pytest.mark.parametrize("metric", [rotation_error, translation_error, scale_error])
def test_the_estimate_comes_first_by_position(metric: Any) -> None:
    est, gt = random_alignment(1), random_alignment(2)
    np.testing.assert_array_equal(metric(est, gt), metric(gt=gt, est=est))
    with pytest.raises(TypeError):
        metric(est, gt, None)
