"""Scan2CAD's alignment accuracy on truth and on synthetic errors of known scores."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import cadalign.datasets
from cadalign.evaluation.metrics.scan2cad import (
    PlacedModel,
    scan2cad_accuracy,
    scan2cad_errors,
)
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.symmetry import Symmetry


def placed(category="chair", *, at=(0, 0, 2), yaw=0.0, scale=(1, 1, 1), fold=1, model_id=None):
    rotation = Rotation.from_euler("y", yaw, degrees=True).as_matrix()
    symmetry = Symmetry.around((0, 1, 0), fold=fold)
    return PlacedModel(category, Alignment(rotation, at, scale), model_id, symmetry)


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
    errors = scan2cad_errors(est=placed(yaw=yaw).alignment, gt=placed(fold=fold))
    assert errors.rotation_deg == pytest.approx(error, abs=1e-6)


def test_scales_of_opposite_errors_cancel_in_the_benchmarks_error():
    """Ratios 1, 1.5, 0.5: their mean is 1. Ratios 1.3, 1.3, 1.3: 30 %."""
    errors = scan2cad_errors(est=placed(scale=(2, 3, 1)).alignment, gt=placed(scale=(2, 2, 2)))
    assert errors.scale == pytest.approx(0)
    np.testing.assert_allclose(errors.scale_axes, [0, 0.5, 0.5])
    assert errors.is_aligned
    assert not errors.is_aligned_on_each_axis
    large = scan2cad_errors(est=placed(scale=(1.3,) * 3).alignment, gt=placed())
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
    assert scan2cad_errors(est=placed(**change).alignment, gt=placed()).is_aligned == is_aligned


def test_positions_are_those_of_the_centre():
    """Turned by 180 deg about the origin, the point (1, 0, 0) goes to (-1, 0, 0): 2 m."""
    gt = PlacedModel("chair", placed().alignment, center=np.array([1.0, 0, 0]))
    assert scan2cad_errors(est=placed(yaw=180).alignment, gt=gt).translation == pytest.approx(2)
    assert scan2cad_errors(est=placed(yaw=180).alignment, gt=placed()).translation == 0


def test_truth_against_truth_is_perfect():
    scene = [placed(), placed("table", at=(1, 0, 2), fold=None), placed("lamp", at=(0, 1, 3))]
    accuracy = scan2cad_accuracy([(scene, scene), ([], [])])
    assert accuracy.by_category == {"chair": 1.0, "table": 1.0, "other": 1.0}
    assert accuracy.category_average == accuracy.instance_average == 1.0


def test_a_worked_case_of_matches():
    """Scene 1 has chairs at x = 0 and 1 and a table; scene 2 a chair.

    Estimates of scene 1, in order: a chair 0.1 m off the first one (a match), another there (the
    first is taken, the second 0.9 m away: none), a sofa at the table (wrong category), a chair
    0.1 m off the second (a match). Scene 2: nothing. Chairs: 2 of 3, table 0 of 1; by category
    (2/3 + 0) / 2 = 1/3, of all 2/4.
    """
    truths = [placed(), placed(at=(1, 0, 2)), placed("table", at=(3, 0, 2))]
    estimates = [
        placed(at=(0.1, 0, 2)),
        placed(at=(0.1, 0, 2)),
        placed("sofa", at=(3, 0, 2)),
        placed(at=(1, 0, 2.1)),
    ]
    accuracy = scan2cad_accuracy([(estimates, truths), ([], [placed()])])
    assert accuracy.aligned == {"chair": 2, "table": 0}
    assert accuracy.total == {"chair": 3, "table": 1}
    assert accuracy.category_average == pytest.approx(1 / 3)
    assert accuracy.instance_average == 0.5


def test_estimates_of_a_model_count_as_often_as_it_is_there():
    """The first estimate of model a, far off, uses up its only appearance."""
    truths = [placed(model_id="a"), placed(at=(5, 0, 2), model_id="b")]
    estimates = [placed(at=(9, 0, 2), model_id="a"), placed(model_id="a"), placed(model_id="c")]
    assert scan2cad_accuracy([(estimates, truths)]).aligned == {"chair": 0}
    assert scan2cad_accuracy([(estimates[1:], truths)]).aligned == {"chair": 1}


def test_no_models_have_no_accuracy():
    accuracy = scan2cad_accuracy([])
    assert np.isnan([accuracy.category_average, accuracy.instance_average]).all()


def test_the_sample_against_itself(real_data):
    photo = cadalign.datasets.open(real_data / "real" / "scan2cad")[0]
    models = [
        PlacedModel(each.category, each.truth.cam_from_model, each.model.model_id, each.symmetry)
        for each in photo.objects
    ]
    assert scan2cad_accuracy([(models, models)]).by_category == {"chair": 1.0}
