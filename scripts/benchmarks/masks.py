"""Masks beside keypoints: exact ones, damaged ones, masks of other objects."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np
from scipy.stats import chi2

from benchmarks import section
from benchmarks.evidence import DAMAGES, damaged_mask
from benchmarks.section import BenchmarkData, Row, Tables
from cadalign import Alignment, Camera, Model, View, align
from cadalign.arrays import FloatArray
from cadalign.datasets import AnnotatedModel
from cadalign.errors import InputError
from cadalign.estimation.contours.mask import MaskSource
from cadalign.estimation.contours.outline import MeasuredOutline, Track
from cadalign.estimation.contours.problem import ContourProblem, Place
from cadalign.estimation.contours.surface import surface_of
from cadalign.estimation.estimates import mean_state, pose_and_lengths
from cadalign.estimation.pack import evidence_of
from cadalign.estimation.prior import prior_of
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.evaluation.simulation import SimulatedProblem
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.metrics import alignment_box_iou, nearest_truth, rotation_error
from cadalign.render import Scene, cast_geometry, sample_view
from cadalign.solvers.constants import LINEAR
from cadalign.solvers.joint.covariance import joint_covariance, pose_and_border

_NOISE_PX = 1.0
_STRETCH = 2.0
_LEAST_KEYPOINTS = 4
_RIGHT_DEG, _RIGHT_STRETCH = 10.0, 0.15
_FAR_OFF = 0.1  # of the logarithms of stretch and distance
_ERRORS = ("R", "stretch", "IoU")
_FILLS = ((0.75, 0.95), (0.5, 0.75), (0.25, 0.5), (0.12, 0.25))  # of the image, by the object
_FREE = [0, 1, 2, 3, 4, 5, 7, 8]  # of a covariance, where x is known


def masks(
    given: BenchmarkData,
    *,
    views: int = 2,
    kinds: tuple[str, ...] = (*DAMAGES, "border"),
    neighbours: int = 40,
    optima: int = 0,
) -> Tables:
    """Medians with masks and without, and of the bound of Cramer and Rao for both together.

    Views of models with meshes, stretched by 0.5 to 2, their visible keypoints with noise of 1 px,
    and masks of 640 x 480 pixels. The bound has the noise and correlation that the contour has at
    the true alignment. The sample dataset, and KeypointNet's models beside ShapeNet's meshes.

    Parameters
    ----------
    views : int
        Views of every model.
    kinds : tuple[str, ...]
        Kinds of masks.
    neighbours : int
        Masks of neighbouring objects.
    optima : int
        Problems at every distance, whose ends of the refinement are compared with the truth.
    """
    cases = _cases_of(given, views)
    rows = [_measure(cases, kind, given.seed) for kind in kinds]
    yield f"masks, {len(cases)} views: medians", rows
    if neighbours:
        yield "masks of neighbouring objects", [_neighbours(cases, given.seed, neighbours)]
    if optima:
        models = _models_of(given)
        ends = [_ends_of(models, fill, optima, given.seed) for fill in _FILLS]
        yield "exact masks, seen from anywhere", ends


def _measure(cases: list[_Case], kind: str, seed: int) -> Row:
    alone, joint, bounds, bottles, further = [], [], [], [], []
    for case, mask, rng in _damaged(cases, kind, seed):
        without = section.attempt(align, case.model, case.view(None))
        view = case.view(mask)
        wall, _, result = section.clocked(partial(section.attempt, align, case.model, view))
        if without is None or result is None:
            print(kind, case.annotated.model_id, "is refused")
            continue
        alone.append(case.errors(without.alignment))
        joint.append(case.errors(result.alignment))
        bounds += case.ideal_errors(contour_bound(case.model, view, case.seen.alignment), rng)
        of_mask = result.evidence[-1]
        sigma = of_mask.rms / of_mask.rms_sigmas
        further.append((sigma, np.isnan(of_mask.rms), wall))
        bottles.append(case.annotated.category.endswith("bottle"))
    row: Row = {"mask": kind}
    for suffix, errors in {"keypoints": alone, "mask": joint, "bound": bounds}.items():
        names = (f"{name} {suffix}" for name in _ERRORS)
        row |= dict(zip(names, np.median(errors, axis=0).tolist(), strict=True))
    of_bottles = np.array(joint)[bottles, 2]
    sigmas, left_out, walls = np.transpose(further)
    return row | {
        "R ratio": row["R mask"] / row["R keypoints"],
        "IoU bottles": float(np.median(of_bottles)) if len(of_bottles) else None,
        "sigma": float(np.nanmedian(sigmas)),
        "left out": int(left_out.sum()),
        "seconds": float(np.median(walls)),
    }


def _neighbours(cases: list[_Case], seed: int, neighbours: int) -> Row:
    named, ratios = [], []
    for number in range(neighbours):
        rng = np.random.default_rng([seed, 2, number])
        case, other = cases[number % len(cases)], cases[int(rng.integers(len(cases)))]
        mask = _beside(other.mask, case.mask, rng)
        if mask is None:
            continue
        alone = case.errors(align(case.model, case.view(None)).alignment)
        result = align(case.model, case.view(mask))
        named.append(any(each.kind == "mask" for each in result.warnings))
        ratios.append(case.errors(result.alignment)[0] / alone[0])
    return {
        "named": float(np.mean(named)),
        "R ratio": float(np.median(ratios)),
        "largest R ratio": float(np.max(ratios)),
        "count": len(named),
    }


def mask_alone(
    given: BenchmarkData,
    *,
    views: int = 3,
    kinds: tuple[str, ...] = ("exact", "dilated", "smoothed", "hidden", "border"),
) -> Tables:
    """The own model, of unknown stretch, from a mask without keypoints.

    Right is an estimate within 10 degrees and 15 % of stretch, up to the model's symmetry; of a
    model that is round about an axis, up to its size as well.

    Parameters
    ----------
    views : int
        Views of every model.
    kinds : tuple[str, ...]
        Kinds of masks.
    """
    cases = _cases_of(given, views)
    rows = [_alone(cases, kind, given.seed) for kind in kinds]
    yield f"a mask alone, {len(cases)} views", rows


def _alone(cases: list[_Case], kind: str, seed: int) -> Row:
    found = []
    for case, mask, _ in _damaged(cases, kind, seed):
        model = Model(mesh=case.scene.mesh, symmetry=case.annotated.symmetry)
        view = View(case.seen.camera, mask=mask)
        wall, _, result = section.clocked(partial(section.attempt, align, model, view))
        if result is None:
            print(kind, case.annotated.model_id, "is refused")
            found.append({"first": False, "among five": False, "seconds": np.nan})
            continue
        poses = [result.alignment, *(each.alignment for each in result.alternatives[:4])]
        right = [case.is_right(pose) for pose in poses]
        found.append({"first": right[0], "among five": any(right), "seconds": wall})
    return {"mask": kind, **section.summary(found)}


@dataclass(frozen=True)
class _Case:
    """A view of a model: true alignment, and keypoints with noise."""

    annotated: AnnotatedModel
    scene: Scene
    ids: list[int]
    seen: SimulatedProblem
    mask: np.ndarray

    @property
    def model(self) -> Model:
        """The model that is aligned."""
        return Model(points_3d=self.annotated.keypoints.xyz, mesh=self.scene.mesh)

    def view(self, mask: np.ndarray | None) -> View:
        """The keypoints, with or without a mask."""
        pixels = self.seen.points_2d
        return View(self.seen.camera, pixels, ids=self.ids, sigma=_NOISE_PX, mask=mask)

    def errors(self, est: Alignment) -> list[float]:
        """Rotation [deg], larger stretch error [%], box IoU."""
        gt = self.seen.alignment
        iou = alignment_box_iou(est=est, gt=gt, bounds=self.scene.bounds)
        stretch = 100 * float(np.abs(est.scale / gt.scale - 1)[1:].max())
        return [rotation_error(est=est, gt=gt), stretch, iou]

    def is_right(self, est: Alignment) -> bool:
        """True for an estimate near the truth, or near one that is equal to it."""
        symmetry = self.annotated.symmetry
        gt = nearest_truth(est=est, gt=self.seen.alignment, symmetry=symmetry)
        logs = np.log(est.scale / gt.scale)
        if symmetry.axes:
            logs -= logs.mean()
        is_turned = rotation_error(est=est, gt=gt) >= _RIGHT_DEG
        return not is_turned and bool(np.abs(logs).max() < _RIGHT_STRETCH)

    def ideal_errors(self, bound: FloatArray, rng: np.random.Generator) -> list[list[float]]:
        """`errors` of an ideal estimator, of every draw."""
        truth, found = self.seen.alignment, []
        for turn, shift, logs in _drawn_errors(bound, rng).reshape(-1, 3, 3):
            rotation = rotation_from_vector(turn) @ truth.rotation
            est = Alignment(rotation, truth.translation + shift, truth.scale * np.exp(logs))
            found.append(self.errors(est))
        return found


def _drawn_errors(bound: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Turns, shifts and log scales (draws, 9) of an ideal estimator."""
    return rng.multivariate_normal(np.zeros(9), bound, size=section.LIMIT_DRAWS, method="eigh")


