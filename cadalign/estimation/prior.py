"""Priors on shape, scales and focal lengths, in the form of the kernels."""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, cast

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError, quote
from cadalign.estimation.model import Model
from cadalign.estimation.view import View
from cadalign.geometry.camera import Camera
from cadalign.io.focal import LONGEST, SHORTEST, PriorOption, prior_of_camera
from cadalign.shapes.model import ShapeModel
from cadalign.shapes.parts import BoxMargins, FewKeypoints
from cadalign.solvers.constants import ScalePrior
from cadalign.solvers.joint.evidence import Evidence, Focals, ScalePriors, Shape, State

_COMMON_SCALE_SIGMA = 3.0  # of the log of the common scale
_SAME_SCALE_SIGMA = 1e-4
_PROPORTION_SIGMA = 3.0  # of free log scales about their mean, for axes that are not seen
_NO_BOUND = ScalePrior(0.0, 0.0)
# Focal lengths from which a search starts [longer sides of the image].
_FOCAL_GRID = (0.15, 0.22, 0.3, 0.4, 0.55, 0.72, 0.95, 1.25, 1.65, 2.3, 3.3, 5.0, 10.0, 30.0)


@dataclass(frozen=True, eq=False)
class ShapePrior:
    """Gaussian components of a shape, and priors on its scales.

    Rows are the keypoints ``ids`` (m,), then the box's minimum and maximum corner. Fields with
    defaults are from `cadalign.ShapeModel`.
    """

    ids: tuple[Hashable, ...]
    components: tuple[Shape, ...]
    weights: tuple[float, ...]
    scales: ScalePriors
    up: FloatArray | None
    inflation: float = 1.0
    degrees_of_freedom: float | None = None
    has_box: bool = True
    box_margins: BoxMargins | None = None
    few_keypoints: FewKeypoints | None = None

    @property
    def lengths(self) -> FloatArray:
        """Lengths (3,) of the mean's box."""
        pairs = zip(self.weights, self.components, strict=True)
        return np.asarray(sum(weight * (each.mean[-1] - each.mean[-2]) for weight, each in pairs))

    def rows_of(self, ids: tuple[Hashable, ...], where: str) -> list[int]:
        """Rows of keypoints; raises InputError if the model lacks one."""
        place = {name: row for row, name in enumerate(self.ids)}
        missing = [name for name in ids if name not in place]
        if missing:
            listed = ", ".join(quote(name) for name in missing[:5])
            names = ", ".join(quote(name) for name in self.ids[:12])
            more = ", ..." if len(self.ids) > 12 else ""
            fix = f"the model has {names}{more}" if names else "give the model points_3d="
            raise InputError(f"the model has no keypoint {listed}", where=where, fix=fix)
        return [place[name] for name in ids]


def prior_of(model: object) -> ShapePrior:
    """The prior of a Model or a ShapeModel; raises InputError for other types."""
    if isinstance(model, Model):
        return _model_prior(model)
    if isinstance(model, ShapeModel):
        return _category_prior(model)
    what = f"expected a cadalign.Model or a cadalign.ShapeModel, got {type(model).__name__}"
    raise InputError(what, where="model")


def _model_prior(model: Model) -> ShapePrior:
    points = cast(FloatArray, model.points_3d)
    mean = np.concatenate([points, cast(FloatArray, model.bounds)])
    spread = np.full(len(mean), model.shape_sigma or 0.0)
    options = model.fit_options()
    free = np.array([float(axis in options.stretched_axes) for axis in "xyz"])
    bound = _NO_BOUND if options.prior_weight else options.scale_prior
    scales = ScalePriors(free, np.diag(free * options.prior_weight), bound)
    shape = Shape(mean, np.empty((0, len(mean), 3)), spread)
    ids, up = cast("tuple[Hashable, ...]", model.ids), axis_vector(model.up_axis)
    return ShapePrior(ids, (shape,), (1.0,), scales, up)


