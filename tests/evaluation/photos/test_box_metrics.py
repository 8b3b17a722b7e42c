"""NOCS's and PASCAL3D+'s metrics on truth and on synthetic errors of known scores."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cadalign.evaluation.metrics.photos import (
    NINE_DOF,
    VIEWPOINT,
    MetricSet,
    degree_cm,
    nine_dof_iou,
    statistics_of,
)
from cadalign.evaluation.summary import Group
from cadalign.geometry.alignment import Alignment, Box
from cadalign.geometry.symmetry import Symmetry

# --- nine degrees of freedom -----------------------------------------------------------------


def test_iou_of_boxes_is_taken_over_symmetries():
    """A cube of 2 moved by 1: 4 of 12. A plank of 2 x 1 x 1 turned by 90 deg: 1 of 3."""
    cube = Box([0, 0, 5], np.eye(3), [2, 2, 2])
    moved = Box([1, 0, 5], np.eye(3), [2, 2, 2])
    assert nine_dof_iou(est=moved, gt=cube, symmetry=Symmetry.none()) == pytest.approx(1 / 3)
    plank = Box([0, 0, 5], np.eye(3), [2, 1, 1])
    turn = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    turned = Box([0, 0, 5], turn, [2, 1, 1])
    assert nine_dof_iou(est=turned, gt=plank, symmetry=Symmetry.none()) == pytest.approx(1 / 3)
    for fold in (4, None):
        symmetry = Symmetry.around((0, 1, 0), fold=fold)
        assert nine_dof_iou(est=turned, gt=plank, symmetry=symmetry) == pytest.approx(1)


def test_degrees_and_centimetres():
    """30 and 40 mm are 5 cm; 90 deg about an axis of symmetry are none."""
    gt = Alignment(np.eye(3), [0, 0, 1000], [1, 1, 1])
    turn = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    est = Alignment(turn, [0, 30, 1040], [1, 1, 1])
    degrees, cm = degree_cm(est=est, gt=gt, symmetry=Symmetry.none(), metres=1e-3)
    assert (degrees, cm) == (pytest.approx(90), pytest.approx(5))
    bottle = Symmetry.around((0, 1, 0), fold=None)
    assert degree_cm(est=est, gt=gt, symmetry=bottle, metres=1e-3)[0] == pytest.approx(0, abs=1e-6)


def shares(chosen: MetricSet, **columns: list[float]) -> dict[str, float]:
    """Shares of a set by its metrics' names, of objects that are all ok."""
    cells = {name: np.array(values, dtype=object) for name, values in columns.items()}
    count = len(next(iter(columns.values())))
    cells["method"] = np.array(["rigid"] * count, dtype=object)
    for name in chosen.columns:
        cells.setdefault(name, np.full(count, np.nan))
    found = statistics_of([chosen], cells)
    return {name: statistic(Group(cells, cells)) for name, statistic in found.items()}


def test_shares_over_thresholds():
    """IoU must be over, degrees and cm within: 0.5 is not over 0.5, (5, 5) is within (5, 5)."""
    found = shares(
        NINE_DOF,
        box_iou=[0.5, 0.76, 0.1],
        rotation_error_deg=[5.0, 5.1, 0.0],
        translation_cm=[5.0, 1.0, 10.0],
    )
    assert found["iou_25"] == pytest.approx(2 / 3)
    assert found["iou_50"] == pytest.approx(1 / 3)
    assert found["deg_5_cm_5"] == pytest.approx(1 / 3)
    assert found["deg_10_cm_5"] == pytest.approx(2 / 3)
    assert found["deg_10_cm_10"] == 1.0


# --- PASCAL3D+ -------------------------------------------------------------------------------


def test_accuracy_at_pi_6():
    """Two of four errors are below 30 degrees; 30 is not below 30."""
    found = shares(VIEWPOINT, rotation_error_deg=[10.0, 29.9, 30.0, 50.0])
    assert found["accuracy_pi_6"] == 0.5
