"""Usual mistakes in data that do not fit: each is undone, and the estimate is made again.

A mistake is named where the data without it fit, and explain the keypoints far better. To add one,
write a `Mistake` and list it in `_mistakes_in`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError
from cadalign.estimation.assemble import result_of_keypoints
from cadalign.estimation.fitted import FittedKeypoints
from cadalign.estimation.model import Model, is_exact_model
from cadalign.estimation.options import FitOptions, RansacOptions, Sigma, pixel_information
from cadalign.estimation.problems import pack_one
from cadalign.estimation.uncertainty.misfit import is_large_sigma
from cadalign.estimation.uncertainty.residuals import area_of, chi_square_tail, f_quantile
from cadalign.estimation.uncertainty.summary import OTHER_SIZES
from cadalign.estimation.view import View, numbered
from cadalign.estimation.warning import EstimateWarning
from cadalign.geometry.camera import Camera
from cadalign.geometry.pixels import rescaled_pixels
from cadalign.shapes.model import ShapeModel

if TYPE_CHECKING:
    from cadalign.estimation.result import Result

AnyModel = Model | ShapeModel
Again = Callable[[AnyModel, Sequence[View]], "Result"]
"""Estimate without a diagnosis."""

_DOUBTFUL = 1e-4  # probability of such residuals by chance, below which mistakes are looked for
_FITTING = 0.004  # the same, at which data without a mistake fit
_MOST_CORRECTED = 1.6  # residuals of uncertain shapes without a mistake, over their deviations
_LEAST_RATIO = 1.7  # of the residuals with and without it
_MORE_AGREE = 2.0  # of -2 log likelihood, that is gained where more keypoints agree
_AS_MANY_AGREE = 12.0  # the same where as many do
_AS_MANY_ARE_FOUND = 2 * math.log(100)  # the same after a robust search
_AS_LIKELY = 6.0  # difference of -2 log likelihoods of mistakes that are both named
_FEW_REJECTED = 0.1  # share of the keypoints, up to which an uncertain shape is not doubted
_CHANCE_OF_RATIO = 1e-3  # that residuals of an unknown noise differ by as much
_UPRIGHT = 0.5  # cosine between the model's y axis and the photo's upwards, at least
_MOST_INSIDE = 0.8  # share of the keypoints that lie in their image
_EQUATIONS = {"keypoints": 2, "gravity": 2, "depth": 1, "size": 1, "camera height": 1}


class Mistake(NamedTuple):
    """A usual mistake: a clause that names it, and the functions that undo it.

    ``factor`` is the size of the images that the keypoints are of, over the camera's.
    """

    clause: str
    undo_view: Callable[[View], View] = lambda view: view
    undo_model: Callable[[Model], Model] = lambda model: model
    factor: float = 1.0


def _mirrored(model: Model) -> Model:
    mirror = np.array([-1.0, 1.0, 1.0])
    bounds = np.sort(cast(FloatArray, model.bounds) * mirror, axis=0)
    points = cast(FloatArray, model.points_3d) * mirror
    return replace(model, points_3d=points, bounds=bounds, symmetry=None)


def _flipped(view: View, *, axis: int) -> View:
    pixels = view.pixels.copy()
    pixels[:, axis] = (view.camera.width, view.camera.height)[axis] - 1.0 - pixels[:, axis]
    return replace(view, points_2d=pixels)


def _of_size(clause: str, factor: float) -> Mistake:
    def undo(view: View) -> View:
        return replace(view, points_2d=rescaled_pixels(view.pixels, 1 / factor))

    return Mistake(clause, undo, factor=factor)


MIRRORED = Mistake("the model is mirrored", undo_model=_mirrored)
SWAPPED = Mistake(
    "u and v are swapped", lambda view: replace(view, points_2d=view.pixels[:, ::-1].copy())
)
FLIPPED = Mistake("the photo is flipped", lambda view: _flipped(view, axis=0))
UPSIDE_DOWN = Mistake("v counts from the bottom", lambda view: _flipped(view, axis=1))
DOWNWARD = Mistake(
    "`up` points down (give its opposite)",
    lambda view: view if view.up is None else replace(view, up=np.negative(view.up)),
)
INVERTED = Mistake(
    "`cam_from_rig` is the inverse, rig_from_cam (give np.linalg.inv of each)",
    lambda view: replace(view, cam_from_rig=np.linalg.inv(np.asarray(view.cam_from_rig))),
)


class Agreement(NamedTuple):
    """Agreement of all evidence with an estimate.

    The ``score`` is -2 log likelihood of all keypoints, of which outliers lie anywhere, in the
    pixels that were given; ``up`` the cosine between the model's y axis and the photo's upwards.
    """

    score: float
    chi_square: float
    redundancy: int
    inliers: int
    keypoints: int
    sigma: float | None  # estimated [px]
    up: float

    @classmethod
    @np.errstate(all="ignore")  # residuals that overflow are outliers'
    def of(
        cls,
        result: Result,
        model: AnyModel,
        views: Sequence[View],
        ransac: RansacOptions | None,
        factor: float = 1.0,
    ) -> Agreement:
        """The agreement of views that take part in a result."""
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
                area = area_of(own.points_2d, own.camera, threshold)
                score += 2 * math.log(area) * int((~kept).sum())
        kinds = {each.kind for each in result.evidence}
        is_whole = inliers == int(result.inliers.sum())
        if result.cost is not None and is_whole and not kinds & {"mask", "photo"}:
            squares = result.cost
        score += squares
        equations = sum(_EQUATIONS.get(each.kind, 0) * each.count for each in result.evidence)
        unknowns = 6 * (1 if views[0].cam_from_rig is not None else len(views))
        unknowns += len(result.stretched_axes) + (result.focal == "estimate")
        equations += result.focal == "estimate" and result.focal_prior is not None
        if isinstance(model, Model):
            options = model.fit_options()
            equations += len(options.stretched_axes) * (options.stretch_sigma is not None)
            logs = np.log(result.alignment.scale / result.alignment.scale.mean())
            score += float((logs**2).sum())  # outliers invite extremes
        return cls(
            score + 4 * count * math.log(factor),
            squares,
            equations - unknowns,
            inliers,
            count,
            result.sigma if any(view.sigma is None for view in views) else None,
            -float(result.alignment.rotation[1, 1]),
        )

    @property
    def ratio(self) -> float:
        """Residuals over their standard deviations; 0 where nothing is redundant."""
        return math.sqrt(self.chi_square / self.redundancy) if self.redundancy > 0 else 0.0

    def has_chance(self, probability: float, inflation: float) -> bool:
        """True if noise leaves such residuals with this probability at least."""
        squares = self.chi_square / inflation**2
        return self.redundancy <= 0 or chi_square_tail(squares, self.redundancy) >= probability

    def explains(
        self, given: Agreement, inflation: float, *, is_exact: bool, is_robust: bool
    ) -> bool:
        """True if data without a mistake fit, and much better than those that were ``given``."""
        if is_robust and (is_exact or given.inliers < given.keypoints):
            more = self.inliers > given.inliers or self.inliers == self.keypoints
            return more and self.score < given.score - _MORE_AGREE
        least = _AS_MANY_ARE_FOUND if is_robust else _AS_MANY_AGREE
        if not self.score < given.score - least * inflation**2:
            return False
        if self.sigma is not None and given.sigma is not None:
            ratio = f_quantile(self.redundancy, self.redundancy, _CHANCE_OF_RATIO)
            return self.sigma < given.sigma / math.sqrt(ratio)
        most = min(_MOST_CORRECTED, given.ratio / _LEAST_RATIO)
        return self.has_chance(_FITTING, inflation) or self.ratio < most


@np.errstate(all="ignore")
def diagnose(
    model: AnyModel,
    views: Sequence[View],
    again: Again,
    *,
    result: Result | None = None,
    ransac: RansacOptions | None = None,
    has_reason: bool = False,
    rival: Camera | None = None,
) -> EstimateWarning | None:
    """Name the mistake without which all data agree, where the residuals fail their test.

    Parameters
    ----------
    model : Model or ShapeModel
    views : sequence of View
        Those that take part in the estimate. Masks and photos are left out.
    again : callable
        Estimates of a model and views.
    result : Result, optional
        The estimate; by default it is made again.
    ransac : RansacOptions, optional
        The search for inliers, if there was one.
    has_reason : bool
        True where a few keypoints, or a stretch, are known to be to blame: smaller images are not,
        then, which leave as much open.
    rival : Camera, optional
        A camera that the keypoints fit as they are: a mistake must explain more.
    """
    inflation, shown = getattr(model, "inflation", 1.0), _without_outlines(views)
    if not any(len(view.keypoint_ids) for view in shown):
        return None
    kind = {"is_exact": is_exact_model(model), "is_robust": ransac is not None}
    given = None if result is None else Agreement.of(result, model, views, ransac)
    if given is not None and not _is_doubtful(given, views, inflation, **kind):
        return None
    if given is None or any(view.has_outline for view in views):
        given = _agreement_without(Mistake(""), model, shown, again, ransac)
    if given is None or not _is_doubtful(given, shown, inflation, **kind):
        return None
    limit = given
    if rival is not None:
        seen = [replace(view, camera=rival) for view in shown]
        other = _agreement_without(Mistake(""), model, seen, again, ransac)
        if other is not None:
            limit = given._replace(score=other.score + _AS_MANY_AGREE)
    mistakes = _mistakes_in(model, shown, has_reason=has_reason or ransac is not None)
    # About a centred principal point, flips are the same as a mirrored model. Where perspective is
    # weak, all keypoints agree with a mirrored model if with any.
    rest = [each for each in mistakes if each in (FLIPPED, UPSIDE_DOWN) and MIRRORED in mistakes]
    if ransac is not None and given.inliers == given.keypoints and kind["is_exact"]:
        rest = [each for each in mistakes if each is not MIRRORED]
    found: list[tuple[Mistake, Agreement]] = []
    explaining: list[Agreement] = []
    for some in ([each for each in mistakes if each not in rest], rest):
        for mistake in some:
            each = _agreement_without(mistake, model, shown, again, ransac)
            if each is not None:
                found.append((mistake, each))
                if each.explains(limit, inflation, **kind):
                    explaining.append(each)
        if not explaining:
            return None
    best = min(explaining, key=lambda each: each.score)
    named = _named(found, best)
    return EstimateWarning("mistake", f"{named}: corrected, {_compared(best, given)}")


def diagnose_fit(
    fitted: FittedKeypoints, *, has_reason: bool, rival: Camera | None
) -> EstimateWarning | None:
    """As `diagnose`, of keypoints in one view."""
    ahead, options = np.isfinite(fitted.residuals).all(axis=1), fitted.options
    if options.sigma is not None and np.ndim(options.sigma) > 0:
        options = replace(options, sigma=np.asarray(options.sigma)[ahead])
    ransac = None if fitted.search is None else fitted.search.ransac
    own = None if fitted.inliers.all() else ransac  # samples need not be drawn where all agree
    points, observed = fitted.points_3d[ahead], fitted.observed[ahead]
    (model, views), again = estimates_by_fit(points, observed, fitted.camera, options, own)
    return diagnose(model, views, again, ransac=ransac, has_reason=has_reason, rival=rival)


@np.errstate(all="ignore")
def diagnose_refusal(
    model: AnyModel,
    views: Sequence[View],
    again: Again,
    ransac: RansacOptions | None,
    *,
    with_keypoints: bool = True,
) -> str | None:
    """Name the mistake without which there is an estimate, where there is none of the data.

    Mistakes in keypoints are tried ``with_keypoints``, otherwise those in other evidence alone.
    """
    shown = _without_outlines(views)
    if not shown:
        return None
    found = [
        (mistake, each)
        for mistake in _mistakes_in(model, shown, has_reason=True)
        if (with_keypoints or mistake in (INVERTED, DOWNWARD))
        and (each := _agreement_without(mistake, model, shown, again, ransac)) is not None
    ]
    if not found:
        return None
    best = min((each for _, each in found), key=lambda each: each.score)
    return f"{_named(found, best)}: corrected, {best.inliers} of {best.keypoints} keypoints agree"


def estimates_by_fit(
    points_3d: FloatArray,
    points_2d: FloatArray,
    camera: Camera,
    options: FitOptions,
    ransac: RansacOptions | None,
) -> tuple[tuple[Model, tuple[View]], Again]:
    """Model and view of a fit's keypoints, and the fit as a function of these."""
    from cadalign.estimation.fit import fit_once  # which imports this module

    model = Model(
        points_3d=points_3d,
        stretch=options.stretch,
        stretch_sigma=options.stretch_sigma,
        known_axis=options.known_axis,
    )

    def again(model: AnyModel, views: Sequence[View]) -> Result:
        (view,), points = views, cast(FloatArray, cast(Model, model).points_3d)
        problems = pack_one(points, view.pixels, view.camera)
        fitted = fit_once(problems, options, ransac, None, 0.0)
        return result_of_keypoints(view.pixels, fitted)

    return (model, (View(camera, points_2d, sigma=options.sigma),)), again


