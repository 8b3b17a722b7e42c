"""How accurate `fit` is: against the Cramer-Rao bound, the physical limit.

The bound, and the refinement from the truth that `fit` is compared with, are computed here, in
plain NumPy, for all problems of a row at once; nothing of them is shared with the solvers.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cadalign import Alignment, Camera, Results, fit, fit_batch
from cadalign.errors import DegenerateError
from cadalign.evaluation.simulation import SimulatedProblem, random_rotation, simulate_problem
from cadalign.metrics import rotation_error, scale_error, translation_error

pytestmark = pytest.mark.slow

PROBLEMS = 2000
DRAWS = 40
KEYPOINT_CAMERA = Camera(640, 480, 935.0, 935.0, 319.5, 239.5)
AMONG = 1e-2  # radians, and relative scales; two minima closer than that are the same


@dataclass(frozen=True)
class Row:
    """Problems of equal size as arrays over them: points, pixels, focal lengths, the truth."""

    points_3d: np.ndarray
    points_2d: np.ndarray
    camera: Camera
    rotation: np.ndarray
    translation: np.ndarray
    scale: np.ndarray

    @classmethod
    def of(cls, problems: list[SimulatedProblem]) -> Row:
        return cls(
            np.array([p.points_3d for p in problems]),
            np.array([p.points_2d for p in problems]),
            problems[0].camera,
            np.array([p.alignment.rotation for p in problems]),
            np.array([p.alignment.translation for p in problems]),
            np.array([p.alignment.scale for p in problems]),
        )


def simulated_row(points: int, noise_px: float, *, count: int = PROBLEMS) -> list[SimulatedProblem]:
    rng = np.random.default_rng([0, points, round(1000 * noise_px)])
    return [simulate_problem(rng, points=points, noise_px=noise_px) for _ in range(count)]


def linearized(
    row: Row, rotation: np.ndarray, translation: np.ndarray, scale: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (B, 2n + 2) [px] and their Jacobian (B, 2n + 2, 8) by central differences.

    The unknowns are a rotation vector in the camera frame, the translation, log s_y, log s_z. The
    last two residuals are those of the prior on the stretch, for a noise of 1 px.
    """
    step = 1e-6

    def project(unknown: int, size: float) -> np.ndarray:
        turned, moved, stretched = rotation, translation, scale
        if unknown < 3:
            turned = Rotation.from_rotvec(size * np.eye(3)[unknown]).as_matrix() @ rotation
        elif unknown < 6:
            moved = translation + size * np.eye(3)[unknown - 3]
        else:
            stretched = scale * np.exp(size * np.eye(3)[unknown - 5])
        inside = (row.points_3d * stretched[:, None]) @ turned.transpose(0, 2, 1) + moved[:, None]
        image = inside[..., :2] / inside[..., 2:]
        pixels = image * [row.camera.fx, row.camera.fy] + [row.camera.cx, row.camera.cy]
        return np.hstack([pixels.reshape(len(pixels), -1), of_prior(stretched)])

    jacobian = np.stack(
        [(project(k, step) - project(k, -step)) / (2 * step) for k in range(8)], axis=2
    )
    observed = row.points_2d.reshape(len(jacobian), -1)
    return project(0, 0.0) - np.hstack([observed, np.zeros((len(observed), 2))]), jacobian


def of_prior(scale: np.ndarray) -> np.ndarray:
    """Residuals (B, 2) of scales (B, 3): 0 from 1/5 to 5, with flanks of 0.5 in the logarithm."""
    logs = np.log(scale[:, 1:])
    return np.sign(logs) * np.maximum(np.abs(logs) - np.log(5), 0) / 0.5


def bound_covariances(row: Row, noise_px: float) -> np.ndarray:
    """The Cramer-Rao bound of every problem, (B, 8, 8)."""
    _, jacobian = linearized(row, row.rotation, row.translation, row.scale)
    return noise_px**2 * np.linalg.inv(jacobian.transpose(0, 2, 1) @ jacobian)


