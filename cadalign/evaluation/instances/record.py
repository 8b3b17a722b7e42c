"""Instance records: camera, keypoints, truth and estimates of an instance, for drawing it.

A record is a row of ``records.parquet``; see docs/formats/runs.md.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.estimation.result import Result
from cadalign.evaluation.methods import pose_of
from cadalign.evaluation.runs.work import Columns, Outcome
from cadalign.geometry.alignment import Alignment, extent
from cadalign.geometry.camera import Camera

RECORD_COLUMNS: Columns = (("category", str), ("model_id", str), ("view", int), ("exhibit", str))
# Precise enough for pictures, and small to store.
_MODEL_DIGITS = 9
_PIXEL_DIGITS = 4
_WARP_DIGITS = 6
_LONGEST_NAME = 200  # bytes
_CAMERA = ("width", "height", "fx", "fy", "cx", "cy")
# Faster than the standard library; numbers that are not finite become null.
_ENCODER = msgspec.json.Encoder(enc_hook=np.generic.item)
_LIKE_A_VIEW = re.compile(r"_[1-9][0-9]*\Z")
_LEAST_SCALE = 1e-6


@dataclass(frozen=True, eq=False)
class AlignedShape:
    """An estimate of pose and shape, for an instance's record.

    ``source`` (k, 3) are keypoints of the model; ``target`` (k, 3) are the estimated keypoints of
    the object. Both are in the model frame, from which the alignment maps to the camera frame.
    """

    alignment: Alignment  # maps the model's box to the estimated box
    source: FloatArray
    target: FloatArray
    sigma: float  # standard deviation of the keypoints [px]
    result: Result | None  # None for methods without uncertainties


Estimate = Result | AlignedShape | Alignment | Exception
"""A result, an estimate of pose and shape, an alignment, or the error of a method."""


def aligned_shape(
    found: Any,
    rows: Sequence[int] | IntArray,
    source: FloatArray,
    *,
    model_bounds: FloatArray,
    sigma: float,
    result: Result | None,
    spans_points: bool = False,
) -> AlignedShape:
    """Express an estimate of pose and shape as an alignment of a model and a warp.

    ``found`` has an ``alignment``, ``points_3d`` and ``bounds``. Its keypoints ``rows`` correspond
    to the model's keypoints ``source``. With ``spans_points``, the estimated box is the box of
    these keypoints.
    """
    points = found.points_3d[rows]
    bounds = extent(points) if spans_points else found.bounds
    alignment = box_alignment(found.alignment, bounds, model_bounds=model_bounds)
    target = alignment.inverse(found.alignment.apply(points))
    return AlignedShape(alignment, source, target, sigma, result)


def box_alignment(
    alignment: Alignment, bounds: FloatArray, *, model_bounds: FloatArray
) -> Alignment:
    """The alignment that maps a model's box to where ``alignment`` maps ``bounds`` (2, 3)."""
    lengths, given = np.ptp(bounds, axis=0) * alignment.scale, np.ptp(model_bounds, axis=0)
    scale = np.maximum(lengths, _LEAST_SCALE) / np.where(given > 0, given, 1.0)
    scale = np.where(given > 0, scale, 1.0)
    center = alignment.apply(bounds.mean(axis=0)[None])[0]
    shift = alignment.rotation @ (scale * model_bounds.mean(axis=0))
    return Alignment(alignment.rotation, center - shift, scale)


def record_of(
    outcomes: Sequence[Outcome],
    estimates: Sequence[Estimate],
    *,
    camera: Camera,
    gt: Alignment | None,
    bounds: FloatArray,
    points_3d: FloatArray,
    points_2d: FloatArray,
    ids: IntArray,
    stretch: FloatArray | None = None,
) -> str:
    """Format the record of an instance as JSON, with the outcome and estimate of each method.

    ``stretch`` (3,) is the stretch of the model, by default the inverse of the true scale.
    """
    if stretch is None:
        stretch = np.ones(3) if gt is None else 1 / gt.scale
    record = {
        "camera": {name: getattr(camera, name) for name in _CAMERA},
        "gt": None if gt is None else _pose(gt),
        "stretch": _round(stretch),
        "bounds": _round(bounds),
        "points_3d": _round(points_3d),
        "points_2d": _round(points_2d, _PIXEL_DIGITS),
        "semantic_ids": ids.tolist(),
        "estimates": list(map(_describe, outcomes, estimates)),
    }
    return _ENCODER.encode(record).decode()


def record_stem(category: str, model_id: str, view: int = 0) -> str:
    """The file name of an instance's pictures, without suffix."""
    name = f"{category}_{model_id}"
    stem = name.replace("/", "_").replace("\0", "_")
    coded = name.encode("utf-8", "replace")
    # Invalid or too long as a file name, or ambiguous with a view of another model.
    if stem != name or len(coded) > _LONGEST_NAME or _LIKE_A_VIEW.search(name):
        stem = f"{stem[:40]}-{hashlib.sha256(coded).hexdigest()[:12]}"
    return stem if view == 0 else f"{stem}_{view}"


def _describe(outcome: Outcome, estimate: Estimate) -> dict[str, Any]:
    method = outcome.names["method"]
    if not outcome.is_ok or isinstance(estimate, Exception):
        return {"method": method, "reason": outcome.reason}
    result = estimate if isinstance(estimate, Result) else getattr(estimate, "result", None)
    # Prefer the residual of the result table.
    rms = outcome.values.get("rms_px", None if result is None else result.rms)
    return {
        "method": method,
        **_pose(pose_of(estimate)),
        **_warp(estimate),
        "rms_px": None if rms is None or not np.isfinite(rms) else round(rms, _PIXEL_DIGITS),
        "sigma": getattr(estimate, "sigma", None),
        "std": None if result is None or result.std is None else vars(result.std),
        "warnings": [] if result is None else [each.text for each in result.warnings],
        "alternatives": [
            {**_pose(other.alignment), "likelihood": other.relative_likelihood}
            for other in (estimate.alternatives if isinstance(estimate, Result) else ())
        ],
    }


def _pose(alignment: Alignment) -> dict[str, Any]:
    # One call for speed, as there are many estimates.
    packed = [alignment.rotation.ravel(), alignment.translation, alignment.scale]
    values = _round(np.concatenate(packed))
    return {"rotation": values[:9], "translation": values[9:12], "scale": values[12:]}


def _warp(estimate: object) -> dict[str, Any]:
    """The warp of an estimated shape; empty for other estimates."""
    if not isinstance(estimate, AlignedShape):
        return {}
    ends = {"from": estimate.source, "to": estimate.target}
    return {"warp": {name: _round(points, _WARP_DIGITS) for name, points in ends.items()}}


def _round(values: FloatArray, digits: int = _MODEL_DIGITS) -> Any:
    return values.round(digits).tolist()
