"""Measure unknown focal lengths beside learned shapes: the Cramer-Rao limit, and unseen objects.

The first table's objects are drawn from a shape model, the second's are those of KeypointNet's
split val, with models learned from its split train, in near views. Prints tables and writes a JSON
file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from common import LIMIT_DRAWS, SeededBenchmark, new_table, write_results
from rich.console import Console
from scipy.spatial.transform import Rotation

from cadalign import Alignment, Camera, Result, ShapeModel, View, align
from cadalign.arrays import FloatArray
from cadalign.datasets import KeypointNet
from cadalign.errors import CadalignError
from cadalign.estimation.uncertainty.misfit import projection_jacobian
from cadalign.evaluation.instances.hull import KeypointHull, sample_hull_view
from cadalign.geometry.metrics import rotation_error
from cadalign.seeding import instance_rng

KNOWN = Camera(width=640, height=480, fx=520.0, fy=520.0, cx=319.5, cy=239.5)
"""An object that fills its image is near, at some 1.3 of its diagonals."""
UNKNOWN = Camera.without_focal(KNOWN.width, KNOWN.height)
POINTS = 14
MODE_COUNTS = (1, 3, 5)
MODE_LENGTH = 0.06
RESIDUAL = 0.005
WITHIN_95 = 1.96
ERRORS = ("rotation", "translation", "focal", "shape")


@dataclass
class FocalShapesArguments(SeededBenchmark):
    """Measure unknown focal lengths beside learned shapes."""

    keypointnet: Path | None = None
    """Folder in KeypointNet's layout, with splits; None leaves out the unseen objects."""
    categories: tuple[str, ...] = ("airplane", "bathtub", "bottle", "chair", "mug")
    """Categories of the unseen objects."""
    objects: int = 60
    """Objects per category, and drawn objects per number of modes five times as many."""
    noise_px: float = 2.0
    """Standard deviation of the unseen objects' keypoints, in pixels."""


@dataclass(frozen=True)
class Sighting:
    """Keypoints (n, 3) of an object, their noisy places (n, 2) [px], ids and the true pose."""

    points_3d: FloatArray
    points_2d: FloatArray
    ids: tuple[int, ...]
    gt: Alignment


def see(
    points_3d: FloatArray, ids: Sequence[int], *, noise_px: float, rng: np.random.Generator
) -> Sighting:
    """Draw a near view of an object, and the noise of its keypoints."""
    gt, _ = sample_hull_view(KeypointHull(points_3d), KNOWN, rng=rng, min_visible=0)
    noise = rng.normal(0, noise_px, (len(points_3d), 2))
    return Sighting(points_3d, KNOWN.project(gt.apply(points_3d)) + noise, tuple(ids), gt)


def estimate(
    shape: ShapeModel, seen: Sighting, camera: Camera, *, noise_px: float
) -> Result | None:
    """Alignment of a shape model; None where none is found."""
    view = View(camera, seen.points_2d, ids=seen.ids, sigma=noise_px)
    focal = "known" if camera is KNOWN else "estimate"
    try:
        return align(shape, view, focal=focal)
    except CadalignError:
        return None


def drawn(arguments: FocalShapesArguments, modes: int) -> dict[str, float]:
    """Median errors on objects of the model, over those of draws from the Cramer-Rao bound."""
    rng = np.random.default_rng(arguments.seed)
    errors, limits = [], []
    for _ in range(5 * arguments.objects):
        mean = rng.uniform(-0.35, 0.35, (POINTS, 3))
        basis = rng.normal(0, MODE_LENGTH, (modes, POINTS, 3))
        shape = ShapeModel.from_basis(mean, basis, np.ones(modes), residual_sigma=RESIDUAL)
        weights = rng.normal(size=modes)
        points = mean + np.tensordot(weights, basis, 1)
        points += rng.normal(0, RESIDUAL, points.shape)
        seen = see(points, range(POINTS), noise_px=1.0, rng=rng)
        bound = posterior_bound(seen, basis, noise_px=1.0)
        limits.append(sizes(rng.multivariate_normal(np.zeros(len(bound)), bound, LIMIT_DRAWS)))
        result = estimate(shape, seen, UNKNOWN, noise_px=1.0)
        if result is None:
            errors.append(np.full((1, len(ERRORS)), np.inf))
            continue
        turn = Rotation.from_matrix(result.alignment.rotation @ seen.gt.rotation.T).as_rotvec()
        moved = result.alignment.translation - seen.gt.translation
        shares = np.linalg.lstsq(
            basis.reshape(modes, -1).T, (result.points_3d - mean).ravel(), rcond=None
        )[0]
        error = [*turn, *moved, np.log(result.camera.fx / KNOWN.fx), *(shares - weights)]
        errors.append(sizes(np.array([error])))
    ratios = np.median(np.concatenate(errors), axis=0) / np.median(np.concatenate(limits), axis=0)
    return {"modes": modes, **dict(zip(ERRORS, ratios.tolist(), strict=True))}


def sizes(errors: FloatArray) -> FloatArray:
    """Sizes (n, 4) of errors (n, 7 + K) in the order of `ERRORS`."""
    norm = np.linalg.norm
    parts = (errors[:, :3], errors[:, 3:6], errors[:, 6:7], errors[:, 7:])
    return np.stack([norm(part, axis=1) for part in parts], axis=1)


