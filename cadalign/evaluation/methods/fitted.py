"""Methods of `cadalign.fit`, variants of them, and the Cramer-Rao bound."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import groupby
from typing import TYPE_CHECKING, Any

from cadalign.errors import CadalignError, InputError
from cadalign.estimation.options import METHODS, RansacOptions
from cadalign.evaluation.methods.method import LIMIT, Method, MethodInput
from cadalign.geometry.alignment import Alignment

if TYPE_CHECKING:
    from cadalign.estimation.result import Result

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
# 99.8 % of Gaussian errors in the plane are shorter than this, in standard deviations.
_INLIER_BOUND = 3.5


@cache
def fit_methods() -> dict[str, Method]:
    """The methods by name, the Cramer-Rao bound last."""
    found = [_fit_method(name) for name in (*METHODS, *_VARIANTS, *_RANSAC)]
    limit = Method(LIMIT, bound_estimate, is_general=True)
    return {method.name: method for method in (*found, limit)}


def _fit_method(name: str) -> Method:
    call = FitCall(name)
    return Method(
        name,
        call,
        call.many,
        is_general=True,
        has_statistics=name == "optimal" or name in _VARIANTS or name in _RANSAC,
        is_robust=name in _RANSAC,
    )


def fit_options(name: str, *, sigma: float, ransac: RansacOptions | None) -> dict[str, Any]:
    """The options of `cadalign.fit` and `cadalign.fit_batch` that make it a method.

    Robust methods take what lies within 3.5 ``sigma`` [px] for an inlier, or go by ``ransac``, but
    for the minimal solver and the refinement, which are the method's own.
    """
    if name in _RANSAC:
        common = ransac or RansacOptions(max_reproj_error=_INLIER_BOUND * sigma)
        return {"sigma": sigma, "ransac": replace(common, **_RANSAC[name])}
    return {"sigma": sigma, **_VARIANTS.get(name, {"method": name})}


@dataclass(frozen=True)
class FitCall:
    """The call of `cadalign.fit` of a method; see `fit_options`."""

    name: str

    def __call__(self, given: MethodInput) -> Result:
        """The fit of one instance."""
        from cadalign.estimation.fit import fit

        how = fit_options(self.name, sigma=given.sigma, ransac=given.ransac)
        return fit(given.points_3d, given.points_2d, given.camera, **how)

    def many(self, inputs: Sequence[MethodInput]) -> list[Alignment | CadalignError]:
        """The alignments of many instances, in batches of one standard deviation."""
        from cadalign.estimation.fit import fit_batch

        found: list[Alignment | CadalignError] = []
        for sigma, group in groupby(inputs, key=lambda given: given.sigma):
            some = list(group)
            batch = fit_batch(
                [given.points_3d for given in some],
                [given.points_2d for given in some],
                [given.camera for given in some],
                **fit_options(self.name, sigma=sigma, ransac=None),
            )
            found += [batch.errors.get(b) or batch.alignment(b) for b in range(len(batch))]
        return found


def bound_estimate(given: MethodInput) -> Alignment:
    """The estimate of an ideal estimator that knows the outliers."""
    from cadalign.evaluation.metrics.cramer_rao import limit_estimate

    if given.gt is None:
        raise InputError("the Cramer-Rao bound needs the true alignment", where="methods")
    kept = slice(None) if given.inliers is None else given.inliers
    return limit_estimate(given.points_3d[kept], given.points_2d[kept], given.camera, given.gt)
