"""Diagnosis of large residuals: find their cause, such as swapped coordinates.

A `Rule` describes a cause: how to correct the data, how much the corrected estimate must gain, and
the text of its warning. The warning names the likeliest rule that explains the residuals. New rules
are listed in `_rules_for`, or in `_mistakes_in` for common mistakes.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import chain, combinations
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import DataError, quote
from cadalign.estimation.agreement import (
    LEAST_GAIN,
    MOST_CORRECTED,
    UNIT,
    Agreement,
    AnyModel,
    DiagnosisCase,
    Rule,
    name_rules,
    shape_names,
    warning_of,
)
from cadalign.estimation.assemble import result_of_keypoints
from cadalign.estimation.fit import fit_once
from cadalign.estimation.model import Model
from cadalign.estimation.options import FitOptions, RansacOptions
from cadalign.estimation.problems import pack_one
from cadalign.estimation.result_parts import EstimateWarning, FittedKeypoints, join_or
from cadalign.estimation.view import View
from cadalign.geometry.calibration import OTHER_SIZES
from cadalign.geometry.camera import Camera
from cadalign.geometry.pixels import rescaled_pixels
from cadalign.io.evidence import LENGTHS, Size

if TYPE_CHECKING:
    from cadalign.estimation.result import Result

_EQUAL_LIKELIHOOD = 6.0  # largest difference of -2 log likelihoods of mistakes named together
_LEAST_INSIDE = 0.8  # share of the keypoints that must lie in the image
_CAMERA_GAIN = 19.5  # of -2 log likelihood, exceeded by chance in one of 100,000
_EQUATION_PRICE = 3.0  # gain required for each equation that is left out
_MOST_VIEWS = 10  # with the largest residuals, each left out in turn
_LEAST_DISTANCE = 5.0  # distance between pixels of one point, beyond noise [px]
_MOST_ROWS = 6  # of keypoints at one point of the model, of which pairs are corrected
_WRONG_UNIT = 100.0  # factor between an object's size and its model's


@np.errstate(all="ignore")
def diagnose(case: DiagnosisCase, *, result: Result | None = None) -> EstimateWarning | None:
    """Name the likeliest cause of residuals that fail their test, or None.

    ``case`` has the views that take part. Without a ``result``, the estimate is computed.
    """
    if not any(len(view.keypoint_ids) for view in case.views):
        return None
    given = None if result is None else case.agreement(result)
    if given is not None and not (case.is_doubtful(given) or _contradicts(case, given)):
        return _size_warning(case, given)
    if given is None or any(view.has_outline for view in case.views):
        case = replace(case, views=_remove_outlines(case.views))
        given = case.correct(None)
    if given is None or not case.is_doubtful(given):
        return None
    if case.ransac is not None and given.inliers == given.keypoints and case.is_exact:
        # With weak perspective, a mirrored model fits as well.
        first = case.correct(MIRRORED)
        if first is None or not case.explains(MIRRORED, first, given):
            return None
    return _likeliest_cause(case, given)


def _likeliest_cause(case: DiagnosisCase, given: Agreement) -> EstimateWarning | None:
    rules = list(_mistakes_in(case)) if case.is_tolerant else list(_rules_for(case, given))
    found = [(rule, each) for rule in rules if (each := case.correct(rule)) is not None]
    explaining = [each for each in found if case.explains(*each, given)]
    if not explaining:
        return (
            None
            if case.is_tolerant or case.has_chance(given)
            else warning_of(case, MISFIT, given, given)
        )
    rule, best = max(explaining, key=lambda each: case.gain(each[0], each[1], given))
    least = case.gain(rule, best, given) - _EQUAL_LIKELIHOOD
    alike = [each for each in found if each[0].kind == rule.kind]
    likely = [each for each in alike if case.gain(*each, given) >= least]
    return warning_of(case, rule, best, given, clauses=name_rules(likely))


def _remove_outlines(views: Sequence[View]) -> tuple[View, ...]:
    given = [
        replace(view, mask=None, mask_sigma=None, image=None) if view.has_outline else view
        for view in views
    ]
    return tuple(view for view in given if view.has_evidence)


def _size_warning(case: DiagnosisCase, given: Agreement) -> EstimateWarning | None:
    """Warn of measured lengths that make the object implausibly large or small."""
    size = float(np.exp(np.log(given.result.alignment.scale).mean()))
    fields = join_or([f"`{name}`" for name in _measures_of(case)] or [""])
    if not fields or 1 / _WRONG_UNIT < size < _WRONG_UNIT:
        return None
    text = f"{fields}: the object is {size:.2g} times as large as the model, is it {UNIT}"
    return EstimateWarning("unit", text)


def _measures_of(case: DiagnosisCase) -> list[str]:
    names = ("depth", "camera_height", "cam_from_rig")
    found = [name for name in names if any(getattr(v, name) is not None for v in case.views)]
    return found if case.size is None else [*found, "size"]


def diagnose_fit(
    fitted: FittedKeypoints, *, labels: Sequence[Hashable] = (), **of_case: Any
) -> EstimateWarning | None:
    """Diagnose keypoints in one view; after a robust search also its inliers alone.

    Messages name keypoints by ``labels``, by default their rows.
    """
    given, options, counted = fitted.ransac, fitted.options, fitted.is_counted
    passes = [(np.isfinite(fitted.residuals).all(axis=1) & counted, given)]
    if given and options.sigma is not None and fitted.fisher_covariance is not None:
        passes.append((fitted.inliers, None))
    for kept, ransac in passes:
        # No samples are needed if all keypoints agree.
        drawn = None if fitted.inliers[counted].all() else ransac
        seen = fitted.points_3d, fitted.observed, fitted.camera
        case = case_of_fit(*seen, options, drawn, np.flatnonzero(kept).tolist())
        if cause := diagnose(replace(case, ransac=ransac, labels=labels, **of_case)):
            return cause
    return None


@np.errstate(all="ignore")
def diagnose_refusal(case: DiagnosisCase, *, with_keypoints: bool = True) -> str | None:
    """Name the mistake (in keypoints if ``with_keypoints``) whose correction has an estimate."""
    shown = replace(case, views=_remove_outlines(case.views))
    if not shown.views:
        return None
    found = [
        (mistake, each)
        for mistake in (*_mistakes_in(shown), *_other_sizes(shown))
        if (with_keypoints or mistake in (INVERTED, DOWNWARD))
        and (each := shown.correct(mistake)) is not None
    ]
    if not found:
        return None
    best = min((each for _, each in found), key=lambda each: each.score)
    likely = [each for each in found if each[1].score <= best.score + _EQUAL_LIKELIHOOD]
    return f"{name_rules(likely)}: corrected, {best.inliers} of {best.keypoints} keypoints agree"


def case_of_fit(
    points_3d: FloatArray,
    points_2d: FloatArray,
    camera: Camera,
    options: FitOptions,
    ransac: RansacOptions | None,
    rows: list[int] | None = None,
) -> DiagnosisCase:
    """The case of a fit of keypoints (n, 3) to pixels (n, 2), or of some rows of these."""
    if rows is not None:
        points_2d, options = points_2d[rows], options.for_keypoints(rows)
    seen = View(camera, points_2d, ids=rows, sigma=options.sigma)
    shape = {name: getattr(options, name) for name in ("stretch", "stretch_sigma")}

    def estimate(model: AnyModel, views: Sequence[View], /, **changes: Any) -> Result:
        exact, (view,) = cast(Model, model), views
        points = cast(FloatArray, exact.points_3d)[list(cast("tuple[int, ...]", view.keypoint_ids))]
        of_model = {"stretch": exact.stretch, "stretch_sigma": exact.stretch_sigma}
        search = changes.pop("ransac", ransac)
        own = replace(options, sigma=view.sigma, **(of_model | changes))
        fitted = fit_once(pack_one(points, view.pixels, view.camera), own, search, None, 0.0)
        return result_of_keypoints(view.pixels, fitted, view=view)

    return DiagnosisCase(
        Model(points_3d=points_3d, **shape), (seen,), estimate, ransac, has_rows=True
    )


# Corrections -------------------------------------------------------------------------------------


def _mirror(model: Model) -> Model:
    mirror = np.array([-1.0, 1.0, 1.0])
    bounds = np.sort(cast(FloatArray, model.bounds) * mirror, axis=0)
    points = cast(FloatArray, model.points_3d) * mirror
    return replace(model, points_3d=points, bounds=bounds, symmetry=None)


def _flip(view: View, *, axis: int) -> View:
    pixels = view.pixels.copy()
    pixels[:, axis] = (view.camera.width, view.camera.height)[axis] - 1.0 - pixels[:, axis]
    return replace(view, points_2d=pixels)


def _resize(view: View, *, size: tuple[int, int], noise: float) -> View:
    """Resize the view's camera, and scale the noise of its keypoints."""
    sigma, power = view.sigma, 2 if np.ndim(cast(FloatArray, view.sigma)) == 3 else 1
    if sigma is not None:
        sigma = np.asarray(sigma) * noise**power
    return replace(view, camera=view.camera.resize(*size), sigma=sigma)