def bound_errors(row: Row, noise_px: float) -> dict[str, np.ndarray]:
    """Errors an estimator at the bound makes: Gaussian steps from the truth, many of each."""
    factors = np.linalg.cholesky(bound_covariances(row, noise_px))
    rng = np.random.default_rng(0)
    steps = factors @ rng.standard_normal((len(factors), 8, DRAWS))
    return {
        "R": np.degrees(np.linalg.norm(steps[:, :3], axis=1)).clip(max=180).ravel(),
        "t": np.linalg.norm(steps[:, 3:6], axis=1).ravel(),
        "s_y": np.abs(np.expm1(steps[:, 6])).ravel(),
        "s_z": np.abs(np.expm1(steps[:, 7])).ravel(),
    }


def fit_errors(
    problems: list[SimulatedProblem], noise_px: float, method: str = "optimal"
) -> dict[str, np.ndarray]:
    """Errors of `fit`; a problem without result counts as the worst possible."""
    batch = fit_batch(
        [p.points_3d for p in problems],
        [p.points_2d for p in problems],
        problems[0].camera,
        method=method,
        sigma=noise_px,
    )
    errors: dict[str, list[float]] = {"R": [], "t": [], "s_y": [], "s_z": []}
    for b, problem in enumerate(problems):
        if b in batch.errors:
            for values in errors.values():
                values.append(np.inf)
            continue
        est = batch.alignment(b)
        errors["R"].append(rotation_error(est=est, gt=problem.alignment))
        errors["t"].append(translation_error(est=est, gt=problem.alignment))
        _, s_y, s_z = scale_error(est=est, gt=problem.alignment).tolist()
        errors["s_y"].append(s_y)
        errors["s_z"].append(s_z)
    return {name: np.array(values) for name, values in errors.items()}


def ratios(reached: dict[str, np.ndarray], bound: dict[str, np.ndarray], q: float) -> dict:
    return {
        name: float(np.quantile(reached[name], q) / np.quantile(bound[name], q)) for name in bound
    }


def assert_at_the_limit(problems: list[SimulatedProblem], noise_px: float) -> None:
    reached = fit_errors(problems, noise_px)
    bound = bound_errors(Row.of(problems), noise_px)
    medians, tails = ratios(reached, bound, 0.5), ratios(reached, bound, 0.9)
    assert max(medians.values()) <= 1.1, f"medians {medians}, 90th percentiles {tails}"
    assert max(tails.values()) <= 1.25, f"medians {medians}, 90th percentiles {tails}"


# --- the table -------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(
    ("points", "noise_px"),
    [(6, 1.0), (7, 1.0), (10, 1.0), (20, 1.0), (100, 2.0), (1024, 10.0)],
)
def test_errors_are_at_the_cramer_rao_bound(points: int, noise_px: float) -> None:
    # Where errors are near Gaussian, a quarter of the draws knows their median to 4 %.
    count = PROBLEMS if points < 1000 else PROBLEMS // 4
    assert_at_the_limit(simulated_row(points, noise_px, count=count), noise_px)


def real_problems(real_data: Path, category: str, count: int) -> Iterator[SimulatedProblem]:
    """Views of annotated models of a category with 7 keypoints or more that span a volume."""
    from cadalign.datasets import KeypointNet

    models = []
    for model in KeypointNet(real_data / "keypointnet").subset(categories=[category]):
        xyz = model.keypoints.xyz
        spread = np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False)
        if len(xyz) >= 7 and spread[2] > 0.05 * spread[0]:
            models.append(xyz)
    rng = np.random.default_rng(0)
    for number in range(count):
        xyz = models[number % len(models)]
        xyz = xyz[rng.permutation(len(xyz))[:7]]
        scale = np.array([1.0, *rng.uniform(0.5, 2, 2)])
        gt = Alignment(random_rotation(rng), [*rng.uniform(-0.2, 0.2, 2), 2.5], scale)
        points_3d = xyz / scale
        points_2d = KEYPOINT_CAMERA.project(gt.apply(points_3d))
        points_2d += rng.standard_normal(points_2d.shape)
        yield SimulatedProblem(points_3d, points_2d, KEYPOINT_CAMERA, gt, None)


