"""Renderers that work on this machine, and a ball."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from cadalign import Mesh
from cadalign.render import RaycastRenderer, make_renderer
from cadalign.render.probe import probe_renderer


def skip_unless_works(name: str) -> None:
    """Skip the test if a renderer does not work; ray casting always works."""
    if name == "raycast":
        return
    found = probe_renderer(name)
    if not found.works:
        pytest.skip(f"{name} does not work here: {found.detail}")


def renderer_or_skip(name: str) -> RaycastRenderer:
    """Make a renderer; skips the test if it does not work."""
    skip_unless_works(name)
    return make_renderer(name)


def ball(subdivisions: int) -> Mesh:
    """A ball of radius 1 with 20 * 4**subdivisions triangles."""
    shape = trimesh.creation.icosphere(subdivisions=subdivisions)
    return Mesh(np.array(shape.vertices), np.array(shape.faces))