def _cases_of(given: BenchmarkData, views: int) -> list[_Case]:
    how = {"fill": (0.6, 0.9), "roll": 10.0}
    found = []
    for number, model in enumerate(_models_of(given)):
        rng = np.random.default_rng([given.seed, number])
        found += [case for case in (_drawn(model, rng, **how) for _ in range(views)) if case]
    return found


_Meshed = tuple[AnnotatedModel, Scene]


def _models_of(given: BenchmarkData) -> list[_Meshed]:
    """The models of the sample dataset and, where it is given, of KeypointNet, with meshes."""
    with tempfile.TemporaryDirectory() as folder:
        sample, real = section.meshed_models(given, folder, per_category=1)
        return [(model, Scene(model.load_mesh())) for model in (*sample, *real)]


def _drawn(model: _Meshed, rng: np.random.Generator, **how: Any) -> _Case | None:
    """A view of a stretched model that shows enough keypoints, if there is one."""
    annotated, scene = model
    scale = np.array([1.0, *np.exp(rng.uniform(-1, 1, 2) * np.log(_STRETCH))])
    seen = scene, annotated.keypoints.xyz, KEYPOINT_CAMERA
    how |= {"rng": rng, "scale": scale}
    view = section.attempt(sample_view, *seen, min_visible=7, **how)
    view = view or section.attempt(sample_view, *seen, min_visible=_LEAST_KEYPOINTS, **how)
    if view is None:
        return None
    ids = np.flatnonzero(view.visible).tolist()
    return _case_of(model, KEYPOINT_CAMERA, view.cam_from_model, ids, rng)


