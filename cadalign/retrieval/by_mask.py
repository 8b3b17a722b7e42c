"""Rankings by masks: of models by a mask alone, and of the best matches again by silhouettes.

Without keypoints, each model has an outline: its silhouettes along directions all around, free of
affine maps and so of pose and stretch. The models whose outlines resemble the mask most are aligned
with it, roughly by their whole outlines; those that meet it, or all where none does, for a part may
be hidden, are aligned by whatever part the mask shows. They are ranked by the likelihood of its
contour at the estimate, neighbouring samples of which count as one as far as they are correlated.

With keypoints, the silhouette of each match's mesh, posed and stretched, is compared with the
object's pixels. The intersection over union of the correct model falls short of 1 by 0.05 on
average, exponentially distributed, so a match gains ``IoU / 0.05`` in log-likelihood over one
without overlap. A match without a mesh gains the mean of the others' gains, so that it is neither
preferred nor rejected.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, cast

import cv2
import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, worker_count
from cadalign.datasets import load_mesh
from cadalign.errors import CadalignError, DegenerateError, InputError
from cadalign.estimation.align import align
from cadalign.estimation.contours.proposals import align_outline
from cadalign.estimation.contours.silhouettes import FacedMask, Whitened, outline_of, overlaps
from cadalign.estimation.contours.view_contour import cost_of_contour
from cadalign.estimation.model import Model
from cadalign.estimation.view import View
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.render import Geometry, Scene, cast_geometry, silhouette_iou
from cadalign.retrieval.match import Match
from cadalign.retrieval.models import LibraryModel, ModelKey, ModelTable
from cadalign.retrieval.options import RetrievalOptions
from cadalign.retrieval.ranking import chosen_models

logger = logging.getLogger("cadalign")

MOST_ALIGNED = 8
"""Models that are aligned with a mask, so that a list of matches is no longer."""

_REACH = 24.0  # [px], farther away is no rim
_SHORTFALL = 0.05
_GRAB_ROUNDS = 5
_MARGIN = 0.15  # around keypoints and boxes, as a share of their extent


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
        without = sum(self._known[row] is None for row in lacking)
        if without and without < len(rows):
            said = "%d of %d models have no mesh that can be read, and are not ranked by the mask"
            logger.warning(said, without, len(rows))
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


def rank_by_mask(
    table: ModelTable,
    outlines: OutlineStore,
    mask: npt.NDArray[Any],
    camera: Camera,
    options: RetrievalOptions,
    exclude: Collection[ModelKey],
    workers: int,
) -> list[Match]:
    """Rank the models whose outlines resemble a mask (h, w) most by their alignments with it.

    Raises InputError if the focal length is unknown or no model has a mesh that can be read,
    DegenerateError if none can be aligned.
    """
    if not camera.focal_known:
        what, fix = "a mask alone does not tell the focal length", "give a calibrated camera"
        raise InputError(what, where="camera", fix=f"{fix}, or keypoints")
    if mask.dtype.kind in "iu":  # of an image
        mask = mask > np.iinfo(mask.dtype).max / 2
    inside = np.asarray(View(camera, mask=mask).mask_image) >= 0.5
    rows = chosen_models(table, options.category, exclude).tolist()
    query = FacedMask.of(inside, camera).outline
    overlapping = [
        (-float(overlaps(outline, query).max()), row)
        for row, outline in zip(rows, outlines.of(rows, workers), strict=True)
        if outline is not None
    ]
    if not overlapping:
        what = "no model has a mesh, without which a mask alone ranks nothing"
        fix = "build the library with meshes, or give keypoints"
        raise InputError(what, where="library", fix=fix)
    resembling = [row for _, row in sorted(overlapping)[:MOST_ALIGNED]]
    view = View(camera, mask=inside)
    with ThreadPoolExecutor(worker_count(workers)) as pool:
        rough = pool.map(
            lambda row: _roughly_aligned(table, table.model(row), view, options),
            resembling,
        )
        aligned = [found for found in rough if found is not None]
        is_any_met = any(each.is_met for each in aligned)
        aligned = list(pool.map(partial(_aligned, view=view, is_any_met=is_any_met), aligned))
    if not aligned:
        what = "no model can be aligned with the mask"
        fix = "check the mask and the camera, or give keypoints"
        raise DegenerateError(what, where="mask", fix=fix)
    aligned.sort(key=lambda each: each.cost)
    logs = np.array([-aligned[0].samples * each.cost for each in aligned])
    scores = np.exp(logs - logs[0])
    scores /= scores.sum()
    return [
        _match(each, camera, inside, float(log), float(score))
        for each, log, score in zip(aligned[: options.top], logs, scores, strict=False)
    ]


class _Aligned(NamedTuple):
    """A model aligned with a mask.

    The ``residuals`` (S,) [px] are distances of the mask's contour from the rim, NaN where there is
    none; so many neighbours as the ``correlation`` count as one.
    """

    model: LibraryModel
    given: Model
    alignment: Alignment
    residuals: FloatArray
    correlation: float
    is_met: bool

    @property
    def cost(self) -> float:
        """Mean of the samples' -log probability density."""
        distances = np.abs(np.nan_to_num(self.residuals, nan=_REACH))
        return cost_of_contour(np.minimum(distances, _REACH), _REACH)

    @property
    def samples(self) -> float:
        """Number of samples that are off independently."""
        return len(self.residuals) / self.correlation


