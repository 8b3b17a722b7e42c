"""Agreement of data with an estimate, also after a correction, and texts of warnings."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from cadalign.errors import CadalignError, quote
from cadalign.estimation.model import Model, is_exact_model
from cadalign.estimation.options import RansacOptions, Sigma, pixel_information
from cadalign.estimation.result_parts import EstimateWarning, Kind, join_or
from cadalign.estimation.uncertainty.doubts import FALSE_ALARMS, is_large_sigma
from cadalign.estimation.uncertainty.residuals import (
    area_of,
    chance_of,
    f_quantile,
    named_keypoints,
)
from cadalign.estimation.view import View, number_views
from cadalign.io.evidence import Size
from cadalign.shapes.model import ShapeModel
from cadalign.shapes.parts import inflation_with

if TYPE_CHECKING:
    from cadalign.estimation.result import Result
    from cadalign.estimation.result_parts import EvidenceSummary


AnyModel = Model | ShapeModel

LEAST_GAIN = 12.0
"""Least gain of -2 log likelihood by the correction of a cause."""
_UNCERTAIN_SHARE = 0.5  # share of it for a mistake if shape or noise are uncertain
_UNLIKELY_POSE_COST = 8.0  # -2 log probability that an object is not upright, or seen from below
_MOST_EXCESS = 1.3  # ratio of squares to expected squares that an uncertain shape may have
_LEAST_FIT = 0.8  # least ratio of squares to their expectation for correct data
_GAIN_RATIO = 2.0  # least ratio of squares with a mistake to squares without, at unknown noise
MOST_CORRECTED = 1.6  # largest corrected residuals of an uncertain shape [sigma]
_LEAST_RATIO = 1.7  # of residuals before and after the correction
_LARGE_RATIO = 5.0  # the same if sigma is wrong
_MORE_INLIERS_GAIN = 2.0  # gain of -2 log likelihood if more keypoints agree
_SAME_INLIERS_GAIN = 2 * math.log(100)  # the same if as many agree, after a robust search
_FEW_REJECTED = 0.1  # share of the keypoints that raises no doubt in an uncertain shape
_MOST_REJECTED = 1 / 3  # share of the keypoints that can be outliers
_LEAST_CHANCE = 0.05  # probability of the squares of one piece of evidence that may be correct
_RATIO_CHANCE = 1e-3  # probability that two estimates of the noise differ as much
_UPRIGHT = 0.5  # least cosine between the model's up axis and the photo's
_SEEN_ALONG = 0.3  # length of the projected up axis, below which it is seen end-on
_BELOW_DEG, _LOW_DEG = -7.0, 0.0  # elevations of cameras below the ground, and near it


class Rule(NamedTuple):
    """A cause of large residuals, how to correct it, and the ``clause`` of its text.

    Only the ``view`` of a number is corrected, if given; one corrected to None is left out. The
    estimate must gain ``gain`` of -2 log likelihood, and ``price`` for each equation that it lacks;
    its residuals are at most ``most``.
    """

    kind: Kind
    clause: str = ""
    undo_view: Callable[[View], View | None] = lambda view: view
    undo_model: Callable[[Model], Model] = lambda model: model
    changes: Mapping[str, Any] = {}
    gain: float = LEAST_GAIN
    price: float = 0.0
    most: float = math.inf  # [sigma]
    view: int | None = None


class Agreement(NamedTuple):
    """Agreement of all evidence with an estimate.

    ``score`` is -2 log likelihood of all keypoints, with outliers uniformly distributed;
    ``integrated`` has the shape integrated out, and is None with outliers; both up to a constant.
    """

    result: Result
    score: float
    chi_square: float
    redundancy: int
    inliers: int
    keypoints: int
    sigma: float | None  # estimated [px]
    squares: Sequence[float]
    posture: str  # an unlikely pose as text; empty for a likely one
    is_low: bool  # the camera is near or below the ground
    integrated: float | None

    @property
    def ratio(self) -> float:
        """Root mean square residual [sigma]; 0 without redundancy."""
        return math.sqrt(self.chi_square / self.redundancy) if self.redundancy > 0 else 0.0


def _posture(result: Result, axis: str | None) -> tuple[str, bool]:
    """``posture`` and ``is_low`` of `Agreement`, for a photo that was taken upright."""
    if axis is None:
        return "", False
    pose = result.alignment
    right, down, away = pose.rotation[:, "xyz".index(axis)].tolist()
    ray = pose.apply(result.points_3d).mean(axis=0)
    along = -float(ray @ (right, down, away)) / max(float(np.linalg.norm(ray)), 1e-300)
    elevation, across = math.degrees(math.asin(max(-1.0, min(along, 1.0)))), math.hypot(right, down)
    if across > _SEEN_ALONG and -down < _UPRIGHT * across:
        return "stands on its head" if down > _UPRIGHT * across else "lies on its side", True
    return "is seen from below the ground" * (elevation < _BELOW_DEG), elevation < _LOW_DEG


def _equations_of(piece: EvidenceSummary) -> int:
    """Number of equations of a piece of evidence; 0 for outlines, whose pixels correlate."""
    each = {"keypoints": 2, "gravity": 2, "mask": 0, "photo": 0}
    return each.get(piece.kind, 1) * piece.count


@dataclass(frozen=True, eq=False)
class DiagnosisCase:
    """The data of an estimate, and the function ``estimate`` to repeat it.

    ``estimate`` takes a model, views and changed options, and raises CadalignError if it fails.
    """

    model: AnyModel
    views: Sequence[View]
    estimate: Callable[..., Result]
    ransac: RansacOptions | None = None
    size: Size | None = None
    has_rows: bool = False  # the ids of keypoints are their rows
    labels: Sequence[Hashable] = ()  # names of the keypoints by row
    photo: str | os.PathLike[str] | None = None  # of the first view
    is_tolerant: bool = False  # a robust loss tolerates large residuals

    @property
    def inflation(self) -> float:
        """Factor on the deviations of a learned shape."""
        if isinstance(self.model, Model):
            return 1.0
        count = sum(len(view.keypoint_ids) for view in self.views)
        return inflation_with(count, self.model.inflation, self.model.few_keypoints)

    @property
    def is_exact(self) -> bool:
        return is_exact_model(self.model)

    @property
    def is_plain(self) -> bool:
        """True for keypoints of known noise in one view, and an exact model, without ransac."""
        first, *others = self.views
        is_alone = not (others or first.sources or self.size or self.ransac)
        return is_alone and self.is_exact and first.sigma is not None

    @np.errstate(all="ignore")  # non-finite results are refused
    def correct(self, rule: Rule | None) -> Agreement | None:
        """The agreement after a rule's correction; None if there is no estimate."""
        model, views, changes = self.model, list(self.views), {} if rule is None else rule.changes
        try:
            if isinstance(model, Model):
                model = replace(model, mesh=None) if model.mesh else model
                model = model if rule is None else rule.undo_model(model)
            if rule is not None:
                undone = [
                    rule.undo_view(each) if rule.view in (None, each.number) else each
                    for each in views
                ]
                views = [each for each in undone if each is not None and each.has_evidence]
            views = number_views(views)
            result = self.estimate(model, views, **changes)
            return replace(self, model=model, views=views).agreement(result)
        except CadalignError:
            return None

    @np.errstate(all="ignore")  # overflows are residuals of outliers
    def agreement(self, result: Result) -> Agreement:
        """The agreement of views that take part in a result."""
        views, ransac = self.views, self.ransac
        score, squares, inliers, count = 0.0, [], 0, 0
        for view in views:
            own = result.views[view.number]
            sigma: Sigma = result.sigma or 1.0 if view.sigma is None else view.sigma
            information, kept = pixel_information(sigma, len(own.residuals)), own.inliers
            threshold = (ransac or RansacOptions()).threshold(view.sigma)
            if ransac is not None and result.options is not None:
                kept = kept & (np.linalg.norm(own.residuals, axis=1) < threshold)
            inliers, count = inliers + int(kept.sum()), count + len(kept)
            residuals, information = own.residuals[kept], information[kept]
            squares.append(float(np.einsum("ni,nij,nj->", residuals, information, residuals)))
            score += float((math.log(4 * math.pi**2) - np.log(np.linalg.det(information))).sum())
            if not kept.all():
                area = area_of(own.points_2d, own.camera, threshold)
                score += 2 * math.log(area) * int((~kept).sum())
        chi_square, redundancy = sum(squares), result.posterior.redundancy
        if any(view.has_outline or view.depth_image is not None for view in views):
            # Outlines are not tested, and depth images only at the object.
            poses = 1 if views[0].cam_from_rig is not None else len(views)
            counted = [each for each in result.evidence if _equations_of(each)]
            redundancy = sum(map(_equations_of, counted))
            redundancy -= 6 * poses + len(result.stretched_axes)
            chi_square = sum(_equations_of(each) * each.rms_sigmas**2 for each in counted)
        elif result.cost is not None and inliers == int(result.inliers.sum()):
            chi_square = result.cost
        if isinstance(self.model, Model):  # outliers invite extreme stretches
            logs = np.log(result.alignment.scale)
            score += float(((logs - logs.mean()) ** 2).sum())
        noise = result.sigma if any(view.sigma is None for view in views) else None
        posture, is_low = _posture(result, self.model.up_axis)
        if posture and not self.is_exact:
            score += _UNLIKELY_POSE_COST
        integrated = None
        if ransac is None and inliers == count and result.posterior.score is not None:
            integrated = score + result.posterior.score
        agreed = inliers, count, noise, squares, posture, is_low, integrated
        return Agreement(result, score + chi_square, chi_square, redundancy, *agreed)

    def has_chance(self, found: Agreement) -> bool:
        """True if noise and the spread of shapes explain the residuals, or sigma is estimated."""
        if found.sigma is not None:
            return True
        squares, freedom = found.chi_square / self.inflation**2, found.result.degrees_of_freedom
        return chance_of(squares, found.redundancy, freedom) >= FALSE_ALARMS

    def has_contradiction(self, found: Agreement) -> bool:
        """True if the residuals of one piece of evidence exceed its noise.

        An uncertain shape bends to wrong evidence, so that its residuals are tested together.
        """
        pieces = found.result.evidence
        if not self.is_exact and found.sigma is None:
            most = found.chi_square - _LEAST_FIT * found.redundancy  # gain of a removal, at most
            return most > LEAST_GAIN * self.inflation**2
        counts = [_equations_of(each) for each in pieces]
        return len(pieces) > 1 and any(
            chance_of(count * each.rms_sigmas**2, count) * len(pieces) < FALSE_ALARMS
            for each, count in zip(pieces, counts, strict=True)
        )

    def is_doubtful(self, given: Agreement) -> bool:
        """True if the residuals fail the test for mistakes.

        An uncertain shape fits keypoints that a robust search with an exact shape rejects.
        """
        rejected = given.keypoints - given.inliers
        if rejected > (0 if self.is_exact else _FEW_REJECTED * given.keypoints):
            return True
        if self.ransac is not None and (self.is_exact or given.ratio >= 1):
            return True
        if given.sigma is None:
            is_odd = bool(given.posture or given.is_low)
            is_odd |= given.chi_square > _MOST_EXCESS * given.redundancy > 0
            return (
                (is_odd and not self.is_exact)
                or not self.has_chance(given)
                or self.has_contradiction(given)
            )
        pixels = [view.pixels for view in self.views]
        return given.redundancy > 0 and is_large_sigma(given.sigma, pixels)

    def gain(self, rule: Rule, found: Agreement, given: Agreement) -> float:
        """Decrease of -2 log likelihood by a correction, less the price of omitted equations."""
        fall = given.score - found.score
        if not self.is_exact and given.integrated is not None and found.integrated is not None:
            fall = given.integrated - found.integrated
        elif rule.price:
            fall = given.chi_square - found.chi_square
        fewer = max(given.redundancy - found.redundancy, 0)
        return fall - rule.price * max(found.ratio, 1.0) ** 2 * fewer  # if sigma is too small

    def _may_be_wrong(self, found: Agreement, given: Agreement) -> bool:
        """True if a piece of evidence adds implausibly many squares."""
        fewer, noise = given.redundancy - found.redundancy, self.inflation * max(found.ratio, 1.0)
        squares, freedom = given.chi_square - found.chi_square, found.result.degrees_of_freedom
        return chance_of(squares / noise**2, max(fewer, 1), freedom) < _LEAST_CHANCE

    def explains(self, rule: Rule, found: Agreement, given: Agreement) -> bool:
        """True if the corrected data fit, and much better than the ``given`` data."""
        gain, is_piece = self.gain(rule, found, given), rule.price > 0
        if is_piece and not self.is_exact and not self._may_be_wrong(found, given):
            return False
        if found.ratio > rule.most:
            return False
        is_robust = self.ransac is not None and not is_piece
        if is_robust and (self.is_exact or given.inliers < given.keypoints):
            more = found.inliers > given.inliers or found.inliers == found.keypoints
            return more and gain > _MORE_INLIERS_GAIN
        rejected = found.keypoints - found.inliers
        least = (_SAME_INLIERS_GAIN if is_robust else rule.gain) * self.inflation**2
        is_correction = rule.kind == "mistake" and rule.gain <= LEAST_GAIN
        if is_correction and not (self.is_exact and given.sigma is None):
            least = _UNCERTAIN_SHARE * rule.gain
        if not gain > least * (max(rejected, 1) if "ransac" in rule.changes else 1):
            return False
        if found.sigma is not None and given.sigma is not None:
            if is_correction:
                squares = (given.sigma / found.sigma) ** 2
                return squares > _GAIN_RATIO and found.redundancy * math.log(squares) > least
            ratio = f_quantile(found.redundancy, found.redundancy, _RATIO_CHANCE)
            return found.sigma < given.sigma / math.sqrt(ratio)
        fits = self.has_chance(found)
        if rejected or "ransac" in rule.changes:
            return fits and 0 < rejected <= _MOST_REJECTED * found.keypoints
        is_small = found.ratio < min(MOST_CORRECTED, given.ratio / _LEAST_RATIO)
        return fits or is_small or found.ratio < given.ratio / _LARGE_RATIO


