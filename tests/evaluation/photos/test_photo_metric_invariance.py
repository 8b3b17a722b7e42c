"""BOP's and Scan2CAD's errors do not change under a model's symmetry or a change of frame."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cadalign import Alignment, Camera, Symmetry
from cadalign.evaluation.metrics.bop import mspd, mssd
from cadalign.evaluation.metrics.scan2cad import PlacedModel, scan2cad_errors
from cadalign.geometry.rotations import rotation_from_vector

pytestmark = pytest.mark.slow

UP = np.array([0.0, 1.0, 0.0])
CAMERA = Camera(640, 480, 500, 500, 319.5, 239.5)

vectors = st.tuples(*[st.floats(-1.5, 1.5)] * 3).map(np.array)
rotations = vectors.map(rotation_from_vector)
places = st.tuples(*[st.floats(-0.5, 0.5)] * 2, st.floats(2, 4)).map(np.array)
folds = st.sampled_from([2, 3, 4, 6])
steps = st.integers(0, 5)


@st.composite
def alignments(draw: st.DrawFn) -> Alignment:
    """Poses with the same stretch along x and z, which rotations about y exchange."""
    across, along = draw(st.floats(0.6, 1.6)), draw(st.floats(0.6, 1.6))
    return Alignment(draw(rotations), draw(places), [across, along, across])


def vertices_of(fold: int) -> np.ndarray:
    """Points (4 * fold, 3) that turns about y by parts of a circle take to one another."""
    some = np.random.default_rng(fold).uniform(-0.3, 0.3, (4, 3))
    turns = [rotation_from_vector(2 * np.pi * k / fold * UP) for k in range(fold)]
    return np.concatenate([some @ turn.T for turn in turns])


def turned(alignment: Alignment, angle: float) -> Alignment:
    """The alignment of the model after a rotation about its y axis, which keeps its scales."""
    rotation = alignment.rotation @ rotation_from_vector(angle * UP)
    return Alignment(rotation, alignment.translation, alignment.scale)


@settings(deadline=None, max_examples=60)
@given(alignments(), alignments(), folds, steps, steps)
def test_bop_distances_are_those_of_any_equal_alignments(
    est: Alignment, gt: Alignment, fold: int, first: int, second: int
) -> None:
    given_ = {"vertices": vertices_of(fold), "symmetry": Symmetry.around(UP, fold=fold)}
    equal = {
        "est": turned(est, 2 * np.pi * first / fold),
        "gt": turned(gt, 2 * np.pi * second / fold),
    }
    expected = mssd(est=est, gt=gt, **given_)
    assert mssd(**equal, **given_) == pytest.approx(expected, abs=1e-9)
    assert mssd(est=gt, gt=est, **given_) == pytest.approx(expected, abs=1e-9)
    expected = mspd(est=est, gt=gt, camera=CAMERA, **given_)
    assert mspd(**equal, camera=CAMERA, **given_) == pytest.approx(expected, abs=1e-6)


@settings(deadline=None, max_examples=60)
@given(alignments(), alignments(), st.floats(-3, 3), st.floats(-3, 3), st.floats(-1, 1))
def test_scan2cad_errors_are_those_of_any_equal_alignments(
    est: Alignment, gt: Alignment, first: float, second: float, height: float
) -> None:
    about = {"symmetry": Symmetry.around(UP, fold=None), "center": height * UP}
    expected = scan2cad_errors(est=est, gt=PlacedModel("chair", gt, **about))
    truth = PlacedModel("chair", turned(gt, first), **about)
    found = scan2cad_errors(est=turned(est, second), gt=truth)
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

    none = {"vertices": vertices_of(3), "symmetry": Symmetry.none()}
    expected = mssd(est=est, gt=gt, **none)
    assert mssd(est=moved(est), gt=moved(gt), **none) == pytest.approx(expected, abs=1e-9)
    before = scan2cad_errors(est=est, gt=PlacedModel("chair", gt, center=center))
    after = scan2cad_errors(est=moved(est), gt=PlacedModel("chair", moved(gt), center=center))
    assert after.translation == pytest.approx(before.translation, abs=1e-9)
    assert after.rotation_deg == pytest.approx(before.rotation_deg, abs=1e-4)
    assert after.scale == before.scale


@settings(deadline=None, max_examples=40)
@given(alignments(), alignments(), st.floats(-np.pi, np.pi))
def test_projections_are_as_far_in_a_rotated_photo(
    est: Alignment, gt: Alignment, angle: float
) -> None:
    """A turn about the optical axis turns the image about the principal point."""
    turn = rotation_from_vector(np.array([0.0, 0.0, angle]))

    def rolled(alignment: Alignment) -> Alignment:
        place = turn @ alignment.translation
        return Alignment(turn @ alignment.rotation, place, alignment.scale)

    given_ = {"vertices": vertices_of(4), "symmetry": Symmetry.none(), "camera": CAMERA}
    expected = mspd(est=est, gt=gt, **given_)
    assert mspd(est=rolled(est), gt=rolled(gt), **given_) == pytest.approx(expected, abs=1e-6)
