"""Renderers by name; they are tested in a subprocess."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import asdict, dataclass
from functools import cache
from importlib import import_module

import numpy as np

from cadalign.errors import RenderError, brief, unknown_name
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.render.raycast import RaycastRenderer
from cadalign.render.scene import Scene
from cadalign.render.surface import Studio

RENDERERS: dict[str, str] = {
    "pyrender": "cadalign.render.opengl:PyrenderRenderer",
    "open3d": "cadalign.render.raycast:Open3DRenderer",
    "raycast": "cadalign.render.raycast:RaycastRenderer",
}
"""Module and class of each renderer."""

_TIMEOUT = 120
REMEDIES = {
    "pyrender": "pip install pyrender2; apt-get install libegl1 libgl1 libgl1-mesa-dri",
    "open3d": "pip install 'cadalign[open3d]'; apt-get install libx11-6 libgl1 libgomp1",
    "raycast": "pip install --force-reinstall embreex trimesh",
}
"""Commands that install what a renderer needs, on Debian."""
# Prefix of the subprocess's last line of output; libraries may write other lines before it.
_MARK = "cadalign-probe "
_CHILD = (
    "import sys, json; sys.path[:] = json.loads(sys.argv[1]); "
    "from cadalign.render.probe import report; report(sys.argv[2])"
)


@dataclass(frozen=True)
class Probe:
    """Result of testing a renderer."""

    name: str
    """Name of the renderer."""
    works: bool
    detail: str
    """The device, or the reason of the failure."""


@cache
def probe_renderer(name: str) -> Probe:
    """Test a renderer in a subprocess; the result is cached.

    Parameters
    ----------
    name : str
        A key of `RENDERERS`.

    Raises
    ------
    InputError
        If the name is unknown.
    """
    if name not in RENDERERS:
        raise unknown_name("renderer", name, RENDERERS)
    arguments = [json.dumps(sys.path), name]
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
        return Probe(name, False, f"no frame within {_TIMEOUT} seconds")
    except OSError as error:
        return Probe(name, False, f"the test process cannot be started ({error})")
    for line in reversed(child.stdout.splitlines()):
        if line.startswith(_MARK):
            return Probe(**json.loads(line.removeprefix(_MARK)))
    if child.returncode < 0:
        reason = f"the process was killed by signal {-child.returncode}"
    else:
        reason = (child.stderr.strip().splitlines() or ["no message"])[-1]
    return Probe(name, False, reason)


def report(name: str) -> None:
    """Test a renderer in this process and write the result to standard output."""
    try:
        result = _try(name)
    except Exception as error:  # the parent process reports any error
        result = Probe(name, False, f"{type(error).__name__}: {brief(error)}")
    sys.stdout.write(f"\n{_MARK}{json.dumps(asdict(result))}\n")
    sys.stdout.flush()


def load_renderer(name: str, studio: Studio | None) -> RaycastRenderer:
    """Make a renderer without a test, which may crash the process."""
    module, _, kind = RENDERERS[name].partition(":")
    renderer: RaycastRenderer = getattr(import_module(module), kind)(studio=studio)
    return renderer


def _try(name: str) -> Probe:
    renderer = load_renderer(name, None)
    corners = np.array([[-1.0, 0, 0], [0, 1, 0], [1, 0, 0], [0, -2, 0]])
    kite = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    camera = Camera.from_fov(64, 48, fov_x=50.0)
    pose = Alignment(np.eye(3), np.array([0, 0, 4.5]), np.ones(3))
    frame = renderer.render(Scene(kite), camera, pose)
    seen = float((frame.color[:, :, 3] > 127).mean())
    if not (frame.mask.any() and abs(seen - frame.mask.mean()) < 0.1):
        return Probe(name, False, "it renders a test image incorrectly")
    return Probe(name, True, str(getattr(renderer, "device", "processor")))


def make_renderer(name: str = "raycast", *, studio: Studio | None = None) -> RaycastRenderer:
    """Make a renderer.

    Renderers other than ``raycast`` are first tested in a subprocess, since broken graphics
    libraries would crash this process.

    Parameters
    ----------
    name : str
        ``raycast`` works everywhere; ``pyrender`` draws the colour with OpenGL; ``open3d`` casts
        rays with Open3D.
    studio : Studio, optional
        The lights.

    Returns
    -------
    RaycastRenderer

    Raises
    ------
    InputError
        If the name is unknown.
    RenderError
        If the renderer does not work on this machine.

    Examples
    --------
    >>> make_renderer("raycast").name
    'raycast'
    """
    if name != "raycast":
        found = probe_renderer(name)
        if not found.works:
            raise RenderError(
                f"the renderer does not work here: {found.detail}",
                where=name,
                fix="run `cadalign doctor` to see what is missing, or use the ray-cast renderer",
            )
    return load_renderer(name, studio)
