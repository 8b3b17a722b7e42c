"""Ranking of models by a mask alone, without keypoints.

Each model has an outline: its silhouettes along directions all around, free of affine maps and so
of pose and stretch. The models whose outlines resemble the mask most are aligned with it, and
ranked by the likelihood of its contour at the estimate, neighbouring samples of which count as one
as far as they are correlated.
"""

from __future__ import annotations

import logging
from collections.abc import Collection
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, worker_count
from cadalign.errors import CadalignError, DegenerateError, InputError
from cadalign.estimation.align import align
from cadalign.estimation.contours.atlas import Whitened, outline_of, overlaps
from cadalign.estimation.contours.noise import cost_of_contour
from cadalign.estimation.contours.silhouettes import outline_of_mask
from cadalign.estimation.model import Model
from cadalign.estimation.result import Result
from cadalign.estimation.uncertainty.summary import MaskResiduals
from cadalign.estimation.view import View
from cadalign.geometry.box import Box
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.render import Scene, cast_geometry, silhouette_iou
from cadalign.retrieval.candidates import chosen_models
from cadalign.retrieval.match import Match
from cadalign.retrieval.models import LibraryModel, ModelKey, ModelTable
from cadalign.retrieval.options import RetrievalOptions

logger = logging.getLogger("cadalign")

MOST_ALIGNED = 8
"""Models that are aligned with a mask, so that a list of matches is no longer."""

_REACH = 24.0  # [px], farther away is no rim


class OutlineStore:
    """Outlines of a library's models with meshes, each made when it is first needed."""

    def __init__(self, table: ModelTable) -> None:
        self._table = table
        self._known: dict[int, Whitened | None] = {}

    def of(self, rows: list[int], workers: int) -> list[Whitened | None]:
        """Outlines of some rows of the table; None where a mesh is missing or cannot be read."""
        lacking = [row for row in rows if row not in self._known]
        with ThreadPoolExecutor(worker_count(workers)) as pool:
            self._known |= zip(lacking, pool.map(self._made, lacking), strict=True)
        return [self._known[row] for row in rows]

    def _made(self, row: int) -> Whitened | None:
        model = self._table.model(row)
        if model.mesh_path is None:
            return None
        try:
            return outline_of(model.load_mesh())
        except CadalignError as error:
            logger.warning("no silhouette: %s", error)
            return None


@dataclass(frozen=True, eq=False)
class _AlignedModel:
    """A model aligned with the mask, and the contour there."""

    model: LibraryModel
    mesh: Mesh
    result: Result
    contour: MaskResiduals = field(repr=False)

    @property
    def cost(self) -> float:
        """Mean of a sample's -log density."""
        residuals = np.abs(np.nan_to_num(self.contour.residuals, nan=_REACH))
        return cost_of_contour(np.minimum(residuals, _REACH), _REACH)


def rank_by_mask(
    table: ModelTable,
    outlines: OutlineStore,
    mask: npt.NDArray[np.generic],
    camera: Camera,
    options: RetrievalOptions,
    *,
    exclude: Collection[ModelKey],
    workers: int,
) -> list[Match]:
    """Rank the models whose outlines resemble a mask (h, w) most by their alignments with it.

    Raises InputError if the focal length is unknown or no model has a mesh that can be read,
    DegenerateError if none can be aligned.
    """
    if not camera.focal_known:
        raise InputError(
            "a mask alone does not tell the focal length",
            where="camera",
            fix="give a calibrated camera, or keypoints",
        )
    inside = np.asarray(View(camera, mask=mask).mask_image) >= 0.5
    aligned = []
    for row in _resembling(table, outlines, inside, camera, options, exclude, workers):
        found = _aligned(table.model(row), inside, camera, options)
        if found is not None:
            aligned.append(found)
    if not aligned:
        raise DegenerateError(
            "no model can be aligned with the mask",
            where="mask",
            fix="check the mask and the camera, or give keypoints",
        )
    aligned.sort(key=lambda each: each.cost)
    first = aligned[0].contour
    samples = len(first.residuals) / first.correlation
    logs = np.array([-samples * each.cost for each in aligned])
    scores = np.exp(logs - logs[0])
    scores /= scores.sum()
    return [
        _match(each, camera, inside, float(log), float(score))
        for each, log, score in zip(aligned, logs, scores, strict=True)
    ][: options.top]


def _resembling(
    table: ModelTable,
    outlines: OutlineStore,
    inside: BoolArray,
    camera: Camera,
    options: RetrievalOptions,
    exclude: Collection[ModelKey],
    workers: int,
) -> list[int]:
    """Rows of the models whose outlines overlap most with the mask's, the best first."""
    rows = chosen_models(table, options.category, exclude).tolist()
    query = outline_of_mask(inside, camera)
    found = [
        (float(overlaps(outline, query).max()), row)
        for row, outline in zip(rows, outlines.of(rows, workers), strict=True)
        if outline is not None
    ]
    if not found:
        raise InputError(
            "no model has a mesh, without which a mask alone ranks nothing",
            where="library",
            fix="build the library with meshes, or give keypoints",
        )
    found.sort(key=lambda each: (-each[0], each[1]))
    return [row for _, row in found[:MOST_ALIGNED]]


def _aligned(
    model: LibraryModel, inside: BoolArray, camera: Camera, options: RetrievalOptions
) -> _AlignedModel | None:
    mesh = model.load_mesh()
    given = Model(mesh=mesh, stretch=options.stretch, stretch_sigma=options.stretch_sigma)
    try:
        result = align(given, View(camera, mask=inside))
    except CadalignError as error:
        logger.debug("%s, model %s: %s", model.category, model.model_id, error)
        return None
    (contour,) = result.mask_residuals
    return None if contour is None else _AlignedModel(model, mesh, result, contour)


def _match(
    aligned: _AlignedModel, camera: Camera, inside: BoolArray, log: float, score: float
) -> Match:
    model, alignment = aligned.model, aligned.result.alignment
    silhouette = cast_geometry(Scene(aligned.mesh), camera, alignment).mask
    none: FloatArray = np.empty((0, 3))
    return Match(
        category=model.category,
        model_id=model.model_id,
        alignment=alignment,
        rms=aligned.contour.rms,
        log_likelihood=log,
        score=score,
        box=Box.from_model(model.bounds, alignment),
        bounds=model.bounds,
        ids=np.empty(0, dtype=np.int64),
        points_3d=none,
        points_2d=none[:, :2],
        residuals=none[:, :2],
        missing_ids=(),
        mirrored=False,
        mesh_path=model.mesh_path,
        silhouette_iou=silhouette_iou(est=silhouette, gt=inside),
        camera=camera,
    )
