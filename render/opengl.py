"""Colour by OpenGL, by way of pyrender; geometry, which OpenGL blurs, by ray casting.

Importing this module loads pyrender, which may fail in many ways: `cadalign.render.probe` does.
"""

from __future__ import annotations

import atexit
import os
import threading
from contextlib import suppress
from functools import cache, partial
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from trimesh.geometry import align_vectors

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import RenderError
from cadalign.geometry.alignment import OPENGL_AXES, OPENGL_FLIP, Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Material
from cadalign.geometry.pixels import PIXEL_CENTRE
from cadalign.render.canvas import ByteImage, LinearArray
from cadalign.render.posed import Rectangle, pose_scene
from cadalign.render.raycast import (
    RaycastRenderer,
    check_samples,
    darken_corners,
    geometry_of,
)
from cadalign.render.scene import Frame, Scene, check_image_size
from cadalign.render.surface import DARKEST, Studio, linear_colors

# pyrender and PyOpenGL read these when they are imported.
os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
os.environ.setdefault("PYGLET_HEADLESS", "True")
import pyrender
from OpenGL import GL

_ROUGHNESS = 0.55
# OpenGL's own number; pyrender exports no name for it.
_TRIANGLES = 4
_NEAR_SHARE = 1e-4
# The clipping planes stand this far off the model, in diagonals.
_CLEARANCE = 0.01
# Half of the sky's light comes from above; the shader gives the ground's to all sides alike.
_SKY_SHARE = 0.5
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
        self._stage = GlStage(self.studio)
        self._fallback = RaycastRenderer(studio=self.studio)

    @property
    def device(self) -> str:
        """Name of the graphics card, or llvmpipe for Mesa on the processor."""
        return self._context.device

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
        if is_bent or is_large or samples == 1 or not scene.surface.opaque:
            return self._fallback.render(scene, camera, cam_from_model, samples=samples)
        check_samples(samples)
        check_image_size(camera)
        posed = pose_scene(scene, camera, cam_from_model)
        geometry = geometry_of(camera, posed)
        color: ByteImage = np.zeros((camera.height, camera.width, 4), dtype=np.uint8)
        if posed is not None:
            block = posed.block.slices
            self._stage.place(scene, camera, cam_from_model, (posed.block.left, posed.block.top))
            color[block] = cv2.cvtColor(self._draw(posed.block), cv2.COLOR_mRGBA2RGBA)
            darken_corners(color, geometry, posed, self.studio)
        return Frame(geometry.depth, geometry.face_id, geometry.normal, color)

    def _draw(self, block: Rectangle) -> ByteImage:
        """Draw a block of an image, premultiplied (h, w, 4)."""
        width, height = (-(-n // _SIZE_STEP) * _SIZE_STEP for n in (block.width, block.height))
        drawn = self._context.draw(self._stage.scene, width=width, height=height)
        return drawn[: block.height, : block.width]


class GlContext:
    """Draws pyrender scenes; make it with `shared_context` alone.

    Two contexts in one process disturb each other, and one that a process inherits from its parent
    blocks forever.
    """

    def __init__(self) -> None:
        try:
            self._renderer = pyrender.OffscreenRenderer(64, 64)  # its context is the current one
            name = GL.glGetString(GL.GL_RENDERER)
        except Exception as error:  # PyOpenGL and ctypes raise what they like
            raise RenderError(
                f"OpenGL does not start ({type(error).__name__}: {_beginning(error)})",
                where="pyrender",
                fix="run `cadalign doctor` to see what is missing, or use the ray-cast renderer",
            ) from None
        self.device = name.decode(errors="replace") if name else "unknown"
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


@cache
def shared_context() -> GlContext:
    """The process's context, made on the first call; a `RenderError` if OpenGL does not start."""
    return GlContext()


def _beginning(error: Exception) -> str:
    """The beginning of a message on one line; PyOpenGL's go on for dozens."""
    return " ".join(str(error).split())[:160] or "no reason given"


# Meshes, lights and the camera --------------------------------------------------------------------


def gl_meshes(scene: Scene) -> tuple[Any, Any]:
    """Make the `pyrender.Mesh` pair of an opaque scene.

    Its shader lights one side of a triangle only. So every triangle is given twice, in one mesh as
    it is and in the other turned round with its normals, and OpenGL culls what is turned away: the
    two sides look alike, as with ray casting. Where triangles coincide, the one wound towards
    the viewer is kept.
    """
    alike, opposite = scene.coincident_faces
    own = np.arange(len(alike))
    first = alike == own
    sides = (np.flatnonzero(first), np.flatnonzero(first & (opposite == own)))
    return _mesh(scene, sides[0], turned=False), _mesh(scene, sides[1], turned=True)


def _mesh(scene: Scene, faces: IntArray, *, turned: bool) -> Any:
    primitives = []
    for number, material in enumerate(scene.mesh.materials):
        chosen = faces[scene.mesh.face_material[faces] == number]
        if len(chosen):
            primitives.append(_primitive(scene, material, chosen, turned=turned))
    return pyrender.Mesh(primitives=primitives)


def _primitive(scene: Scene, material: Material, faces: IntArray, *, turned: bool) -> Any:
    mesh = scene.mesh
    texture = None if mesh.corner_uv is None else material.texture
    (factor,) = linear_colors(np.array([material.color]))
    colors: LinearArray | None = None
    if mesh.vertex_colors is not None:
        # They take the place of the material's colour.
        colors, factor = linear_colors(mesh.vertex_colors), np.ones(4, dtype=np.float32)
        colors[:, :3] = _lifted(colors[:, :3])
    elif texture is None:
        factor[:3] = _lifted(factor[:3])

    def corners(values: npt.NDArray[Any] | None) -> LinearArray | None:
        """Values (m, 3, k) of triangles' corners one after the other, (3 f, k) float32."""
        if values is None:
            return None
        chosen = values[faces][:, ::-1] if turned else values[faces]
        return np.ascontiguousarray(chosen.reshape(-1, values.shape[2]), dtype=np.float32)

    return pyrender.Primitive(
        positions=corners(scene.triangles),
        normals=corners(scene.corner_normals * (-1 if turned else 1)),
        texcoord_0=None if texture is None else corners(mesh.corner_uv),
        color_0=None if colors is None else corners(colors[mesh.faces]),
        material=pyrender.MetallicRoughnessMaterial(
            alphaMode="OPAQUE",
            baseColorFactor=factor,
            metallicFactor=0.0,
            roughnessFactor=_ROUGHNESS,
            baseColorTexture=None if texture is None else _texture(texture),
        ),
        mode=_TRIANGLES,
    )


def _lifted(color: LinearArray) -> LinearArray:
    return np.asarray(DARKEST + (1 - DARKEST) * color, dtype=np.float32)


def _texture(image: npt.NDArray[np.uint8]) -> Any:
    """An opaque RGBA texture: rows of other widths than 4 bytes a pixel would be misread."""
    rgba = np.full((*image.shape[:2], 4), 255, dtype=np.uint8)
    rgba[:, :, :3] = image[:, :, :3]
    return pyrender.Texture(source=rgba, source_channels="RGBA")


class GlStage:
    """A `pyrender.Scene`: lights and camera that stand still, a mesh that stays loaded.

    OpenGL's lights have no size, so shadows' edges are harder than in ray-cast frames.
    """

    def __init__(self, studio: Studio) -> None:
        sky = studio.sky_power - studio.ground_power
        # A light of some size reaches round the object; here that part comes from everywhere.
        around = 0.5 * studio.wrap * (studio.key_power + studio.fill_power)
        ambient = np.full(3, studio.ground_power + (1 - _SKY_SHARE) * sky + around)
        self.scene: Any = pyrender.Scene(bg_color=np.zeros(4), ambient_light=ambient)
        for direction, power in ((studio.key, studio.key_power), (studio.fill, studio.fill_power)):
            self._turn(self._add_light(power), OPENGL_AXES * direction)
        self._sky = self._add_light(_SKY_SHARE * sky)
        self._camera = pyrender.IntrinsicsCamera(1, 1, 0, 0)
        self.scene.add(self._camera, pose=np.eye(4))
        self._shown: Scene | None = None
        self._nodes: tuple[Any, ...] = ()

    def place(
        self, scene: Scene, camera: Camera, cam_from_model: Alignment, corner: tuple[int, int]
    ) -> None:
        """Put a scene's mesh where it is seen, in the part of an image that begins at a pixel."""
        if scene is not self._shown:
            for node in self._nodes:
                self.scene.remove_node(node)
            self._nodes = tuple(self.scene.add(mesh) for mesh in gl_meshes(scene))
            self._shown = scene
        pose = OPENGL_FLIP @ cam_from_model.cam_from_model
        for node in self._nodes:
            self.scene.set_pose(node, pose)
        self._turn(self._sky, pose[:3, 1])
        depth = scene.used_vertices @ cam_from_model.linear[2] + cam_from_model.translation[2]
        slack = _CLEARANCE * scene.diagonal * float(cam_from_model.scale.max())
        lens = self._camera
        lens.zfar = float(depth.max()) + slack
        lens.znear = max(float(depth.min()) - slack, _NEAR_SHARE * lens.zfar)
        lens.fx, lens.fy = camera.fx, camera.fy
        lens.cx = camera.cx + PIXEL_CENTRE - corner[0]
        lens.cy = camera.cy + PIXEL_CENTRE - corner[1]

    def _add_light(self, power: float) -> Any:
        # The shader divides by pi, as a surface spreads its light over the hemisphere.
        return self.scene.add(pyrender.DirectionalLight(color=np.ones(3), intensity=np.pi * power))

    def _turn(self, light: Any, direction: FloatArray) -> None:
        """Let a light shine from a direction (3,): along its +z axis."""
        pose = align_vectors(np.array([0.0, 0.0, 1.0]), direction)  # type: ignore[no-untyped-call]
        self.scene.set_pose(light, pose)