# Texts of causes, for users -----------------------------------------------------------------------


_WORST = 3  # keypoints that are named if no cause is found

UNIT = "in another unit (millimetres for metres)?"
_TEXTS = {
    "mistake": "{posture}{named}: corrected, {compared}",
    "unit": "{named}: is it " + UNIT + " Corrected, {compared}",
    "contradiction": "{named} contradicts the other evidence: without it, {compared}",
    "stretch": "the keypoints contradict the constraint on the stretch: without it they fit "
    "better, with the scale ({scale})",
    "camera": "the keypoints contradict the camera: they fit better with a focal length "
    "of {best.result.camera.fx:.4g} px",
    "outlier": "the residuals are {given.ratio:.2g} times as large as sigma explains: {wrong} "
    "{do} not fit the others (with the distance to the predicted position)",
    "misfit": "the residuals are {given.ratio:.2g} times as large as sigma{spread} "
    "can explain: keypoints, sigma, the camera or the model are wrong; the worst are {wrong}",
}


def warning_of(
    case: DiagnosisCase, rule: Rule, best: Agreement, given: Agreement, *, clauses: str = ""
) -> EstimateWarning:
    scale = ", ".join(f"{value:.3g}" for value in best.result.alignment.scale.tolist())
    posture = ""
    if given.posture and not (best.posture or case.is_exact):
        posture = f"the object {given.posture}; if that is wrong, perhaps "
    wrong, view, keypoints = "", None, tuple[int, ...]()
    if rule.kind in ("outlier", "misfit"):
        wrong, view, keypoints = _wrong_keypoints(case, best, all_agree=rule.kind == "misfit")
    words = {"named": clauses, "compared": _comparison(best, given), "scale": scale, "wrong": wrong}
    words |= {"posture": posture, "do": "does" if len(keypoints) == 1 else "do"}
    words["spread"] = "" if case.is_exact else " and the spread of shapes"
    text = _TEXTS[rule.kind].format(best=best, given=given, **words)
    return EstimateWarning(rule.kind, text, 0 if rule.kind == "camera" else view, keypoints)


