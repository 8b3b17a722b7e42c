"""Measure the robust search on real correspondences: success, and time over PoseLib's and OpenCV's.

Scales are drawn anew for every image and draw, and the given share of the image points is replaced
by uniform ones. PoseLib and OpenCV get the true scales: they solve the easier problem without
stretch. Prints a table and writes a JSON file.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from timeit import timeit

import cv2
import numpy as np
import poselib
import tyro
from common import Benchmark, figure, new_table, write_figures, write_results
from rich.console import Console

import cadalign
from cadalign import Alignment, RansacOptions, metrics
from cadalign.datasets import Bundler, Colmap, Correspondences

OPTIONS = {"max_reproj_error": 4.0, "success_prob": 0.9999}
OPENCV_DRAWS = 2  # it takes the better part of a second


@dataclass(kw_only=True)
class RansacArguments(Benchmark):
    """Measure the robust search on real correspondences."""

    colmap: Path
    """Folder of a COLMAP model."""
    bundler: Path
    """Folder of a Bundler model."""
    json: Path | None = None
    """File for the times over PoseLib's, as `compare_ratios.py` reads them."""
    draws: int = 20
    """Draws of scales and outliers for each image."""
    outliers: tuple[float, ...] = (0.0, 0.2, 0.5, 0.8, 0.9)
    """Shares of outliers among the image points."""


def main(arguments: RansacArguments) -> None:
    """Run all measurements."""
    console = Console(width=110)
    title = "Robust search: success (R < 0.5 deg, scales within 1 %), median times"
    columns = ("model", "outliers", "success", "ms", "over PoseLib", "over cv2 RANSAC EPNP")
    table = new_table(title, *columns)
    rows = []
    models = {"COLMAP": list(Colmap(arguments.colmap)), "Bundler": list(Bundler(arguments.bundler))}
    for name, images in models.items():
        for share in arguments.outliers:
            row = {"model": name, **_measure(images, share, arguments.draws)}
            rows.append(row)
            table.add_row(
                name,
                f"{share:.0%}",
                f"{100 * row['success']:.1f} %",
                f"{1e3 * row['seconds']:.2f}",
                f"{row['over_poselib']:.2f}",
                f"{row['over_opencv']:.3f}",
            )
    console.print(table)
    write_results(arguments.out, rows)
    write_figures(
        arguments.json,
        {
            f"robust, {row['model']}, {row['outliers']:.0%} outliers": figure(
                1e3 * row["seconds"], "ms", row["over_poselib"]
            )
            for row in rows
        },
    )


def _measure(images: list[Correspondences], share: float, draws: int) -> dict[str, float]:
    rng = np.random.default_rng(1)
    max_iterations = 200_000 if share > 0.85 else 10_000
    succeeded, ours, poselibs, opencvs = [], [], [], []
    for draw in range(draws):
        for image in images:
            scale = np.array([1.0, *rng.uniform(0.5, 2.0, 2)])
            pose = image.cam_from_world
            gt = Alignment(pose.rotation, pose.translation, scale)
            points_2d = image.points_2d.copy()
            wrong = rng.choice(len(points_2d), round(share * len(points_2d)), replace=False)
            size = [image.camera.width - 1, image.camera.height - 1]
            points_2d[wrong] = rng.uniform([0, 0], size, (len(wrong), 2))
            options = RansacOptions(**OPTIONS, max_iterations=max_iterations, seed=draw)
            model = image.points_3d / scale
            start = time.perf_counter()
            try:
                est = cadalign.fit(model, points_2d, image.camera, ransac=options).alignment
                succeeded.append(
                    metrics.rotation_error(est=est, gt=gt) < 0.5
                    and metrics.scale_error(est=est, gt=gt).max() < 0.01
                )
            except cadalign.CadalignError:
                succeeded.append(False)
            ours.append(time.perf_counter() - start)
            poselibs.append(timeit(partial(_poselib, image, points_2d, max_iterations), number=1))
            if draw < OPENCV_DRAWS:
                opencvs.append(timeit(partial(_opencv, image, points_2d), number=1))
    seconds = float(np.median(ours))
    return {
        "outliers": share,
        "success": float(np.mean(succeeded)),
        "seconds": seconds,
        "over_poselib": seconds / float(np.median(poselibs)),
        "over_opencv": seconds / float(np.median(opencvs)),
    }


def _undistorted(image: Correspondences, points_2d: np.ndarray) -> np.ndarray:
    camera = image.camera
    return camera.normalize(points_2d) * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def _poselib(image: Correspondences, points_2d: np.ndarray, iterations: int) -> object:
    camera = image.camera
    return poselib.estimate_absolute_pose(
        _undistorted(image, points_2d),
        image.points_3d,
        {
            "model": "PINHOLE",
            "width": camera.width,
            "height": camera.height,
            "params": [camera.fx, camera.fy, camera.cx, camera.cy],
        },
        OPTIONS | {"max_iterations": iterations},
        {},
    )


def _opencv(image: Correspondences, points_2d: np.ndarray) -> object:
    return cv2.solvePnPRansac(
        image.points_3d,
        _undistorted(image, points_2d),
        image.camera.matrix,
        None,
        flags=cv2.SOLVEPNP_EPNP,
        iterationsCount=10_000,
        reprojectionError=OPTIONS["max_reproj_error"],
        confidence=OPTIONS["success_prob"],
    )


if __name__ == "__main__":
    main(tyro.cli(RansacArguments))