def posterior_bound(seen: Sighting, basis: FloatArray, *, noise_px: float) -> FloatArray:
    """Least covariance (7 + K, 7 + K) of rotation, translation, log focal length and modes.

    Inverse of the keypoints' Fisher information at the truth and that of the modes' prior; the
    deviations that the modes leave are noise of the keypoints.
    """
    modes = len(basis)
    jacobian = projection_jacobian(seen.points_3d, KNOWN, seen.gt)
    by_place = jacobian[:, :, 3:6] @ seen.gt.rotation
    by_mode = np.einsum("nia,kna->nik", by_place, basis)
    rows = np.concatenate([jacobian[:, :, :6], jacobian[:, :, 9:], by_mode], axis=2)
    noise = noise_px**2 * np.eye(2) + RESIDUAL**2 * by_place @ by_place.transpose(0, 2, 1)
    information = np.einsum("nik,nil->kl", rows, np.linalg.solve(noise, rows))
    information[7:, 7:] += np.eye(modes)
    return np.linalg.inv(information)


def unseen(arguments: FocalShapesArguments, root: Path, category: str) -> dict[str, object]:
    """Errors with the focal length known and unknown on objects that are not in the model."""
    dataset = KeypointNet(root)
    shape = ShapeModel.from_dataset(dataset, category, split="train", meshes=False)
    objects = dataset.subset(categories=[category], split="val")
    rows, deviations = [], []
    for key in sorted(objects.ids(category))[: arguments.objects]:
        keypoints = objects[key].keypoints
        rng = instance_rng(arguments.seed, *key)
        noise_px = arguments.noise_px
        seen = see(keypoints.xyz, keypoints.semantic_ids.tolist(), noise_px=noise_px, rng=rng)
        known = estimate(shape, seen, KNOWN, noise_px=noise_px)
        found = estimate(shape, seen, UNKNOWN, noise_px=noise_px)
        if known is None or found is None or found.std is None:
            continue
        rows.append([*unseen_errors(known, seen), *unseen_errors(found, seen)])
        deviations.append(np.log(found.camera.fx / KNOWN.fx) / found.std.focal)
    known_deg, known_iou, deg, iou = np.median(rows, axis=0).tolist()
    return {
        "category": category,
        "objects": len(rows),
        "known": {"rotation_error_deg": known_deg, "extents_iou": known_iou},
        "unknown": {"rotation_error_deg": deg, "extents_iou": iou},
        "rotation_ratio": deg / known_deg,
        "focal_deviations": deviations,
    }


def unseen_errors(result: Result, seen: Sighting) -> tuple[float, float]:
    """Rotation error [deg], and intersection over union of the extents up to scale."""
    rows = [result.ids.index(name) for name in seen.ids if name in result.ids]
    kept = [row for row, name in enumerate(seen.ids) if name in result.ids]
    extents = np.ptp(result.points_3d[rows], axis=0), np.ptp(seen.points_3d[kept], axis=0)
    a, b = (each / np.linalg.norm(each) for each in extents)
    overlap = np.prod(np.minimum(a, b)) / np.prod(np.maximum(a, b))
    return rotation_error(est=result.alignment, gt=seen.gt), float(overlap)


def held(deviations: Sequence[float], quantile: float) -> float:
    """Share of focal lengths within a number of stated standard deviations."""
    return float(np.mean(np.abs(deviations) < quantile))


def main(arguments: FocalShapesArguments) -> None:
    """Run all measurements."""
    console = Console(width=130)
    title = f"{POINTS} keypoints, 1 px: median errors over the Cramer-Rao limit's of 7 + K unknowns"
    table = new_table(title, "modes K", "R", "t", "f", "shape")
    ideal = [drawn(arguments, modes) for modes in MODE_COUNTS]
    for row in ideal:
        table.add_row(str(row["modes"]), *(f"{row[error]:.2f}" for error in ERRORS))
    console.print(table)
    results: dict[str, object] = {"drawn": ideal}
    if arguments.keypointnet is not None:
        root = arguments.keypointnet
        found = [unseen(arguments, root, category) for category in arguments.categories]
        title = f"unseen objects in near views, {arguments.noise_px:g} px"
        names = (
            "R known",
            "R unknown [deg]",
            "ratio",
            "extents' IoU known",
            "unknown",
            "f in 95 %",
        )
        table = new_table(title, "category", "objects", *names)
        for row in found:
            degrees = [row[each]["rotation_error_deg"] for each in ("known", "unknown")]
            ious = [row[each]["extents_iou"] for each in ("known", "unknown")]
            table.add_row(
                *(row["category"], str(row["objects"])),
                *(f"{value:.2f}" for value in (*degrees, row["rotation_ratio"])),
                *(f"{value:.3f}" for value in ious),
                f"{100 * held(row['focal_deviations'], WITHIN_95):.0f} %",
            )
        console.print(table)
        every = [value for row in found for value in row["focal_deviations"]]
        console.print(f"focal lengths in 95 %: {100 * held(every, WITHIN_95):.1f} %")
        results["unseen"] = found
    write_results(arguments.out, results)


if __name__ == "__main__":
    main(tyro.cli(FocalShapesArguments))
