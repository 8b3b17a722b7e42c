"""Instance records of the experiment: every method's shape, as a warp of the object's own."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.datasets import KeypointNet
from cadalign.errors import CadalignError, DataError
from cadalign.evaluation.instances.aligned import AlignedShape, Warp, box_alignment, shape_of_result
from cadalign.evaluation.instances.instance import HULL, KEYPOINT_CAMERA, Instance
from cadalign.evaluation.instances.preview import write_preview
from cadalign.evaluation.instances.record import record_row, record_stem
from cadalign.evaluation.outcome import Outcome
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import Row
from cadalign.evaluation.unseen.methods import ShapeEstimate
from cadalign.evaluation.unseen.tasks import UnseenSighting, UnseenTask
from cadalign.geometry.alignment import Alignment
from cadalign.io.files import writing

logger = logging.getLogger("cadalign")


def sighting_record(
    sighting: UnseenSighting,
    outcomes: Sequence[Outcome],
    estimates: Sequence[ShapeEstimate | CadalignError],
    *,
    sigma: float,
) -> Row:
    """The record of a view of an object, whose box is that of its keypoints.

    ``sigma`` is the standard deviation of the keypoints [px] that methods were told.
    """
    instance = Instance(
        camera=KEYPOINT_CAMERA,
        cam_from_model=sighting.gt,
        points_3d=sighting.xyz[sighting.rows],
        points_2d=sighting.points_2d,
        semantic_ids=sighting.semantic_ids,
        bounds=sighting.bounds,
        gt=sighting.gt,
        visibility=HULL,
        scene=None,
        diagonal=1.0,
    )
    described = [
        each if isinstance(each, CadalignError) else _aligned(each, sighting, sigma)
        for each in estimates
    ]
    return record_row(instance, outcomes, described)


def keep_preview(folder: RunFolder, root: Path, task: UnseenTask) -> None:
    """Write the preview of an object's mesh to a run's folder; nothing without a readable mesh."""
    model = _dataset(root)[task.category, task.model_id]
    if model.mesh_path is None:
        return
    try:
        mesh = model.load_mesh()
    except DataError as error:
        logger.warning("no preview of the mesh: %s", error)
        return
    with writing(folder.previews):
        folder.previews.mkdir(exist_ok=True)
    write_preview(folder.previews / f"{record_stem(task.category, task.model_id)}.json", mesh)


_dataset = lru_cache(maxsize=1)(KeypointNet)


def _aligned(found: ShapeEstimate, sighting: UnseenSighting, sigma: float) -> AlignedShape:
    """An estimate in terms of the object, of which it has some keypoints."""
    row_of = {label: row for row, label in enumerate(found.ids.tolist())}
    known = np.flatnonzero([label in row_of for label in sighting.all_ids.tolist()])
    rows = np.array([row_of[label] for label in sighting.all_ids[known].tolist()], dtype=np.int64)
    alignment, warp = _warp(found.alignment, found.points_3d[rows], sighting, known)
    rms = _rms(alignment, warp, sighting, known)
    if found.result is None:
        return AlignedShape(alignment, None, rms, sigma, (), (), warp)
    return shape_of_result(
        found.result,
        lambda each: _warp(each.alignment, each.points_3d[rows], sighting, known),
        rms=rms,
        sigma=sigma,
    )


def _warp(
    found: Alignment, points: FloatArray, sighting: UnseenSighting, known: IntArray
) -> tuple[Alignment, Warp]:
    """The alignment of the object's box with that of estimated points, and what remains."""
    bounds = np.stack([points.min(axis=0), points.max(axis=0)])
    alignment = box_alignment(found, bounds, model_bounds=sighting.bounds)
    return alignment, Warp(sighting.xyz[known], alignment.inverse(found.apply(points)))


def _rms(alignment: Alignment, warp: Warp, sighting: UnseenSighting, known: IntArray) -> float:
    """Root mean square residual [px] of the given keypoints that the method has."""
    given = np.isin(sighting.rows, known)
    places = warp.target[np.searchsorted(known, sighting.rows[given])]
    in_camera = alignment.apply(places)
    ahead = in_camera[:, 2] > 0
    if not ahead.any():
        return float("nan")
    residuals = KEYPOINT_CAMERA.project(in_camera[ahead]) - sighting.points_2d[given][ahead]
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))
