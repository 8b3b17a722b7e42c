"""`cadalign doctor`: check this machine, or a data set of photos."""

from __future__ import annotations

import os
import platform
import time
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

from cadalign.cli.common import JsonOption, answer, new_console, print_json, waiting
from cadalign.errors import InputError

if TYPE_CHECKING:
    from cadalign.datasets import PhotoSummary

# Problems of a data set that are printed; JSON has all.
_SHOWN = 10
_TIMED_FRAMES = 5


@dataclass(frozen=True)
class Doctor(JsonOption):
    """Check this machine: the speed of drawing, the cores, the cache of compiled solvers.

    With --data, lists what lies
    in a folder of photos instead: its format, and how many photos and objects can be read. With
    --compile, compiles the solvers ahead.
    """

    data: Path | None = None
    """Folder of a data set of photos, in any known format (see cadalign.datasets.open)."""
    compile: bool = False
    """Compile all solvers now, as for a Docker image, in place of when they are first called."""

    def run(self) -> int:
        """Run the checks; returns the exit code, 0 if photos can be read."""
        if self.data is not None:
            return self._check_data(self.data)
        if self.compile:
            return self._compile()
        with waiting("drawing ..."):
            health = examine()
        if self.json:
            print_json(asdict(health))
        else:
            _print(health)
        return 0

    def _compile(self) -> int:
        from cadalign.cli.compile_ahead import compile_ahead

        require_cache()
        began = time.perf_counter()
        with waiting("compiling ...") as show:
            compile_ahead(progress=lambda text: show(f"compiled: {text} ..."))
        found = {"seconds": round(time.perf_counter() - began, 1), "cache": compiled_cache()}
        if self.json:
            print_json(found)
        else:
            answer(f"Compiled in {found['seconds']} s: {found['cache']}")
        return 0

    def _check_data(self, folder: Path) -> int:
        from cadalign.datasets import open_photos

        with waiting("reading the annotations ...") as show:
            dataset = open_photos(folder)
            summary = dataset.summary(progress=lambda count: show(f"{count} photos read ..."))
        if self.json:
            print_json({**asdict(summary), "root": str(summary.root)})
        else:
            _print_data(summary)
        return 0 if summary.photos else 1


def _print(health: Health) -> None:
    answer(f"Ray casting: {health.milliseconds:.0f} ms for 640 x 480 px, 20,480 triangles")
    answer(f"Python {health.python}, NumPy {health.numpy}, Numba {health.numba}")
    answer(f"Cores: {health.cores}, of which this process may use {health.usable_cores}")
    answer(f"Compiled solvers: {health.cache}")


def _print_data(summary: PhotoSummary) -> None:
    from rich.table import Column, Table

    answer(f"{summary.root}: {summary.kind}")
    answer(f"{summary.photos} of {summary.records} photos can be read, {summary.images} with image")
    table = Table("category", Column("objects", justify="right"), title="Objects")
    for category, count in summary.categories.items():
        table.add_row(category, str(count))
    new_console(stderr=False).print(table)
    answer(
        f"{summary.objects} objects: {summary.with_pose} with pose, {summary.with_keypoints} with "
        f"keypoints, {summary.with_model} with CAD model, {summary.with_mask} with mask"
    )
    for problem in summary.problems[:_SHOWN]:
        answer(f"Left out: {problem}")
    if len(summary.problems) > _SHOWN:
        answer(f"... and {len(summary.problems) - _SHOWN} more problems; --json has all")


@dataclass(frozen=True)
class Health:
    """Findings of `examine`."""

    milliseconds: float
    """The median time in which a frame is drawn."""
    cores: int
    usable_cores: int
    """Those that this process may use."""
    cache: str
    """Location and state of the cache of compiled solvers."""
    python: str
    numpy: str
    numba: str


def examine() -> Health:
    """Draw some frames and collect the rest."""
    return Health(
        milliseconds=_frame_milliseconds(),
        cores=os.cpu_count() or 1,
        usable_cores=_usable_cores(),
        cache=compiled_cache(),
        python=platform.python_version(),
        numpy=version("numpy"),
        numba=version("numba"),
    )


def _frame_milliseconds() -> float:
    from trimesh.creation import icosphere

    from cadalign.geometry.camera import Camera
    from cadalign.geometry.mesh import Mesh
    from cadalign.render.raycast.renderer import RaycastRenderer
    from cadalign.render.scene import Scene
    from cadalign.render.viewpoints import look_at

    ball = icosphere(subdivisions=5)
    scene, camera = Scene(Mesh(ball.vertices, ball.faces)), Camera.from_fov(640, 480, fov_x=50.0)
    pose, times = look_at(azimuth=0, elevation=0, distance=4.5), list[float]()
    for _ in range(_TIMED_FRAMES + 1):
        begin = time.perf_counter()
        RaycastRenderer().render(scene, camera, pose)
        times.append(time.perf_counter() - begin)
    return 1000 * median(times[1:])  # the first one prepares the mesh


def compiled_cache() -> str:
    """Describe the cache of compiled solvers: its folder, and how many functions it holds."""
    from cadalign.compile.files import can_write, kernel_folder

    folder = kernel_folder()
    count = sum(1 for _ in folder.rglob("*.nbi")) if folder.is_dir() else 0
    if count:
        return f"{count} functions kept in {folder}"
    if can_write(folder):
        return f"none yet; they will be kept in {folder}"
    fix = "set NUMBA_CACHE_DIR, or every process compiles anew"
    return f"{folder} cannot be written to; {fix}"


def require_cache() -> None:
    """Refuse to compile ahead where nothing of it could be kept."""
    from cadalign.compile.files import can_write, kernel_folder

    folder = kernel_folder()
    if not can_write(folder):
        fix = "set NUMBA_CACHE_DIR to a folder that can be"
        raise InputError(f"{folder} cannot be written to", where="--compile", fix=fix)


def _usable_cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
