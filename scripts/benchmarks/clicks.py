"""Clicks needed on real photos, and other ways from rough clicks to an outline."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from benchmarks.photo import PhotoCase, PhotoClicks, bop_cases
from benchmarks.section import BenchmarkData, NotGivenError, RatioTable, Row, clocked
from cadalign import Model, View, align
from cadalign.errors import CadalignError
from cadalign.geometry.alignment import Alignment
from cadalign.metrics import rotation_error
from cadalign.render import Scene, cast_geometry

_FEWEST = 3
_MARGIN = 0.05  # of a box that is dragged around an object, relative to its larger side
_BAND = 0.1  # about an estimated outline, relative to the larger side of its box
_GRAB_ROUNDS = 5
_RAPID_STEPS = 20
_RAPID_LINES, _RAPID_REACH = 100, 20  # search lines, and their length to either side [px]

Estimator = Callable[[PhotoClicks], Alignment]


@dataclass
class Clicks:
    """Clicks needed until the rotation is within a limit and stays there, scripted.

    On the photos of HANDAL and LINEMOD, a rigid model; clicks with an error of 4 px in a photo 640
    px wide are added one by one. By the clicks alone, with the photo, and with the mask that
    GrabCut makes of a box around the object, which is aligned without a click as well. The mean
    takes one more than the most where these are not enough.
    """

    draws: int = 3
    """Draws of the clicks on every photo."""
    most: int = 12
    """Most clicks that are tried."""
    within: float = 3.0
    """Limit of the rotation's error [degrees]."""

    def run(self, given: BenchmarkData) -> Iterator[RatioTable]:
        """Count the clicks of each method."""
        cases = list(_photos(given))
        methods: dict[str, Callable[[PhotoClicks], Alignment | None]] = {
            "keypoints": _by_clicks,
            "with the photo": _by_photo,
            "with box and mask": _by_box,
        }
        needed: dict[tuple[str, str], list[int]] = {}
        for number, case in enumerate(cases):
            for draw in range(self.draws):
                rng = np.random.default_rng([given.seed, 4, number, draw])
                clicks = case.clicked(rng, stretched=False, count=self.most)
                for name, method in methods.items():
                    count = self._needed(clicks, method, least=0 if method is _by_box else _FEWEST)
                    needed.setdefault((case.group, name), []).append(count)
        rows = [self._row(f"{group}, {name}", counts) for (group, name), counts in needed.items()]
        yield RatioTable(f"clicks until the rotation stays within {self.within:g} deg", rows)

    def _needed(
        self, clicks: PhotoClicks, method: Callable[[PhotoClicks], Alignment | None], *, least: int
    ) -> int:
        """The least number from which on all estimates are within the limit."""
        enough = self.most + 1
        for count in (*range(self.most, _FEWEST - 1, -1), 0):
            if count < least or not self._is_within(clicks, method, count):
                break
            enough = count
        return enough

    def _is_within(
        self, clicks: PhotoClicks, method: Callable[[PhotoClicks], Alignment | None], count: int
    ) -> bool:
        try:
            est = method(clicks.first(count))
        except CadalignError:
            return False
        return est is not None and rotation_error(est=est, gt=clicks.true_for(est)) < self.within

    def _row(self, name: str, counts: list[int]) -> Row:
        return {
            "photos": name,
            "median": float(np.median(counts)),
            "mean": float(np.mean(counts)),
            "enough": float(np.mean(np.array(counts) <= self.most)),
            "count": len(counts),
        }


@dataclass
class OutlineMethods:
    """Six rough clicks refined by the photo, by GrabCut's mask, and by OpenCV's edge trackers.

    GrabCut starts from a band about the outline that the clicks predict; its mask is evidence
    beside the clicks. The trackers (`cv2.rapid`, of OpenCV's contributed modules, left out where
    they are not installed) start from the clicks' estimate. Rigid models, photos of HANDAL and
    LINEMOD.
    """

    draws: int = 5
    """Draws of the clicks on every photo."""

    def run(self, given: BenchmarkData) -> Iterator[RatioTable]:
        """Measure all methods on the same starts."""
        methods: dict[str, Estimator] = {
            "clicks": _by_clicks,
            "the photo": _by_photo,
            "GrabCut's mask": _by_grabcut,
        }
        if hasattr(cv2, "rapid"):
            methods |= {
                "Rapid": _by_rapid,
                "OLS": partial(_by_tracker, "OLSTracker"),
                "GOS": partial(_by_tracker, "GOSTracker"),
            }
        errors: dict[tuple[str, str], list[tuple[float, float, float]]] = {}
        for number, case in enumerate(_photos(given)):
            for draw in range(self.draws):
                rng = np.random.default_rng([given.seed, 3, number, draw])
                clicks = case.clicked(rng, stretched=False)
                first = rotation_error(est=_by_clicks(clicks), gt=clicks.truth)
                for name, method in methods.items():
                    wall, _, est = clocked(partial(method, clicks))
                    error = rotation_error(est=est, gt=clicks.truth)
                    errors.setdefault((case.group, name), []).append((error, first, wall))
        rows = []
        for (group, name), values in errors.items():
            error, first, wall = np.array(values).T
            row: Row = {"photos": f"{group}, {name}", "R": float(np.median(error))}
            row |= {"better": float((error < first).mean()), "seconds": float(np.median(wall))}
            rows.append(row | {"count": len(error)})
        yield RatioTable("rough clicks refined, rigid models: medians", rows)


