"""Scan2CAD's errors do not change under a model's symmetry or a change of frame."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cadalign import Alignment, Symmetry
from cadalign.evaluation.metrics.photos import scan2cad_errors
from cadalign.geometry.rotations import rotation_from_vector

pytestmark = pytest.mark.slow

UP = np.array([0.0, 1.0, 0.0])

vectors = st.tuples(*[st.floats(-1.5, 1.5)] * 3).map(np.array)
rotations = vectors.map(rotation_from_vector)
places = st.tuples(*[st.floats(-0.5, 0.5)] * 2, st.floats(2, 4)).map(np.array)


@st.composite
def alignments(draw: st.DrawFn) -> Alignment:
    """Poses with the same stretch along x and z, which rotations about y exchange."""
    across, along = draw(st.floats(0.6, 1.6)), draw(st.floats(0.6, 1.6))
    return Alignment(draw(rotations), draw(places), [across, along, across])


def turned(alignment: Alignment, angle: float) -> Alignment:
    """The alignment of the model after a rotation about its y axis, which keeps its scales."""
    rotation = alignment.rotation @ rotation_from_vector(angle * UP)
    return Alignment(rotation, alignment.translation, alignment.scale)


@settings(deadline=None, max_examples=60)
@given(alignments(), alignments(), st.floats(-3, 3), st.floats(-3, 3), st.floats(-1, 1))
def test_scan2cad_errors_are_those_of_any_equal_alignments(
    est: Alignment, gt: Alignment, first: float, second: float, height: float
) -> None:
    about: Any = {"symmetry": Symmetry.around(UP, fold=None), "center": height * UP}
    expected = scan2cad_errors(est=est, gt=gt, **about)
    found = scan2cad_errors(est=turned(est, second), gt=turned(gt, first), **about)
    # The angle of a rotation near 0 is known to the root of rounding.
    assert found.rotation_deg == pytest.approx(expected.rotation_deg, abs=1e-4)
    assert found.translation == pytest.approx(expected.translation, abs=1e-9)
    assert found.scale == pytest.approx(expected.scale, abs=1e-9)


@settings(deadline=None, max_examples=60)
@given(alignments(), alignments(), rotations, vectors, vectors)
def test_distances_are_those_in_any_frame(
    est: Alignment, gt: Alignment, rotation: np.ndarray, shift: np.ndarray, center: np.ndarray
) -> None:
    def moved(alignment: Alignment) -> Alignment:
        place = rotation @ alignment.translation + shift
        return Alignment(rotation @ alignment.rotation, place, alignment.scale)

    before = scan2cad_errors(est=est, gt=gt, center=center)
    after = scan2cad_errors(est=moved(est), gt=moved(gt), center=center)
    assert after.translation == pytest.approx(before.translation, abs=1e-9)
    assert after.rotation_deg == pytest.approx(before.rotation_deg, abs=1e-4)
    assert after.scale == before.scale
