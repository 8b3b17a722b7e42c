"""Measure the renderers: milliseconds a frame, and of what is done once per mesh.

Prints a table and writes a JSON file. Times are medians; the smallest is beside it, since other
programs may share the machine.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from timeit import repeat
from typing import Any

import numpy as np
import tyro
from common import Benchmark, new_table, write_results
from rich.console import Console

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
class RenderArguments(Benchmark):
    """Measure the renderers' speed at 640 x 480 px on 20,480 triangles."""

    repetitions: int = 15
    """Timed frames per figure; the median counts."""


def main(arguments: RenderArguments) -> None:
    """Run all measurements."""
    camera = Camera.from_fov(640, 480, fov_x=50.0)
    scene = Scene(ball(5))
    rotation = look_at(azimuth=35, elevation=20, distance=3).rotation
    pose = frame_object(scene.bounds, camera, rotation=rotation, fill=0.9)
    rows = [
        timed(name, task, arguments.repetitions)
        for name, task in tasks(scene, camera, pose).items()
    ]
    share = float(cast_geometry(scene, camera, pose).mask.mean())
    title = f"640 x 480 px, 20,480 triangles on {100 * share:.0f} % of the image"
    table = new_table(title, "task", "median ms", "smallest ms", "limit ms")
    for row in rows:
        limit = "" if row["limit"] is None else f"{row['limit']:g}"
        table.add_row(row["task"], f"{row['median']:.2f}", f"{row['smallest']:.2f}", limit)
    Console(width=100).print(table)
    write_results(arguments.out, {"cores": os.cpu_count(), "timings": rows})


def tasks(scene: Scene, camera: Camera, pose: Alignment) -> dict[str, Callable[[], object]]:
    """Everything that is timed, by name."""

    def drawing(renderer: Renderer) -> Callable[[], object]:
        return lambda: renderer.render(scene, camera, pose)

    rng = np.random.default_rng(0)
    keypoints = scene.mesh.vertices[rng.choice(len(scene.mesh.vertices), KEYPOINTS)]
    plain = RaycastRenderer(studio=Studio(occlusion=0))
    found: dict[str, Callable[[], object]] = {
        "once per mesh: ray hierarchy": lambda: Scene(scene.mesh).caster,
        "once per mesh: smooth normals": lambda: Scene(scene.mesh).corner_normals,
        "visibility of 20 keypoints": lambda: visible_keypoints(scene, keypoints, camera, pose),
        "raycast: geometry": lambda: cast_geometry(scene, camera, pose),
        "raycast: colour": drawing(RaycastRenderer()),
        "raycast: colour, no ambient occlusion": drawing(plain),
    }
    for name in ("open3d", "pyrender"):
        try:
            found[f"{name}: colour"] = drawing(make_renderer(name))
        except RenderError as error:
            Console(stderr=True).print(str(error), markup=False)
            continue
        if name == "open3d":
            found["open3d: geometry"] = lambda: cast_geometry(
                scene, camera, pose, caster=scene.open3d_caster
            )
    return found


def timed(name: str, task: Callable[[], object], repetitions: int) -> dict[str, Any]:
    """Times [ms] of a task, after a first run that prepares what is prepared once."""
    task()
    times = [1000 * seconds for seconds in repeat(task, number=1, repeat=repetitions)]
    median = float(np.median(times))
    return {"task": name, "median": median, "smallest": min(times), "limit": LIMITS.get(name)}


if __name__ == "__main__":
    main(tyro.cli(RenderArguments))
