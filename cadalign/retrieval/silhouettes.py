"""Silhouettes of matches: the best matches by keypoints are ranked again by the object's mask.

The silhouette of each match's mesh, posed and stretched, is compared with the object's pixels. The
intersection over union of the correct model falls short of 1 by 0.05 on average, exponentially
distributed, so a match gains ``IoU / 0.05`` in log-likelihood over one without overlap. A match
without a mesh gains the mean of the others' gains, so that it is neither preferred nor rejected.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray
from cadalign.datasets import load_mesh
from cadalign.errors import CadalignError, InputError
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.render import Geometry, Scene, cast_geometry, silhouette_iou
from cadalign.retrieval.match import Match
from cadalign.retrieval.models import ModelTable

logger = logging.getLogger("cadalign")

_SHORTFALL = 0.05
_GRAB_ROUNDS = 5
_MARGIN = 0.15  # around keypoints and boxes, as a share of their extent


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
