"""Causes of residuals that fail their test, such as swapped coordinates or a wrong focal length.

Each cause is a `Rule`: what is undone in the data, what the estimate without it must explain, and
what is said. Of the rules that explain the residuals the likeliest is named. To add one, list it in
`_rules_for`, or in `_mistakes_in` if it is a usual mistake.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.estimation.agreement import AS_GIVEN, Agreement, AnyModel, DiagnosisCase, Rule
from cadalign.estimation.assemble import KeypointPosterior, result_of_keypoints
from cadalign.estimation.fit import fit_once
from cadalign.estimation.model import Model
from cadalign.estimation.options import FitOptions, RansacOptions
from cadalign.estimation.problems import Problems, pack_one
from cadalign.estimation.result_parts import FittedKeypoints, listed, uncertainty_of
from cadalign.estimation.uncertainty.doubts import (
    CAMERA_GAIN,
    FALSE_ALARMS,
    OTHER_SIZES,
    may_fit_other_cameras,
    percent,
)
from cadalign.estimation.uncertainty.residuals import (
    named_keypoints,
)
from cadalign.estimation.view import View
from cadalign.estimation.warning import EstimateWarning
from cadalign.geometry.camera import Camera
from cadalign.geometry.pixels import rescaled_pixels

if TYPE_CHECKING:
    from cadalign.estimation.result import Result

_AS_LIKELY = 6.0  # difference of -2 log likelihoods of mistakes that are both named
_MOST_INSIDE = 0.8  # share of the keypoints that lie in their image
_TESTED_TO = 0.1  # relative standard deviation to which a held scale must be tested


@np.errstate(all="ignore")
def diagnose(case: DiagnosisCase, *, result: Result | None = None) -> EstimateWarning | None:
    """Name the likeliest cause without which all data agree, where the residuals fail their test.

    ``case`` has the views that take part in the estimate, whose masks and photos are left out, and
    ``result`` is the estimate; by default it is made again.
    """
    if not any(len(view.keypoint_ids) for view in case.views):
        return None
    given = None if result is None else case.agreement(result)
    if given is not None and not case.is_doubtful(given):
        return None
    shown = replace(case, views=_without_outlines(case.views))
    if given is None or any(view.has_outline for view in case.views):
        given = shown.without(AS_GIVEN)
    return None if given is None else _likeliest(shown, given)


def _likeliest(case: DiagnosisCase, given: Agreement) -> EstimateWarning | None:
    rules = list(_rules_for(case, given))
    if case.ransac is not None and given.inliers == given.keypoints and case.is_exact:
        # Where perspective is weak, all keypoints agree with a mirrored model if with any.
        first = case.without(MIRRORED)
        if first is None or not case.explains(MIRRORED, first, given):
            return None
    found = [(rule, each) for rule in rules if (each := case.without(rule)) is not None]
    explaining = [each for each in found if case.explains(*each, given)]
    if not explaining:
        return _unexplained(case, given)
    rule, best = min(explaining, key=lambda each: each[1].score)
    if rule.says is not None:
        return rule.says(best, given)
    named = _named([each for each in found if each[0].clause], best)
    return EstimateWarning("mistake", f"{named}: corrected, {_compared(best, given)}")


def _unexplained(case: DiagnosisCase, given: Agreement) -> EstimateWarning | None:
    """The warning about residuals that no rule explains, or a stretch that these do not test."""
    if case.options is None:
        return None
    if not case.has_chance(given, FALSE_ALARMS):
        text = (
            "the keypoints do not fit the model together (wrong pairs, model, stretch or camera), "
            "or sigma is too small; sigma=None suits a model that is only similar"
        )
        return EstimateWarning("misfit", _too_large(given) + text)
    held = set("xyz") - {given.result.known_axis} - set(given.result.stretched_axes)
    free = case.without(HELD) if held else None
    covariance = None if free is None else free.result.fisher_covariance
    if covariance is None:
        return None
    scale = dict(zip("xyz", uncertainty_of(covariance).scale, strict=True))
    open_axes = [axis for axis in sorted(held) if scale[axis] > _TESTED_TO]
    if not open_axes:
        return None
    known = " and ".join(f"s_{axis} to +-{percent(scale[axis])}" for axis in open_axes)
    text = (
        f"the scale is held at 1, which is not tested: free, the keypoints determine {known} only"
    )
    return EstimateWarning("scale", text)


def _without_outlines(views: Sequence[View]) -> tuple[View, ...]:
    """The views with evidence beside masks and photos."""
    given = [
        replace(view, mask=None, mask_sigma=None, image=None) if view.has_outline else view
        for view in views
    ]
    return tuple(view for view in given if view.has_evidence)


def diagnose_fit(fitted: FittedKeypoints) -> EstimateWarning | None:
    """As `diagnose`, of keypoints in one view; after a robust search also of its inliers."""
    ransac = None if fitted.search is None else fitted.search.ransac
    ahead = np.asarray(np.isfinite(fitted.residuals).all(axis=1))
    if ransac is not None:
        own = None if fitted.inliers.all() else ransac  # samples need not be drawn where all agree
        cause = diagnose(replace(_case_of_rows(fitted, ahead, own), ransac=ransac, options=None))
        if cause is not None or fitted.options.sigma is None:
            return cause
    if fitted.fisher_covariance is None:
        return None
    return diagnose(
        _case_of_rows(fitted, ahead if fitted.options.sigma is None else fitted.inliers)
    )


@np.errstate(all="ignore")
def diagnose_refusal(case: DiagnosisCase, *, with_keypoints: bool = True) -> str | None:
    """Name the mistake without which there is an estimate, where there is none of the data.

    Mistakes in keypoints are tried ``with_keypoints``, otherwise those in other evidence alone.
    """
    shown = replace(case, views=_without_outlines(case.views))
    if not shown.views:
        return None
    found = [
        (mistake, each)
        for mistake in (*_mistakes_in(shown), *_other_sizes(shown))
        if (with_keypoints or mistake in (INVERTED, DOWNWARD))
        and (each := shown.without(mistake)) is not None
    ]
    if not found:
        return None
    best = min((each for _, each in found), key=lambda each: each.score)
    return f"{_named(found, best)}: corrected, {best.inliers} of {best.keypoints} keypoints agree"


def diagnose_refused_fit(
    problems: Problems, options: FitOptions, ransac: RansacOptions | None
) -> str | None:
    """As `diagnose_refusal`, of the only problem."""
    view = View(problems.camera(0), problems.points_2d, sigma=options.sigma)
    return diagnose_refusal(_case_of_fit(problems.points_3d, view, options, ransac))


def _case_of_rows(
    fitted: FittedKeypoints, kept: BoolArray, ransac: RansacOptions | None = None
) -> DiagnosisCase:
    rows, sigma = np.flatnonzero(kept), fitted.options.sigma
    if sigma is not None and np.ndim(sigma) > 0:
        sigma = np.asarray(sigma)[rows]
    view = View(fitted.camera, fitted.observed[rows], ids=rows.tolist(), sigma=sigma)
    return _case_of_fit(fitted.points_3d, view, fitted.options, ransac)


def _case_of_fit(
    points_3d: FloatArray, view: View, options: FitOptions, ransac: RansacOptions | None
) -> DiagnosisCase:
    """The case of a fit of a model's keypoints (n, 3) to a view, whose ids are rows of these."""
    model = Model(
        points_3d=points_3d,
        stretch=options.stretch,
        stretch_sigma=options.stretch_sigma,
        known_axis=options.known_axis,
    )

    def again(model: AnyModel, views: Sequence[View], /, **changes: Any) -> Result:
        exact, (view,) = cast(Model, model), views
        points = cast(FloatArray, exact.points_3d)[_rows_of(view)]
        of_model = {"stretch": exact.stretch, "stretch_sigma": exact.stretch_sigma}
        search = changes.pop("ransac", ransac)
        own = replace(options, sigma=view.sigma, **(of_model | changes))
        problems = pack_one(points, view.pixels, view.camera)
        fitted = fit_once(problems, own, search, None, 0.0)
        return result_of_keypoints(view.pixels, fitted, view=view)

    is_tested = ransac is None and options.sigma is not None
    return DiagnosisCase(model, (view,), again, ransac, options if is_tested else None)


