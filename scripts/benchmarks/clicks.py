"""Clicks needed on real photos, and other ways from rough clicks to an outline."""

from __future__ import annotations

import tempfile
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from benchmarks import section
from benchmarks.photo import PhotoClicks, drawn_clicks, real_cases
from benchmarks.section import BenchmarkData, Row, Tables
from cadalign import Alignment, Model, View, align
from cadalign.annotate.candidates import MaskCandidates, best_click
from cadalign.datasets import AnnotatedModel, KeypointNet, write_sample_dataset
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.metrics import rotation_error
from cadalign.render import Scene, cast_geometry, sample_view
from cadalign.retrieval.silhouettes import grab_cut

_FEWEST = 3
_CLICK_PX = 2.0
_SIMILAR_DEG = 30.0
_MARGIN = 0.05  # of a box that is dragged around an object, relative to its larger side
_BAND = 0.1  # about an estimated outline, relative to the larger side of its box
_RAPID_STEPS = 20
_RAPID_LINES, _RAPID_REACH = 100, 20  # search lines, and their length to either side [px]

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


def outline_methods(given: BenchmarkData, *, draws: int = 5) -> Tables:
    """Six rough clicks refined by the photo, by GrabCut's mask, and by OpenCV's edge trackers.

    GrabCut starts from a band about the outline that the clicks predict; its mask is evidence
    beside the clicks. The trackers (`cv2.rapid`, of OpenCV's contributed modules, left out where
    they are not installed) start from the clicks' estimate. Rigid models, photos of HANDAL and
    LINEMOD.

    Parameters
    ----------
    draws : int
        Draws of the clicks on every photo.
    """
    methods: dict[str, Callable[[PhotoClicks], Alignment]] = {
        "clicks": _by_clicks,
        "the photo": _by_photo,
        "GrabCut's mask": _by_grabcut,
    }
    if hasattr(cv2, "rapid"):
        for name in ("Rapid", "OLS", "GOS"):
            methods[name] = partial(_by_tracker, name)
    found: dict[str, list[Row]] = defaultdict(list)
    cases = ((case, draws) for case in real_cases(given, "bop_samples"))
    for clicks in drawn_clicks(cases, given.seed, 3, stretched=False):
        first = rotation_error(est=_by_clicks(clicks), gt=clicks.truth)
        for name, method in methods.items():
            wall, _, est = section.clocked(partial(method, clicks))
            error = rotation_error(est=est, gt=clicks.truth)
            row = {"R": error, "better": error < first, "seconds": wall}
            found[f"{clicks.case.group}, {name}"].append(row)
    rows = [{"photos": name, **section.summary(each)} for name, each in found.items()]
    yield "rough clicks refined, rigid models: medians", rows


