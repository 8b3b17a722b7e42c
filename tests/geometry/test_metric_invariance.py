"""Metrics are invariant to a model's symmetry and to the camera's frame."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cadalign import Alignment, Symmetry
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.metrics import (
    rotation_error,
    scale_error,
    translation_error,
)

pytestmark = pytest.mark.long

BOUNDS = np.array([[-0.3, -0.5, -0.3], [0.3, 0.5, 0.3]])
UP = np.array([0.0, 1.0, 0.0])

vectors = st.tuples(*[st.floats(-1.5, 1.5)] * 3).map(np.array)
rotations = vectors.map(rotation_from_vector)
places = st.tuples(*[st.floats(-0.5, 0.5)] * 2, st.floats(2, 4)).map(np.array)
stretches = st.floats(0.6, 1.6)


@st.composite
def alignments(draw: st.DrawFn) -> Alignment:
    """Poses with equal stretches along x and z, which rotations about y exchange."""
    across = draw(stretches)
    scale = np.array([across, draw(stretches), across])
    return Alignment(draw(rotations), draw(places), scale)


def turn_model(alignment: Alignment, angle: float) -> Alignment:
    """Rotate the model about its y axis, which keeps its scales."""
    rotation = alignment.rotation @ rotation_from_vector(angle * UP)
    return Alignment(rotation, alignment.translation, alignment.scale)


def errors(est: Alignment, gt: Alignment, symmetry: Symmetry | None) -> np.ndarray:
    values = {"est": est, "gt": gt, "symmetry": symmetry}
    scale = scale_error(**values)
    return np.array([rotation_error(**values), translation_error(**values), *np.ravel(scale)])


@pytest.mark.parametrize("fold", [None, 2, 3, 4, 6])
@settings(deadline=None, max_examples=30)
@given(est=alignments(), gt=alignments(), angle=st.floats(-3, 3))
def test_equivalent_alignments_have_the_same_errors(
    fold: int | None, est: Alignment, gt: Alignment, angle: float
) -> None:
    symmetry, step = Symmetry.around(UP, fold=fold), angle
    if fold is not None:
        step = 2 * np.pi / fold * round(angle * fold / (2 * np.pi))
    expected = errors(est, gt, symmetry)
    # Near 0, the angle has an error of the square root of the rounding error.
    found = errors(turn_model(est, -step), turn_model(gt, step), symmetry)
    np.testing.assert_allclose(found, expected, atol=1e-4)
    assert expected[0] <= rotation_error(est=est, gt=gt) + 1e-4