def _rows_of(view: View) -> IntArray:
    return np.array(view.keypoint_ids, dtype=np.intp)


# Rules -------------------------------------------------------------------------------------------


def _mirrored(model: Model) -> Model:
    mirror = np.array([-1.0, 1.0, 1.0])
    bounds = np.sort(cast(FloatArray, model.bounds) * mirror, axis=0)
    points = cast(FloatArray, model.points_3d) * mirror
    return replace(model, points_3d=points, bounds=bounds, symmetry=None)


def _flipped(view: View, *, axis: int) -> View:
    pixels = view.pixels.copy()
    pixels[:, axis] = (view.camera.width, view.camera.height)[axis] - 1.0 - pixels[:, axis]
    return replace(view, points_2d=pixels)


def _resized(view: View, *, factor: float, noise: float) -> View:
    """The view of images that are larger by a factor, with keypoints whose noise is."""
    sigma, power = view.sigma, 2 if np.ndim(cast(FloatArray, view.sigma)) == 3 else 1
    if sigma is not None:
        sigma = np.asarray(sigma) * noise**power
    return replace(view, camera=view.camera.resized(*_size(view.camera, factor)), sigma=sigma)


def _size(camera: Camera, factor: float) -> tuple[int, int]:
    return max(1, round(camera.width * factor)), max(1, round(camera.height * factor))


