"""Live alignment of the object's own shape: `cadalign.align` to the pairs that it knows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cadalign.annotate.alignment import LEAST_SIGMA
from cadalign.annotate.object_shape import ObjectShape
from cadalign.annotate.wireframe import Wireframe
from cadalign.arrays import BoolArray, FloatArray
from cadalign.datasets.models.model_keypoints import ModelKeypoint
from cadalign.errors import CadalignError
from cadalign.fitting.joint.align import align
from cadalign.fitting.joint.model import Model
from cadalign.fitting.joint.observed import views_of
from cadalign.fitting.joint.result import AlignResult
from cadalign.fitting.joint.view import View
from cadalign.fitting.options import RansacOptions
from cadalign.geometry.camera import Camera
from cadalign.io.observation import Observation
from cadalign.shapes.model import ShapeModel

LEAST_SHAPE_PAIRS = 3
_LEAST_JUDGED = 6  # pairs from which on one can contradict the others
_CONTRADICTS = 5.0  # distance from the others' prediction [sigmas]; hands click to about 2 px


@dataclass(frozen=True, eq=False)
class WarpedModel:
    """The model, warped to the estimated shape, in its frame before the stretch.

    ``carried`` (k, 3) are points of the model that the estimate does not know.
    """

    wireframe: Wireframe
    carried: FloatArray


@dataclass(frozen=True, eq=False)
class LiveShape:
    """Alignment and shape from the pairs placed so far.

    It is provisional if the focal length was assumed. ``counts`` (n,) are the complete pairs whose
    keypoints the shape knows; the others' residuals are those of points that the warp carries.
    """

    shown: AlignResult | None
    message: str = ""
    provisional: bool = False
    camera: Camera | None = None
    counts: BoolArray = field(default_factory=lambda: np.empty(0, dtype=bool))
    residuals: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    outliers: Mapping[int, float] = field(default_factory=dict)
    warped: WarpedModel | None = None
    prior_lengths: FloatArray = field(default_factory=lambda: np.zeros(3))
    sigma: float = LEAST_SIGMA

    @property
    def fit_options(self) -> Mapping[str, Any]:
        """Options with which `cadalign fit` finds the same: its defaults."""
        return {}


def warm_up_joint(points_3d: FloatArray, points_2d: FloatArray, camera: Camera) -> None:
    """Compile or load what `align_shape` calls, by aligning points (n, 3) with (n, 2) [px]."""
    view = View(camera, points_2d)
    for ransac in (None, RansacOptions()):
        align(Model(points_3d=points_3d, shape_sigma=0.01), view, ransac=ransac)


def align_shape(
    shape: ObjectShape,
    wireframe: Wireframe,
    observation: Observation | None,
    points: Sequence[ModelKeypoint],
    uv: FloatArray,
    *,
    anchors: Mapping[Any, ModelKeypoint],
    assumed_focal: bool,
) -> LiveShape:
    """Align a shape with the complete pairs.

    Parameters
    ----------
    shape : ObjectShape
    wireframe : Wireframe
        That of the model.
    observation : Observation, optional
        The pairs that the shape knows; None if there are none.
    points, uv
        Model points and photo points (n, 2) [px] of all complete pairs.
    anchors : mapping
        The model's keypoints that the shape knows, by their ids there.
    assumed_focal : bool
        Whether the focal length is neither measured nor chosen.
    """
    counts = np.array([shape.id_of(point) is not None for point in points], dtype=bool)
    missing = LEAST_SHAPE_PAIRS - int(counts.sum())
    if observation is None or missing > 0:
        return LiveShape(None, _missing(missing, shape, all_count=bool(counts.all())))
    mesh = wireframe.scene.mesh
    try:
        model = shape.model_with(anchors.values(), mesh)
        (view,) = views_of(observation, model)
        result = align(model, view)
    except CadalignError as error:
        return LiveShape(None, f"No alignment: {error}.")
    free = np.array([point.xyz for point in points], dtype=float).reshape(-1, 3)[~counts]
    warped = _warp(wireframe, result, anchors, free)
    residuals = np.empty((len(points), 2))
    residuals[counts] = result.residuals[0]
    seen = observation.camera.project(result.alignment.apply(warped.carried))
    residuals[~counts] = seen - uv[~counts]
    rows = np.flatnonzero(counts)
    message = ""
    if assumed_focal:
        message = (
            f"The focal length is assumed, {observation.camera.fx:.0f} px. Choose 'known' to "
            "accept or correct it; until then the alignment is not saved."
        )
    return LiveShape(
        shown=result,
        message=message,
        provisional=assumed_focal,
        camera=observation.camera,
        counts=counts,
        residuals=residuals,
        outliers={
            int(rows[row]): off for row, off in _contradicting(model, view, observation).items()
        },
        warped=warped,
        prior_lengths=shape.length_sigmas(model),
    )


def _missing(missing: int, shape: ObjectShape, *, all_count: bool) -> str:
    text = f"{missing} more pair{'s' if missing > 1 else ''} to the first alignment"
    if all_count or shape.learned is None:
        return text
    return f"{text}: keypoints that {shape.learned.category} has, marked by rings on the model"


def _warp(
    wireframe: Wireframe,
    result: AlignResult,
    anchors: Mapping[Any, ModelKeypoint],
    free: FloatArray,
) -> WarpedModel:
    """Warp the model such that its known keypoints come to the estimated ones."""
    rows = [row for row, label in enumerate(result.ids) if label in anchors]
    source = np.array([anchors[result.ids[row]].xyz for row in rows])
    warped = wireframe.warped(source, result.points_3d[rows], result.bounds, carried=free)
    return WarpedModel(*warped)


def _contradicting(
    model: Model | ShapeModel, view: View, observation: Observation
) -> dict[int, float]:
    """Distances [px] of pairs that a robust search leaves out, by their rows."""
    if len(observation.points_2d) < _LEAST_JUDGED:
        return {}
    try:
        robust = align(model, view, ransac=RansacOptions(max_reproj_error=_CONTRADICTS))
    except CadalignError:
        return {}
    lengths = np.linalg.norm(robust.residuals[0], axis=1)
    return {int(row): float(lengths[row]) for row in np.flatnonzero(~robust.inliers[0])}
