"""NOCS's and PASCAL3D+'s metrics on truth and on synthetic errors of known scores."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cadalign.evaluation.metrics.photos import (
    VIEWPOINT,
    MetricSet,
    score_columns,
    statistics_of,
    symmetric_box_iou,
)
from cadalign.evaluation.summary import Group
from cadalign.geometry.alignment import Box
from cadalign.geometry.symmetry import Symmetry

# --- boxes -----------------------------------------------------------------------------------


def test_iou_of_boxes_is_taken_over_symmetries():
    """A cube of 2 moved by 1: 4 of 12. A plank of 2 x 1 x 1 turned by 90 deg: 1 of 3."""
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


def shares(chosen: MetricSet, **columns: list[float]) -> dict[str, float]:
    """Shares of a set by its metrics' names, of objects that are all ok."""
    cells = {name: np.array(values, dtype=object) for name, values in columns.items()}
    count = len(next(iter(columns.values())))
    cells["method"] = np.array(["rigid"] * count, dtype=object)
    for name, _ in score_columns([chosen]):
        cells.setdefault(name, np.full(count, np.nan))
    found = statistics_of([chosen], cells)
    return {name: statistic(Group(cells, cells)) for name, statistic in found.items()}


# --- PASCAL3D+ -------------------------------------------------------------------------------


def test_accuracy_at_pi_6():
    """Two of four errors are below 30 degrees; 30 is not below 30."""
    found = shares(VIEWPOINT, rotation_error_deg=[10.0, 29.9, 30.0, 50.0])
    assert found["accuracy_pi_6"] == 0.5