def _case_of(
    model: _Meshed, camera: Camera, truth: Alignment, ids: list[int], rng: np.random.Generator
) -> _Case:
    """Draw the noise of the keypoints, and cast the exact mask."""
    annotated, scene = model
    seen = section.seen_in(camera, truth, annotated.keypoints.xyz[ids], _NOISE_PX, rng)
    return _Case(annotated, scene, ids, seen, cast_geometry(scene, camera, truth).mask)


def _ends_of(models: list[_Meshed], fill: tuple[float, float], count: int, seed: int) -> Row:
    """Ends of exact masks, of objects at one distance: errors, and whether these are stated."""
    found = []
    for number in range(count):
        rng = np.random.default_rng([seed, 3, round(100 * fill[0]), number])
        how = {"fill": fill, "roll": 180.0, "elevation": (-89.0, 89.0)}
        case = _drawn(models[number % len(models)], rng, **how)
        if case is None:
            continue
        wall, _, result = section.clocked(partial(align, case.model, case.view(case.mask)))
        est, truth = result.alignment, case.seen.alignment
        # With the logarithm of the distance: it rises with the stretches where the size is open.
        error = section.deviation(est=truth, gt=est)[_FREE]
        error[3:6] = _shift_to(est.translation, truth.translation)
        square = error @ np.linalg.solve(result.covariance[np.ix_(_FREE, _FREE)], error)
        lengths = np.linalg.norm([truth.translation, est.translation], axis=1)
        errors = np.abs([*error[6:], np.log(lengths[1] / lengths[0])])
        bound = contour_bound(case.model, case.view(case.mask), truth)
        drawn = _drawn_errors(bound, rng)
        along = np.log(np.linalg.norm(truth.translation + drawn[:, 3:6], axis=1) / lengths[0])
        ideal = np.maximum(np.abs(drawn[:, 7:]).max(axis=1), np.abs(along)) > _FAR_OFF
        found.append((errors[:2].max(), errors[2], square, wall, ideal.mean()))
    stretch, distance, squares, walls, ideals = np.transpose(found)
    return {
        "image filled": f"{fill[0]:g} to {fill[1]:g}",
        "count": len(found),
        "beyond 10 %": int((np.maximum(stretch, distance) > _FAR_OFF).sum()),
        "of the bound": float(ideals.sum()),
        "beyond the 99.9 % region, %": section.percent(squares > chi2.ppf(0.999, len(_FREE))),
        "95 % regions hold": float((squares < chi2.ppf(0.95, len(_FREE))).mean()),
        "stretch, %": 100 * float(np.median(stretch)),
        "distance, %": 100 * float(np.median(distance)),
        "seconds": float(np.median(walls)),
    }


