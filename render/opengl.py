"""Colour by OpenGL, by way of pyrender; geometry, which OpenGL blurs, by ray casting."""

from __future__ import annotations

import atexit
import os
import threading
from contextlib import suppress
from functools import cache, partial
from typing import Any

import numpy as np

from cadalign.errors import RenderError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.render.drawing.canvas import ByteImage
from cadalign.render.raycast.occlusion import darken_corners
from cadalign.render.raycast.posed import Rectangle, pose_scene
from cadalign.render.raycast.renderer import RaycastRenderer, check_samples, geometry_of
from cadalign.render.raycast.surface import Studio
from cadalign.render.scene import Frame, Scene, check_image_size

_LARGEST = 4096  # side of an image that OpenGL draws [px]; larger ones are ray cast
# Sizes of what is drawn are rounded up, so that buffers are not made anew for every frame.
_SIZE_STEP = 64


class PyrenderRenderer:
    """Draws colour with OpenGL under EGL; depth, triangle numbers and normals are ray cast.

    Ray casting draws models with transparent parts, which OpenGL would need sorted, and what a lens
    with distortion sees.
    A process has one OpenGL context, however many of these there are; a forked process must not
    use its parent's, so start pools with "spawn". Where OpenGL's libraries are broken
    the whole process may die: `make_renderer` tries it in another one first.
    """

    name = "pyrender"

    def __init__(self, *, studio: Studio | None) -> None:
        self.studio = studio or Studio()
        self._context = shared_context()
        self._context.check_process()
        # It imports pyrender, which reads the environment that the context has set.
        from cadalign.render.opengl_stage import GlStage

        self._stage = GlStage(self.studio)
        self._fallback = RaycastRenderer(studio=self.studio)

    @property
    def device(self) -> str:
        """Name of the graphics card, or llvmpipe for Mesa on the processor."""
        return self._context.description()

    def __reduce__(self) -> tuple[object, ...]:
        # OpenGL's objects belong to this process; another one makes its own.
        return partial(PyrenderRenderer, studio=self.studio), ()

    def render(
        self, scene: Scene, camera: Camera, cam_from_model: Alignment, *, samples: int = 8
    ) -> Frame:
        """Draw a scene; see `RaycastRenderer.render`.

        OpenGL antialiases with 4 samples whatever ``samples`` says; 1 turns antialiasing off.
        """
        is_bent = camera.is_wide or bool(camera.distortion)
        is_large = max(camera.width, camera.height) > _LARGEST
        if is_bent or is_large or self.drawn_by(scene, samples=samples) != self.name:
            return self._fallback.render(scene, camera, cam_from_model, samples=samples)
        check_samples(samples)
        check_image_size(camera)
        posed = pose_scene(scene, camera, cam_from_model, caster=None)
        geometry = geometry_of(camera, posed)
        color: ByteImage = np.zeros((camera.height, camera.width, 4), dtype=np.uint8)
        if posed is not None:
            block = posed.block.slices
            self._stage.place(scene, cam_from_model, posed.seen_sides(geometry.face_id[block]))
            color[block] = straight_color(self._draw(camera, posed.block))
            darken_corners(color, geometry, posed, self.studio)
        return Frame(geometry.depth, geometry.face_id, geometry.normal, color)

    def drawn_by(self, scene: Scene, *, samples: int) -> str:
        """ "pyrender", or "raycast" for transparent models and frames without antialiasing."""
        return self.name if scene.surface.opaque and samples > 1 else self._fallback.name

    def _draw(self, camera: Camera, block: Rectangle) -> ByteImage:
        """Draw a block of an image, premultiplied (h, w, 4)."""
        width, height = (-(-n // _SIZE_STEP) * _SIZE_STEP for n in (block.width, block.height))
        self._stage.look(camera, (block.left, block.top, width, height))
        drawn = self._context.draw(self._stage.scene, width=width, height=height)
        return drawn[: block.height, : block.width]


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
            raise RenderError(
                f"OpenGL does not start ({type(error).__name__}: {_beginning(error)})",
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
