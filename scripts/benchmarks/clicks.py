"""Clicks needed on real photos."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable

import cv2
import numpy as np

from benchmarks import section
from benchmarks.photo import PhotoClicks, drawn_clicks, real_cases
from benchmarks.section import BenchmarkData, Tables
from cadalign import Alignment, Model, View, align
from cadalign.annotate.evidence import grab_cut
from cadalign.metrics import rotation_error
from cadalign.render import Scene, cast_geometry

_FEWEST = 3
_MARGIN = 0.05  # of a box that is dragged around an object, relative to its larger side

Estimator = Callable[[PhotoClicks], Alignment | None]


def clicks(given: BenchmarkData, *, draws: int = 3, most: int = 12, within: float = 3.0) -> Tables:
    """Clicks needed until the rotation is within a limit and stays there, scripted.

    On the photos of HANDAL and LINEMOD, a rigid model; clicks with an error of 4 px in a photo 640
    px wide are added one by one. By the clicks alone, with the photo, and with the mask that
    GrabCut makes of a box around the object, which is aligned without a click as well. The mean
    takes one more than the most where these are not enough.

    Parameters
    ----------
    draws : int
        Draws of the clicks on every photo.
    most : int
        Most clicks that are tried.
    within : float
        Limit of the rotation's error [degrees].
    """
    methods: dict[str, tuple[Estimator, int]] = {
        "keypoints": (_by_clicks, _FEWEST),
        "with the photo": (_by_photo, _FEWEST),
        "with box and mask": (_by_box, 0),
    }
    needed: dict[str, list[int]] = defaultdict(list)
    cases = ((case, draws) for case in real_cases(given, "bop_samples"))
    for clicks in drawn_clicks(cases, given.seed, 4, stretched=False, count=most):
        for name, (method, least) in methods.items():
            count = _needed(clicks, method, least, most, within)
            needed[f"{clicks.case.group}, {name}"].append(count)
    rows = [
        {
            "photos": name,
            "median": float(np.median(counts)),
            "mean": float(np.mean(counts)),
            "enough": float(np.mean(np.array(counts) <= most)),
            "count": len(counts),
        }
        for name, counts in needed.items()
    ]
    yield f"clicks until the rotation stays within {within:g} deg", rows


def _needed(clicks: PhotoClicks, method: Estimator, least: int, most: int, within: float) -> int:
    enough = most + 1
    for count in (*range(most, _FEWEST - 1, -1), 0):
        est = section.attempt(method, clicks.first(count)) if count >= least else None
        if est is None or rotation_error(est=est, gt=clicks.true_for(est)) >= within:
            break
        enough = count
    return enough


def _by_clicks(clicks: PhotoClicks) -> Alignment:
    return clicks.aligned().alignment


def _by_photo(clicks: PhotoClicks) -> Alignment:
    return clicks.aligned(image=clicks.case.pixels).alignment


def _by_box(clicks: PhotoClicks) -> Alignment | None:
    """By the mask that GrabCut makes of a box around the object, and clicks where there are any."""
    case, truth = clicks.case, _outline(clicks, clicks.truth)
    box = _box_of(truth)
    margin = _MARGIN * np.ptp(box, axis=0).max()
    (left, top), (right, bottom) = np.maximum(box + margin * np.array([[-1], [1]]), 0).astype(int)
    labels = np.full(truth.shape, cv2.GC_BGD, dtype=np.uint8)
    labels[top : bottom + 1, left : right + 1] = cv2.GC_PR_FGD
    mask = grab_cut(case.pixels, labels)
    if not mask.any():
        return None
    if len(clicks.pixels):
        return clicks.aligned(mask=mask).alignment
    return align(Model(mesh=case.mesh, stretch="none"), View(case.camera, mask=mask)).alignment


def _outline(clicks: PhotoClicks, pose: Alignment) -> np.ndarray:
    return cast_geometry(Scene(clicks.case.mesh), clicks.case.camera, pose).mask


def _box_of(mask: np.ndarray) -> np.ndarray:
    """Left and top, right and bottom (2, 2)."""
    rows, columns = np.nonzero(mask)
    return np.array([[columns.min(), rows.min()], [columns.max(), rows.max()]])
