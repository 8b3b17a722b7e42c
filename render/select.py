"""Choosing a renderer by name."""

from __future__ import annotations

import logging

from cadalign.errors import InputError, RenderError
from cadalign.render.frame import Renderer
from cadalign.render.probe import RENDERERS, load_renderer, probe_renderer
from cadalign.render.raycast.shading import Studio

logger = logging.getLogger("cadalign")

AUTO = "auto"

_IMITATIONS = ("llvmpipe", "softpipe", "swrast", "software rasterizer", "swiftshader")


def make_renderer(name: str = AUTO, *, studio: Studio | None = None) -> Renderer:
    """Make a renderer.

    Renderers other than ``raycast`` are tried in a process of their own first, once in the life of
    this one, since broken graphics libraries would take this process down.

    Parameters
    ----------
    name : str
        ``raycast`` works everywhere; ``pyrender`` draws the colour with OpenGL; ``open3d`` casts
        rays with Open3D. ``auto`` takes pyrender where it works on a graphics card, and raycast
        elsewhere: OpenGL imitated on the processor takes as long and smooths edges less, and
        Open3D casts no faster. It says which (logger "cadalign", level info; the renderer's
        ``name``).
    studio : Studio, optional
        The lights.

    Returns
    -------
    Renderer

    Raises
    ------
    InputError
        If there is no renderer of that name.
    RenderError
        If the one asked for does not work here.

    Examples
    --------
    >>> make_renderer("raycast").name
    'raycast'
    """
    if name == AUTO:
        return load_renderer(best_renderer(), studio)
    if name not in RENDERERS:
        known = ", ".join([AUTO, *RENDERERS])
        raise InputError(f"unknown renderer {name!r}", where="renderer", fix=f"known are {known}")
    if name != "raycast":
        found = probe_renderer(name)
        if not found.works:
            raise RenderError(
                f"the renderer does not work here: {found.detail}",
                where=name,
                fix="run `cadalign doctor` to see what is missing, or use the ray-cast renderer",
            )
    return load_renderer(name, studio)


def best_renderer() -> str:
    """The renderer that "auto" takes here, by name; ray casting needs no proof."""
    found = probe_renderer("pyrender")
    if found.works and not _is_imitation(found.detail):
        logger.info("renderer: pyrender (%s)", found.detail)
        return "pyrender"
    if found.works:
        reason = f"OpenGL has no graphics card here but {found.detail}"
    else:
        reason = f"pyrender does not work here: {found.detail}"
    logger.info("renderer: raycast (%s)", reason)
    return "raycast"


def _is_imitation(device: str) -> bool:
    """OpenGL's device is a program that runs on the processor."""
    return any(name in device.lower() for name in _IMITATIONS)