def _say_stretch(best: Agreement, _: Agreement) -> EstimateWarning:
    listed = ", ".join(f"{value:.3g}" for value in best.result.alignment.scale.tolist())
    text = (
        "the keypoints contradict the constraint on the stretch: without it they fit better, "
        f"with the scale ({listed})"
    )
    return EstimateWarning("stretch", text)


def _say_outliers(best: Agreement, given: Agreement) -> EstimateWarning:
    (view,) = best.result.views
    lengths = np.linalg.norm(view.residuals, axis=1)
    wrong = {
        int(cast(int, view.ids[row])): lengths[row]
        for row in np.flatnonzero(~view.inliers).tolist()
    }
    keypoints, do = ("keypoint", "does") if len(wrong) == 1 else ("keypoints", "do")
    text = (
        f"{keypoints} {named_keypoints(wrong)} {do} not fit the others (counted from 0, with the "
        "distance from where those put it)"
    )
    return EstimateWarning("outlier", _too_large(given) + text, 0, tuple(sorted(wrong)))


def _say_camera(best: Agreement, _: Agreement) -> EstimateWarning:
    text = (
        "the keypoints contradict the camera: they fit one better that has a focal length of "
        f"{best.result.camera.fx:.4g} px"
    )
    return EstimateWarning("camera", text, 0)


MIRRORED = Rule("the model is mirrored", undo_model=_mirrored)
SWAPPED = Rule(
    "u and v are swapped", lambda view: replace(view, points_2d=view.pixels[:, ::-1].copy())
)
FLIPPED = Rule("the photo is flipped", lambda view: _flipped(view, axis=0))
UPSIDE_DOWN = Rule("v counts from the bottom", lambda view: _flipped(view, axis=1))
DOWNWARD = Rule(
    "`up` points down (give its opposite)",
    lambda view: view if view.up is None else replace(view, up=np.negative(view.up)),
)
INVERTED = Rule(
    "`cam_from_rig` is the inverse, rig_from_cam (give np.linalg.inv of each)",
    lambda view: replace(view, cam_from_rig=np.linalg.inv(np.asarray(view.cam_from_rig))),
)
HELD = Rule(
    undo_model=lambda model: replace(model, stretch=None, stretch_sigma=None), says=_say_stretch
)
OUTLIERS = Rule(changes={"ransac": RansacOptions()}, gain=-math.inf, says=_say_outliers)
ANOTHER_FOCAL = Rule(changes={"focal": "estimate"}, gain=CAMERA_GAIN, says=_say_camera)


