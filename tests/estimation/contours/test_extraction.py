"""Bias of contour extraction by pixels and smoothing."""

from __future__ import annotations

import numpy as np
from support.scenes import BOX, CAMERA, truth_of

from cadalign import Alignment
from cadalign.estimation.contours import contour as contours
from cadalign.estimation.contours.contour import (
    Sight,
    contour_of,
    extraction_bias,
    find_rims,
    mask_image,
    remove_steep,
)
from cadalign.geometry.raycaster import RayCaster
from cadalign.render import Scene, cast_geometry

TRUTH = truth_of((0.6, 0.4, 0.8))


def offsets_and_bias(mask: np.ndarray, pose: Alignment) -> tuple[np.ndarray, np.ndarray]:
    """Distances of a pose's rims from a mask's contour, and their bias."""
    contour, sight = contour_of(mask), Sight(RayCaster(BOX), CAMERA, pose)
    rims = find_rims(sight, contour, 8.0)
    bias = extraction_bias(sight, mask_image(mask, contour), contour, rims)
    assert rims.found.mean() > 0.9
    return rims.offset[rims.found], bias[rims.found]


def test_at_the_truth_it_is_all_that_separates_rim_and_contour() -> None:
    offsets, bias = offsets_and_bias(cast_geometry(Scene(BOX), CAMERA, TRUTH).mask, TRUTH)
    assert np.sqrt((offsets**2).mean()) > 0.1
    assert np.percentile(np.abs(offsets - bias), 95) < 0.01
    assert offsets.max() > 0.25  # at corners, which smoothing rounds off


def test_a_displacement_is_no_part_of_it() -> None:
    mask = cast_geometry(Scene(BOX), CAMERA, TRUTH).mask
    nearer = Alignment(TRUTH.rotation, 0.99 * TRUTH.translation, TRUTH.scale)
    offsets, bias = offsets_and_bias(mask, nearer)
    outwards = np.median(offsets - bias)
    assert 0.2 < outwards < 2
    assert abs(np.median(bias)) < 0.15
    assert np.abs(bias).max() < 2


def test_corners_that_are_rounded_off_are_not_steep() -> None:
    points = np.column_stack([2.0 * np.arange(9), np.zeros(9)])
    contour = contours.Contour(points, np.tile([0.0, -1.0], (9, 1)), np.zeros(9, dtype=int))
    offset = np.array([0, 0, 0, 0, 3.0, 0, 0, 0, 0])
    nothing = np.zeros((9, 3)), np.zeros(9, dtype=int)
    rims = contours.Rims(np.ones(9, dtype=bool), offset, *nothing)
    assert remove_steep(contour, rims).found.tolist() == [*[True] * 3, *[False] * 3, *[True] * 3]
    assert remove_steep(contour, rims, offset).found.all()
