"""Errors of an alignment of an object, by the metrics of its data set."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from cadalign.datasets.photos.bop import MILLIMETRES
from cadalign.evaluation.outcome import overlap_up_to_scale
from cadalign.evaluation.photos import protocols
from cadalign.evaluation.photos.metrics import bop
from cadalign.evaluation.photos.metrics.kitti import kitti_errors
from cadalign.evaluation.photos.metrics.nine_dof import degree_cm, nine_dof_iou
from cadalign.evaluation.photos.metrics.scan2cad import PlacedModel, scan2cad_errors
from cadalign.evaluation.photos.protocols import Protocol
from cadalign.evaluation.photos.sighting import PhotoTarget
from cadalign.evaluation.runs.tables import Columns, Row
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box
from cadalign.geometry.symmetry import symmetric_rotation_error

SCORE_COLUMNS: Columns = (
    *(("rotation_error_deg", float), ("translation_cm", float), ("box_iou", float)),
    ("box_iou_up_to_scale", float),
    *(("scan2cad_translation_m", float), ("scan2cad_scale", float)),
    *(("scan2cad_aligned", float), ("scan2cad_aligned_axes", float)),
    *(("yaw_error_deg", float), ("depth_error", float), ("depth_error_relative", float)),
    *(("iou_3d", float), ("iou_bev", float)),
    *(("mssd", float), ("mspd_px", float)),
    *(("mssd_recall", float), ("mspd_recall", float), ("vsd_recall", float)),
)
"""Columns of all metrics; those of other data sets are empty."""


def score_alignment(target: PhotoTarget, protocol: Protocol, est: Alignment, box: Box) -> Row:
    """Errors of an estimate by column; none where the truth is not known.

    Parameters
    ----------
    target : PhotoTarget
        The object.
    protocol : Protocol
        Of the data set.
    est : Alignment
        Of the data set's model, in the frame of the photo's camera.
    box : Box
        The estimated box in that frame.
    """
    gt = target.gt
    if gt is None:
        return {}
    return {
        name: value
        for kind in protocol.metrics
        for name, value in _SCORES[kind](target, est, gt, box).items()
        if value is not None
    }


def _viewpoint(target: PhotoTarget, est: Alignment, gt: Alignment, box: Box) -> Row:
    symmetry = target.found.symmetry
    error = symmetric_rotation_error(est=est, gt=gt, symmetry=symmetry)
    return {"rotation_error_deg": error}


def _nine_dof(target: PhotoTarget, est: Alignment, gt: Alignment, box: Box) -> Row:
    found, gt_box = target.found, target.gt_box
    values: Row = {}
    if found.truth.metres is not None:
        how: dict[str, Any] = {"symmetry": found.symmetry, "metres": found.truth.metres}
        values["translation_cm"] = degree_cm(est=est, gt=gt, **how)[1]
    if gt_box is not None and min(box.volume, gt_box.volume) > 0:
        values["box_iou"] = nine_dof_iou(est=box, gt=gt_box, symmetry=found.symmetry)
        values["box_iou_up_to_scale"] = overlap_up_to_scale(est=box, gt=gt_box)
    return values


def _scan2cad(target: PhotoTarget, est: Alignment, gt: Alignment, box: Box) -> Row:
    found, bounds = target.found, target.bounds
    center = np.zeros(3) if bounds is None else -bounds.mean(axis=0)
    truth = PlacedModel(found.category, gt, symmetry=found.symmetry, center=center)
    errors = scan2cad_errors(est=est, gt=truth)
    return {
        "scan2cad_translation_m": errors.translation,
        "scan2cad_scale": errors.scale,
        "scan2cad_aligned": float(errors.is_aligned),
        "scan2cad_aligned_axes": float(errors.is_aligned_on_each_axis),
    }


def _kitti(target: PhotoTarget, est: Alignment, gt: Alignment, box: Box) -> Row:
    if target.gt_box is None:
        return {}
    errors = kitti_errors(est=box, gt=target.gt_box)
    return {
        "yaw_error_deg": errors.yaw_deg,
        "depth_error": errors.depth,
        "depth_error_relative": errors.depth_relative,
        "iou_3d": errors.iou_3d,
        "iou_bev": errors.iou_bev,
    }


def _bop(target: PhotoTarget, est: Alignment, gt: Alignment, box: Box) -> Row:
    cad, camera, metres = target.cad, target.photo.camera, target.found.truth.metres
    if cad is None or not cad.has_mesh or camera is None:
        return {}
    given: dict[str, Any] = {"est": est, "gt": gt, "symmetry": target.found.symmetry}
    diameter = cad.diameter
    # The distance is a convex function of the vertex: largest on the hull.
    surface = bop.mssd(vertices=cad.hull_vertices, **given)
    pixels = bop.mspd(vertices=cad.scene.used_vertices, camera=camera, **given)
    values = {
        "mssd": surface / diameter,
        "mspd_px": pixels if np.isfinite(pixels) else None,
        "mssd_recall": bop.mssd_recall([surface], [diameter]),
        "mspd_recall": bop.mspd_recall([pixels], width=camera.width),
    }
    if target.photo.depth is None or metres is None:
        return values
    discrepancies = bop.vsd(
        est=est,
        gt=gt,
        scene=cad.scene,
        camera=camera,
        depth=target.photo.depth.read(),
        diameter=diameter,
        delta=bop.VSD_DELTA * MILLIMETRES / metres,
    )
    return values | {"vsd_recall": bop.vsd_recall([discrepancies])}


_SCORES: dict[str, Callable[[PhotoTarget, Alignment, Alignment, Box], Row]] = {
    protocols.VIEWPOINT: _viewpoint,
    protocols.NINE_DOF: _nine_dof,
    protocols.SCAN2CAD: _scan2cad,
    protocols.KITTI: _kitti,
    protocols.BOP: _bop,
}
