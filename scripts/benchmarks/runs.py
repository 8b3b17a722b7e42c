"""Times of whole runs, of the robust search, of first calls and of small commands."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import cv2
import msgspec
import numpy as np
import poselib
from scipy.spatial.transform import Rotation

from benchmarks import section
from benchmarks.section import COMMAND, BenchmarkData, Row, Table, Tables
from cadalign import Camera, Observation, RansacOptions
from cadalign.datasets import Colmap, Correspondences, KeypointNet, write_sample_dataset
from cadalign.evaluation.experiments.correspondences import errors_of, spoil
from cadalign.evaluation.methods import MethodInput
from cadalign.evaluation.simulation import simulate_problem
from cadalign.io.images import write_image

_POINTS = 8
_CAMERA = Camera(640, 480, 700.0, 700.0, 319.5, 239.5)
_SIZES = (25_000, 100_000)  # observations of the shorter and of the longer run
_SEARCH = {"max_reproj_error": 4.0, "success_prob": 0.9999}
_OPENCV_DRAWS = 2  # it takes the better part of a second


def runs(given: BenchmarkData) -> Tables:
    """Fits of many observations, evaluations, and searches in real correspondences."""
    yield _fits(given)
    yield _evaluations(given)
    yield _ransac(given)


def _used(*call: str) -> section.Used:
    with tempfile.TemporaryDirectory() as folder:
        return section.used_by([*COMMAND, *call, f"--out={folder}/run"])


def _rate_and_memory(name: str, count: int, shorter: list[str], longer: list[str]) -> Iterator[Row]:
    """Rate of what a longer run of two processes does more, ``count`` items, and its memory.

    The rate's ratio is that of processor time to `reference_seconds`, the memory's the longer run's
    over the shorter one's.
    """
    (short, long), reference = section.with_reference(
        lambda: [_used(*call, "--workers=2") for call in (shorter, longer)]
    )
    rate, busy = count / (long.wall - short.wall), (long.processor - short.processor) / count
    yield section.figure(f"{name}, two processes", rate, "1/s", 1e3 * busy / reference)
    grown = long.megabytes / short.megabytes
    yield section.figure(f"{name}, memory", long.megabytes, "MB", grown)


def _dask_over_processes(name: str, call: list[str]) -> Row:
    """Time of a run by two Dask workers over two processes."""
    from distributed import LocalCluster

    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        on_dask = _used(*call, f"--dask={cluster.scheduler_address}")
    return section.figure(name, on_dask.wall, "s", on_dask.wall / _used(*call, "--workers=2").wall)


def _evaluations(given: BenchmarkData) -> Table:
    """Instances a second of whole runs, with two processes or two workers of a Dask cluster.

    Rates are those of what a longer run does more than a shorter one: neither start nor figures are
    in them.
    """
    root = given.folder("keypointnet")
    with tempfile.TemporaryDirectory() as folder:
        samples = write_sample_dataset(Path(folder) / "samples", per_category=12)
        on_hulls = _evaluate(root, "--visibility=hull")
        overlays = _evaluate(samples, "--methods=optimal", "--render=overlay")
        rows = []
        for name, call, data, views in (
            ("run on annotations", [*on_hulls, "--methods=aepnp"], root, (4, 16)),
            ("run with overlays", overlays, samples, (1, 4)),
        ):
            count = (views[1] - views[0]) * len(KeypointNet(data))
            runs = ([*call, f"--views-per-model={each}"] for each in views)
            rows += _rate_and_memory(name, count, *runs)
        dask = "run by Dask over one by processes"
        rows.append(_dask_over_processes(dask, [*on_hulls, "--views-per-model=3"]))
    return "Evaluations", rows


def _evaluate(root: Path, *options: str) -> list[str]:
    return ["evaluate", "keypointnet", str(root), *options, "--json"]


def _fits(given: BenchmarkData) -> Table:
    """Observations a second of whole runs by two processes, memory, and two Dask workers."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        files = [_write_observations(Path(folder), n, given.seed) for n in _SIZES]
        for method in ("aepnp", "optimal"):
            runs = (_fit(file, method) for file in files)
            rows += _rate_and_memory(f"fits by {method}", _SIZES[1] - _SIZES[0], *runs)
        dask = "fits by Dask over those by processes"
        rows.append(_dask_over_processes(dask, _fit(files[0], "aepnp")))
    return f"Fits of {_POINTS} keypoints", rows


def _fit(file: Path, method: str) -> list[str]:
    return ["fit", str(file), "--no-picture", f"--method={method}"]


