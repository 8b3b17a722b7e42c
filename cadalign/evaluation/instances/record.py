"""Instance records: camera, keypoints, truth and estimates, enough to draw an instance.

A record is a row of ``records.parquet``, whose form docs/formats/runs.md describes.
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
# More than any picture can show, and little enough to store.
_MODEL_DIGITS = 9
_PIXEL_DIGITS = 4
_WARP_DIGITS = 6
_LONGEST_NAME = 200  # bytes
_CAMERA = ("width", "height", "fx", "fy", "cx", "cy")
# Several times as fast as the standard library's; numbers that are not finite become null.
_ENCODER = msgspec.json.Encoder(enc_hook=np.generic.item)
_LIKE_A_VIEW = re.compile(r"_[1-9][0-9]*\Z")
_LEAST_SCALE = 1e-6


@dataclass(frozen=True, eq=False)
class AlignedShape:
    """The estimate of an object's own shape, for an instance's record.

    ``source`` (k, 3) are keypoints of the given model, ``target`` (k, 3) their places on the
    estimated object, in the model's coordinates: the alignment takes both into the camera's.
    """

    alignment: Alignment  # takes the box of the model that methods are given to the estimated one
    source: FloatArray
    target: FloatArray
    sigma: float  # standard deviation of the keypoints [px]
    result: Result | None  # None for a method that states no uncertainties


Estimate = Result | AlignedShape | Alignment | Exception
"""A fit, the estimate of the object's own shape, the alignment of a method that returns no more, or
the reason why there is none."""


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
    """An estimate of pose and shape in terms of a model, with what remains of the shape as a warp.

    ``found`` is a result or another estimate with an ``alignment``, ``points_3d`` and ``bounds``;
    ``rows`` are those of the estimated keypoints that the model has at the places ``source``. The
    estimated box is theirs where it ``spans_points``.
    """
    points = found.points_3d[rows]
    bounds = extent(points) if spans_points else found.bounds
    alignment = box_alignment(found.alignment, bounds, model_bounds=model_bounds)
    target = alignment.inverse(found.alignment.apply(points))
    return AlignedShape(alignment, source, target, sigma, result)


def box_alignment(
    alignment: Alignment, bounds: FloatArray, *, model_bounds: FloatArray
) -> Alignment:
    """The alignment that takes a model's box to where another one takes given bounds (2, 3)."""
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
    """The record of an instance as JSON, from each method's outcome and its estimate.

    ``stretch`` (3,) is that of the model, by default what the true scale undoes.
    """
    if stretch is None:
        stretch = np.ones(3) if gt is None else 1 / gt.scale
    record = {
        "camera": {name: getattr(camera, name) for name in _CAMERA},
        "gt": None if gt is None else _pose(gt),
        "stretch": _rounded(stretch),
        "bounds": _rounded(bounds),
        "points_3d": _rounded(points_3d),
        "points_2d": _rounded(points_2d, _PIXEL_DIGITS),
        "semantic_ids": ids.tolist(),
        "estimates": list(map(_described, outcomes, estimates)),
    }
    return _ENCODER.encode(record).decode()


def record_stem(category: str, model_id: str, view: int = 0) -> str:
    """The name, without an ending, of the files with an instance's pictures."""
    name = f"{category}_{model_id}"
    stem = name.replace("/", "_").replace("\0", "_")
    coded = name.encode("utf-8", "replace")
    # Not a possible name of a file, or the same as that of another model's view.
    if stem != name or len(coded) > _LONGEST_NAME or _LIKE_A_VIEW.search(name):
        stem = f"{stem[:40]}-{hashlib.sha256(coded).hexdigest()[:12]}"
    return stem if view == 0 else f"{stem}_{view}"


def _described(outcome: Outcome, estimate: Estimate) -> dict[str, Any]:
    method = outcome.names["method"]
    if not outcome.is_ok or isinstance(estimate, Exception):
        return {"method": method, "reason": outcome.reason}
    result = estimate if isinstance(estimate, Result) else getattr(estimate, "result", None)
    # The residual of the result table, or else the estimate's own.
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
    # Rounded in one go: this is done for every estimate of every instance.
    packed = [alignment.rotation.ravel(), alignment.translation, alignment.scale]
    values = _rounded(np.concatenate(packed))
    return {"rotation": values[:9], "translation": values[9:12], "scale": values[12:]}


def _warp(estimate: object) -> dict[str, Any]:
    """The deformation of an estimated shape; nothing for the given model."""
    if not isinstance(estimate, AlignedShape):
        return {}
    ends = {"from": estimate.source, "to": estimate.target}
    return {"warp": {name: _rounded(points, _WARP_DIGITS) for name, points in ends.items()}}


def _rounded(values: FloatArray, digits: int = _MODEL_DIGITS) -> Any:
    return values.round(digits).tolist()