def proposal_clicks(
    given: BenchmarkData,
    *,
    models: int = 4,
    views: int = 2,
    shape_sigma: float = 0.06,
    categories: tuple[str, ...] = ("bottle", "car", "chair", "vessel"),
) -> Tables:
    """Clicks that tell apart what a mask allows of a model that is only similar.

    Photos of sample models, stretched by 0.74 to 1.35, exact masks, and the next model of the
    category with the keypoints that both have. The clicks, off by 2 px, are those that the
    annotator asks for, on visible keypoints, until one alignment is left. Right is a rotation
    within 30 degrees, up to the object's symmetry.

    Parameters
    ----------
    models : int
        Models of each category.
    views : int
        Views of every model.
    shape_sigma : float
        Standard deviation of a keypoint on the object about the model's [model units].
    categories : tuple[str, ...]
        Categories of the sample.
    """
    found: dict[str, list[Row]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as folder:
        sample = write_sample_dataset(Path(folder) / "sample", per_category=models)
        for category in categories:
            alike = [each for each in KeypointNet(sample) if each.category == category]
            for number, own in enumerate(alike):
                other = alike[(number + 1) % len(alike)]
                for view in range(views):
                    rng = np.random.default_rng([given.seed, 5, number, view])
                    found[category].append(_clicked(own, other, rng, shape_sigma))
    every = [row for rows in found.values() for row in rows]
    table = [_told(name, rows) for name, rows in {**found, "all": every}.items()]
    yield "clicks among what a mask allows of a similar model", table


def _clicked(
    own: AnnotatedModel, other: AnnotatedModel, rng: np.random.Generator, shape_sigma: float
) -> Row:
    """Click until one alignment is left."""
    scene, scale = Scene(own.load_mesh()), np.exp([0.0, *rng.uniform(-0.3, 0.3, 2)])
    how = {"rng": rng, "scale": scale, "fill": (0.6, 0.9), "roll": 10.0}
    view = sample_view(scene, own.keypoints.xyz, KEYPOINT_CAMERA, min_visible=4, **how)
    gt = view.cam_from_model
    pixels = KEYPOINT_CAMERA.project(gt.apply(own.keypoints.xyz))
    places = dict(zip(own.keypoints.ids.tolist(), pixels, strict=True))
    visible = set(own.keypoints.ids[view.visible].tolist())
    ids, points = other.keypoints.ids.tolist(), other.keypoints.xyz
    model = Model(points_3d=points, ids=ids, mesh=other.load_mesh(), shape_sigma=shape_sigma)
    mask = cast_geometry(scene, KEYPOINT_CAMERA, gt).mask
    wall, _, result = section.clocked(lambda: align(model, View(KEYPOINT_CAMERA, mask=mask)))
    candidates = MaskCandidates.of(model, KEYPOINT_CAMERA, result)
    predicted = candidates.predicted(ids, points)
    chances = candidates.probabilities((), np.empty((0, 3)), np.empty((0, 2)))
    first, clicked = int(np.count_nonzero(chances)), list[int]()
    while np.count_nonzero(chances) > 1:
        free = np.array([label in visible and label not in clicked for label in ids])
        row = best_click(chances, *predicted, np.tile(free, (len(chances), 1)))
        if row is None:
            break
        clicked.append(ids[row])
        seen = np.array([places[label] for label in clicked])
        seen += rng.normal(0, _CLICK_PX, seen.shape)
        chances = candidates.probabilities(clicked, np.empty((len(clicked), 3)), seen)
    poses = (each.alignment for each in candidates.every)
    turns = [rotation_error(est=pose, gt=gt, symmetry=own.symmetry) for pose in poses]
    right, left = np.array(turns) < _SIMILAR_DEG, np.flatnonzero(chances)
    return {
        "first": bool(right[0]),
        "among": bool(right.any()),
        "candidates": first,
        "clicks": len(clicked),
        "settled": len(left) == 1,
        "refused": len(left) == 0,
        "right": len(left) == 1 and bool(right[left[0]]),
        "seconds": wall,
    }


def _told(name: str, rows: list[Row]) -> Row:
    """Shares and numbers of clicks where several were allowed; `None` without any."""
    several = [row for row in rows if row["candidates"] > 1]
    clicks = [row["clicks"] for row in several if row["settled"]]
    return {
        "objects": name,
        "count": len(rows),
        "right first": np.mean([row["first"] for row in rows]),
        "right among": np.mean([row["among"] for row in rows]),
        "several": len(several),
        "clicks": section.spread(clicks) if clicks else None,
        "one left": len(clicks),
        "none left": sum(row["refused"] for row in several),
        "right left": sum(row["right"] for row in several),
        "seconds": float(np.median([row["seconds"] for row in rows])),
    }


def _by_clicks(clicks: PhotoClicks) -> Alignment:
    return clicks.aligned().alignment


def _by_photo(clicks: PhotoClicks) -> Alignment:
    return clicks.aligned(image=clicks.case.pixels).alignment


def _by_grabcut(clicks: PhotoClicks) -> Alignment:
    pixels = _outline(clicks, _by_clicks(clicks)).astype(np.uint8)
    width = max(int(_BAND * np.ptp(_box_of(pixels), axis=0).max()), 3)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * width + 1, 2 * width + 1))
    labels = np.where(pixels > 0, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[cv2.dilate(pixels, disc) == 0] = cv2.GC_BGD
    labels[cv2.erode(pixels, disc) > 0] = cv2.GC_FGD
    mask = grab_cut(clicks.case.pixels, labels)
    return clicks.aligned(mask=mask).alignment if mask.any() else _by_clicks(clicks)


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


def _by_tracker(name: str, clicks: PhotoClicks) -> Alignment:
    """By an edge tracker of OpenCV from the clicks' estimate, which is kept where it gets lost."""
    mesh, camera, start = clicks.case.mesh, clicks.case.camera, _by_clicks(clicks)
    image = np.ascontiguousarray(clicks.case.pixels[:, :, ::-1])
    points, faces = mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32)
    turn, shift = cv2.Rodrigues(start.rotation)[0], start.translation.reshape(3, 1).copy()
    lines = image, _RAPID_LINES, _RAPID_REACH
    try:
        if name == "Rapid":
            for _ in range(_RAPID_STEPS):
                _, turn, shift, _ = cv2.rapid.rapid(
                    *lines, points, faces, camera.matrix, turn, shift
                )
        else:
            tracker = getattr(cv2.rapid, f"{name}Tracker").create(points, faces)
            ends = (cv2.TERM_CRITERIA_MAX_ITER + cv2.TERM_CRITERIA_EPS, _RAPID_STEPS, 1.5)
            _, turn, shift = tracker.compute(*lines, camera.matrix, turn, shift, termcrit=ends)
    except cv2.error:
        return start
    if not (np.isfinite(turn).all() and np.isfinite(shift).all()):
        return start
    return Alignment(cv2.Rodrigues(turn)[0], shift.ravel(), np.ones(3))
