"""Methods, what they are given and may answer, and those of `cadalign.fit`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import groupby
from typing import TYPE_CHECKING, Any

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import CadalignError, InputError
from cadalign.estimation.options import METHODS, RansacOptions
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera

if TYPE_CHECKING:
    from cadalign.estimation.result import Result


LIMIT = "limit"
"""The pseudo-method of the Cramer-Rao bound; see `cadalign.evaluation.metrics.cramer_rao`."""
SHAPE = "shape"
"""The alignment of a category's learned shape, in runs that have one."""


@dataclass(frozen=True, eq=False)
class MethodInput:
    """An instance as general methods are given it."""

    points_3d: FloatArray  # (n, 3), keypoints on the model [model units]
    points_2d: FloatArray  # (n, 2), their observations [px]
    camera: Camera
    sigma: float  # standard deviation of the observations that methods are given [px]
    bounds: FloatArray | None = None  # (2, 3), least and greatest coordinates of the model
    ransac: RansacOptions | None = None  # options of searches for inliers
    gt: Alignment | None = None
    """The truth, for metrics and for the Cramer-Rao bound; no method is given it."""
    inliers: BoolArray | None = None  # (n,), the true inliers, for the bound


@dataclass(frozen=True)
class Method:
    """A method by name."""

    name: str
    solve: Callable[[Any], Any]
    """Makes an estimate; raises where it has none. A general method takes a `MethodInput` and
    returns an alignment or a result of `cadalign.fit`; another one takes an
    instance of its benchmark, and returns what that measures."""
    solve_many: Callable[[Sequence[Any]], list[Any]] | None = None
    """Makes estimates of a sequence, with an error in the place of one that there is not."""
    is_general: bool = False
    has_statistics: bool = False
    """``solve`` states uncertainties and alternatives, ``solve_many`` does not."""
    is_robust: bool = False  # it searches for inliers


# Names for a method together with options of `cadalign.fit`.
_VARIANTS: dict[str, dict[str, Any]] = {
    "optimal-huber": {"method": "optimal", "loss": "huber"},
    "optimal-cauchy": {"method": "optimal", "loss": "cauchy"},
}
# Robust ones, named after what they return: the optimum over all inliers, or the best hypothesis of
# a minimal solver as it is. With the linear solver, on 6 points, these are the AEPnP paper's two
# steps: RANSAC-AEPnP, and the same with non-linear refinement.
_RANSAC: dict[str, dict[str, Any]] = {
    "ransac-optimal": {"minimal": "ap4p", "refine": True},
    "ransac-ap4p": {"minimal": "ap4p", "refine": False},
    "ransac-aepnp": {"minimal": "aepnp", "refine": False},
    "ransac-aepnp-refined": {"minimal": "aepnp", "refine": True},
}
_INLIER_BOUND = 3.5  # [standard deviations], longer than 99.8 % of Gaussian errors in the plane


@cache
def fit_methods() -> dict[str, Method]:
    """The methods by name, the Cramer-Rao bound last."""
    found = [
        Method(
            name,
            partial(_fit, name=name),
            partial(_fit_many, name=name),
            is_general=True,
            has_statistics=name == "optimal" or name in _VARIANTS or name in _RANSAC,
            is_robust=name in _RANSAC,
        )
        for name in (*METHODS, *_VARIANTS, *_RANSAC)
    ]
    limit = Method(LIMIT, _bound, is_general=True)
    return {method.name: method for method in (*found, limit)}


def fit_options(name: str, *, sigma: float, ransac: RansacOptions | None) -> dict[str, Any]:
    """The options of `cadalign.fit` and `cadalign.fit_batch` that make it a method.

    Robust methods take what lies within 3.5 ``sigma`` [px] for an inlier, or go by ``ransac``, but
    for the minimal solver and the refinement, which are the method's own.
    """
    if name in _RANSAC:
        common = ransac or RansacOptions(max_reproj_error=_INLIER_BOUND * sigma)
        return {"sigma": sigma, "ransac": replace(common, **_RANSAC[name])}
    return {"sigma": sigma, **_VARIANTS.get(name, {"method": name})}


def _fit(given: MethodInput, *, name: str) -> Result:
    from cadalign.estimation.fit import fit

    how = fit_options(name, sigma=given.sigma, ransac=given.ransac)
    return fit(given.points_3d, given.points_2d, given.camera, **how)


def _fit_many(inputs: Sequence[MethodInput], *, name: str) -> list[Alignment | CadalignError]:
    """The alignments of many instances, in batches of one standard deviation and camera."""
    from cadalign.estimation.fit import fit_batch

    found: list[Alignment | CadalignError] = []
    for (sigma, camera), group in groupby(inputs, key=lambda given: (given.sigma, given.camera)):
        some = list(group)
        batch = fit_batch(
            [given.points_3d for given in some],
            [given.points_2d for given in some],
            camera,
            **fit_options(name, sigma=sigma, ransac=None),
        )
        found += [batch.errors.get(b) or batch.alignment(b) for b in range(len(batch))]
    return found


def _bound(given: MethodInput) -> Alignment:
    from cadalign.evaluation.metrics.cramer_rao import limit_estimate

    if given.gt is None:
        raise InputError("the Cramer-Rao bound needs the true alignment", where="methods")
    kept = slice(None) if given.inliers is None else given.inliers
    return limit_estimate(given.points_3d[kept], given.points_2d[kept], given.camera, given.gt)
