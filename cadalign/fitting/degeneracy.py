"""Conversion of solver status codes to exceptions."""

from __future__ import annotations

from cadalign.arrays import FloatArray
from cadalign.errors import DegenerateError
from cadalign.fitting.options import FitOptions
from cadalign.solvers.constants import NOT_FOUND, TOO_FEW
from cadalign.solvers.linear import describe_plane


def solver_error(
    status: int, undetermined: int, points_3d: FloatArray, options: FitOptions
) -> DegenerateError:
    """Convert a solver's status to an exception.

    Parameters
    ----------
    status : int
        See `cadalign.solvers.constants`.
    undetermined : int
        Number of an unknown of the solvers that is not determined, or -1.
    points_3d : (n, 3) float
    options : FitOptions
    """
    if status == TOO_FEW:
        return _too_few_error(len(points_3d), options)
    if status == NOT_FOUND:
        return DegenerateError(
            "no alignment with all keypoints in front of the camera was found",
            where="points_2d",
            fix="check that points_3d and points_2d correspond, row by row, and the camera",
        )
    reason = describe_plane(points_3d)
    if undetermined < 0:
        return DegenerateError(
            reason or "the points lie nearly in one plane",
            where="points_3d",
            fix="a linear solver needs keypoints that span a volume",
        )
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
    return DegenerateError(
        f"{missing} is not determined: {reason or 'seen from there, the keypoints leave it open'}",
        where="points_3d",
        fix="add keypoints elsewhere, hold scales fixed with stretch=, or give scale_prior_sigma",
    )


def no_redundancy_error(count: int) -> DegenerateError:
    """The error for a noise that is to be estimated from keypoints that always fit."""
    return DegenerateError(
        f"{count} keypoints fit exactly, so their noise cannot be estimated",
        where="sigma",
        fix="give sigma, or more keypoints",
    )


def _too_few_error(count: int, options: FitOptions) -> DegenerateError:
    if options.method == "optimal":
        what = f"{count} keypoints are too few for {options.unknowns} unknowns"
        fix = f"give at least {options.min_points}, fewer unknowns by stretch=, or a prior"
    else:
        what = f"{count} keypoints are too few for the method {options.method!r}"
        fix = f"give at least {options.min_points}"
    return DegenerateError(what, where="points_3d", fix=fix)