def _scale_measure(view: View, *, name: str, factor: float) -> View:
    value = getattr(view, name, None)
    if value is None:
        return view
    value = np.array(value, dtype=np.float64)
    value[(slice(3), 3) if name == "cam_from_rig" else ...] *= factor
    changed: dict[str, Any] = {name: value if value.ndim else float(value)}
    return replace(view, **changed)


def _scale_size(size: Size, factor: float) -> Size:
    lengths = {name: getattr(size, name) for name in LENGTHS}
    scaled = {name: each and each * factor for name, each in lengths.items()}
    return Size(**scaled, sigma=size.sigma)


def _remove_rows(view: View, *, rows: list[int]) -> View:
    kept = np.delete(np.arange(len(view.pixels)), rows)
    ids = [view.keypoint_ids[row] for row in kept.tolist()]
    each = {name: getattr(view, name) for name in ("sigma", "scores", "depth")}
    some: dict[str, Any] = {name: np.asarray(v)[kept] for name, v in each.items() if np.ndim(v) > 0}
    return replace(view, points_2d=view.pixels[kept], ids=ids, **some)


def _exchange(view: View, *, rows: list[int]) -> View:
    pixels = view.pixels.copy()
    pixels[rows] = pixels[rows[::-1]]
    return replace(view, points_2d=pixels)