@pytest.mark.long
@pytest.mark.parametrize("category", ["chair", "airplane"])
def test_errors_on_real_keypoints_are_at_the_cramer_rao_bound(
    real_data: Path, category: str
) -> None:
    assert_at_the_limit(list(real_problems(real_data, category, PROBLEMS)), 1.0)


# --- the optimum -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Modes:
    """Where refinements ended: poses, costs [px^2], and whether that is a minimum."""

    rotation: np.ndarray
    translation: np.ndarray
    scale: np.ndarray
    cost: np.ndarray
    converged: np.ndarray


def in_front(row: Row, rotation: np.ndarray, translation: np.ndarray, scale: np.ndarray) -> bool:
    depth = np.einsum("bi,bni->bn", rotation[:, 2], row.points_3d * scale[:, None])
    return (depth + translation[:, 2:] > 0).all(axis=1)


def refined_from_truth(row: Row) -> Modes:
    """Levenberg-Marquardt from the truth."""
    modes = Modes(
        row.rotation.copy(),
        row.translation.copy(),
        row.scale.copy(),
        np.full(len(row.scale), np.inf),
        np.zeros(len(row.scale), dtype=bool),
    )
    damping = np.full(len(row.scale), 1e-3)
    for _ in range(400):
        active = np.flatnonzero(~modes.converged)
        if not len(active):
            break
        some = Row(row.points_3d[active], row.points_2d[active], row.camera, *[np.empty(0)] * 3)
        state = (modes.rotation[active], modes.translation[active], modes.scale[active])
        residuals, jacobian = linearized(some, *state)
        cost = (residuals**2).sum(axis=1)
        hessian = jacobian.transpose(0, 2, 1) @ jacobian
        gradient = np.einsum("bij,bi->bj", jacobian, residuals)
        diagonal = np.einsum("bii->bi", hessian) * damping[active, None] + 1e-12
        step = -np.linalg.solve(hessian + diagonal[:, :, None] * np.eye(8), gradient[:, :, None])
        step = step[:, :, 0]
        newton = np.linalg.solve(hessian + 1e-9 * np.eye(8), gradient[:, :, None])[:, :, 0]
        step *= np.minimum(1.0, 0.5 / np.abs(step).max(axis=1))[:, None]
        trial = (
            Rotation.from_rotvec(step[:, :3]).as_matrix() @ state[0],
            state[1] + step[:, 3:6],
            state[2] * np.exp(np.column_stack([np.zeros(len(step)), step[:, 6:]])),
        )
        trial_residuals, _ = linearized(some, *trial)
        better = ((trial_residuals**2).sum(axis=1) <= cost) & in_front(some, *trial)
        # The decrease still to be had [px^2], where 1 is one standard deviation squared.
        modes.converged[active] = (newton * gradient).sum(axis=1) < 1e-6
        damping[active] = np.where(
            better, np.maximum(damping[active] / 5, 1e-9), damping[active] * 5
        )
        for kept, new in zip((modes.rotation, modes.translation, modes.scale), trial, strict=True):
            kept[active[better]] = new[better]
    modes.cost[:] = (linearized(row, modes.rotation, modes.translation, modes.scale)[0] ** 2).sum(1)
    return modes


def are_modes(modes: Modes) -> np.ndarray:
    """Leave out refinements that ran off to a model without thickness or without end."""
    return modes.converged & (np.abs(np.log(modes.scale)) < np.log(100)).all(axis=1)


@pytest.mark.long
@pytest.mark.parametrize(("points", "allowed"), [(6, 0.005), (7, 0.002), (10, 0.001)])
def test_optimum_is_hardly_ever_missed(points: int, allowed: float) -> None:
    problems = simulated_row(points, 1.0)
    modes = refined_from_truth(Row.of(problems))
    assert are_modes(modes).mean() > 0.99
    batch = fit_batch(
        [p.points_3d for p in problems], [p.points_2d for p in problems], problems[0].camera
    )
    reached = points * batch.rms**2
    reached += (of_prior(batch.scale) ** 2).sum(axis=1)
    missed = ~(reached <= modes.cost * (1 + 1e-4) + 1e-6) & are_modes(modes)
    assert missed.mean() < allowed, f"missed in problems {np.flatnonzero(missed).tolist()}"