def _shift_to(place: FloatArray, other: FloatArray) -> FloatArray:
    """The step to another place, of which the part along the direction is that of a logarithm."""
    square, along = float(place @ place), float(place @ other)
    ratio = np.log(np.linalg.norm(other) / np.sqrt(square))
    return np.asarray(ratio * place + square / along * other - place)


def _damaged(
    cases: list[_Case], kind: str, seed: int
) -> Iterator[tuple[_Case, np.ndarray, np.random.Generator]]:
    """The cases with their masks of one kind; moved, where the border cuts them."""
    for number, case in enumerate(cases):
        rng = np.random.default_rng([seed, 1, number])
        if kind == "border":
            cut = _cut_by_border(case, rng)
            yield cut, cut.mask, rng
        else:
            yield case, damaged_mask(case.mask, kind, rng), rng


def _cut_by_border(case: _Case, rng: np.random.Generator) -> _Case:
    """The view with a quarter of the object outside the image; enough keypoints stay inside."""
    columns = np.cumsum(case.mask.sum(axis=0)) / case.mask.sum()
    shift = float(np.searchsorted(columns, 0.25))
    camera = replace(case.seen.camera, cx=case.seen.camera.cx - shift)
    inside = camera.contains(case.seen.points_2d - [shift, 0.0])
    if inside.sum() < _LEAST_KEYPOINTS:
        inside[:] = True
    ids = np.array(case.ids)[inside].tolist()
    return _case_of((case.annotated, case.scene), camera, case.seen.alignment, ids, rng)


def _beside(other: np.ndarray, own: np.ndarray, rng: np.random.Generator) -> np.ndarray | None:
    """Another object's mask moved beside the own one; None where too little of it is seen."""
    angle = rng.uniform(0, 2 * np.pi)
    rows, columns = np.nonzero(own)
    size = np.array([np.ptp(columns), np.ptp(rows)])
    x, y = rng.uniform(0.5, 1.0) * np.array([np.cos(angle), np.sin(angle)]) * size
    shift = np.array([[1, 0, x], [0, 1, y]])
    moved = cv2.warpAffine(other.astype(np.uint8), shift, own.shape[::-1])
    return moved > 0 if moved.sum() > 0.2 * other.sum() else None


_REACH = 8.0  # [px]
_LEAST_OFFSET = 0.1  # [px], that the whole contour may have in common


def contour_bound(model: Model, view: View, gt: Alignment) -> FloatArray:
    """The least covariance (9, 9) of an estimate from one view's keypoints and mask.

    It is in the form of `cadalign.Result.covariance`. The contour has the standard deviation and
    the correlation that its residuals show at the true alignment, which has the scale 1 along the
    model's known axis. Raises InputError if the view has no mask, its mask no contour, or the model
    no mesh or is not exact.
    """
    if view.mask_image is None or model.shape_sigma is not None:
        raise InputError("expected a view with a mask, and an exact model", where="view")
    evidence = evidence_of(prior_of(model), [view])
    state = mean_state(evidence, gt.packed[None, :12], np.log(gt.scale))
    keypoints = len(evidence.shape.mean) - 2
    surface = surface_of(model, evidence.shape.mean[:keypoints], "views[0].mask")
    source = MaskSource.of(0, view, view.camera)
    problem = ContourProblem(evidence, keypoints, [source], surface)
    track = Track(source.first().noise, _REACH, is_fine=True)
    look = problem.look(Place.of(state, 1), [track])
    (outline,) = look.outlines
    assert outline is not None
    centred = outline.places[outline.found]
    offset = float(np.median(centred)) if len(centred) else 0.0
    known = track.noise._replace(sigma=1.0, offset=max(abs(offset), _LEAST_OFFSET))
    learned = source.learned(outline, offset, track._replace(noise=known))
    agreeing = MeasuredOutline(outline, offset, learned.noise).inliers
    seen = look._replace(outlines=[outline._replace(found=agreeing)])
    augmented = problem.augmented(seen, [learned])
    assert augmented is not None
    sightings = augmented.evidence.sightings
    linear = sightings._replace(loss=np.full_like(sightings.loss, LINEAR))
    ideal = augmented.evidence._replace(sightings=linear)
    unknowns = pose_and_border(joint_covariance(ideal, augmented.state), 0)
    return pose_and_lengths(ideal, augmented.state, unknowns)
