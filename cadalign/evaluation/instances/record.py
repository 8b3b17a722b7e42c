"""Instance records: camera, keypoints, truth and estimates, enough to draw an instance.

A record is a row of ``records.parquet``, whose form docs/formats/runs.md describes.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import msgspec
import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import CadalignError
from cadalign.estimation.result import Result
from cadalign.estimation.uncertainty.summary import Uncertainty
from cadalign.estimation.view import View
from cadalign.evaluation.instances.instance import Instance
from cadalign.evaluation.outcome import Outcome
from cadalign.evaluation.runs.tables import Columns, Row
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.shapes.model import ShapeModel

RECORD_COLUMNS: Columns = (("category", str), ("model_id", str), ("view", int), ("exhibit", str))
# More than any picture can show, and little enough to store.
_MODEL_DIGITS = 9
_PIXEL_DIGITS = 4
_WARP_DIGITS = 6
_LONGEST_NAME = 200  # bytes
# Several times as fast as the standard library's; numbers that are not finite become null.
_ENCODER = msgspec.json.Encoder(enc_hook=np.generic.item)
_LIKE_A_VIEW = re.compile(r"_[1-9][0-9]*\Z")
_LEAST_SCALE = 1e-6


class Placed(Protocol):
    """An estimate of pose and shape: a result, an alternative to it, or of another method."""

    @property
    def alignment(self) -> Alignment: ...

    @property
    def points_3d(self) -> FloatArray: ...

    @property
    def bounds(self) -> FloatArray: ...


@dataclass(frozen=True, eq=False)
class Warp:
    """Deformation of the given model to the estimated shape.

    ``source`` (k, 3) are keypoints of the given model, ``target`` (k, 3) their places on the
    estimated object, in the model's coordinates: the alignment takes both into the camera's.
    """

    source: FloatArray
    target: FloatArray


@dataclass(frozen=True, eq=False)
class AlignedShape:
    """The estimate of an object's own shape, or an alternative to it, for an instance's record."""

    alignment: Alignment
    """Takes the box of the model that other methods are given to the estimated one."""
    warp: Warp  # what remains of the shape after the alignment
    rms: float = np.nan  # of the residuals [px]
    sigma: float = np.nan  # standard deviation of the keypoints [px]
    std: Uncertainty | None = None  # None for a method that states none
    warnings: tuple[str, ...] = ()
    alternatives: tuple[AlignedShape, ...] = ()
    relative_likelihood: float = 1.0  # of an alternative


def align_instance(
    shape: ShapeModel,
    instance: Instance,
    own_ids: npt.ArrayLike,
    own_xyz: npt.ArrayLike,
    *,
    sigma: float,
) -> AlignedShape:
    """Align a category's shape with an instance's keypoints, of which the shape knows.

    ``own_ids`` (k,) and ``own_xyz`` (k, 3) are the semantic ids of all keypoints of the instance's
    model, whose extent is its box where it has no mesh, and their places as the image shows them;
    ``sigma`` is the keypoints' standard deviation [px]. Raises DegenerateError as `cadalign.align`.
    """
    # Only here: their kernels take time to import, and most experiments do without.
    from cadalign.estimation.align import align

    known = np.isin(instance.ids, shape.ids)
    view = View(
        instance.camera,
        instance.points_2d[known],
        ids=instance.ids[known].tolist(),
        sigma=sigma,
    )
    result = align(shape, view)
    ids = np.asarray(own_ids)
    shared = np.isin(ids, shape.ids)
    rows = shape.rows(ids[shared].tolist())
    given = np.asarray(own_xyz)[shared] / instance.gt.scale
    return shape_of_result(
        result,
        rows,
        given,
        rms=_rms(result),
        sigma=sigma,
        model_bounds=instance.bounds,
        spans_points=instance.scene is None and len(rows) > 0,
    )


def placed_in_model(
    found: Placed,
    rows: Sequence[int] | IntArray,
    source: FloatArray,
    *,
    model_bounds: FloatArray,
    spans_points: bool = False,
) -> tuple[Alignment, Warp]:
    """The alignment of a model's box with an estimated one, and what remains of the shape.

    ``rows`` are those of the estimated keypoints that the model has at the places ``source``; the
    estimated box is theirs where it ``spans_points``.
    """
    points = found.points_3d[rows]
    bounds = found.bounds
    if spans_points:
        bounds = np.stack([points.min(axis=0), points.max(axis=0)])
    alignment = box_alignment(found.alignment, bounds, model_bounds=model_bounds)
    return alignment, Warp(source, alignment.inverse(found.alignment.apply(points)))


def shape_of_result(
    result: Result,
    rows: Sequence[int] | IntArray,
    source: FloatArray,
    *,
    rms: float,
    sigma: float,
    **how: Any,
) -> AlignedShape:
    """The aligned shape of a result; see `placed_in_model`.

    ``rms`` and ``sigma`` are those of `AlignedShape` [px].
    """
    alternatives = tuple(
        AlignedShape(
            *placed_in_model(other, rows, source, **how),
            relative_likelihood=other.relative_likelihood,
        )
        for other in result.alternatives
    )
    placed = placed_in_model(result, rows, source, **how)
    return AlignedShape(*placed, rms, sigma, result.std, result.warnings, alternatives)


def box_alignment(
    alignment: Alignment, bounds: FloatArray, *, model_bounds: FloatArray
) -> Alignment:
    """The alignment that takes a model's box to where another one takes given bounds (2, 3).

    Examples
    --------
    >>> found = Alignment(np.eye(3), [0, 0, 4], [1, 1, 1])
    >>> other = box_alignment(found, np.array([[0, 0, 0], [1, 2, 3]]),
    ...                       model_bounds=np.array([[-1, -1, -1], [1, 1, 1]]))
    >>> other.scale.tolist(), other.translation.tolist()
    ([0.5, 1.0, 1.5], [0.5, 1.0, 5.5])
    """
    lengths, given = np.ptp(bounds, axis=0) * alignment.scale, np.ptp(model_bounds, axis=0)
    scale = np.maximum(lengths, _LEAST_SCALE) / np.where(given > 0, given, 1.0)
    scale = np.where(given > 0, scale, 1.0)
    center = alignment.apply(bounds.mean(axis=0)[None])[0]
    shift = alignment.rotation @ (scale * model_bounds.mean(axis=0))
    return Alignment(alignment.rotation, center - shift, scale)


def _rms(result: Result) -> float:
    """Root mean square residual [px], outliers included, as of the other methods."""
    return float(np.sqrt((result.residuals**2).sum(axis=1).mean()))


Estimate = Result | AlignedShape | Alignment | CadalignError
"""A fit, the estimate of the object's own shape, the alignment of a method that returns no more, or
the reason why there is none."""


def pose_of(estimate: Result | AlignedShape | Alignment) -> Alignment:
    """The alignment of an estimate."""
    return estimate if isinstance(estimate, Alignment) else estimate.alignment


def record_row(
    instance: Instance, outcomes: Sequence[Outcome], estimates: Sequence[Estimate]
) -> Row:
    """The record of an instance as a table row, from each method's outcome and its estimate."""
    return record_of(
        camera=instance.camera,
        gt=instance.gt,
        stretch=1 / instance.gt.scale,
        bounds=instance.bounds,
        points_3d=instance.points_3d,
        points_2d=instance.points_2d,
        ids=instance.ids,
        outcomes=outcomes,
        estimates=estimates,
    )


