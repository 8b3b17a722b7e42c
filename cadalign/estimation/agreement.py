"""The agreement of data with an estimate, and with that of data in which something is undone."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from cadalign.errors import CadalignError
from cadalign.estimation.model import Model, is_exact_model
from cadalign.estimation.options import FitOptions, RansacOptions, Sigma, pixel_information
from cadalign.estimation.uncertainty.doubts import FALSE_ALARMS, is_large_sigma
from cadalign.estimation.uncertainty.residuals import area_of, chi_square_tail, f_quantile
from cadalign.estimation.view import View, numbered
from cadalign.estimation.warning import EstimateWarning
from cadalign.shapes.model import ShapeModel

if TYPE_CHECKING:
    from cadalign.estimation.result import Result

AnyModel = Model | ShapeModel

AS_MANY_AGREE = 12.0
"""Gain of -2 log likelihood by a mistake that is corrected, at least."""
_DOUBTFUL = 1e-4  # probability of such residuals by chance, below which mistakes are looked for
_MOST_CORRECTED = 1.6  # residuals of uncertain shapes without a mistake, over their deviations
_LEAST_RATIO = 1.7  # of the residuals with and without it
_MORE_AGREE = 2.0  # of -2 log likelihood, that is gained where more keypoints agree
_AS_MANY_ARE_FOUND = 2 * math.log(100)  # the same after a robust search, where as many do
_FEW_REJECTED = 0.1  # share of the keypoints, up to which an uncertain shape is not doubted
_MOST_REJECTED = 1 / 3  # share of the keypoints that are outliers; more are none
_CHANCE_OF_RATIO = 1e-3  # that residuals of an unknown noise differ by as much
_UPRIGHT = 0.5  # cosine between the model's y axis and the photo's upwards, at least
_EQUATIONS = {"keypoints": 2, "gravity": 2, "depth": 1, "size": 1, "camera height": 1}


class Again(Protocol):
    """Estimate without a diagnosis; ``changes`` are those of its `FitOptions`."""

    def __call__(self, model: AnyModel, views: Sequence[View], /, **changes: Any) -> Result:
        """Raises CadalignError if there is none."""


class Rule(NamedTuple):
    """A cause of residuals that are too large.

    What is undone: ``undo_view``, ``undo_model``, and ``changes`` of the options. What the estimate
    must explain: so much ``gain`` of -2 log likelihood. What is said: a ``clause`` that names a
    usual mistake, or what ``says`` makes of the agreement without the cause and with it.
    """

    clause: str = ""
    undo_view: Callable[[View], View] = lambda view: view
    undo_model: Callable[[Model], Model] = lambda model: model
    changes: Mapping[str, Any] = {}
    gain: float = AS_MANY_AGREE
    says: Callable[[Agreement, Agreement], EstimateWarning] | None = None


AS_GIVEN = Rule()
"""Nothing is undone."""


class Agreement(NamedTuple):
    """Agreement of all evidence with an estimate.

    The ``score`` is -2 log likelihood of all keypoints, of which outliers lie anywhere.
    """

    result: Result
    score: float
    chi_square: float
    redundancy: int
    inliers: int
    keypoints: int
    sigma: float | None  # estimated [px]

    @property
    def ratio(self) -> float:
        """Residuals over their standard deviations; 0 where nothing is redundant."""
        return math.sqrt(self.chi_square / self.redundancy) if self.redundancy > 0 else 0.0

    @property
    def is_upright(self) -> bool:
        """True if the model's y axis points up in the photo."""
        return bool(-self.result.alignment.rotation[1, 1] > _UPRIGHT)


