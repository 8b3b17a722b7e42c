"""Times of first calls, and of small calls."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks import section
from benchmarks.section import COMMAND, BenchmarkData, Row, Tables
from cadalign import Observation
from cadalign.datasets import KeypointNet, write_sample_dataset
from cadalign.evaluation.simulation import simulate_problem
from cadalign.io.images import write_image

_POINTS = """
import numpy as np
from cadalign import Camera, RansacOptions, fit
camera = Camera(640, 480, 900.0, 900.0, 319.5, 239.5)
points = np.random.default_rng(0).uniform(-0.3, 0.3, (12, 3))
pixels = camera.project(points + [0.0, 0.0, 2.0])
"""
_FIRST_CALLS = {
    "first fit": _POINTS + "fit(points, pixels, camera)",
    "first robust fit, after it": _POINTS
    + "fit(points, pixels, camera, ransac=RansacOptions(), sigma=1.0)",
    "doctor --compile, two processes": (
        "from cadalign.cli import main; main(['doctor', '--compile'])"
    ),
}
_SMALL_FUNCTION = """
import numba, numpy as np
@numba.njit
def total(a):
    found = np.zeros(a.shape[0])
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            found[i] += a[i, j] ** 2
    return np.sqrt(found).sum()
total(np.ones((3, 3)))
"""
_LIBRARIES = "import numpy, numba"


def cold(given: BenchmarkData) -> Tables:
    """Time of the first calls after installation, when nothing is compiled yet.

    Each call runs in a new process with an empty folder of compiled code. The ratio is that to a
    first call of a function of ten lines compiled by Numba, measured right before.
    """
    with tempfile.TemporaryDirectory() as folder:

        def called(code: str, place: str) -> section.Used:
            command = [sys.executable, "-c", code]
            return section.used_by(command, NUMBA_CACHE_DIR=str(Path(folder, place)))

        reference = called(_SMALL_FUNCTION, "small").processor
        rows = []
        for name, code in _FIRST_CALLS.items():
            used = called(code, "all" if "doctor" in name else "fit")
            ratio = used.processor / reference
            rows.append(section.figure(name, used.wall, "s", ratio, "a first small call"))
    yield "First calls", rows


def speed(given: BenchmarkData) -> Tables:
    """Processor time of the warm command line."""
    with tempfile.TemporaryDirectory() as folder:
        yield "Commands, processor time", _commands(Path(folder), given.count or 7)


def _commands(folder: Path, runs: int) -> Iterator[Row]:
    seen = str(_observation(folder))

    def processor(command: list[str]) -> float:
        return section.used_by(command).processor

    other = partial(processor, [sys.executable, "-c", _LIBRARIES])
    for options in (["--help"], ["fit", seen], ["fit", seen, "--json", "--no-picture"]):
        own = partial(processor, [*COMMAND, *options])
        found = section.medians_in_turns({"own": own, "other": other}, runs)
        name = " ".join(["cadalign", *(each for each in options if each != seen)])
        ratio = found["own"] / found["other"]
        yield section.figure(name, found["own"], "s", ratio, _LIBRARIES)


def _observation(folder: Path) -> Path:
    root = write_sample_dataset(folder / "sample", categories=["chair"], per_category=1)
    mesh = KeypointNet(root)["chair"][0].load_mesh()
    problem = simulate_problem(np.random.default_rng(0), points=10, noise_px=0.5)
    camera = problem.camera
    photo, path = folder / "photo.jpg", folder / "chair.obj"
    write_image(photo, np.full((camera.height, camera.width, 3), 180, dtype=np.uint8))
    lines = [f"v {x} {y} {z}" for x, y, z in mesh.vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist()]
    path.write_text("\n".join(lines) + "\n")
    seen = Observation(problem.points_3d, problem.points_2d, camera, image=photo, model=path)
    seen.save(folder / "seen.json")
    return folder / "seen.json"