def _named(found: Sequence[tuple[Mistake, Agreement]], best: Agreement) -> str:
    """Names of the mistakes that are as likely as the best; first those of an upright object."""
    likely = [each for each in found if each[1].score <= best.score + _AS_LIKELY]
    upright = [mistake.clause for mistake, each in likely if each.up > _UPRIGHT]
    others = [mistake.clause for mistake, each in likely if each.up <= _UPRIGHT]
    named = _listed(upright or others)
    if upright and others:
        named += f" (or, if y is not up in the photo, {_listed(others)})"
    return named


def _without_outlines(views: Sequence[View]) -> tuple[View, ...]:
    """The views with evidence beside masks and photos."""
    given = [replace(view, mask=None, mask_sigma=None, image=None) for view in views]
    return tuple(view for view in given if view.has_evidence)


def _is_doubtful(
    given: Agreement, views: Sequence[View], inflation: float, *, is_exact: bool, is_robust: bool
) -> bool:
    """True if the residuals fail their test.

    An uncertain shape follows keypoints that a robust search would reject of an exact one, which
    may agree with its mirror image.
    """
    rejected = given.keypoints - given.inliers
    if rejected > (0 if is_exact else _FEW_REJECTED * given.keypoints):
        return True
    if is_robust and (is_exact or given.ratio >= 1):
        return True
    if given.sigma is None:
        return not given.has_chance(_DOUBTFUL, inflation)
    return given.redundancy > 0 and is_large_sigma(given.sigma, [each.pixels for each in views])


