"""Keypoints that do not determine what is asked of them, and the errors that say so."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import DegenerateError
from cadalign.estimation.options import FitOptions
from cadalign.solvers.constants import NOT_FOUND, OUT_OF_RANGE, TOO_FEW
from cadalign.solvers.linear import aepnp_error, describe_plane, out_of_range_error

_FLAT = 1e-6  # extent across a line or a plane over that along it


def are_on_a_line(points: FloatArray, flat: float) -> bool:
    """True for points (n, 3) whose second extent is at most ``flat`` times the first."""
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(extents[1] <= flat * extents[0])


def are_in_one_plane(points: FloatArray) -> bool:
    """True for points (n, 3) that do not all coincide and lie in a plane or on a line."""
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(extents[0] > 0 and extents[2] <= _FLAT * extents[0])


def solver_error(
    status: int, undetermined: int, points_3d: FloatArray, options: FitOptions
) -> DegenerateError:
    """Convert a solver's status to an exception; ``undetermined`` is an unknown's number, or -1."""
    if status == TOO_FEW:
        method = f"the method {options.method!r}"
        fix = f"give at least {options.min_points}"
        if options.method == "optimal":
            method = f"{options.unknowns} unknowns"
            fix += ", fewer unknowns by stretch=, or a prior"
        what = f"{len(points_3d)} keypoints are too few for {method}"
        return DegenerateError(what, where="points_3d", fix=fix)
    if status == OUT_OF_RANGE:
        return out_of_range_error()
    if status == NOT_FOUND:
        return DegenerateError(
            "no alignment with all keypoints in front of the camera was found",
            where="points_2d",
            fix="check that points_3d and points_2d correspond, row by row, and the camera",
        )
    if undetermined < 0:
        return aepnp_error(points_3d)
    reason = describe_plane(points_3d)
    if undetermined < 3:
        missing = "the rotation"
    elif undetermined < 6:
        missing = f"the translation along the camera's {'xyz'[undetermined - 3]}"
    else:
        missing = f"the scale s_{'xyz'[options.axis_order[undetermined - 5]]}"
    if reason is None and 2 * len(points_3d) <= options.unknowns:
        return DegenerateError(
            f"no alignment reprojects the {len(points_3d)} keypoints exactly, and the nearest one "
            f"leaves {missing} open",
            where="points_3d",
            fix="give more keypoints, or a scale_prior_sigma",
        )
    fix = "add keypoints elsewhere, hold scales fixed with stretch=, or give scale_prior_sigma"
    if undetermined < 3 and are_on_a_line(points_3d, _FLAT):
        fix = "add keypoints off their line: no option, and no symmetry about it, takes their place"
    return DegenerateError(
        f"{missing} is not determined: {reason or 'seen from there, the keypoints leave it open'}",
        where="points_3d",
        fix=fix,
    )


def no_redundancy_error(count: int) -> DegenerateError:
    """The error for a noise that is to be estimated from keypoints that always fit."""
    return DegenerateError(
        f"{count} keypoints fit exactly, so their noise cannot be estimated",
        where="sigma",
        fix="give sigma, or more keypoints",
    )