def _photos(given: BenchmarkData) -> Iterator[PhotoCase]:
    if given.keypointnet is None:
        raise NotGivenError("give --keypointnet, or CADALIGN_DATA")
    return bop_cases(given.keypointnet.parent)


def _by_clicks(clicks: PhotoClicks) -> Alignment:
    return clicks.aligned(with_photo=False).alignment


def _by_photo(clicks: PhotoClicks) -> Alignment:
    return clicks.aligned(with_photo=True).alignment


def _by_grabcut(clicks: PhotoClicks) -> Alignment:
    """By the mask that GrabCut makes of a band about the outline that the clicks predict."""
    case = clicks.case
    predicted = cast_geometry(Scene(case.mesh), case.camera, _by_clicks(clicks)).mask
    width = max(int(_BAND * _larger_side(predicted)), 3)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * width + 1, 2 * width + 1))
    pixels = predicted.astype(np.uint8)
    labels = np.where(pixels > 0, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[cv2.dilate(pixels, disc) == 0] = cv2.GC_BGD
    labels[cv2.erode(pixels, disc) > 0] = cv2.GC_FGD
    mask = _grabbed(case.pixels, labels)
    return clicks.aligned_with(mask=mask).alignment if mask.any() else _by_clicks(clicks)


def _by_box(clicks: PhotoClicks) -> Alignment | None:
    """By the mask that GrabCut makes of a box around the object, and clicks where there are any."""
    case = clicks.case
    truth = cast_geometry(Scene(case.mesh), case.camera, clicks.truth).mask
    margin = _MARGIN * _larger_side(truth)
    left, top, right, bottom = _box_of(truth) + margin * np.array([-1, -1, 1, 1])
    labels = np.full(truth.shape, cv2.GC_BGD, dtype=np.uint8)
    labels[max(int(top), 0) : int(bottom) + 1, max(int(left), 0) : int(right) + 1] = cv2.GC_PR_FGD
    mask = _grabbed(case.pixels, labels)
    if not mask.any():
        return None
    if len(clicks.pixels):
        return clicks.aligned_with(mask=mask).alignment
    return align(Model(mesh=case.mesh, stretch="none"), View(case.camera, mask=mask)).alignment


def _grabbed(pixels: np.ndarray, labels: np.ndarray) -> np.ndarray:
    cv2.setRNGSeed(0)
    models = np.zeros((2, 1, 65))
    bgr = np.ascontiguousarray(pixels[:, :, ::-1])
    whole = (0, 0, 1, 1)  # not used with labels
    cv2.grabCut(bgr, labels, whole, models[0], models[1], _GRAB_ROUNDS, cv2.GC_INIT_WITH_MASK)
    found: np.ndarray = np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD))
    return found


def _box_of(mask: np.ndarray) -> np.ndarray:
    """Left, top, right, bottom."""
    rows, columns = np.nonzero(mask)
    return np.array([columns.min(), rows.min(), columns.max(), rows.max()])


def _larger_side(mask: np.ndarray) -> float:
    left, top, right, bottom = _box_of(mask)
    return float(max(right - left, bottom - top))


# Edge trackers of OpenCV --------------------------------------------------------------------------


def _by_rapid(clicks: PhotoClicks) -> Alignment:
    image, points, faces, matrix, turn, shift = _tracked(clicks)
    lines = image, _RAPID_LINES, _RAPID_REACH
    try:
        for _ in range(_RAPID_STEPS):
            _, turn, shift, _ = cv2.rapid.rapid(*lines, points, faces, matrix, turn, shift)
    except cv2.error:  # it lost the object
        return _by_clicks(clicks)
    return _from_vectors(turn, shift, clicks)


def _by_tracker(name: str, clicks: PhotoClicks) -> Alignment:
    image, points, faces, matrix, turn, shift = _tracked(clicks)
    tracker = getattr(cv2.rapid, name).create(points, faces)
    ends = (cv2.TERM_CRITERIA_MAX_ITER + cv2.TERM_CRITERIA_EPS, _RAPID_STEPS, 1.5)
    lines = image, _RAPID_LINES, _RAPID_REACH
    try:
        _, turn, shift = tracker.compute(*lines, matrix, turn, shift, termcrit=ends)
    except cv2.error:
        return _by_clicks(clicks)
    return _from_vectors(turn, shift, clicks)


def _tracked(clicks: PhotoClicks) -> tuple[np.ndarray, ...]:
    """Image, mesh, camera and start of a tracker."""
    mesh, camera, start = clicks.case.mesh, clicks.case.camera, _by_clicks(clicks)
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    turn = cv2.Rodrigues(start.rotation)[0]
    points, faces = mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32)
    image = np.ascontiguousarray(clicks.case.pixels[:, :, ::-1])
    return image, points, faces, matrix, turn, start.translation.reshape(3, 1).copy()


def _from_vectors(turn: np.ndarray, shift: np.ndarray, clicks: PhotoClicks) -> Alignment:
    if not (np.isfinite(turn).all() and np.isfinite(shift).all()):
        return _by_clicks(clicks)
    return Alignment(cv2.Rodrigues(turn)[0], shift.ravel(), np.ones(3))