@lru_cache(maxsize=4)
def _category_prior(model: ShapeModel) -> ShapePrior:
    shapes = tuple(
        Shape(
            np.array(component.mean),
            np.array(component.modes),
            np.array(np.broadcast_to(component.residual_sigma, len(component.mean)), dtype=float),
        )
        for component in model.components
    )
    weights = tuple(component.weight for component in model.components)
    up = axis_vector(model.up_axis)
    held = ScalePriors(np.zeros(3), np.zeros((3, 3)), _NO_BOUND)
    names = "inflation", "degrees_of_freedom", "has_box", "box_margins", "few_keypoints"
    own: dict[str, Any] = {name: getattr(model, name) for name in names}
    return ShapePrior(model.ids, shapes, weights, held, up, **own)


def axis_vector(axis: str | None) -> FloatArray | None:
    return None if axis is None else np.eye(3)["xyz".index(axis)]


def scale_priors(prior: ShapePrior, metric: bool) -> ScalePriors:
    """Free the size if evidence determines it; fixed scales are then tied to the common scale."""
    if not metric:
        return prior.scales
    if prior.scales.free.sum() == 2 and not prior.scales.precision.any():
        proportions = (np.eye(3) - 1 / 3) / _PROPORTION_SIGMA**2
        return ScalePriors(np.ones(3), proportions, prior.scales.bound)
    held = prior.scales.free == 0
    weights = np.where(held, 1 / _SAME_SCALE_SIGMA**2, prior.scales.precision.diagonal())
    common = np.tile(held / held.sum(), (3, 1))
    from_common = np.eye(3) - common
    tied = from_common.T @ (weights[:, None] * from_common)
    precision = tied + common.T @ common / (3 * _COMMON_SCALE_SIGMA**2)
    return ScalePriors(np.ones(3), precision, prior.scales.bound)


def has_scale_prior(scales: ScalePriors) -> bool:
    """True if a prior ties the scales together beyond plausible proportions."""
    return bool((scales.precision > 2 / _PROPORTION_SIGMA**2).any())


def redundancy_of(evidence: Evidence) -> int:
    """Number of equations, including priors on the scales, minus number of unknowns."""
    whitening, depths = evidence.sightings.whitening, evidence.sightings.depths
    # Two for a keypoint, one for a sample of a contour.
    count = int(
        (whitening[:, 2] > 0).sum() + whitening.any(axis=1).sum() + (depths[:, 1] > 0).sum()
    )
    count += 2 * len(evidence.directions.image) + len(evidence.offsets.weight)
    if has_scale_prior(evidence.scales):
        count += int(np.linalg.matrix_rank(evidence.scales.precision))
    return count - 6 * int(evidence.rig.pose.max() + 1) - int(evidence.scales.free.sum())


def widen_prior(evidence: Evidence, state: State, factor: float) -> tuple[Evidence, State]:
    """Multiply the prior's standard deviations by a factor, for the same points."""
    if factor == 1:
        return evidence, state
    shape = evidence.shape
    wide = shape._replace(modes=factor * shape.modes, spread=factor * shape.spread)
    return evidence._replace(shape=wide), state._replace(coefficients=state.coefficients / factor)


def is_exact(evidence: Evidence) -> bool:
    """True if the shape is known up to its scales."""
    return not (len(evidence.shape.modes) or evidence.shape.spread.any())


def log_focal_range(camera: Camera, prior: PriorOption) -> tuple[float, float, float, float]:
    """Bounds of the log focal length relative to the camera's, and its prior's mean and weight."""
    prior = prior_of_camera(prior, camera)
    side = max(camera.width, camera.height) / camera.fx
    low, high = math.log(SHORTEST * side), math.log(LONGEST * side)
    if prior is None:
        return low, high, 0.0, 0.0
    mean = math.log(prior.focal / camera.fx)
    return min(low, mean), max(high, mean), mean, prior.relative_sigma**-2