def _mistakes_in(model: AnyModel, views: Sequence[View], *, has_reason: bool) -> list[Mistake]:
    """Mistakes that such data may have."""
    found = [MIRRORED] if isinstance(model, Model) else []  # learned models share one frame
    if any(len(view.keypoint_ids) for view in views):
        found += [SWAPPED, FLIPPED, UPSIDE_DOWN]
    if len(views) > 1 and views[0].cam_from_rig is not None:
        found.append(INVERTED)
    if any(view.up is not None for view in views):
        found.append(DOWNWARD)
    sizes = {(view.camera.width, view.camera.height) for view in views}
    # Another size leaves much open, so that other evidence which is wrong would pass for it.
    if len(sizes) == 1 and not any(view.sources for view in views):
        pixels = np.concatenate([view.pixels for view in views])
        found += _other_sizes(pixels, views[0].camera, may_be_smaller=not has_reason)
    return found


def _other_sizes(points_2d: FloatArray, camera: Camera, *, may_be_smaller: bool) -> list[Mistake]:
    """Mistakes in the resolution of keypoints (n, 2), of images that hold most of them.

    Larger ones where the camera's image does not.
    """

    def holds_most(factor: float) -> bool:
        inside = camera.contains(rescaled_pixels(points_2d, 1 / factor))
        return bool(inside.sum() > _MOST_INSIDE * len(points_2d))

    usual = [each for each in OTHER_SIZES if (each > 1) != holds_most(1.0)]
    own = f"{camera.width} x {camera.height} px"
    return [
        _of_size(
            f"the keypoints are of images of {camera.width * factor:.0f} x "
            f"{camera.height * factor:.0f} px, the camera of {own}",
            factor,
        )
        for factor in usual
        if holds_most(factor) and (factor > 1 or may_be_smaller)
    ]


