"""Times of first calls, of small calls, and of pictures."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np

import cadalign
from benchmarks import section
from benchmarks.section import COMMAND, BenchmarkData, Row, Tables
from cadalign import Camera, Observation
from cadalign.datasets import sample_models
from cadalign.errors import RenderError
from cadalign.evaluation.simulation import simulate_problem
from cadalign.io.images import write_image
from cadalign.render import (
    RaycastRenderer,
    Scene,
    Studio,
    cast_geometry,
    frame_object,
    look_at,
    make_renderer,
    visible_keypoints,
)
from cadalign.render.probe import ball
from cadalign.solvers.linear import aepnp_batch

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
# The largest allowed medians [ms], on two cores.
_LIMITS = {
    "raycast: geometry": 40.0,
    "raycast: colour": 150.0,
    "pyrender: colour": 100.0,
    "visibility of 20 keypoints": 1.0,
}


def cold(given: BenchmarkData) -> Tables:
    """Time of the first calls after installation, when nothing is compiled yet.

    Each call runs in a new process with an empty folder of compiled code. The ratio is that to a
    first call of a function of ten lines compiled by Numba, measured right before.
    """
    with tempfile.TemporaryDirectory() as folder:

        def called(code: str, place: str) -> tuple[float, float]:
            environment = {**os.environ, "NUMBA_CACHE_DIR": str(Path(folder, place))}
            return section.seconds_of_process([sys.executable, "-c", code], environment=environment)

        _, reference = called(_SMALL_FUNCTION, "small")
        rows = []
        for name, code in _FIRST_CALLS.items():
            wall, busy = called(code, "all" if "doctor" in name else "fit")
            rows.append(section.figure(name, wall, "s", busy / reference, "a first small call"))
    yield "First calls", rows


def calls(given: BenchmarkData, *, runs: int = 7, calls: int = 2000) -> Tables:
    """Cost of calls beside their solving: the warm command line, and small fits in Python.

    Parameters
    ----------
    runs : int
        Runs of each command.
    calls : int
        Calls of each fit.
    """
    with tempfile.TemporaryDirectory() as folder:
        yield "Commands, processor time", _commands(Path(folder), runs)
    yield "Fits", _fits(calls)


def _commands(folder: Path, runs: int) -> Iterator[Row]:
    seen = str(_observation(folder))
    libraries = "import numpy, numba"
    for name, given in {
        "cadalign --help": ["--help"],
        "cadalign fit": ["fit", seen],
        "cadalign fit --json --no-picture": ["fit", seen, "--json", "--no-picture"],
        "cadalign demo": ["demo", "--out", str(folder / "demo"), "--workers", "0"],
    }.items():
        command = [*COMMAND, *given]
        section.seconds_of_process(command)  # compiles what is not yet on disk
        processor, ratio = section.median_and_ratio(
            lambda command=command: section.seconds_of_process(command)[1],
            lambda: section.seconds_of_process([sys.executable, "-c", libraries])[1],
            1 if name == "cadalign demo" else runs,
        )
        yield section.figure(name, processor, "s", ratio, libraries)


def _fits(calls: int) -> Iterator[Row]:
    ten, seven = (
        simulate_problem(np.random.default_rng(0), points=points, noise_px=1.0)
        for points in (10, 7)
    )
    x, uv, camera = ten.points_3d, ten.points_2d, ten.camera
    rays, offsets = camera.normalize(uv), np.array([0, 10])
    for name, ours, theirs, to in (
        (
            "fit(method='aepnp'), 10 points",
            lambda: cadalign.fit(x, uv, camera, method="aepnp"),
            lambda: aepnp_batch(x, rays, offsets),
            "its kernel",
        ),
        (
            "fit, 7 points",
            lambda: cadalign.fit(seven.points_3d, seven.points_2d, seven.camera),
            lambda: cv2.solvePnP(x, uv, camera.matrix, None),
            "OpenCV's ITERATIVE, 10 points",
        ),
    ):
        timed = (partial(section.seconds, call) for call in (ours, theirs))
        median, ratio = section.median_and_ratio(*timed, calls)
        yield section.figure(name, 1e6 * median, "us", ratio, to)


def _observation(folder: Path) -> Path:
    (model,) = sample_models(categories=["chair"], per_category=1)
    problem = simulate_problem(np.random.default_rng(0), points=10, noise_px=0.5)
    camera = problem.camera
    photo, path = folder / "photo.jpg", folder / "chair.obj"
    write_image(photo, np.full((camera.height, camera.width, 3), 180, dtype=np.uint8))
    lines = [f"v {x} {y} {z}" for x, y, z in model.mesh.vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in (model.mesh.faces + 1).tolist()]
    path.write_text("\n".join(lines) + "\n")
    seen = Observation(problem.points_3d, problem.points_2d, camera, image=photo, model=path)
    seen.save(folder / "seen.json")
    return folder / "seen.json"


def rendering(given: BenchmarkData, *, repetitions: int = 15) -> Tables:
    """Milliseconds a frame of the renderers, and of what is done once per mesh.

    640 x 480 px on 20,480 triangles. Medians, and the smallest beside them, since other programs
    may share the machine.

    Parameters
    ----------
    repetitions : int
        Timed frames per figure; the median counts.
    """
    camera = Camera.from_fov(640, 480, fov_x=50.0)
    scene = Scene(ball(5))
    rotation = look_at(azimuth=35, elevation=20, distance=3).rotation
    pose = frame_object(scene.bounds, camera, rotation=rotation, fill=0.9)
    vertices = scene.mesh.vertices
    keypoints = vertices[np.random.default_rng(0).choice(len(vertices), 20)]
    shown = scene, camera, pose
    plain = RaycastRenderer(studio=Studio(occlusion=0))
    tasks: dict[str, Callable[[], object]] = {
        "once per mesh: ray hierarchy": lambda: Scene(scene.mesh).caster,
        "once per mesh: smooth normals": lambda: Scene(scene.mesh).corner_normals,
        "visibility of 20 keypoints": lambda: visible_keypoints(scene, keypoints, camera, pose),
        "raycast: geometry": lambda: cast_geometry(*shown),
        "raycast: colour": partial(RaycastRenderer().render, *shown),
        "raycast: colour, no ambient occlusion": partial(plain.render, *shown),
    }
    for name in ("open3d", "pyrender"):
        try:
            tasks[f"{name}: colour"] = partial(make_renderer(name).render, *shown)
        except RenderError as error:
            print(error, file=sys.stderr)
            continue
        if name == "open3d":
            tasks["open3d: geometry"] = lambda: cast_geometry(*shown, caster=scene.open3d_caster)
    rows = []
    for name, task in tasks.items():
        task()  # prepares what is prepared once
        times = [1e3 * section.seconds(task) for _ in range(repetitions)]
        median, limit = float(np.median(times)), _LIMITS.get(name)
        rows.append({"task": name, "median ms": median, "smallest": min(times), "limit": limit})
    share = 100 * float(cast_geometry(*shown).mask.mean())
    yield f"20,480 triangles on {share:.0f} % of the image, {os.cpu_count()} cores", rows