# Rules -------------------------------------------------------------------------------------------

MIRRORED = Rule("mistake", "the model is mirrored", undo_model=_mirror)
SWAPPED = Rule(
    "mistake",
    "u and v are swapped",
    lambda view: replace(view, points_2d=view.pixels[:, ::-1].copy()),
)
FLIPPED = Rule("mistake", "the photo is flipped", partial(_flip, axis=0))
# Categories are nearly symmetric: exchanged names look like a flipped photo.
EXCHANGED = FLIPPED._replace(clause="the photo is flipped or left and right are exchanged")
UPSIDE_DOWN = Rule("mistake", "v counts from the bottom", partial(_flip, axis=1))
DOWNWARD = Rule(
    "mistake",
    "`up` points down (give its opposite)",
    lambda view: view if view.up is None else replace(view, up=np.negative(view.up)),
)
INVERTED = Rule(
    "mistake",
    "`cam_from_rig` is the inverse, rig_from_cam (give np.linalg.inv of each)",
    lambda view: replace(view, cam_from_rig=np.linalg.inv(np.asarray(view.cam_from_rig))),
)
HELD = Rule("stretch", undo_model=lambda model: replace(model, stretch=None, stretch_sigma=None))
OUTLIERS = Rule("outlier", changes={"ransac": RansacOptions()}, gain=-math.inf)
ANOTHER_FOCAL = Rule("camera", changes={"focal": "estimate"}, gain=_CAMERA_GAIN)
MISFIT = Rule("misfit")


def _rules_for(case: DiagnosisCase, given: Agreement) -> Iterator[Rule]:
    model, fails = case.model, not case.has_chance(given)
    yield from _mistakes_in(case)
    yield from _conflicting_pairs(case)
    yield from _exchanged_pairs(case, given)
    yield from _other_sizes(case) if case.is_exact or fails else ()
    if case.is_plain and isinstance(model, Model) and fails:
        if model.stretch is not None or model.stretch_sigma is not None:
            yield HELD
        if given.result.focal == "known":
            yield ANOTHER_FOCAL
    if fails or case.has_contradiction(given):
        least = OUTLIERS.gain if case.is_exact else LEAST_GAIN
        yield from () if case.ransac else (OUTLIERS._replace(gain=least),)
    if fails or not case.is_exact or case.has_contradiction(given):
        yield from _pieces_of(case, given)


def _mistakes_in(case: DiagnosisCase) -> Iterator[Rule]:
    model, views = case.model, case.views
    if isinstance(model, Model):  # learned models share one frame
        yield MIRRORED
    if any(len(view.keypoint_ids) for view in views):
        yield from (SWAPPED, FLIPPED if isinstance(model, Model) else EXCHANGED, UPSIDE_DOWN)
    if len(views) > 1 and views[0].cam_from_rig is not None:
        yield INVERTED
    if any(view.up is not None for view in views):
        yield DOWNWARD
        for axis in "xyz" if isinstance(model, Model) else "":
            if axis != model.up_axis:
                clause = f"the model's {axis} axis points up (give up_axis={axis!r})"
                yield Rule("mistake", clause, undo_model=partial(replace, up_axis=axis))
    for name in _measures_of(case):
        for factor in (1e-3, 1e3):
            undo = partial(_scale_measure, name=name, factor=factor)
            lengths = None if case.size is None else _scale_size(case.size, factor)
            changes = {"size": lengths} if name == "size" else {}
            yield Rule("unit", f"`{name}`", undo, changes=changes)