def _rules_for(case: DiagnosisCase, given: Agreement) -> Iterator[Rule]:
    """The rules that may explain such residuals."""
    options, is_doubtful = case.options, case.is_doubtful(given)
    if is_doubtful:
        yield from _mistakes_in(case)
    if options is None:
        yield from _other_sizes(case) if is_doubtful else ()
        return
    if options.stretch is not None or options.stretch_sigma is not None:
        yield HELD
    fails = not case.has_chance(given, FALSE_ALARMS)
    if may_fit_other_cameras(cast(KeypointPosterior, given.result.posterior).keypoints, fails):
        yield ANOTHER_FOCAL
        yield from _other_sizes(case)
    if fails:
        yield OUTLIERS


def _mistakes_in(case: DiagnosisCase) -> Iterator[Rule]:
    """Mistakes that such data may have."""
    model, views = case.model, case.views
    if isinstance(model, Model):  # learned models share one frame
        yield MIRRORED
    if any(len(view.keypoint_ids) for view in views):
        yield from (SWAPPED, FLIPPED, UPSIDE_DOWN)
    if len(views) > 1 and views[0].cam_from_rig is not None:
        yield INVERTED
    if any(view.up is not None for view in views):
        yield DOWNWARD


def _other_sizes(case: DiagnosisCase) -> Iterator[Rule]:
    """Mistakes in the resolution of keypoints, whose noise may grow with it.

    Where their noise is not known: images that hold most of them, and the camera's does not.
    """
    camera, points = case.views[0].camera, np.concatenate([view.pixels for view in case.views])
    sizes = {(view.camera.width, view.camera.height) for view in case.views}
    # Another size leaves much open, so that other evidence which is wrong would pass for it.
    if len(sizes) > 1 or any(view.sources for view in case.views):
        return

    def holds_most(factor: float) -> bool:
        inside = camera.contains(rescaled_pixels(points, 1 / factor))
        return bool(inside.sum() > _MOST_INSIDE * len(points))

    own, is_inside = f"{camera.width} x {camera.height} px", holds_most(1.0)
    for factor in OTHER_SIZES:
        is_usual = (factor > 1) != is_inside and (factor > 1 or case.ransac is None)
        if case.options is None and not (is_usual and holds_most(factor)):
            continue
        width, height = _size(camera, factor)
        clause = f"the keypoints are of images of {width} x {height} px, the camera of {own}"
        for noise in sorted({1.0, 1.0 if is_inside else max(factor, 1.0)}):
            undo = partial(_resized, factor=factor, noise=noise)
            yield Rule(clause, undo, gain=CAMERA_GAIN)


# Texts -------------------------------------------------------------------------------------------


def _named(found: Sequence[tuple[Rule, Agreement]], best: Agreement) -> str:
    """Names of the mistakes that are as likely as the best; first those of an upright object."""
    likely = [each for each in found if each[1].score <= best.score + _AS_LIKELY]
    upright = {mistake.clause: None for mistake, each in likely if each.is_upright}
    others = {mistake.clause: None for mistake, each in likely if not each.is_upright}
    named = listed(list(upright or others))
    if upright and others:
        named += f" (or, if y is not up in the photo, {listed(list(others))})"
    return named


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


def _too_large(given: Agreement) -> str:
    return f"the residuals are {given.ratio:.2g} times as large as sigma explains: "
