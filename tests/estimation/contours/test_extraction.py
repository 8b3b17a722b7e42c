"""The bias of a contour's extraction: what pixels and smoothing do to the silhouette's outline."""

from __future__ import annotations

import numpy as np
from support.scenes import CAMERA, truth_of

from cadalign import Alignment, Mesh
from cadalign.estimation.contours.contour import (
    Sight,
    contour_of,
    extraction_bias,
    find_rims,
    mask_image,
)
from cadalign.estimation.contours.surface import caster_of
from cadalign.render import Scene, cast_geometry

CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float) - 0.5
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
BOX = Mesh(CORNERS, np.array([face for a, b, c, d in QUADS for face in ((a, b, c), (a, c, d))]))
TRUTH = truth_of((0.6, 0.4, 0.8))


def offsets_and_bias(mask: np.ndarray, pose: Alignment) -> tuple[np.ndarray, np.ndarray]:
    """How far the rims of a pose lie outside of a mask's contour, and the bias of these."""
    contour, sight = contour_of(mask), Sight(caster_of(BOX), CAMERA, pose)
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
