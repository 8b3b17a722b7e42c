"""Metrics of PASCAL3D+, NOCS and Scan2CAD on truth and on synthetic errors of known scores."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cadalign import Alignment
from cadalign.evaluation import metrics
from cadalign.evaluation.metrics import Metric
from cadalign.evaluation.metrics.photos import (
    RATES,
    Protocol,
    Rate,
    scan2cad_errors,
    symmetric_box_iou,
)
from cadalign.evaluation.summary import Group
from cadalign.geometry.alignment import Box
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.geometry.symmetry import Symmetry


def test_iou_of_boxes_is_taken_over_symmetries():
    """A cube of side 2 moved by 1: 4 / 12. A box of 2 x 1 x 1 rotated by 90 deg: 1 / 3."""
    cube = Box([0, 0, 5], np.eye(3), [2, 2, 2])
    moved = Box([1, 0, 5], np.eye(3), [2, 2, 2])
    assert symmetric_box_iou(est=moved, gt=cube, symmetry=Symmetry.none()) == pytest.approx(1 / 3)
    plank = Box([0, 0, 5], np.eye(3), [2, 1, 1])
    turn = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    turned = Box([0, 0, 5], turn, [2, 1, 1])
    assert symmetric_box_iou(est=turned, gt=plank, symmetry=Symmetry.none()) == pytest.approx(1 / 3)
    for fold in (4, None):
        symmetry = Symmetry.around((0, 1, 0), fold=fold)
        assert symmetric_box_iou(est=turned, gt=plank, symmetry=symmetry) == pytest.approx(1)


def test_accuracy_at_pi_6():
    """Two of four errors are below 30 degrees; 30 is not below 30."""
    cells = {"rotation_error_deg": [10.0, 29.9, 30.0, 50.0], "method": ["rigid"] * 4}
    arrays = {name: np.array(values, dtype=object) for name, values in cells.items()}
    (rate,) = (each for each in RATES if each.metric.key == "accuracy_pi_6")
    assert rate.share(Group(arrays, arrays)) == 0.5


def test_a_measure_adds_a_metric() -> None:
    """For functions as metrics see `test_metrics`."""
    protocol = Protocol((lambda target, est, gt, box: {"depth": float((est - gt).sum())},))
    target: Any = SimpleNamespace(gt=np.array([0.0, 0.0, 2.0]))
    est, box = target.gt + [0, 0, 0.25], cast(Any, None)
    assert protocol.score(target, est, box) == {"depth": 0.25}
    assert protocol.score(cast(Any, SimpleNamespace(gt=None)), est, box) == {}
    rate = Rate(metrics.SUCCESS, Metric("depth", "depth error", "m"), limit=0.5)
    cells = {"depth": np.array([0.25, 0.5, 2.0, 0.1]), "method": np.array(["mine"] * 4)}
    assert rate.share(Group(cells, cells)) == 0.5


# Scan2CAD -----------------------------------------------------------------------------------------


def placed(*, at=(0, 0, 2), yaw=0.0, scale=(1, 1, 1)):
    rotation = Rotation.from_euler("y", yaw, degrees=True).as_matrix()
    return Alignment(rotation, at, scale)


@pytest.mark.parametrize(
    ("yaw", "fold", "error"),
    [
        (170, 1, 170),
        (170, 2, 10),  # 10 deg short of the half turn
        (110, 4, 20),  # 20 deg over the quarter turn
        (135, 4, 45),  # between the first and the second quarter turn
        (77, None, 0),
    ],
)
def test_rotations_are_compared_up_to_symmetry(yaw, fold, error):
    symmetry = Symmetry.around((0, 1, 0), fold=fold)
    errors = scan2cad_errors(est=placed(yaw=yaw), gt=placed(), symmetry=symmetry)
    assert errors["rotation_error_deg"] == pytest.approx(error, abs=1e-6)


def test_scales_of_opposite_errors_cancel_in_the_benchmarks_error():
    """Ratios 1, 1.5, 0.5: their mean is 1. Ratios 1.3, 1.3, 1.3: 30 %."""
    errors = scan2cad_errors(est=placed(scale=(2, 3, 1)), gt=placed(scale=(2, 2, 2)))
    assert errors["scan2cad_scale"] == pytest.approx(0)
    assert (errors["scan2cad_aligned"], errors["scan2cad_aligned_axes"]) == (1, 0)
    large = scan2cad_errors(est=placed(scale=(1.3,) * 3), gt=placed())
    assert large["scan2cad_scale"] == pytest.approx(0.3)
    assert large["scan2cad_aligned"] == 0


@pytest.mark.parametrize(
    ("change", "is_aligned"),
    [
        ({"at": (0.12, 0.15, 2)}, True),  # 0.192 m
        ({"at": (0.12, 0.17, 2)}, False),  # 0.208 m
        ({"yaw": 19.9}, True),
        ({"yaw": 20.1}, False),
        ({"scale": (1.59, 1, 1)}, True),  # mean ratio 1.197
        ({"scale": (1.61, 1, 1)}, False),  # mean ratio 1.203
    ],
)
def test_thresholds(change, is_aligned):
    found = scan2cad_errors(est=placed(**change), gt=placed())
    assert found["scan2cad_aligned"] == is_aligned


def test_translation_errors_are_of_the_centre():
    """Turned by 180 deg about the origin, the point (1, 0, 0) goes to (-1, 0, 0): 2 m."""
    turned, center = placed(yaw=180), np.array([1.0, 0, 0])
    found = scan2cad_errors(est=turned, gt=placed(), center=center)
    assert found["scan2cad_translation_m"] == pytest.approx(2)
    assert scan2cad_errors(est=placed(yaw=180), gt=placed())["scan2cad_translation_m"] == 0


vectors = st.tuples(*[st.floats(-1.5, 1.5)] * 3).map(np.array)


@pytest.mark.slow
@settings(deadline=None, max_examples=60)
@given(vectors, vectors, vectors, vectors, st.floats(-3, 3), st.floats(0.6, 1.6))
def test_errors_are_those_in_any_frame_and_of_any_equal_alignment(
    est: np.ndarray,
    gt: np.ndarray,
    frame: np.ndarray,
    shift: np.ndarray,
    angle: float,
    scale: float,
) -> None:
    up = np.array([0.0, 1.0, 0.0])
    about: Any = {"symmetry": Symmetry.around(up, fold=None), "center": 0.5 * up}

    def pose(turn: np.ndarray, scales: list[float]) -> Alignment:
        return Alignment(rotation_from_vector(turn), [0.1, 0.2, 3 + turn[0]], scales)

    def moved(alignment: Alignment, about_up: float) -> Alignment:
        """In another frame, the model turned about its axis, along which its scales are equal."""
        rotation = rotation_from_vector(frame) @ alignment.rotation
        place = rotation_from_vector(frame) @ alignment.translation + shift
        return Alignment(rotation @ rotation_from_vector(about_up * up), place, alignment.scale)

    first, second = pose(est, [scale, 1.1, scale]), pose(gt, [1, 0.9, 1])
    before = scan2cad_errors(est=first, gt=second, **about)
    after = scan2cad_errors(est=moved(first, angle), gt=moved(second, -angle), **about)
    # Angles near 0 have an error of the square root of the rounding error.
    for name in ("rotation_error_deg", "scan2cad_translation_m", "scan2cad_scale"):
        assert after[name] == pytest.approx(before[name], abs=1e-4)