def record_of(
    *,
    camera: Camera,
    gt: Alignment | None,
    stretch: FloatArray,
    bounds: FloatArray,
    points_3d: FloatArray,
    points_2d: FloatArray,
    ids: IntArray,
    outcomes: Sequence[Outcome],
    estimates: Sequence[Estimate],
) -> Row:
    """The record of an instance of these parts; see the module's documentation."""
    names = ("width", "height", "fx", "fy", "cx", "cy")
    record = {
        "camera": {name: getattr(camera, name) for name in names},
        "gt": None if gt is None else _pose(gt),
        "stretch": _rounded(stretch),
        "bounds": _rounded(bounds),
        "points_3d": _rounded(points_3d),
        "points_2d": _rounded(points_2d, _PIXEL_DIGITS),
        "semantic_ids": ids.tolist(),
        "estimates": [
            _described(outcome, estimate)
            for outcome, estimate in zip(outcomes, estimates, strict=True)
        ],
    }
    row = {name: outcomes[0].names[name] for name in ("category", "model_id", "view")}
    return {**row, "exhibit": _ENCODER.encode(record).decode()}


def record_stem(category: str, model_id: str, view: int = 0) -> str:
    """The name, without an ending, of the files with an instance's pictures.

    Examples
    --------
    >>> record_stem("chair", "88382b87", 2)
    'chair_88382b87_2'
    """
    name = f"{category}_{model_id}"
    stem = name.replace("/", "_").replace("\0", "_")
    coded = name.encode("utf-8", "replace")
    # Not a possible name of a file, or the same as that of another model's view.
    if stem != name or len(coded) > _LONGEST_NAME or _LIKE_A_VIEW.search(name):
        stem = f"{stem[:40]}-{hashlib.sha256(coded).hexdigest()[:12]}"
    return stem if view == 0 else f"{stem}_{view}"


def _described(outcome: Outcome, estimate: Estimate) -> dict[str, Any]:
    method = outcome.names["method"]
    if not outcome.is_ok or isinstance(estimate, CadalignError):
        return {"method": method, "reason": outcome.reason}
    fit = None if isinstance(estimate, Alignment) else estimate
    return {
        "method": method,
        **_pose(pose_of(estimate)),
        **_warp(estimate),
        "rms_px": _rms_px(outcome, estimate),
        "sigma": None if fit is None else fit.sigma,
        "std": None if fit is None or fit.std is None else vars(fit.std),
        "warnings": () if fit is None else fit.warnings,
        "alternatives": [
            {**_pose(other.alignment), **_warp(other), "likelihood": other.relative_likelihood}
            for other in (() if fit is None else fit.alternatives)
        ],
    }


def _pose(alignment: Alignment) -> dict[str, Any]:
    # Rounded in one go: this is done for every estimate of every instance.
    packed = [alignment.rotation.ravel(), alignment.translation, alignment.scale]
    values = _rounded(np.concatenate(packed))
    return {"rotation": values[:9], "translation": values[9:12], "scale": values[12:]}


def _rms_px(outcome: Outcome, estimate: object) -> float | None:
    """The residual of the result table, or else the estimate's own."""
    rms = outcome.values.get("rms_px")
    if rms is None and isinstance(estimate, AlignedShape):
        rms = estimate.rms
    return None if rms is None or not np.isfinite(rms) else round(rms, _PIXEL_DIGITS)


def _warp(estimate: object) -> dict[str, Any]:
    """The deformation of an estimated shape; nothing for the given model."""
    if not isinstance(estimate, AlignedShape):
        return {}
    ends = {"from": estimate.warp.source, "to": estimate.warp.target}
    return {"warp": {name: _rounded(points, _WARP_DIGITS) for name, points in ends.items()}}


def _rounded(values: FloatArray, digits: int = _MODEL_DIGITS) -> Any:
    return values.round(digits).tolist()