def _roughly_aligned(
    table: ModelTable, model: LibraryModel, view: View, options: RetrievalOptions
) -> _Aligned | None:
    """A model aligned with a mask that shows all of it; None if it cannot be."""
    mesh = table.mesh_at(cast(Path, model.mesh_path))
    given = Model(mesh=mesh, stretch=options.stretch, stretch_sigma=options.stretch_sigma)
    try:
        found = align_outline(given, view)
    except CadalignError as error:
        logger.debug("%s, model %s: %s", model.category, model.model_id, error)
        return None
    return None if found is None else _Aligned(model, given, *found)


def _aligned(rough: _Aligned, view: View, *, is_any_met: bool) -> _Aligned:
    """A model aligned with whatever part a mask shows, unless another one meets all of it."""
    if is_any_met and not rough.is_met:
        return rough
    try:
        result = align(rough.given, view)
    except CadalignError as error:
        logger.debug("%s, model %s: %s", rough.model.category, rough.model.model_id, error)
        return rough
    (contour,) = result.mask_residuals
    if contour is None:
        return rough
    return rough._replace(
        alignment=result.alignment,
        residuals=contour.residuals,
        correlation=contour.correlation,
    )


def _match(
    aligned: _Aligned, camera: Camera, inside: BoolArray, log_likelihood: float, score: float
) -> Match:
    model, alignment = aligned.model, aligned.alignment
    silhouette = cast_geometry(Scene(cast(Mesh, aligned.given.mesh)), camera, alignment).mask
    found = aligned.residuals[np.isfinite(aligned.residuals)]
    none: FloatArray = np.empty((0, 3))
    return Match.of(
        model,
        alignment,
        rms=float(np.sqrt((found**2).mean())) if len(found) else float("nan"),
        log_likelihood=log_likelihood,
        score=score,
        ids=np.empty(0, dtype=np.int64),
        points_3d=none,
        points_2d=none[:, :2],
        residuals=none[:, :2],
        missing_ids=(),
        mirrored=False,
        silhouette_iou=silhouette_iou(est=silhouette, gt=inside),
        camera=camera,
    )


# Reranking ---------------------------------------------------------------------------------------