def _conflicting_pairs(case: DiagnosisCase) -> Iterator[Rule]:
    """Rules for points of the model that are paired with two pixels."""
    if not isinstance(case.model, Model):
        return
    points = dict(zip(case.model.ids or (), cast(FloatArray, case.model.points_3d), strict=True))
    for view in case.views:
        names, rows_at = view.keypoint_ids, dict[tuple[float, ...], list[int]]()
        for row, name in enumerate(names):
            rows_at.setdefault(tuple(points[name].tolist()), []).append(row)
        pairs = (combinations(rows[:_MOST_ROWS], 2) for rows in rows_at.values())
        for a, b in chain.from_iterable(pairs):
            apart = float(np.linalg.norm(view.pixels[a] - view.pixels[b]))
            if apart > _LEAST_DISTANCE:
                clause = f"keypoints {quote(names[a])} and {quote(names[b])} are one point of the "
                clause += f"model and lie {apart:.3g} px apart"
                yield Rule("mistake", clause, partial(_remove_rows, rows=[a, b]), view=view.number)


def _exchanged_pairs(case: DiagnosisCase, given: Agreement) -> Iterator[Rule]:
    """Rules for an exchanged left and right keypoint of a learned shape, in the worst view."""
    view = case.views[int(np.argmax(given.squares))]
    shown = shape_names(case.model, view.keypoint_ids)
    for row, name in enumerate(shown):
        other = name.replace("left", "right")
        if other != name and other in shown:
            undo = partial(_exchange, rows=[row, shown.index(other)])
            clause = f"keypoints {quote(name)} and {quote(other)} are exchanged"
            yield Rule("mistake", clause, undo, most=MOST_CORRECTED, view=view.number)


def _other_sizes(case: DiagnosisCase) -> Iterator[Rule]:
    """Rules for keypoints from an image of another size, whose noise may scale with it."""
    camera, points = case.views[0].camera, np.concatenate([view.pixels for view in case.views])
    sizes = {(view.camera.width, view.camera.height) for view in case.views}
    # Another size fits so flexibly that it would explain errors in other evidence.
    if len(sizes) > 1 or any(view.sources for view in case.views):
        return
    if case.photo is not None:
        from cadalign.io.images import photo_size  # with Pillow

        with suppress(DataError):
            if photo_size(case.photo) in sizes:
                return

    def holds_most(factor: float) -> bool:
        inside = camera.contains(rescaled_pixels(points, 1 / factor))
        return bool(inside.sum() > _LEAST_INSIDE * len(points))

    own, is_inside = f"{camera.width} x {camera.height} px", holds_most(1.0)
    lie_inside = bool(camera.contains(points).all())
    for factor in OTHER_SIZES:
        is_usual = (factor > 1) != is_inside and (factor > 1 or case.ransac is None)
        if not holds_most(factor) or (factor > 1 and lie_inside):  # inside already
            continue
        if not case.is_plain and not is_usual:
            continue
        width, height = (max(1, round(side * factor)) for side in (camera.width, camera.height))
        clause = f"the keypoints are of images of {width} x {height} px, the camera of {own}"
        for noise in sorted({1.0, 1.0 if is_inside else max(factor, 1.0)}):
            undo = partial(_resize, size=(width, height), noise=noise)
            yield Rule("mistake", clause, undo, gain=_CAMERA_GAIN)


def _contradicts(case: DiagnosisCase, given: Agreement) -> bool:
    """True if an uncertain shape fits much better without one piece of evidence."""
    return not case.is_exact and any(
        found is not None and case.explains(piece, found, given)
        for piece in _pieces_of(case, given)
        for found in [case.correct(piece)]
    )


def _pieces_of(case: DiagnosisCase, given: Agreement) -> Iterator[Rule]:
    """Rules that leave out one piece of evidence, or one of several views."""
    is_rig = case.views[0].cam_from_rig is not None
    piece = partial(Rule, "contradiction", price=_EQUATION_PRICE)
    for place in np.argsort(-np.array(given.squares), kind="stable")[:_MOST_VIEWS].tolist():
        view = case.views[place]
        fields = ("up", "depth", "camera_height")
        for name in fields:
            if getattr(view, name) is not None:
                undo = partial(replace, **{name: None})
                yield piece(f"views[{view.number}].{name}", undo, view=view.number)
        if len(case.views) > 1:
            clause = f"views[{view.number}].{'cam_from_rig' if is_rig else 'points_2d'}"
            yield piece(clause, lambda view: None, view=view.number)
    if case.size is not None:
        yield piece("size", changes={"size": None})