@np.errstate(all="ignore")  # what is not finite is refused
def _agreement_without(
    mistake: Mistake,
    model: AnyModel,
    views: Sequence[View],
    again: Again,
    ransac: RansacOptions | None,
) -> Agreement | None:
    """The agreement after a mistake is undone; None where there is no estimate."""
    try:
        if isinstance(model, Model):
            model = mistake.undo_model(replace(model, mesh=None) if model.mesh else model)
        undone = numbered([mistake.undo_view(view) for view in views])
        return Agreement.of(again(model, undone), model, undone, ransac, mistake.factor)
    except CadalignError:
        return None


def _listed(clauses: Sequence[str]) -> str:
    *some, last = clauses
    return f"{', '.join(some)} or {last}" if some else last


def _compared(best: Agreement, given: Agreement) -> str:
    """Words that compare the corrected data with the given ones."""
    rejected = given.keypoints - given.inliers
    if rejected:
        share = f"{rejected} ({100 * rejected / given.keypoints:.0f} %)"
        agree = f"{best.inliers} of {best.keypoints} keypoints agree"
        return f"{agree}; as given, {share} are rejected"
    if best.sigma is not None and given.sigma is not None:
        return f"sigma is {best.sigma:.2g} px; as given, {given.sigma:.2g} px"
    what = "times what their standard deviations allow"
    return f"the residuals are {best.ratio:.2g} {what}; as given, {given.ratio:.2g} times"