def focal_grid(camera: Camera, prior: PriorOption) -> FloatArray:
    """Focal lengths [px] to start from; with a prior, its mean and the grid near it."""
    prior = prior_of_camera(prior, camera)
    grid = np.array(_FOCAL_GRID) * max(camera.width, camera.height)
    if prior is None:
        return grid
    near = np.abs(np.log(grid / prior.focal)) < max(4 * prior.relative_sigma, 0.5)
    return np.sort(np.append(grid[near], prior.focal))


@dataclass(frozen=True)
class Lenses:
    """Cameras of views (V,), with focal lengths that may be estimated."""

    cameras: tuple[Camera, ...]  # with reference focal lengths, which estimates are relative to
    groups: tuple[int, ...]  # index of each view's unknown focal length; -1 if known
    prior: PriorOption = None

    @classmethod
    def from_views(cls, views: Sequence[View], focal: str, prior: PriorOption) -> Lenses:
        """The views' lenses; only focal lengths of views with evidence are estimated."""
        cameras = tuple(view.camera for view in views)
        if focal == "known":
            for camera in cameras:
                camera.require_focal()
            return cls(cameras, (-1,) * len(cameras))
        for camera in cameras:
            if camera.is_wide or camera.distortion:
                what = "the focal length of a lens with distortion is not estimated"
                raise InputError(what, where="focal", fix='calibrate it, and give focal="known"')
        distinct = list(dict.fromkeys(view.camera for view in views if view.has_evidence))
        reference = []
        for camera in cameras:
            grid, own = focal_grid(camera, prior), prior_of_camera(prior, camera)
            known = own.focal if own is not None else float(grid[len(grid) // 2])
            reference.append(camera.replace_focal(known))
        groups = [distinct.index(each) if each in distinct else -1 for each in cameras]
        return cls(tuple(reference), tuple(groups), prior)

    @property
    def count(self) -> int:
        """Number of unknown focal lengths."""
        return max(self.groups, default=-1) + 1

    @property
    def focal_lengths(self) -> FloatArray:
        """Reference values (F,) of the unknown focal lengths [px]."""
        return np.array([camera.fx for camera in self._firsts])

    @property
    def _firsts(self) -> list[Camera]:
        return [self.cameras[self.groups.index(group)] for group in range(self.count)]

    def focals(self) -> Focals:
        """Bounds and priors in the form of the kernels."""
        ranges = [log_focal_range(camera, self.prior) for camera in self._firsts]
        columns = np.ascontiguousarray(np.array(ranges).reshape(-1, 4).T)
        return Focals(np.array(self.groups, dtype=np.int64), *columns)

    def cameras_at(self, log_focals: FloatArray) -> list[Camera]:
        """The cameras of all views at log focal lengths (F,), relative to the references."""
        return [
            camera if group < 0 else camera.replace_focal(camera.fx * math.exp(log_focals[group]))
            for camera, group in zip(self.cameras, self.groups, strict=True)
        ]

    def replace_focals(self, log_focals: FloatArray) -> Lenses:
        """Lenses with new references at log focal lengths (F,), relative to the old ones."""
        return replace(self, cameras=tuple(self.cameras_at(log_focals)))

    def grid(self) -> list[FloatArray]:
        """Starts: log focal lengths (F,) relative to the references."""
        grids = [np.log(focal_grid(camera, self.prior) / camera.fx) for camera in self._firsts]
        return list(np.array(grids).T) if grids else [np.zeros(0)]


def camera_like(camera: Camera, estimated: Mapping[Camera, Camera]) -> Camera:
    """The camera with its estimated focal length or, if it has none, the first one's by size."""
    if camera in estimated or camera.focal_known:
        return estimated.get(camera, camera)
    first = next(iter(estimated.values()))
    side = max(camera.width, camera.height) / max(first.width, first.height)
    return camera.replace_focal(first.fx * side)