@pytest.mark.long
def test_five_points_give_the_true_mode_first_or_among_the_alternatives() -> None:
    problems = simulated_row(5, 1.0, count=PROBLEMS // 2)
    modes = refined_from_truth(Row.of(problems))
    there = np.flatnonzero(are_modes(modes))
    assert len(there) > 0.98 * len(problems)
    named = 0
    for b in there:
        problem = problems[b]
        mode = Alignment(modes.rotation[b], modes.translation[b], modes.scale[b])
        try:
            result = fit(problem.points_3d, problem.points_2d, problem.camera)
        except DegenerateError:
            continue
        found = [result.alignment, *(other.alignment for other in result.alternatives)]
        named += any(
            np.radians(rotation_error(est=each, gt=mode)) < AMONG
            and scale_error(est=each, gt=mode).max() < AMONG
            for each in found
        )
    assert named >= 0.98 * len(there), f"{named} of {len(there)}"


# --- the covariance --------------------------------------------------------------------------

UNKNOWN = [0, 1, 2, 3, 4, 5, 7, 8]  # x has the scale 1


def fisher_covariances(batch: Results) -> np.ndarray:
    return np.array([each.fisher_covariance for each in batch])


@pytest.mark.long
def test_covariance_is_calibrated() -> None:
    """Mean squared Mahalanobis distance of the error: the number of unknowns, 8."""
    problems = simulated_row(20, 1.0)
    batch = fit_batch(
        [p.points_3d for p in problems], [p.points_2d for p in problems], problems[0].camera
    )
    row = Row.of(problems)
    turn = Rotation.from_matrix(batch.rotation @ row.rotation.transpose(0, 2, 1)).as_rotvec()
    log_scale = np.log(batch.scale / row.scale)
    error = np.column_stack([turn, batch.translation - row.translation, log_scale[:, 1:]])
    covariance = fisher_covariances(batch)[:, UNKNOWN][:, :, UNKNOWN]
    squared = np.einsum("bi,bij,bj->b", error, np.linalg.inv(covariance), error)
    assert squared.mean() == pytest.approx(8.0, abs=0.6)


@pytest.mark.long
def test_covariance_at_the_truth_is_the_cramer_rao_bound() -> None:
    """What `fit` reports for noise-free keypoints is the bound computed here."""
    problems = simulated_row(12, 0.0, count=200)
    bound = bound_covariances(Row.of(problems), 1.0)
    batch = fit_batch(
        [p.points_3d for p in problems], [p.points_2d for p in problems], problems[0].camera
    )
    deviation = np.sqrt(np.einsum("bii->bi", bound))
    difference = np.abs(fisher_covariances(batch)[:, UNKNOWN][:, :, UNKNOWN] - bound)
    assert (difference < 1e-3 * deviation[:, :, None] * deviation[:, None]).all()


# --- the linear solvers ----------------------------------------------------------------------


@pytest.mark.long
def test_linear_solver_is_several_times_as_accurate_as_the_papers() -> None:
    """The paper's simulation at 1024 points and 2 px."""
    problems = simulated_row(1024, 2.0, count=500)
    better = np.median(fit_errors(problems, 2.0, "aepnp")["R"])
    paper = np.median(fit_errors(problems, 2.0, "aepnp-paper")["R"])
    assert better < 1.3
    assert 3.0 < paper < 5.5


@pytest.mark.long
def test_linear_solver_is_consistent_where_the_papers_is_biased() -> None:
    """At 10 px, four times the points halve the linear solver's error, and not the paper's."""
    few, many = (
        [
            simulate_problem(np.random.default_rng([seed, points]), points=points, noise_px=10.0)
            for seed in range(200)
        ]
        for points in (1024, 4096)
    )
    errors = {
        method: [np.median(fit_errors(p, 10.0, method)["R"]) for p in (few, many)]
        for method in ("aepnp", "aepnp-paper")
    }
    assert errors["aepnp"][1] < 0.6 * errors["aepnp"][0]
    assert errors["aepnp-paper"][1] > 0.8 * errors["aepnp-paper"][0]