def _wrong_keypoints(
    case: DiagnosisCase, best: Agreement, *, all_agree: bool
) -> tuple[str, int | None, tuple[int, ...]]:
    """Names of outliers with their errors, and their view and rows if all are in one view.

    With ``all_agree``, the keypoints with the largest errors are named, without view and rows.
    """
    texts, wrong = [], dict[int, tuple[int, ...]]()
    lengths = [np.linalg.norm(own.residuals, axis=1) for own in best.result.views]
    largest = np.sort(np.concatenate(lengths))[-_WORST:][0] if all_agree else math.inf
    for view, own, errors in zip(case.views, best.result.views, lengths, strict=True):
        marked = errors >= largest if all_agree else ~own.inliers
        rows, names = np.flatnonzero(marked).tolist(), view.keypoint_ids
        if rows:
            numbers = [names[row] for row in rows] if case.has_rows else rows
            wrong[view.number] = tuple(cast("list[int]", numbers))
            where = f"views[{view.number}]: " if len(case.views) > 1 else ""
            called = [names[row] for row in rows]
            called = [*shape_names(case.model, called)] or called
            if case.labels:
                called = [case.labels[each] for each in wrong[view.number]]
            of_each = zip(map(quote, called), errors[rows].tolist(), strict=True)
            texts.append(where + named_keypoints(dict(of_each)))
    total = sum(map(len, wrong.values()))
    text = f"{'keypoint' if total == 1 else 'keypoints'} {'; '.join(texts)}"
    return (text, None, ()) if all_agree or len(wrong) > 1 else (text, *next(iter(wrong.items())))


