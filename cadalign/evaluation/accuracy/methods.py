"""Methods that can be evaluated, by name."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from cadalign.errors import InputError
from cadalign.estimation.options import METHODS, RansacOptions

LIMIT = "limit"
"""The pseudo-method of the Cramer-Rao bound; see `cramer_rao.limit_estimate`."""

SHAPE = "shape"
"""The alignment of a category's learned shape, in runs that are given one."""

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


def method_names() -> tuple[str, ...]:
    """All names: the methods of `cadalign.fit`, variants of them, and the Cramer-Rao bound."""
    return (*METHODS, *_VARIANTS, *_RANSAC, LIMIT)


def is_robust(name: str) -> bool:
    """True for methods that search for inliers."""
    return name in _RANSAC


def has_statistics(name: str) -> bool:
    """True for methods that predict standard deviations and know of alternatives."""
    return name == "optimal" or name in _VARIANTS or name in _RANSAC


def check_methods(names: Iterable[str]) -> tuple[str, ...]:
    """Return the names, each once, if all are known."""
    unique = tuple(dict.fromkeys(names))
    known = method_names()
    for name in unique:
        if name not in known:
            nearest = difflib.get_close_matches(name, known, n=1)
            hint = f", did you mean {nearest[0]!r}?" if nearest else ""
            raise InputError(
                f"unknown method {name!r}{hint}",
                where="methods",
                fix=f"known are {', '.join(known)}",
            )
    if not unique:
        raise InputError("none is given", where="methods", fix=f"known are {', '.join(known)}")
    return unique


def fit_options(name: str, *, sigma: float, ransac: RansacOptions | None) -> dict[str, Any]:
    """The options of `cadalign.fit` and `cadalign.fit_batch` that make it a method.

    Robust methods take what lies within 3.5 ``sigma`` [px] for an inlier, or go by ``ransac``, but
    for the minimal solver and the refinement, which are the method's own.
    """
    if name in _RANSAC:
        common = ransac or RansacOptions(max_reproj_error=_INLIER_BOUND * sigma)
        return {"sigma": sigma, "ransac": replace(common, **_RANSAC[name])}
    return {"sigma": sigma, **_VARIANTS.get(name, {"method": name})}