@dataclass(frozen=True, eq=False)
class DiagnosisCase:
    """The data of an estimate, the estimate as a function of these, and the search for inliers."""

    model: AnyModel
    views: Sequence[View]
    again: Again
    ransac: RansacOptions | None = None
    options: FitOptions | None = None  # of a fit to keypoints of known noise, without a search

    @property
    def inflation(self) -> float:
        """Factor on the deviations of a learned shape."""
        return float(getattr(self.model, "inflation", 1.0))

    @property
    def is_exact(self) -> bool:
        """True for a CAD model whose object has its shape, but for the stretch."""
        return is_exact_model(self.model)

    @np.errstate(all="ignore")  # what is not finite is refused
    def without(self, rule: Rule) -> Agreement | None:
        """The agreement after a cause is undone; None where there is no estimate."""
        model = self.model
        try:
            if isinstance(model, Model):
                model = rule.undo_model(replace(model, mesh=None) if model.mesh else model)
            views = numbered([rule.undo_view(view) for view in self.views])
            result = self.again(model, views, **rule.changes)
            return replace(self, model=model, views=views).agreement(result)
        except CadalignError:
            return None

    @np.errstate(all="ignore")  # residuals that overflow are outliers'
    def agreement(self, result: Result) -> Agreement:
        """The agreement of views that take part in a result."""
        views, ransac = self.views, self.ransac
        score, squares, inliers, count = 0.0, 0.0, 0, 0
        for view in views:
            own = result.views[view.number]
            sigma: Sigma = result.sigma or 1.0 if view.sigma is None else view.sigma
            information, kept = pixel_information(sigma, len(own.residuals)), own.inliers
            threshold = (ransac or RansacOptions()).threshold(view.sigma)
            if ransac is not None and result.options is not None:
                kept = kept & (np.linalg.norm(own.residuals, axis=1) < threshold)
            inliers, count = inliers + int(kept.sum()), count + len(kept)
            if len(kept):
                seen = own.residuals[kept], information[kept]
                squares += float(np.einsum("ni,nij,nj->", seen[0], seen[1], seen[0]))
                score += float((math.log(4 * math.pi**2) - np.log(np.linalg.det(seen[1]))).sum())
                if not kept.all():
                    area = area_of(own.points_2d, own.camera, threshold)
                    score += 2 * math.log(area) * int((~kept).sum())
        kinds = {each.kind for each in result.evidence}
        is_whole = inliers == int(result.inliers.sum())
        if result.cost is not None and is_whole and not kinds & {"mask", "photo"}:
            squares = result.cost
        equations = sum(_EQUATIONS.get(each.kind, 0) * each.count for each in result.evidence)
        unknowns = 6 * (1 if views[0].cam_from_rig is not None else len(views))
        unknowns += len(result.stretched_axes) + (result.focal == "estimate")
        equations += result.focal == "estimate" and result.focal_prior is not None
        if isinstance(self.model, Model):
            options, scale = self.model.fit_options(), result.alignment.scale
            equations += options.prior_equations(np.ones(3) if self.options is None else scale)
            score += float((np.log(scale / scale.mean()) ** 2).sum())  # outliers invite extremes
        return Agreement(
            result,
            score + squares,
            squares,
            equations - unknowns,
            inliers,
            count,
            result.sigma if any(view.sigma is None for view in views) else None,
        )

    def has_chance(self, found: Agreement, probability: float) -> bool:
        """True if noise leaves such residuals with this probability at least."""
        squares = found.chi_square / self.inflation**2
        return found.redundancy <= 0 or chi_square_tail(squares, found.redundancy) >= probability

    def is_doubtful(self, given: Agreement) -> bool:
        """True if the residuals fail the test for mistakes.

        An uncertain shape follows keypoints that a robust search would reject of an exact one,
        which may agree with its mirror image.
        """
        rejected = given.keypoints - given.inliers
        if rejected > (0 if self.is_exact else _FEW_REJECTED * given.keypoints):
            return True
        if self.ransac is not None and (self.is_exact or given.ratio >= 1):
            return True
        if given.sigma is None:
            return not self.has_chance(given, _DOUBTFUL)
        pixels = [view.pixels for view in self.views]
        return given.redundancy > 0 and is_large_sigma(given.sigma, pixels)

    def explains(self, rule: Rule, found: Agreement, given: Agreement) -> bool:
        """True if the data without a cause fit, and much better than as they were ``given``."""
        gain = given.score - found.score
        if self.ransac is not None and (self.is_exact or given.inliers < given.keypoints):
            more = found.inliers > given.inliers or found.inliers == found.keypoints
            return more and gain > _MORE_AGREE
        least = rule.gain if self.ransac is None else _AS_MANY_ARE_FOUND
        if not gain > least * self.inflation**2:
            return False
        if found.sigma is not None and given.sigma is not None:
            ratio = f_quantile(found.redundancy, found.redundancy, _CHANCE_OF_RATIO)
            return found.sigma < given.sigma / math.sqrt(ratio)
        rejected, fits = found.keypoints - found.inliers, self.has_chance(found, FALSE_ALARMS)
        if rejected:
            return fits and rejected <= _MOST_REJECTED * found.keypoints
        return fits or found.ratio < min(_MOST_CORRECTED, given.ratio / _LEAST_RATIO)