def shape_names(model: AnyModel, labels: Collection[Any]) -> list[str]:
    """Names of a learned shape's keypoints; empty for other models, and without names."""
    if isinstance(model, Model) or not model.names:
        return []
    return [model.names[row] for row in model.rows(labels)]


def name_rules(likely: Sequence[tuple[Rule, Agreement]]) -> str:
    """Join the clauses of equally likely rules; rules with an upright object come first."""
    upright = {rule.clause: None for rule, each in likely if not each.posture}
    others = {rule.clause: None for rule, each in likely if rule.clause not in upright}
    clauses = join_or(list(upright or others)) if likely else ""
    if upright and others:
        clauses += f" (or, if y is not up in the photo, {join_or(list(others))})"
    return clauses


def _comparison(best: Agreement, given: Agreement) -> str:
    rejected = given.keypoints - given.inliers
    if rejected:
        share = f"{rejected} ({100 * rejected / given.keypoints:.0f} %)"
        agree = f"{best.inliers} of {best.keypoints} keypoints agree"
        return f"{agree}; as given, {share} are rejected"
    if best.sigma is not None and given.sigma is not None:
        return f"sigma is {best.sigma:.2g} px; as given, {given.sigma:.2g} px"
    what = "times what their standard deviations allow"
    return f"the residuals are {best.ratio:.2g} {what}; as given, {given.ratio:.2g} times"
