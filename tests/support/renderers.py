"""Renderers, as far as they work on this machine."""

from __future__ import annotations

import pytest

from cadalign.render import Renderer, make_renderer
from cadalign.render.probe import probe_renderer


def renderer_or_skip(name: str) -> Renderer:
    """A renderer; the test is skipped where it does not work."""
    found = probe_renderer(name)
    if not found.works:
        pytest.skip(f"{name} does not work here: {found.detail}")
    return make_renderer(name)
