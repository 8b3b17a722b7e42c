"""Trying a renderer in a process of its own: broken graphics libraries kill the process."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version

import numpy as np

from cadalign.errors import CadalignError, InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.render.frame import Renderer
from cadalign.render.raycast.shading import Studio
from cadalign.render.scene import Scene

RENDERERS: dict[str, str] = {
    "pyrender": "cadalign.render.opengl.renderer:PyrenderRenderer",
    "open3d": "cadalign.render.open3d.renderer:Open3DRenderer",
    "raycast": "cadalign.render.raycast.renderer:RaycastRenderer",
}
"""Module and class of each renderer."""

_TIMEOUT = 120
_TIMED_FRAMES = 5
_PACKAGES = {
    "pyrender": ("pyrender2", "PyOpenGL"),
    "open3d": ("open3d",),
    "raycast": ("trimesh", "embreex"),
}
# The last line of the child's output begins so; libraries write what they like before it.
_MARK = "cadalign-probe "
_CHILD = (
    "import sys, json; sys.path[:] = json.loads(sys.argv[1]); "
    "from cadalign.render.probe import report; report(sys.argv[2], timed=sys.argv[3] == 'timed')"
)


@dataclass(frozen=True)
class Probe:
    """Result of trying a renderer.

    Parameters
    ----------
    name : str
        The renderer.
    works : bool
    detail : str
        Device that draws, or the reason of the failure.
    versions : str
        Versions of the packages that it needs.
    milliseconds : float, optional
        The median time of a frame, 640 x 480 px with 20,480 triangles.
    """

    name: str
    works: bool
    detail: str
    versions: str
    milliseconds: float | None = None


def probe_renderer(name: str, *, timed: bool = False) -> Probe:
    """Try a renderer in a process of its own; the result is kept for the life of this one.

    Parameters
    ----------
    name : str
        One of `RENDERERS`.
    timed : bool
        Measure the time of a frame too, which takes some seconds.

    Raises
    ------
    InputError
        If there is no such renderer.
    """
    if name not in RENDERERS:
        raise InputError(
            f"unknown renderer {name!r}", where="renderer", fix=f"known are {', '.join(RENDERERS)}"
        )
    return _probe(name, timed)


@cache
def _probe(name: str, timed: bool) -> Probe:
    arguments = [json.dumps(sys.path), name, "timed" if timed else "untimed"]
    try:
        child = subprocess.run(
            [sys.executable, "-c", _CHILD, *arguments],
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_TIMEOUT,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return Probe(name, False, f"no frame within {_TIMEOUT} seconds", _versions(name))
    except OSError as error:
        return Probe(name, False, f"no process to try it in ({error})", _versions(name))
    for line in reversed(child.stdout.splitlines()):
        if line.startswith(_MARK):
            return Probe(**json.loads(line.removeprefix(_MARK)))
    if child.returncode < 0:
        reason = f"the process was killed by signal {-child.returncode}"
    else:
        reason = (child.stderr.strip().splitlines() or ["no message"])[-1]
    return Probe(name, False, reason, _versions(name))


def report(name: str, *, timed: bool) -> None:
    """Try a renderer in this process and write the result to standard output, for the parent."""
    try:
        result = _try(name, timed=timed)
    except Exception as error:  # whatever it is, the parent wants to know
        reason = error.what if isinstance(error, CadalignError) else str(error)
        result = Probe(name, False, reason or type(error).__name__, _versions(name))
    sys.stdout.write(f"\n{_MARK}{json.dumps(asdict(result))}\n")
    sys.stdout.flush()


def load_renderer(name: str, studio: Studio | None) -> Renderer:
    """Make a renderer in this process, even if that takes the process down."""
    module, _, kind = RENDERERS[name].partition(":")
    renderer: Renderer = getattr(import_module(module), kind)(studio=studio)
    return renderer


def _try(name: str, *, timed: bool) -> Probe:
    renderer = load_renderer(name, None)
    mesh = ball(5 if timed else 1)
    camera = Camera.from_fov(*((640, 480) if timed else (64, 48)), fov_x=50.0)
    scene, pose = Scene(mesh), Alignment(np.eye(3), np.array([0, 0, 4.5]), np.ones(3))
    frame = renderer.render(scene, camera, pose)
    seen = float((frame.color[:, :, 3] > 127).mean())
    if not (frame.mask.any() and abs(seen - frame.mask.mean()) < 0.1):
        return Probe(name, False, "it draws a ball wrongly", _versions(name))
    milliseconds = None
    if timed:
        times = []
        for _ in range(_TIMED_FRAMES):
            begin = time.perf_counter()
            renderer.render(scene, camera, pose)
            times.append(time.perf_counter() - begin)
        milliseconds = 1000 * float(np.median(times))
    device = str(getattr(renderer, "device", "processor"))
    return Probe(name, True, device, _versions(name), milliseconds)


def ball(subdivisions: int) -> Mesh:
    """A ball of radius 1 with 20 * 4**subdivisions triangles."""
    import trimesh

    shape = trimesh.creation.icosphere(subdivisions=subdivisions)
    return Mesh(np.array(shape.vertices), np.array(shape.faces))


def _versions(name: str) -> str:
    found = []
    for package in _PACKAGES[name]:
        try:
            found.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            found.append(f"{package} missing")
    return ", ".join(found)