def rerank(
    table: ModelTable, matches: Sequence[Match], mask: npt.ArrayLike, camera: Camera
) -> list[Match]:
    """Rank the best matches by keypoints and silhouettes together.

    They get their ``silhouette_iou``, and ``score`` is redistributed among them. The likelihood
    remains that of the keypoints.
    """
    casts = (cast_match(match, camera, table.mesh_at) for match in matches)
    found = [None if cast is None else silhouette_iou(est=cast.mask, gt=mask) for cast in casts]
    known = [overlap for overlap in found if overlap is not None]
    if not known:
        logger.warning("none of the matches has a mesh: the mask is not used")
        return list(matches)
    mean = float(np.mean(known))
    gains = np.array([(mean if overlap is None else overlap) / _SHORTFALL for overlap in found])
    log_scores = np.array([match.log_likelihood for match in matches]) + gains
    weights = np.exp(log_scores - log_scores.max())
    weights *= sum(match.score for match in matches) / weights.sum()
    order = np.lexsort(([match.model_id for match in matches], -log_scores))
    return [
        replace(matches[k], score=float(weights[k]), silhouette_iou=found[k])
        for k in order.tolist()
    ]


def mask_of(
    mask: npt.ArrayLike | None,
    image: npt.ArrayLike | None,
    matches: Sequence[Match],
    camera: Camera,
) -> npt.NDArray[Any]:
    """Choose the object's pixels: the given mask, the image's opacity, or a segmentation.

    The segmentation (OpenCV's GrabCut) starts from the box around the keypoints and the best match.
    The parameters are those of `cadalign.Library.retrieve`.
    """
    if (mask is None) == (image is None):
        raise InputError("give a mask or an image, not both", where="mask")
    where = "image" if mask is None else "mask"
    found = np.asarray(image if mask is None else mask)
    if mask is None:
        if found.dtype != np.uint8 or found.ndim != 3 or found.shape[2] not in (3, 4):
            what = f"{found.dtype} of shape {found.shape}, expected an RGB or RGBA image of uint8"
            raise InputError(what, where="image")
        found = found[:, :, 3] if found.shape[2] == 4 else _segment(found, matches, camera)
    if found.shape != (camera.height, camera.width):
        size = f"{camera.height} high and {camera.width} wide"
        what = f"shape {found.shape}, but the camera's image is {size}"
        raise InputError(what, where=where)
    if np.isnan(silhouette_iou(est=found, gt=found)):
        raise InputError("contains no pixel of the object", where=where)
    return found


def cast_match(
    match: Match, camera: Camera, mesh_at: Callable[[Path], Mesh] = load_mesh
) -> Geometry | None:
    """Cast rays at a match's mesh; None if there is none or, with a warning, it is unreadable."""
    if match.mesh_path is None:
        return None
    try:
        return cast_geometry(Scene(mesh_at(match.mesh_path)), camera, match.alignment)
    except CadalignError as error:
        logger.warning("no silhouette: %s", error)
        return None


def _segment(pixels: npt.NDArray[Any], matches: Sequence[Match], camera: Camera) -> BoolArray:
    corners = camera.project(matches[0].box.corners)
    points = np.concatenate([matches[0].points_2d, corners])
    margin = _MARGIN * np.ptp(points, axis=0)
    last = np.array(pixels.shape[1::-1]) - 1
    left, top = np.clip(points.min(axis=0) - margin, 0, last).astype(int).tolist()
    right, bottom = np.clip(points.max(axis=0) + margin, 0, last).astype(int).tolist()
    labels: npt.NDArray[Any] = np.full(pixels.shape[:2], cv2.GC_BGD, dtype=np.uint8)
    labels[top : bottom + 1, left : right + 1] = cv2.GC_PR_FGD
    is_split = (labels == cv2.GC_BGD).any() and (labels != cv2.GC_BGD).any()
    return grab_cut(pixels, labels) if is_split else labels == cv2.GC_PR_FGD


def grab_cut(pixels: npt.NDArray[Any], labels: npt.NDArray[Any]) -> BoolArray:
    """Segment an image (h, w, 3) by its colours, from OpenCV's labels (h, w) of a part of it.

    Rother, Kolmogorov, Blake, "GrabCut: interactive foreground extraction using iterated graph
    cuts" (2004).
    """
    cv2.setRNGSeed(0)
    bgr = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    colors = np.zeros((2, 1, 65))
    whole = (0, 0, 1, 1)  # not used with labels
    cv2.grabCut(bgr, labels, whole, colors[0], colors[1], _GRAB_ROUNDS, cv2.GC_INIT_WITH_MASK)
    return np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD))
