"""KITTI's, NOCS's and PASCAL3D+'s metrics on truth and on synthetic errors of known scores."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import cadalign.datasets
from cadalign.datasets.photos.kitti_keypoints import car_box
from cadalign.evaluation.metrics.photos import (
    NINE_DOF,
    VIEWPOINT,
    MetricSet,
    degree_cm,
    kitti_errors,
    nine_dof_iou,
    shares_of,
)
from cadalign.geometry.alignment import Alignment, Box
from cadalign.geometry.symmetry import Symmetry

DIMS = np.array([1.5, 1.6, 4.0])


def car(x=0.0, y=1.5, z=10.0, yaw=0.0):
    return car_box(DIMS, np.array([x, y, z]), yaw)


# --- KITTI -----------------------------------------------------------------------------------


@pytest.mark.parametrize("yaw", [-2.0, 0.0, 1.0])
def test_a_true_car_is_perfect(yaw):
    errors = kitti_errors(est=car(yaw=yaw), gt=car(yaw=yaw))
    assert (errors.yaw_deg, errors.depth, errors.depth_relative) == (0, 0, 0)
    assert errors.iou_3d == pytest.approx(1)
    assert errors.iou_bev == pytest.approx(1)


def test_a_car_moved_along_and_up():
    """1 m along its 4 m: footprints share 3 of 5 m. 0.5 m up: 1 m of 1.5 m is shared.

    Volumes: 3 * 1.6 * 1 = 4.8 of 2 * 9.6 - 4.8 = 14.4.
    """
    errors = kitti_errors(est=car(x=1.0, y=1.0), gt=car())
    assert errors.iou_bev == pytest.approx(3 / 5)
    assert errors.iou_3d == pytest.approx(4.8 / 14.4)
    assert errors.depth == 0


def test_a_car_turned():
    """By 90 deg: footprints cross in 1.6 x 1.6 = 2.56 of 2 * 6.4 - 2.56 = 10.24 square metres."""
    errors = kitti_errors(est=car(yaw=np.pi / 2), gt=car())
    assert errors.yaw_deg == pytest.approx(90)
    assert errors.iou_bev == pytest.approx(0.25)
    assert errors.iou_3d == pytest.approx(0.25)
    back = kitti_errors(est=car(yaw=np.pi), gt=car())
    assert back.yaw_deg == pytest.approx(180)
    assert back.iou_3d == pytest.approx(1)


def test_yaw_is_the_short_way_round_and_depth_is_relative():
    """-179 and 179 deg are 2 deg apart; 1 m of 10 m are 10 %."""
    errors = kitti_errors(est=car(z=11.0, yaw=np.radians(-179)), gt=car(yaw=np.radians(179)))
    assert errors.yaw_deg == pytest.approx(2)
    assert errors.depth == pytest.approx(1)
    assert errors.depth_relative == pytest.approx(0.1)


def test_a_tilted_car_counts_by_its_heading():
    tilt = Rotation.from_rotvec([0, 0, 0.3]).as_matrix()  # raises the nose
    tilted = Box(car().center, tilt @ car().rotation, car().extents)
    errors = kitti_errors(est=tilted, gt=car())
    assert errors.yaw_deg == pytest.approx(0, abs=1e-9)
    assert errors.iou_3d == pytest.approx(1)


def test_the_sample_cars_against_themselves(real_data):
    dataset = cadalign.datasets.open(real_data / "real" / "kitti_cars")
    for name in dataset.names[:3]:
        (found,) = dataset[name].objects
        errors = kitti_errors(est=found.truth.box, gt=found.truth.box)
        assert errors.yaw_deg == errors.depth == 0
        assert errors.iou_3d == pytest.approx(1)


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
    cells["status"] = np.array(["ok"] * len(next(iter(columns.values()))), dtype=object)
    return shares_of([chosen], cells, cells)


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