def _write_observations(folder: Path, count: int, seed: int) -> Path:
    """Write observations of one model in random poses, stretched, with 1 px of noise."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (_POINTS, 3))
    turns = Rotation.random(count, random_state=rng).as_matrix()
    scales = np.exp(rng.uniform(-0.5, 0.5, (count, 3)))
    scales[:, 0] = 1
    path = folder / f"{count}.jsonl"
    camera = _CAMERA.to_dict()
    with path.open("wb") as file:
        for turn, scale in zip(turns, scales, strict=True):
            pixels = _CAMERA.project(points * scale @ turn.T + [0.0, 0.0, 6.0])
            pixels += rng.normal(0, 1, pixels.shape)
            pairs = zip(points.tolist(), pixels.round(2).tolist(), strict=True)
            keypoints = [{"xyz": xyz, "uv": uv} for xyz, uv in pairs]
            file.write(msgspec.json.encode({"camera": camera, "keypoints": keypoints}) + b"\n")
    return path


# Robust search ------------------------------------------------------------------------------------


def _ransac(given: BenchmarkData) -> Table:
    """The robust search on real correspondences: success, and time over PoseLib's and OpenCV's.

    Images are those of `cadalign evaluate correspondences`: scales are drawn anew for every image
    and draw, and a share of the points is moved to anywhere. PoseLib and OpenCV get the true
    scales: they solve the easier problem without stretch.
    """
    images = list(Colmap(given.folder("sfm", "maupertuis_colmap")))
    shares = (0.0, 0.2, 0.5, 0.8, 0.9)
    return "Robust search", [_row(images, share, given.count or 20) for share in shares]


def _row(images: list[Correspondences], share: float, draws: int) -> Row:
    rng = np.random.default_rng(1)
    iterations = 200_000 if share > 0.85 else 10_000
    succeeded, ours, poselibs, opencvs = [], [], [], []
    for draw in range(draws):
        options = RansacOptions(**_SEARCH, max_iterations=iterations, seed=draw)
        for image in images:
            truth = spoil(image, share, rng=rng)
            wall, _, result = section.clocked(partial(section.fitted, truth, ransac=options))
            ours.append(wall)
            given = MethodInput.of_problem(truth, 1.0)
            succeeded.append(result is not None and errors_of(result, given)["success"])
            poselibs.append(section.seconds(_poselib(image, truth.points_2d, iterations)))
            if draw < _OPENCV_DRAWS:
                opencvs.append(section.seconds(_opencv(image, truth.points_2d)))
    own, other, opencv = (float(np.median(each)) for each in (ours, poselibs, opencvs))
    name = f"robust, COLMAP, {share:.0%} outliers"
    return section.figure(name, 1e3 * own, "ms", own / other, "PoseLib") | {
        "success": f"{np.mean(succeeded):.1%}",
        "over cv2 RANSAC EPNP": own / opencv,
    }


def _undistorted(image: Correspondences, points_2d: np.ndarray) -> np.ndarray:
    camera = image.camera
    return camera.normalize(points_2d) * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def _poselib(
    image: Correspondences, points_2d: np.ndarray, iterations: int
) -> Callable[[], object]:
    camera = image.camera
    params = [camera.fx, camera.fy, camera.cx, camera.cy]
    size = {"width": camera.width, "height": camera.height}
    intrinsics = {"model": "PINHOLE", **size, "params": params}
    options = _SEARCH | {"max_iterations": iterations}
    return lambda: poselib.estimate_absolute_pose(
        _undistorted(image, points_2d), image.points_3d, intrinsics, options, {}
    )


def _opencv(image: Correspondences, points_2d: np.ndarray) -> Callable[[], object]:
    return lambda: cv2.solvePnPRansac(
        image.points_3d,
        _undistorted(image, points_2d),
        image.camera.matrix,
        None,
        flags=cv2.SOLVEPNP_EPNP,
        iterationsCount=10_000,
        reprojectionError=_SEARCH["max_reproj_error"],
        confidence=_SEARCH["success_prob"],
    )


# Commands and first calls -------------------------------------------------------------------------

_SETUP = """
import numpy as np
from cadalign import Camera, RansacOptions, fit
camera = Camera(640, 480, 900.0, 900.0, 319.5, 239.5)
points = np.random.default_rng(0).uniform(-0.3, 0.3, (12, 3))
pixels = camera.project(points + [0.0, 0.0, 2.0])
"""
_FIRST_CALLS = {
    "first fit": _SETUP + "fit(points, pixels, camera)",
    "first robust fit, after it": _SETUP
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
_SPAN = 3.0  # of simulated keypoints [model units]; that of the mesh is 1


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
    seen = str(_small_observation(folder))

    def processor(command: list[str]) -> float:
        return section.used_by(command).processor

    other = partial(processor, [sys.executable, "-c", _LIBRARIES])
    for options in (["--help"], ["fit", seen], ["fit", seen, "--json", "--no-picture"]):
        own = partial(processor, [*COMMAND, *options])
        found = section.medians_in_turns({"own": own, "other": other}, runs)
        name = " ".join(["cadalign", *(each for each in options if each != seen)])
        ratio = found["own"] / found["other"]
        yield section.figure(name, found["own"], "s", ratio, _LIBRARIES)


def _small_observation(folder: Path) -> Path:
    root = write_sample_dataset(folder / "sample", categories=["chair"], per_category=1)
    mesh = KeypointNet(root)["chair"][0].load_mesh()
    problem = simulate_problem(np.random.default_rng(0), points=10, noise_px=0.5)
    camera = problem.camera
    photo, path = folder / "photo.jpg", folder / "chair.obj"
    write_image(photo, np.full((camera.height, camera.width, 3), 180, dtype=np.uint8))
    vertices = _SPAN * mesh.vertices  # of the size of the keypoints' cloud
    lines = [f"v {x} {y} {z}" for x, y, z in vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist()]
    path.write_text("\n".join(lines) + "\n")
    seen = Observation(problem.points_3d, problem.points_2d, camera, image=photo, model=path)
    seen.save(folder / "seen.json")
    return folder / "seen.json"
