"""Scan2CAD's alignment accuracy on truth and on synthetic errors of known scores."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cadalign import Alignment
from cadalign.evaluation.metrics.photos import scan2cad_errors
from cadalign.geometry.symmetry import Symmetry


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
    assert errors.rotation_deg == pytest.approx(error, abs=1e-6)


def test_scales_of_opposite_errors_cancel_in_the_benchmarks_error():
    """Ratios 1, 1.5, 0.5: their mean is 1. Ratios 1.3, 1.3, 1.3: 30 %."""
    errors = scan2cad_errors(est=placed(scale=(2, 3, 1)), gt=placed(scale=(2, 2, 2)))
    assert errors.scale == pytest.approx(0)
    np.testing.assert_allclose(errors.scale_axes, [0, 0.5, 0.5])
    assert errors.is_aligned
    assert not errors.is_aligned_on_each_axis
    large = scan2cad_errors(est=placed(scale=(1.3,) * 3), gt=placed())
    assert large.scale == pytest.approx(0.3)
    assert not large.is_aligned


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
    assert scan2cad_errors(est=placed(**change), gt=placed()).is_aligned == is_aligned


def test_positions_are_those_of_the_centre():
    """Turned by 180 deg about the origin, the point (1, 0, 0) goes to (-1, 0, 0): 2 m."""
    turned, center = placed(yaw=180), np.array([1.0, 0, 0])
    found = scan2cad_errors(est=turned, gt=placed(), center=center)
    assert found.translation == pytest.approx(2)
    assert scan2cad_errors(est=placed(yaw=180), gt=placed()).translation == 0
