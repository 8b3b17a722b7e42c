"""The evidence of one view of keypoints, made when it is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.fitting.joint.pack import evidence_of
from cadalign.fitting.joint.prior import prior_of, rows_among
from cadalign.fitting.joint.view import View
from cadalign.fitting.options import LOSSES, FitOptions
from cadalign.shapes.model import ShapeModel
from cadalign.solvers.joint.evidence import Evidence, State


@dataclass(frozen=True, eq=False)
class SingleBasis:
    """The evidence of one view and the state estimated from it, as `Basis`."""

    model: ShapeModel
    view: View
    options: FitOptions
    component: int
    pose: FloatArray
    force: FloatArray
    numbers: tuple[int, ...] | None = None

    @cached_property
    def evidence(self) -> Evidence:
        """The evidence in the form of the kernels."""
        prior = prior_of(self.model)
        loss, scale = LOSSES[self.options.loss], self.options.loss_scale
        first = evidence_of(prior, [self.view], None, loss=loss, loss_scale=scale)
        return first._replace(shape=prior.components[self.component])

    @cached_property
    def state(self) -> State:
        """The state that was estimated."""
        shape = self.evidence.shape
        rows = rows_among(self.model.ids, self.view.keypoint_ids, "views[0].ids")
        coefficients = np.tensordot(shape.modes[:, rows], self.force, 2)
        displacements = np.zeros_like(shape.mean)
        displacements[rows] = shape.spread[rows, None] ** 2 * self.force
        return State(self.pose[None], np.zeros(3), coefficients, displacements)
