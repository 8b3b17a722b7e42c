"""The one OpenGL context of a process, under EGL, without a display."""

from __future__ import annotations

import atexit
import os
import threading
from contextlib import suppress
from functools import cache
from typing import Any

import numpy as np

from cadalign.errors import RenderError
from cadalign.render.drawing.color import ByteImage
from cadalign.render.probe import missing_libraries


class GlContext:
    """Draws pyrender scenes; make it with `shared_context` alone.

    Two contexts in one process disturb each other, and one that a process inherits from its parent
    blocks forever.
    """

    def __init__(self) -> None:
        # pyrender and PyOpenGL read these when they are imported.
        os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
        os.environ.setdefault("PYGLET_HEADLESS", "True")
        try:
            import pyrender

            self._renderer = pyrender.OffscreenRenderer(64, 64)
        except Exception as error:  # PyOpenGL and ctypes raise what they like
            missing = missing_libraries("pyrender")
            reason = (
                f"{' and '.join(missing)} cannot be loaded"
                if missing
                else f"{type(error).__name__}: {_beginning(error)}"
            )
            raise RenderError(
                f"OpenGL does not start ({reason})",
                where="pyrender",
                fix="run `cadalign doctor` to see what is missing, or use the ray-cast renderer",
            ) from None
        self._flags = pyrender.RenderFlags.RGBA
        self._lock = threading.Lock()
        self._process = os.getpid()
        # Left to the interpreter's end, PyOpenGL would complain that half of it is gone.
        atexit.register(self._close)

    def _close(self) -> None:
        if os.getpid() == self._process:
            with suppress(Exception):
                self._renderer.delete()

    def check_process(self) -> None:
        """Refuse a process that was forked from the one that made the context."""
        if os.getpid() != self._process:
            raise RenderError(
                "this process was forked from one that draws with OpenGL",
                where="pyrender",
                fix='start worker processes with "spawn", or use the ray-cast renderer in them',
            )

    def draw(self, scene: Any, *, width: int, height: int) -> ByteImage:
        """Draw a `pyrender.Scene`; (height, width, 4) uint8, red, green and blue premultiplied."""
        self.check_process()
        with self._lock:
            self._renderer.viewport_width = width
            self._renderer.viewport_height = height
            try:
                color, _ = self._renderer.render(scene, flags=self._flags)
            except Exception as error:  # PyOpenGL's errors have no common base with ours
                raise RenderError(
                    f"OpenGL failed to draw ({type(error).__name__}: {_beginning(error)})",
                    where="pyrender",
                    fix="use the ray-cast renderer",
                ) from None
        return np.asarray(color, dtype=np.uint8)

    def description(self) -> str:
        """Name of the graphics card, or of the software that imitates one."""
        from OpenGL import GL

        platform = self._renderer._platform
        with self._lock:
            platform.make_current()
            name = GL.glGetString(GL.GL_RENDERER)
            platform.make_uncurrent()
        return name.decode(errors="replace") if name else "unknown"


@cache
def shared_context() -> GlContext:
    """The process's context, made on the first call; a `RenderError` if OpenGL does not start."""
    return GlContext()


def straight_color(premultiplied: ByteImage) -> ByteImage:
    """Divide colours (h, w, 4) by their opacity, where that is neither none nor full."""
    result = np.array(premultiplied)
    opacity = result[:, :, 3]
    partial = (opacity > 0) & (opacity < 255)
    share = opacity[partial, None] / np.float32(255)
    result[partial, :3] = np.minimum(result[partial, :3] / share + 0.5, 255).astype(np.uint8)
    return result


def _beginning(error: Exception) -> str:
    """The beginning of a message on one line; PyOpenGL's go on for dozens."""
    return " ".join(str(error).split())[:160] or "no reason given"
