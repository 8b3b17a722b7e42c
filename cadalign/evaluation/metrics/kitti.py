"""KITTI's metrics of cars: yaw, depth, and the overlap of boxes in space and from above.

Geiger et al., "Are we ready for Autonomous Driving?", CVPR 2012, and the benchmark's evaluation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from cadalign.datasets.photos.kitti_keypoints import car_box, yaw_of_car
from cadalign.evaluation.metrics.sets import MetricSet
from cadalign.evaluation.metrics.table import BOX_IOU, Metric
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box
from cadalign.geometry.metrics import box_iou

if TYPE_CHECKING:
    from cadalign.evaluation.photos.target import PhotoTarget
    from cadalign.evaluation.runs.tables import Row


@dataclass(frozen=True)
class KittiErrors:
    """Errors and overlaps of one car.

    Parameters
    ----------
    yaw_deg : float
        Difference of the headings [degrees], 0 to 180.
    depth : float
        Difference of the centres' depths [m].
    depth_relative : float
        The same as a fraction of the true depth.
    iou_3d : float
        Intersection over union of the boxes.
    iou_bev : float
        The same of their footprints: from a bird's eye.
    """

    yaw_deg: float
    depth: float
    depth_relative: float
    iou_3d: float
    iou_bev: float


def kitti_errors(*, est: Box, gt: Box) -> KittiErrors:
    """Errors of a car's box in the frame of the camera.

    The boxes' axes are the car's: x to its left, y to its rear, z up (see
    `cadalign.datasets.KittiCars`). KITTI knows cars by their yaw alone: an estimate that is tilted
    counts as the upright box of its heading, centre and extents.

    Raises
    ------
    InputError
        If a box has no volume.

    Examples
    --------
    >>> gt = car_box(np.array([1.5, 1.6, 4.0]), np.array([0.0, 1.5, 10.0]), 0.0)
    >>> est = car_box(np.array([1.5, 1.6, 4.0]), np.array([0.0, 1.5, 10.8]), 0.1)
    >>> errors = kitti_errors(est=est, gt=gt)
    >>> round(errors.yaw_deg, 3), round(errors.depth, 3), round(errors.depth_relative, 3)
    (5.73, 0.8, 0.08)
    """
    turn = yaw_of_car(est.rotation) - yaw_of_car(gt.rotation)
    depth = float(abs(est.center[2] - gt.center[2]))
    return KittiErrors(
        yaw_deg=float(np.degrees(abs(np.arctan2(np.sin(turn), np.cos(turn))))),
        depth=depth,
        depth_relative=depth / float(gt.center[2]),
        iou_3d=box_iou(est=_upright(est), gt=_upright(gt)),
        iou_bev=box_iou(est=_footprint(est), gt=_footprint(gt)),
    )


def _upright(box: Box) -> Box:
    width, length, height = box.extents
    bottom = box.center + np.array([0, height / 2, 0])
    return car_box(np.array([height, width, length]), bottom, yaw_of_car(box.rotation))


def _footprint(box: Box) -> Box:
    """The prism of height 1 on the footprint: volumes of prisms are areas of footprints."""
    width, length, _ = box.extents
    bottom = np.array([box.center[0], 0.0, box.center[2]])
    return car_box(np.array([1.0, width, length]), bottom, yaw_of_car(box.rotation))


YAW = Metric("yaw_error_deg", "yaw error", "deg", symbol="yaw", limit=30.0)
YAW_90 = replace(
    YAW,
    key="yaw_error_deg_90",
    label="90th percentile of the yaw error",
    head="yaw error, 90 %",
    symbol="yaw90",
)
DEPTH = Metric(
    "depth_error_relative", "depth error", "%", 1, factor=100.0, symbol="depth %", limit=50.0
)
IOU_3D = replace(BOX_IOU, key="iou_3d", label="3D IoU", head="3D IoU", symbol="IoU3D")
IOU_BEV = replace(
    BOX_IOU, key="iou_bev", label="bird's-eye IoU", head="bird's-eye IoU", symbol="BEV"
)


def _measure(target: PhotoTarget, est: Alignment, gt: Alignment, box: Box) -> Row:
    if target.gt_box is None:
        return {}
    errors = kitti_errors(est=box, gt=target.gt_box)
    return {
        YAW.key: errors.yaw_deg,
        "depth_error": errors.depth,
        DEPTH.key: errors.depth_relative,
        IOU_3D.key: errors.iou_3d,
        IOU_BEV.key: errors.iou_bev,
    }


KITTI = MetricSet(
    "kitti",
    _measure,
    columns=(YAW.key, "depth_error", DEPTH.key, IOU_3D.key, IOU_BEV.key),
    medians=(YAW, DEPTH, IOU_3D, IOU_BEV),
    tails=((YAW_90, YAW),),
    headline=(YAW, YAW_90, DEPTH, IOU_3D, IOU_BEV),
    console=(YAW, YAW_90, DEPTH, IOU_3D, IOU_BEV),
)
