"""From a view's mask to its contour."""

from __future__ import annotations

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import InputError
from cadalign.fitting.contours.contour import Contour, contour_of


def mask_contour(mask: FloatArray | BoolArray, where: str) -> Contour:
    """The contour of a checked mask (h, w).

    Raises
    ------
    InputError
        If it is empty or covers all of the image, or all of its contour lies at the image's border.
    """
    inside = mask if mask.dtype == bool else mask >= 0.5
    if not inside.any():
        fix = "give the mask of the object, or None"
        raise InputError("contains no pixel of the object", where=where, fix=fix)
    if inside.all():
        fix = "give the mask of the object alone, or None"
        raise InputError("covers all of the image, so that it has no contour", where=where, fix=fix)
    contour = contour_of(mask)
    if not len(contour.points):
        raise InputError(
            "no part of its contour is larger than a few pixels and off the image's border",
            where=where,
            fix="give a photo in which more of the object's outline is seen, or None",
        )
    return contour
