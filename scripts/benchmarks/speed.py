"""Times of solvers relative to OpenCV, and of first calls."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

import cadalign
from benchmarks import section
from benchmarks.section import BenchmarkData, Row, Tables
from cadalign.evaluation.simulation import simulate_problem
from cadalign.solvers.linear import aepnp

_SETUP = """
import numpy as np
from cadalign import Camera, RansacOptions, fit
camera = Camera(640, 480, 900.0, 900.0, 319.5, 239.5)
points = np.random.default_rng(0).uniform(-0.3, 0.3, (12, 3))
pixels = camera.project(points + [0.0, 0.0, 2.0])
"""
_FIRST_CALLS = {
    "first fit": _SETUP + "fit(points, pixels, camera)",
    "first RANSAC fit, after it": _SETUP + "fit(points, pixels, camera, ransac=RansacOptions())",
    "doctor --compile": "from cadalign.cli import main; main(['doctor', '--compile'])",
}


def speed(given: BenchmarkData) -> Tables:
    """Times relative to OpenCV's compiled solvers, on the same problems."""
    rng = np.random.default_rng(given.seed)
    rows = (row for points in (10, 100, 1024, 4096) for row in _over_opencv(rng, points))
    yield "Times relative to OpenCV, which estimates no stretch", rows


def _over_opencv(rng: np.random.Generator, points: int) -> Iterator[Row]:
    problem = simulate_problem(rng, points=points, noise_px=1.0)
    x, uv, camera = problem.points_3d, problem.points_2d, problem.camera
    rays, matrix = camera.normalize(uv), camera.matrix
    calls: dict[str, Callable[[], object]] = {
        "cv2 EPNP": lambda: cv2.solvePnP(x, uv, matrix, None, flags=cv2.SOLVEPNP_EPNP),
        "cv2 ITERATIVE": lambda: cv2.solvePnP(x, uv, matrix, None),
        "solvers.aepnp": lambda: aepnp(x, rays),
        "fit aepnp": lambda: cadalign.fit(x, uv, camera, method="aepnp"),
        "fit optimal": lambda: cadalign.fit(x, uv, camera),
    }
    # Alternating, so that load on the machine affects all alike; the first round is warm-up.
    turns = [[_seconds(call) for call in calls.values()] for _ in range(31)]
    medians = dict(zip(calls, np.median(turns[1:], axis=0).tolist(), strict=True))
    for name in (each for each in medians if not each.startswith("cv2")):
        peer = "cv2 ITERATIVE" if name == "fit optimal" else "cv2 EPNP"
        ratio, label = medians[name] / medians[peer], f"{name}, {points} keypoints"
        yield section.figure(label, 1e6 * medians[name], "us", ratio, peer)


def _seconds(call: Callable[[], object]) -> float:
    """Median of ten calls, one after the other."""
    return float(np.median([section.seconds(call) for _ in range(10)]))


def cold(given: BenchmarkData) -> Tables:
    """Times of the first calls after installation, before anything is compiled.

    Each call runs in a new process; the second one uses the compiled code of the first.
    """
    with tempfile.TemporaryDirectory() as folder:
        rows = []
        for name, code in _FIRST_CALLS.items():
            place = Path(folder, "all" if "doctor" in name else "fit")
            command = [sys.executable, "-c", code]
            wall, _ = section.measure_command(command, NUMBA_CACHE_DIR=str(place))
            rows.append({"call": name, "s": wall})
    yield "First calls", rows
