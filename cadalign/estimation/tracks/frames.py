"""Frames of a track: the views of one time share a pose, and frames stand in the order of time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, cast

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import InputError
from cadalign.estimation.prior import ShapePrior
from cadalign.estimation.view import View
from cadalign.estimation.weak_views import lie_on_a_line
from cadalign.geometry.camera import needs_facing

_MOST_FIRST = 40  # frames that the shape is first estimated from


class Frames(NamedTuple):
    """Increasing ``times`` (P,) [s], and the number of each view's frame (V,)."""

    times: FloatArray
    of_view: IntArray

    @classmethod
    def of(cls, views: Sequence[View]) -> Frames:
        """The frames of views; successive views are a second apart where none has a time.

        Raises
        ------
        InputError
            If only some views have a time, all have the same one, or a view has evidence that a
            motion cannot be estimated with.
        """
        lacking = [view.time is None for view in views]
        if any(lacking) != all(lacking):
            fix = "give it for all views, or for none"
            where = f"views[{lacking.index(True)}].time"
            raise InputError("only some views have a time", where=where, fix=fix)
        for number, view in enumerate(views):
            for name in ("mask", "image"):
                if getattr(view, name) is not None:
                    what = "contours are not used together with a motion"
                    raise InputError(what, where=f"views[{number}].{name}", fix="leave it away")
            if needs_facing([view.camera]):
                fix = "undistort the photos to a pinhole's"
                what = "a wide lens cannot be used together with a motion"
                raise InputError(what, where=f"views[{number}].camera", fix=fix)
        given = [float(n if view.time is None else view.time) for n, view in enumerate(views)]
        times, of_view = np.unique(given, return_inverse=True)
        if len(times) < 2:
            fix = "give views of two times or more, or no motion"
            raise InputError("all views have the same time", where="views", fix=fix)
        return cls(times, of_view.astype(np.int64))

    def chosen(self, prior: ShapePrior, views: Sequence[View]) -> list[int]:
        """Views of the frames that tell most of the shape, spread over the track."""
        mean = prior.components[0].mean
        counts = np.zeros(len(self.times), dtype=int)
        for number, view in enumerate(views):
            points = mean[prior.rows_of(view.keypoint_ids, f"views[{number}].ids")]
            if not lie_on_a_line(points):
                counts[self.of_view[number]] += len(points)
        parts = np.array_split(np.arange(len(counts)), min(_MOST_FIRST, len(counts)))
        best = [int(part[np.argmax(counts[part])]) for part in parts]
        kept = [frame for frame in best if counts[frame] > 0]
        return np.flatnonzero(np.isin(self.of_view, kept)).tolist()

    def among(self, numbers: Sequence[int]) -> tuple[int, ...]:
        """Frames of some views, numbered from 0 without those that are not among them."""
        _, renumbered = np.unique(self.of_view[list(numbers)], return_inverse=True)
        return tuple(cast("list[int]", renumbered.tolist()))
