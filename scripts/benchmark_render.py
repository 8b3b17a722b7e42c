"""Measure the renderers: milliseconds a frame, and of what is done once per mesh.

Prints a table and writes a JSON file. Times are medians; the smallest is beside it, since other
programs may share the machine.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from cadalign import Alignment, Camera
from cadalign.errors import RenderError
from cadalign.render import (
    RaycastRenderer,
    Renderer,
    Scene,
    Studio,
    cast_geometry,
    frame_object,
    look_at,
    make_renderer,
    visible_keypoints,
)
from cadalign.render.probe import ball

KEYPOINTS = 20
# The largest allowed medians [ms], on two cores.
LIMITS = {
    "raycast: geometry": 40.0,
    "raycast: colour": 150.0,
    "pyrender: colour": 100.0,
    "visibility of 20 keypoints": 1.0,
}


@dataclass
class Arguments:
    """Measure the renderers' speed at 640 x 480 px on 20,480 triangles."""

    out: Path = Path("bench/render.json")
    """JSON file to write."""
    repetitions: int = 15
    """Timed frames per figure; the median counts."""


@dataclass(frozen=True)
class Timing:
    """Times of one task [ms]."""

    task: str
    median: float
    smallest: float
    limit: float | None


def main(arguments: Arguments) -> None:
    """Run all measurements."""
    camera = Camera.from_fov(640, 480, fov_x=50.0)
    scene = Scene(ball(5))
    rotation = look_at(azimuth=35, elevation=20, distance=3).rotation
    pose = frame_object(scene.bounds, camera, rotation=rotation, fill=0.9)
    timings = measure(scene, camera, pose, arguments.repetitions)
    print_table(timings, share=float(cast_geometry(scene, camera, pose).mask.mean()))
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    rows = {"cores": os.cpu_count(), "timings": [asdict(timing) for timing in timings]}
    arguments.out.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")


def measure(scene: Scene, camera: Camera, pose: Alignment, repetitions: int) -> list[Timing]:
    """Time everything, each after a first run that prepares what is prepared once."""
    rng = np.random.default_rng(0)
    keypoints = scene.mesh.vertices[rng.choice(len(scene.mesh.vertices), KEYPOINTS)]
    tasks: dict[str, Callable[[], object]] = {
        "once per mesh: ray hierarchy": lambda: Scene(scene.mesh).caster,
        "once per mesh: smooth normals": lambda: Scene(scene.mesh).corner_normals,
        "visibility of 20 keypoints": lambda: visible_keypoints(scene, keypoints, camera, pose),
        "raycast: geometry": lambda: cast_geometry(scene, camera, pose),
    }
    plain = RaycastRenderer(studio=Studio(occlusion=0))
    tasks["raycast: colour"] = _drawing(RaycastRenderer(), scene, camera, pose)
    tasks["raycast: colour, no ambient occlusion"] = _drawing(plain, scene, camera, pose)
    for name in ("open3d", "pyrender"):
        try:
            tasks[f"{name}: colour"] = _drawing(make_renderer(name), scene, camera, pose)
        except RenderError as error:
            Console(stderr=True).print(str(error), markup=False)
            continue
        if name == "open3d":
            tasks["open3d: geometry"] = lambda: cast_geometry(
                scene, camera, pose, caster=scene.open3d_caster
            )
    return [_timed(name, task, repetitions) for name, task in tasks.items()]


def print_table(timings: list[Timing], *, share: float) -> None:
    """Print the times beside what is allowed."""
    table = Table(title=f"640 x 480 px, 20,480 triangles on {100 * share:.0f} % of the image")
    table.add_column("task")
    for name in ("median ms", "smallest ms", "limit ms"):
        table.add_column(name, justify="right")
    for timing in timings:
        limit = "" if timing.limit is None else f"{timing.limit:g}"
        table.add_row(timing.task, f"{timing.median:.2f}", f"{timing.smallest:.2f}", limit)
    Console(width=100).print(table)


def _drawing(
    renderer: Renderer, scene: Scene, camera: Camera, pose: Alignment
) -> Callable[[], object]:
    return lambda: renderer.render(scene, camera, pose)


def _timed(name: str, task: Callable[[], object], repetitions: int) -> Timing:
    task()
    times = []
    for _ in range(repetitions):
        begin = time.perf_counter()
        task()
        times.append(1000 * (time.perf_counter() - begin))
    return Timing(name, float(np.median(times)), min(times), LIMITS.get(name))


if __name__ == "__main__":
    main(tyro.cli(Arguments))
