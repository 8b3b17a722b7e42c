"""Silhouettes, rims and contours: masks and photos as evidence, with OpenCV and embree."""

from __future__ import annotations

from collections.abc import Sequence

from cadalign.estimation.problem import Problem
from cadalign.estimation.result_parts import NO_NOTES, OutlineNotes
from cadalign.estimation.search import Minimum


def refine(problem: Problem, minima: Sequence[Minimum]) -> tuple[Sequence[Minimum], OutlineNotes]:
    """The third stage of an estimate: minima with masks and photos, and a result's notes of these.

    Without any of them they are the same, and neither OpenCV nor embree is loaded.
    """
    if not problem.uses_outlines:
        return minima, NO_NOTES
    from cadalign.estimation.contours.engine import refine_with_outlines

    return refine_with_outlines(problem, minima)
