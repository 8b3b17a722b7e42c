"""Prior knowledge of an object's shape and scales, in the form that the kernels take."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError, quote
from cadalign.estimation.model import Model
from cadalign.shapes.box_margins import BoxMargins
from cadalign.shapes.inflation import FewKeypoints
from cadalign.shapes.model import ShapeModel
from cadalign.solvers.joint.evidence import Evidence, ScalePriors, Shape, State

_COMMON_SCALE_SIGMA = 3.0  # of the log of a size that other evidence determines
_SAME_SCALE_SIGMA = 1e-4
_PROPORTION_SIGMA = 3.0  # of free log scales about their mean, lest an unseen axis collapses


@dataclass(frozen=True, eq=False)
class ShapePrior:
    """Gaussian components of a shape, and what is known of its scales.

    The rows of a component are the keypoints with ``ids`` (m,), then the least and the greatest
    corner of the box. ``inflation``, ``degrees_of_freedom``, ``box_margins`` and ``few_keypoints``
    are those of `cadalign.ShapeModel`.
    """

    ids: tuple[Hashable, ...]
    components: tuple[Shape, ...]
    weights: tuple[float, ...]
    scales: ScalePriors
    up: FloatArray | None
    inflation: float = 1.0
    degrees_of_freedom: float | None = None
    box_margins: BoxMargins | None = None
    few_keypoints: FewKeypoints | None = None

    @property
    def lengths(self) -> FloatArray:
        """Lengths (3,) of the mean's box."""
        pairs = zip(self.weights, self.components, strict=True)
        return np.asarray(sum(weight * (each.mean[-1] - each.mean[-2]) for weight, each in pairs))

    def rows_of(self, ids: tuple[Hashable, ...], where: str) -> list[int]:
        """Row numbers of keypoints.

        Raises
        ------
        InputError
            If the model has no such keypoint.
        """
        return rows_among(self.ids, ids, where)


def rows_among(known: Sequence[Hashable], ids: Sequence[Hashable], where: str) -> list[int]:
    """Row numbers of keypoints among a model's; see `ShapePrior.rows_of`."""
    place = {name: row for row, name in enumerate(known)}
    missing = [name for name in ids if name not in place]
    if missing:
        listed = ", ".join(quote(name) for name in missing[:5])
        names = ", ".join(quote(name) for name in known[:12])
        more = ", ..." if len(known) > 12 else ""
        fix = f"the model has {names}{more}"
        raise InputError(f"the model has no keypoint {listed}", where=where, fix=fix)
    return [place[name] for name in ids]


def prior_of(model: object) -> ShapePrior:
    """The prior of an exact, a stretched or a learned model.

    Raises
    ------
    InputError
        If it is none of these.
    """
    if isinstance(model, Model):
        return _of_model(model)
    if isinstance(model, ShapeModel):
        return _of_category(model)
    what = f"expected a cadalign.Model or a cadalign.ShapeModel, got {type(model).__name__}"
    raise InputError(what, where="model")


def _of_model(model: Model) -> ShapePrior:
    points = cast(FloatArray, model.points_3d)
    mean = np.concatenate([points, cast(FloatArray, model.bounds)])
    spread = np.full(len(mean), model.shape_sigma or 0.0)
    options = model.fit_options(1.0)
    free = np.array([float(axis in options.stretched_axes) for axis in "xyz"])
    scales = ScalePriors(free, np.diag(free * options.prior_weight))
    shape = Shape(mean, np.empty((0, len(mean), 3)), spread)
    return ShapePrior(cast("tuple[Hashable, ...]", model.ids), (shape,), (1.0,), scales, _Y)


def _of_category(model: ShapeModel) -> ShapePrior:
    shapes = tuple(
        Shape(
            np.array(component.mean),
            np.array(component.modes),
            np.array(np.broadcast_to(component.residual_sigma, len(component.mean)), dtype=float),
        )
        for component in model.components
    )
    weights = tuple(component.weight for component in model.components)
    up = None if model.up_axis is None else np.eye(3)["xyz".index(model.up_axis)]
    held = ScalePriors(np.zeros(3), np.zeros((3, 3)))
    return ShapePrior(
        model.ids,
        shapes,
        weights,
        held,
        up,
        inflation=model.inflation,
        degrees_of_freedom=model.degrees_of_freedom,
        box_margins=model.box_margins,
        few_keypoints=model.few_keypoints,
    )


_Y = np.array([0.0, 1.0, 0.0])


def scale_priors(prior: ShapePrior, metric: bool) -> ScalePriors:
    """Free the size where it is told; what was held to x is then held to the common scale."""
    if not metric:
        return prior.scales
    if prior.scales.free.sum() == 2 and not prior.scales.precision.any():
        return ScalePriors(np.ones(3), (np.eye(3) - 1 / 3) / _PROPORTION_SIGMA**2)
    held = prior.scales.free == 0
    weights = np.where(held, 1 / _SAME_SCALE_SIGMA**2, prior.scales.precision.diagonal())
    common = np.tile(held / held.sum(), (3, 1))
    from_common = np.eye(3) - common
    tied = from_common.T @ (weights[:, None] * from_common)
    return ScalePriors(np.ones(3), tied + common.T @ common / (3 * _COMMON_SCALE_SIGMA**2))


def has_scale_prior(scales: ScalePriors) -> bool:
    """True where a prior ties the scales together more than any plausible proportions do."""
    return bool((scales.precision > 2 / _PROPORTION_SIGMA**2).any())


def widened(evidence: Evidence, state: State, factor: float) -> tuple[Evidence, State]:
    """The same points under a prior of wider deviations."""
    if factor == 1:
        return evidence, state
    shape = evidence.shape
    wide = shape._replace(modes=factor * shape.modes, spread=factor * shape.spread)
    return evidence._replace(shape=wide), state._replace(coefficients=state.coefficients / factor)


def is_exact(evidence: Evidence) -> bool:
    """True if the shape is known but for its scales."""
    return not (len(evidence.shape.modes) or evidence.shape.spread.any())
