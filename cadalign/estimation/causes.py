"""Texts of causes of residuals that fail their test, for users."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import cast

import numpy as np

from cadalign.errors import quote
from cadalign.estimation.agreement import Agreement, DiagnosisCase, Rule
from cadalign.estimation.result_parts import listed
from cadalign.estimation.uncertainty.residuals import named_keypoints
from cadalign.estimation.warning import EstimateWarning

_WORST = 3  # keypoints that are named where nothing explains the residuals

UNIT = "in another unit (millimetres for metres)?"
_TEXTS = {
    "mistake": "{posture}{named}{asked} corrected, {compared}",
    "unit": "{named}: is it " + UNIT + " Corrected, {compared}",
    "contradiction": "{named} contradicts the other evidence: without it, {compared}",
    "stretch": "the keypoints contradict the constraint on the stretch: without it they fit "
    "better, with the scale ({scale})",
    "camera": "the keypoints contradict the camera: they fit one better that has a focal length "
    "of {best.result.camera.fx:.4g} px",
    "outlier": "the residuals are {given.ratio:.2g} times as large as sigma explains: {wrong} "
    "{do} not fit the others (with the distance from where those put it)",
    "misfit": "the residuals are {given.ratio:.2g} times as large as sigma and the spread of "
    "shapes explain: keypoints, sigma, the camera or the model are wrong; the worst are {wrong}",
}


def warning_of(
    case: DiagnosisCase, rule: Rule, best: Agreement, given: Agreement, *, clauses: str = ""
) -> EstimateWarning:
    scale = ", ".join(f"{value:.3g}" for value in best.result.alignment.scale.tolist())
    posture, asked = "", ":"
    if given.posture and not (best.posture or case.is_exact):
        posture, asked = f"the object {given.posture}: is it so, or is it that ", "?"
    wrong, view, keypoints = "", None, tuple[int, ...]()
    if rule.kind in ("outlier", "misfit"):
        wrong, view, keypoints = _wrong_keypoints(case, best, all_agree=rule.kind == "misfit")
    words = {"named": clauses, "compared": _compared(best, given), "scale": scale, "wrong": wrong}
    words |= {"posture": posture, "asked": asked, "do": "does" if len(keypoints) == 1 else "do"}
    text = _TEXTS[rule.kind].format(best=best, given=given, **words)
    return EstimateWarning(rule.kind, text, 0 if rule.kind == "camera" else view, keypoints)


def _wrong_keypoints(
    case: DiagnosisCase, best: Agreement, *, all_agree: bool
) -> tuple[str, int | None, tuple[int, ...]]:
    """Names of outliers with their errors, and the view and the rows of those in one view.

    Where ``all_agree`` those with the largest errors are named, and none is said to be wrong.
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
            if case.labels:
                called = [case.labels[each] for each in wrong[view.number]]
            of_each = zip(map(quote, called), errors[rows].tolist(), strict=True)
            texts.append(where + named_keypoints(dict(of_each)))
    total = sum(map(len, wrong.values()))
    text = f"{'keypoint' if total == 1 else 'keypoints'} {'; '.join(texts)}"
    return (text, None, ()) if all_agree or len(wrong) > 1 else (text, *next(iter(wrong.items())))


def named(likely: Sequence[tuple[Rule, Agreement]]) -> str:
    """Names of rules that are as likely; first those of an upright object."""
    upright = {rule.clause: None for rule, each in likely if not each.posture}
    others = {rule.clause: None for rule, each in likely if rule.clause not in upright}
    clauses = listed(list(upright or others)) if likely else ""
    if upright and others:
        clauses += f" (or, if y is not up in the photo, {listed(list(others))})"
    return clauses


def _compared(best: Agreement, given: Agreement) -> str:
    rejected = given.keypoints - given.inliers
    if rejected:
        share = f"{rejected} ({100 * rejected / given.keypoints:.0f} %)"
        agree = f"{best.inliers} of {best.keypoints} keypoints agree"
        return f"{agree}; as given, {share} are rejected"
    if best.sigma is not None and given.sigma is not None:
        return f"sigma is {best.sigma:.2g} px; as given, {given.sigma:.2g} px"
    what = "times what their standard deviations allow"
    return f"the residuals are {best.ratio:.2g} {what}; as given, {given.ratio:.2g} times"
