"""Silhouettes, rims and contours: masks and photos as evidence, with OpenCV and embree."""

from __future__ import annotations

from collections.abc import Sequence

from cadalign.estimation.model import Model
from cadalign.estimation.prior import ShapePrior
from cadalign.estimation.result_parts import NO_NOTES, OutlineNotes
from cadalign.estimation.search import Minimum
from cadalign.estimation.view import View
from cadalign.shapes.model import ShapeModel


def refine_with_images(
    model: Model | ShapeModel,
    prior: ShapePrior,
    views: Sequence[View],
    minima: Sequence[Minimum],
) -> tuple[list[Minimum], OutlineNotes]:
    """Minima with the views' masks and photos, and what a result is to note of these.

    Without any of them they are the same, and neither OpenCV nor embree is loaded.
    """
    if not any(view.has_outline for view in views):
        return list(minima), NO_NOTES
    from cadalign.estimation.contours.engine import refine_with_outlines

    return refine_with_outlines(model, prior, views, minima)
