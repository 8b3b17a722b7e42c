"""Accuracy of the solvers against the Cramer-Rao bound, their speed, and what they state."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

import cadalign
from benchmarks.section import (
    BenchmarkData,
    RatioTable,
    Row,
    figure,
    ideal_errors,
    medians_in_turns,
    seconds,
)
from cadalign import Alignment, Camera, Model, RansacOptions, Result, View
from cadalign.arrays import FloatArray
from cadalign.datasets import KeypointNet
from cadalign.errors import CadalignError
from cadalign.estimation.facing import faced, turned_alignment
from cadalign.estimation.options import BOUNDING_PRIOR
from cadalign.estimation.problems import whitening_of
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA, STRETCH_RANGE
from cadalign.evaluation.metrics.errors import alignment_errors
from cadalign.evaluation.simulation.problems import (
    SIMULATION_CAMERA,
    Problem,
    random_rotation,
    simulate_problem,
)
from cadalign.shapes.tails import probability_within
from cadalign.solvers.alignment import evaluate_cost, keypoint_objective
from cadalign.solvers.linear import aepnp
from cadalign.solvers.minimal import ap4p
from cadalign.solvers.search import refine

_ROWS = ((6, 1.0), (7, 1.0), (10, 1.0), (20, 1.0), (100, 2.0), (1024, 2.0), (1024, 10.0))
_SPEED_SIZES = (10, 100, 1024, 4096)
_BATCH = 10_000
_METHODS = ("optimal", "aepnp", "aepnp-paper")
_ERRORS = {
    "rotation_error_deg": "R",
    "translation_error": "t",
    "scale_y_error": "s_y",
    "scale_z_error": "s_z",
}
_FOCAL_ERRORS = {**_ERRORS, "focal_error": "f"}
_UNKNOWN = Camera.without_focal(SIMULATION_CAMERA.width, SIMULATION_CAMERA.height)
_ROBUST_POINTS = 100
_LARGE_ROTATION_DEG, _LARGE_SCALE = 15.0, 0.25
_COVERED = 0.95
_FIELDS = (120, 180, 200)  # of view [degrees]
_WIDE_SIDE = 1000  # of their images [px]
_CALIBRATED_SIZES = (5, 6, 7, 8, 10, 20, 50, 100)

Draw = Callable[[np.random.Generator], Problem]


# Known focal length -------------------------------------------------------------------------------


@dataclass
class Solvers:
    """Accuracy against the Cramer-Rao bound, speed against OpenCV.

    Everything runs in one process on the same problems; speeds are ratios of medians. KeypointNet
    adds rows on real keypoints.
    """

    problems: int = 2000
    """Random problems per row."""
    repetitions: int = 300
    """Timed calls per figure; the median counts."""

    def run(self, given: BenchmarkData) -> Iterator[RatioTable]:
        """Measure accuracy, the minimal solver and speed."""
        title = "Errors over the Cramer-Rao limit's: median (90th percentile)"
        yield RatioTable(title, list(self._accuracy(given)))
        yield RatioTable(
            "4 points: the truth among the minimal solver's solutions", [self._minimal(given)]
        )
        rng = np.random.default_rng(given.seed)
        rows = []
        for points in _SPEED_SIZES:
            problem = simulate_problem(rng, points=points, noise_px=1.0)
            rows += _speed(problem, points, self.repetitions)
        yield RatioTable("Time over OpenCV's, which does not stretch", rows)

    def _accuracy(self, given: BenchmarkData) -> Iterator[Row]:
        sources: list[tuple[str, float, Draw]] = [
            (
                f"{n} points, {noise:g} px",
                noise,
                partial(simulate_problem, points=n, noise_px=noise),
            )
            for n, noise in _ROWS
        ]
        if given.keypointnet is not None:
            sources += _keypointnet_sources(given.keypointnet)
        return _accuracy_rows(sources, self.problems, given.seed)

    def _minimal(self, given: BenchmarkData) -> Row:
        """Rate of the truth among the solutions, and their number."""
        rng = np.random.default_rng(given.seed)
        found = solutions = 0
        for _ in range(self.problems):
            problem = simulate_problem(rng, points=4, noise_px=0.0)
            rays = problem.camera.normalize(problem.points_2d)
            rotations, translations, scales = ap4p(problem.points_3d, rays)
            poses = np.concatenate([rotations.reshape(-1, 9), translations, scales], axis=1)
            solutions += len(poses)
            found += bool((np.abs(poses - problem.alignment.packed) < 1e-4).all(axis=1).any())
        share, mean = 100 * found / self.problems, solutions / self.problems
        return {"truth found %": share, "solutions on average": mean}


@dataclass
class WideLenses:
    """Accuracy of fits with wide lenses against the Cramer-Rao bound.

    Objects lie anywhere in the field of view, which fills an image of 1000 x 1000 px.
    """

    problems: int = 1000
    """Random problems per row."""
    points: int = 20
    """Keypoints of an object."""

    def run(self, given: BenchmarkData) -> Iterator[RatioTable]:
        """Measure accuracy at several fields of view."""
        half = (_WIDE_SIDE - 1) / 2
        sources: list[tuple[str, float, Draw]] = []
        for field in _FIELDS:
            reach = np.radians(field / 2)
            omega = 0.9
            bend = np.arctan2(2 * np.tan(omega / 2) * np.sin(reach), np.cos(reach)) / omega
            for lens, focal, coefficients in (
                ("fisheye", half / reach, ()),
                ("fov", half / bend, (omega,)),
            ):
                size = (_WIDE_SIDE, _WIDE_SIDE)
                camera = Camera(*size, focal, focal, half, half, coefficients, lens=lens)
                draw = partial(_wide_problem, camera, reach, self.points)
                sources.append((f"{lens}, {field} degrees", 1.0, draw))
        title = "Errors over the Cramer-Rao limit's: median (90th percentile)"
        yield RatioTable(title, list(_accuracy_rows(sources, self.problems, given.seed)))


def _accuracy_rows(
    sources: Iterable[tuple[str, float, Draw]], count: int, seed: int
) -> Iterator[Row]:
    """Errors of every method on so many problems of each source."""
    for name, noise, draw in sources:
        rng = np.random.default_rng(seed)
        problems = [draw(rng) for _ in range(count)]
        limit = ideal_errors(problems, rng, sigma=noise, focal="known")
        for method in _METHODS:
            yield {"problems": name, **_accuracy_row(problems, noise, method, limit)}


def _wide_problem(camera: Camera, reach: float, points: int, rng: np.random.Generator) -> Problem:
    """A problem as `simulate_problem` draws them, turned to anywhere in a field of view."""
    while True:
        drawn = simulate_problem(rng, points=points, noise_px=0.0, depth=(3.0, 6.0))
        pose = turned_alignment(drawn.alignment, random_rotation(rng))
        seen = pose.apply(drawn.points_3d)
        if (np.arctan2(np.hypot(seen[:, 0], seen[:, 1]), seen[:, 2]) < reach).all():
            pixels = camera.project(seen)
            pixels += rng.standard_normal(pixels.shape)
            return Problem(drawn.points_3d, pixels, camera, pose, None)


def _keypointnet_sources(root: Path) -> Iterator[tuple[str, float, Draw]]:
    dataset = KeypointNet(root)
    for category in ("chair", "bottle", "airplane"):
        if category in dataset.categories:
            models = [m.keypoints.xyz for m in dataset[category] if _spans_volume(m.keypoints.xyz)]
            yield f"{category}, 7 keypoints", 1.0, partial(_keypointnet_problem, models)


def _keypointnet_problem(models: list[np.ndarray], rng: np.random.Generator) -> Problem:
    points = models[rng.integers(len(models))]
    chosen = points[rng.choice(len(points), 7, replace=False)]
    scale = np.array([1.0, *(1 / rng.uniform(*STRETCH_RANGE, 2))])
    alignment = Alignment(random_rotation(rng), [0.0, 0.0, rng.uniform(1.5, 3)], scale)
    pixels = KEYPOINT_CAMERA.project(alignment.apply(chosen / scale))
    pixels += rng.standard_normal(pixels.shape)
    return Problem(chosen / scale, pixels, KEYPOINT_CAMERA, alignment, None)


def _spans_volume(points: np.ndarray) -> bool:
    if len(points) < 7:
        return False
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[2] > 0.05 * spread[0])


def _accuracy_row(
    problems: list[Problem], noise: float, method: str, limit: dict[str, np.ndarray]
) -> Row:
    """Errors of a method over those of the limit, and the global minima that it missed."""
    errors = []
    failed = missed = 0
    for problem in problems:
        try:
            sigma = noise if method == "optimal" else 1.0
            est = cadalign.fit(
                problem.points_3d, problem.points_2d, problem.camera, method=method, sigma=sigma
            ).alignment
        except CadalignError:
            failed += 1
            errors.append([180.0, np.inf, np.inf, np.inf])
            continue
        found = alignment_errors(est=est, gt=problem.alignment)
        errors.append([found[error] for error in _ERRORS])
        missed += method == "optimal" and _is_missed(problem, noise, est)

    def levels(values: np.ndarray) -> np.ndarray:
        return np.percentile(values, (50, 90))

    ratios = {
        short: tuple((levels(values) / levels(limit[error])).tolist())
        for (error, short), values in zip(_ERRORS.items(), np.array(errors).T, strict=True)
    }
    return {
        "limit R deg": tuple(levels(limit["rotation_error_deg"]).tolist()),
        "method": method,
        "median R deg": float(np.median(np.array(errors)[:, 0])),
        **ratios,
        "failed %": 100 * failed / len(problems),
        "missed %": 100 * missed / len(problems) if method == "optimal" else None,
    }


def _is_missed(problem: Problem, noise: float, est: Alignment) -> bool:
    """True if a refinement from the truth ends at a better alignment."""
    camera = faced(problem.camera, problem.points_2d)
    truth, found = (
        turned_alignment(each, camera.lens_from_camera.T).packed
        for each in (problem.alignment, est)
    )
    rays = camera.normalize(problem.points_2d)
    whitening = whitening_of(noise, rays, camera)
    objective = keypoint_objective(problem.points_3d, rays, whitening)
    objective = objective._replace(scale_prior=BOUNDING_PRIOR)
    cost, _, _ = refine(objective, 200, truth)
    return bool(cost < evaluate_cost(objective, found) * (1 - 1e-6) - 1e-9)


def _speed(problem: Problem, points: int, repetitions: int) -> Iterator[Row]:
    x, uv, camera = problem.points_3d, problem.points_2d, problem.camera
    rays, matrix = camera.normalize(uv), camera.matrix
    timed: dict[str, Callable[[], object]] = {
        "cv2 EPNP": lambda: cv2.solvePnP(x, uv, matrix, None, flags=cv2.SOLVEPNP_EPNP),
        "cv2 SQPNP": lambda: cv2.solvePnP(x, uv, matrix, None, flags=cv2.SOLVEPNP_SQPNP),
        "cv2 ITERATIVE": lambda: cv2.solvePnP(x, uv, matrix, None),
        "solvers.aepnp": lambda: aepnp(x, rays),
        "fit aepnp": lambda: cadalign.fit(x, uv, camera, method="aepnp"),
        "fit optimal": lambda: cadalign.fit(x, uv, camera),
        "fit aepnp-paper": lambda: cadalign.fit(x, uv, camera, method="aepnp-paper"),
    }
    clocked = {name: partial(seconds, call) for name, call in timed.items()}
    medians = medians_in_turns(clocked, repetitions, per_turn=10)
    if points == 10:
        xs, uvs = np.tile(x, (_BATCH, 1, 1)), np.tile(uv, (_BATCH, 1, 1))
        for name, workers in {"1 thread": 1, "all cores": -1}.items():
            run = partial(cadalign.fit_batch, xs, uvs, camera, method="aepnp", workers=workers)
            median = medians_in_turns({"": partial(seconds, run)}, 10, per_turn=10)[""]
            medians[f"fit_batch aepnp, {name}"] = median / _BATCH
    for name in (*(each for each in medians if not each.startswith("cv2")), "cv2 SQPNP"):
        peer = "cv2 ITERATIVE" if name == "fit optimal" else "cv2 EPNP"
        ratio, label = medians[name] / medians[peer], f"{name}, {points} keypoints"
        yield figure(label, 1e6 * medians[name], "us", ratio, peer)


# Unknown focal length -----------------------------------------------------------------------------


@dataclass
class UnknownFocal:
    """Fits with an unknown focal length: accuracy against the Cramer-Rao bound, and outliers."""

    problems: int = 1000
    """Random problems per row of accuracy."""
    robust_problems: int = 40
    """Random problems per share of outliers."""

    def run(self, given: BenchmarkData) -> Iterator[RatioTable]:
        """Measure accuracy and the robust search."""
        title = "1 px: median errors over the Cramer-Rao limit's of 9 unknowns"
        yield RatioTable(title, [self._accuracy(given, points) for points in (10, 20, 50, 200)])
        title = f"{_ROBUST_POINTS} points: none of the wrong kept, and over 90 % of the others"
        yield RatioTable(title, [self._robust(given, share) for share in (0.0, 0.3, 0.5, 0.7, 0.8)])

    def _accuracy(self, given: BenchmarkData, points: int) -> Row:
        """Median errors over those of an ideal estimator."""
        rng = np.random.default_rng(given.seed)
        problems = [
            simulate_problem(rng, points=points, noise_px=1.0) for _ in range(self.problems)
        ]
        batch = cadalign.fit_batch(
            [problem.points_3d for problem in problems],
            [problem.points_2d for problem in problems],
            _UNKNOWN,
            focal="estimate",
            focal_prior=None,
            workers=-1,
        )
        errors = []
        for b, problem in enumerate(problems):
            row = dict.fromkeys(_FOCAL_ERRORS, np.inf)
            if batch.solved[b]:
                row = alignment_errors(est=batch.alignment(b), gt=problem.alignment)
                row["focal_error"] = abs(batch.focal_length[b] / SIMULATION_CAMERA.fx - 1)
            errors.append(row)
        ideal = ideal_errors(problems, rng, sigma=1.0, focal="estimate")
        limit = {error: float(np.median(ideal[error])) for error in _FOCAL_ERRORS}
        ratios = {
            short: float(np.median([row[error] for row in errors])) / limit[error]
            for error, short in _FOCAL_ERRORS.items()
        }
        failed = 100 * float(1 - batch.solved.mean())
        row = {"points": points, "limit f %": 100 * limit["focal_error"]}
        return {**row, **ratios, "failed %": failed}

    def _robust(self, given: BenchmarkData, share: float) -> Row:
        """Rate at which outliers are told from inliers."""
        rng = np.random.default_rng(given.seed)
        found = 0
        for _ in range(self.robust_problems):
            problem = simulate_problem(rng, points=_ROBUST_POINTS, noise_px=1.0)
            points_2d = problem.points_2d.copy()
            places = rng.uniform(points_2d.min(axis=0), points_2d.max(axis=0), points_2d.shape)
            wrong = rng.permutation(_ROBUST_POINTS) < round(share * _ROBUST_POINTS)
            points_2d[wrong] = places[wrong]
            # One that landed where it belongs is not wrong.
            wrong &= np.linalg.norm(points_2d - problem.points_2d, axis=1) > 15
            try:
                inliers = cadalign.fit(
                    problem.points_3d, points_2d, _UNKNOWN, focal="estimate", ransac=RansacOptions()
                ).inliers
            except CadalignError:
                continue
            clean = np.linalg.norm(points_2d - problem.points_2d, axis=1) == 0
            found += not inliers[wrong].any() and inliers[clean].mean() > 0.9
        return {"wrong %": 100 * share, "found %": 100 * found / self.robust_problems}


# Stated uncertainty -------------------------------------------------------------------------------


@dataclass
class Coverage:
    """Coverage of stated uncertainties, and how often large errors come without a warning.

    Problems are the simulation's (f = 150 px). An error is large from 15 deg or 25 % of a scale,
    and silent without warning and alternative.
    """

    problems: int = 1000
    """Random problems per row."""
    noise_px: float = 1.0
    """Standard deviation of the noise [px], which sigma states."""
    region_problems: int = 150
    """Random objects in a unit cube per row of the regions."""

    def run(self, given: BenchmarkData) -> Iterator[RatioTable]:
        """Measure coverage and warnings."""
        yield RatioTable("Truths within nominal 68, 95 %", list(self._regions(given)))
        yield RatioTable("Errors within the 95 % ellipsoid", list(self._coverage(given)))
        title = "Large errors without a warning, and misfits found"
        yield RatioTable(title, list(self._warnings(given)))

    def _regions(self, given: BenchmarkData) -> Iterator[Row]:
        """Regions of rotation, translation and lengths, by what is estimated from how much."""
        for kind in _KINDS:
            for points in _REGION_SIZES:
                reached: list[FloatArray] = []
                for number in range(self.region_problems):
                    rng = np.random.default_rng([given.seed, points, number])
                    try:
                        result, truth = _estimated(rng, kind, points, self.noise_px)
                    except CadalignError:
                        continue
                    reached.append(_regions_reached(result, truth))
                row: Row = {"estimate": kind, "keypoints": points, "results": len(reached)}
                if not reached:  # all were refused
                    yield row
                    continue
                within = np.array(reached)
                for column, name in enumerate(("R", "t", "lengths")):
                    shares = [
                        100 * float((within[:, column] <= share).mean()) for share in (0.68, 0.95)
                    ]
                    row[name] = f"{shares[0]:.0f}, {shares[1]:.0f}"
                yield row

    def _coverage(self, given: BenchmarkData) -> Iterator[Row]:
        for sigma, loss in ((self.noise_px, "linear"), (None, "linear"), (None, "cauchy")):
            for points in _CALIBRATED_SIZES[1:]:
                draw = partial(simulate_problem, points=points, noise_px=self.noise_px)
                held = [
                    [
                        _holds(result, problem.alignment, result.fisher_covariance),
                        _holds(result, problem.alignment, result.covariance),
                        not result.alternatives,
                    ]
                    for problem, result in self._fits(given, draw, sigma=sigma, loss=loss)
                ]
                names = ("inverse Fisher %", "stated %", "no alternative %")
                shares = (100 * np.mean(held, axis=0)).tolist()
                row = {"sigma": str(sigma), "loss": loss, "keypoints": points}
                yield row | dict(zip(names, shares, strict=True))

    def _warnings(self, given: BenchmarkData) -> Iterator[Row]:
        for name, draw, options in _cases(self.noise_px):
            fits = list(self._fits(given, draw, **options))
            large = [result for problem, result in fits if _is_large(result, problem.alignment)]
            silent = sum(not result.warnings and not result.alternatives for result in large)
            misfits = sum(result.misfit is not None for _, result in fits)
            yield {
                "data": name,
                "fits": len(fits),
                "large errors": len(large),
                "silent": silent,
                "silent %": 100 * silent / max(len(large), 1),
                "misfits %": 100 * misfits / max(len(fits), 1),
            }

    def _fits(
        self, given: BenchmarkData, draw: Draw, **options: Any
    ) -> Iterator[tuple[Problem, Result]]:
        """Problems with their fits; those that are refused are left out."""
        for number in range(self.problems):
            problem = draw(np.random.default_rng([given.seed, number]))
            try:
                result = cadalign.fit(
                    problem.points_3d, problem.points_2d, problem.camera, **options
                )
            except CadalignError:
                continue
            yield problem, result


_KINDS = ("fit", "sigma=None", "20 % outliers", "focal", "shape_sigma=.05", "two views")
_REGION_SIZES = (5, 6, 8, 12, 30, 100, 200)
_REGION_CAMERA = Camera(640, 480, 935, 935, 319.5, 239.5)
_SHAPE_SIGMA = 0.05


def _estimated(
    rng: np.random.Generator, kind: str, points: int, noise_px: float
) -> tuple[Result, Alignment]:
    """An estimate of a random object from its first view, and the truth."""
    model = rng.uniform(-0.5, 0.5, (points, 3))
    scale = np.array([1.0, *np.exp(rng.normal(0, 0.2, 2))])
    differs = _SHAPE_SIGMA if kind.startswith("shape_sigma") else 0.0
    object_points = model * scale + rng.normal(0, 1, model.shape) * differs
    poses = []
    for _ in range(2):
        turn = Rotation.random(random_state=rng).as_matrix()
        place = rng.uniform((-0.3, -0.2, 3.0), (0.3, 0.2, 5.0))
        poses.append(Alignment(turn, place, np.ones(3)))
    seen = [
        _REGION_CAMERA.project(pose.apply(object_points)) + rng.normal(0, noise_px, (points, 2))
        for pose in poses
    ]
    truth = Alignment(poses[0].rotation, poses[0].translation, scale)
    if kind == "two views":
        views = [View(_REGION_CAMERA, each, sigma=noise_px) for each in seen]
        return cadalign.align(Model(points_3d=model), views), truth
    if differs:
        similar = Model(points_3d=model, shape_sigma=differs)
        return cadalign.align(similar, View(_REGION_CAMERA, seen[0], sigma=noise_px)), truth
    camera, options = _REGION_CAMERA, dict[str, Any](sigma=noise_px)
    if kind == "sigma=None":
        options = {"sigma": None}
    elif kind == "20 % outliers":
        wrong = rng.choice(points, points // 5, replace=False)
        seen[0][wrong] = rng.uniform(0, (640, 480), (len(wrong), 2))
        options["ransac"] = RansacOptions()
    elif kind == "focal":
        camera, options["focal"] = Camera.without_focal(640, 480), "estimate"
    return cadalign.fit(model, seen[0], camera, **options), truth


def _regions_reached(result: Result, truth: Alignment) -> FloatArray:
    """Nominal probabilities (3,) of the regions of R, t and lengths that reach the truth."""
    covariance = result.covariance
    assert covariance is not None
    errors, found = _errors_of(result.alignment, truth), []
    for first in (0, 3, 6):
        rows = [row for row in range(first, first + 3) if covariance[row, row] > 0]
        square = _square(errors, covariance, rows)
        found.append(probability_within(square, len(rows), result.degrees_of_freedom))
    return np.array(found)


def _cases(noise_px: float) -> list[tuple[str, Draw, dict[str, Any]]]:
    """Names, problems and options of `fit`; first data with outliers, then inliers alone."""

    def draw(points: int, change: Callable[..., None] | None = None) -> Draw:
        def problem_of(rng: np.random.Generator) -> Problem:
            problem = simulate_problem(rng, points=points, noise_px=noise_px)
            if change is not None:
                change(rng, problem.points_2d)
            return problem

        return problem_of

    def misplace(rng: np.random.Generator, points_2d: np.ndarray) -> None:
        points_2d[rng.integers(len(points_2d))] = rng.uniform(0, (640, 480))

    def swap(rng: np.random.Generator, points_2d: np.ndarray) -> None:
        pair = rng.choice(len(points_2d), 2, replace=False)
        points_2d[pair] = points_2d[pair[::-1]]

    given = {"sigma": noise_px}
    return [
        ("1 wrong of 8", draw(8, misplace), given),
        ("2 swapped of 12", draw(12, swap), given),
        ("20 shuffled", draw(20, np.random.Generator.shuffle), given),
        ("10, stretch none", draw(10), given | {"stretch": "none"}),
        ("1 wrong of 8, cauchy", draw(8, misplace), given | {"loss": "cauchy"}),
        *((f"{points} right", draw(points), given) for points in _CALIBRATED_SIZES),
        ("8 right, cauchy", draw(8), given | {"loss": "cauchy"}),
        ("8 right, prior", draw(8), given | {"stretch_sigma": 0.5}),
        ("8 right, covariances", draw(8), {"sigma": np.tile(noise_px**2 * np.eye(2), (8, 1, 1))}),
        ("8 right, focal unknown", draw(8), given | {"focal": "estimate"}),
        ("20 right, RANSAC", draw(20), given | {"ransac": RansacOptions(max_iterations=300)}),
    ]


def _is_large(result: Result, gt: Alignment) -> bool:
    est = result.alignment
    angle = np.degrees(Rotation.from_matrix(gt.rotation @ est.rotation.T).magnitude())
    return bool(
        angle > _LARGE_ROTATION_DEG or np.abs(est.scale / gt.scale - 1).max() > _LARGE_SCALE
    )


def _holds(result: Result, gt: Alignment, covariance: np.ndarray | None) -> bool:
    """True if the truth lies within the 95 % ellipsoid."""
    assert covariance is not None
    free = np.flatnonzero(covariance.diagonal()).tolist()
    square = _square(_errors_of(result.alignment, gt), covariance, free)
    return bool(square < chdtri(len(free), 1 - _COVERED))


def _errors_of(est: Alignment, gt: Alignment) -> FloatArray:
    """Errors (9,) of an alignment, in the order of a result's covariance."""
    vector = Rotation.from_matrix(gt.rotation @ est.rotation.T).as_rotvec()
    return np.concatenate([vector, gt.translation - est.translation, np.log(gt.scale / est.scale)])


def _square(errors: FloatArray, covariance: FloatArray, rows: list[int]) -> float:
    """Squared Mahalanobis distance of some of the errors."""
    kept = errors[rows]
    return float(kept @ np.linalg.solve(covariance[np.ix_(rows, rows)], kept))
