"""Silhouettes, rims and contours: masks and photos as evidence, with OpenCV and embree."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from cadalign.estimation.model import Model
from cadalign.estimation.prior import ShapePrior
from cadalign.estimation.search import Minimum
from cadalign.estimation.view import View
from cadalign.shapes.model import ShapeModel

if TYPE_CHECKING:
    from cadalign.estimation.contours.fit import Refined


def refine_with_images(
    model: Model | ShapeModel,
    prior: ShapePrior,
    views: Sequence[View],
    minima: Sequence[Minimum],
) -> tuple[list[Minimum], list[Refined]]:
    """Minima with the views' masks and photos, and what a result is to note of these.

    Without any of them they are the same, and neither OpenCV nor embree is loaded.
    """
    refined: list[Refined] = []
    found = list(minima)
    if any(view.mask is not None for view in views):
        from cadalign.estimation.contours.fit import fit_masks

        refined.append(fit_masks(model, prior, views, found))
        found = refined[-1].minima
    if any(view.image is not None and view.mask is None for view in views):
        from cadalign.estimation.contours.photo import fit_photos

        refined.append(fit_photos(model, prior, views, found))
        found = refined[-1].minima
    return found, refined
