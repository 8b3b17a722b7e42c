"""Renderer with pyrender (OpenGL) for the colour and ray casting for the exact geometry.

Only `cadalign.render.probe` imports this module: importing pyrender may fail or crash.
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
from cadalign.errors import RenderError, brief
from cadalign.geometry.alignment import OPENGL_AXES, OPENGL_FLIP
from cadalign.geometry.mesh import Material
from cadalign.geometry.pixels import PIXEL_CENTRE
from cadalign.render.canvas import ByteImage, LinearArray
from cadalign.render.posed_scene import PosedScene, Rectangle
from cadalign.render.raycast import RaycastRenderer, geometry_of
from cadalign.render.scene import Geometry, Scene
from cadalign.render.surface import DARKEST, Studio, linear_colors

# pyrender and PyOpenGL read these when they are imported.
os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
os.environ.setdefault("PYGLET_HEADLESS", "True")
import pyrender
from OpenGL import GL

_ROUGHNESS = 0.55
# OpenGL's constant; pyrender has no name for it.
_TRIANGLES = 4
_NEAR_SHARE = 1e-4
# Distance of the clipping planes from the model, in diagonals.
_CLEARANCE = 0.01
# Half of the sky's light is directional, from above; the rest is ambient.
_SKY_SHARE = 0.5
_LARGEST = 4096  # side [px] of images that OpenGL draws; larger ones are ray cast
# Image sizes are rounded up to multiples of this, so that frames share buffers.
_SIZE_STEP = 64


class PyrenderRenderer(RaycastRenderer):
    """Renderer with OpenGL under EGL; depth, triangle indices and normals are ray cast.

    Models with transparent parts and cameras with lens distortion are ray cast entirely. OpenGL
    antialiases with 4 samples for all ``samples`` above 1. All renderers of a process share one
    OpenGL context. A forked process must not use its parent's context, so start pools with "spawn".
    Broken OpenGL libraries may crash the process: `make_renderer` tests them in a subprocess first.
    """

    name = "pyrender"

    def __init__(self, *, studio: Studio | None) -> None:
        super().__init__(studio=studio)
        self._context = shared_context()
        self._context.check_process()
        self._stage = GlStage(self.studio)

    @property
    def device(self) -> str:
        """Name of the GPU, or llvmpipe for Mesa on the CPU."""
        return self._context.device

    def __reduce__(self) -> tuple[object, ...]:
        # OpenGL objects belong to this process; other processes make their own.
        return partial(PyrenderRenderer, studio=self.studio), ()

    def _paint(self, color: ByteImage, posed: PosedScene, samples: int) -> Geometry:
        camera = posed.camera
        is_bent = camera.is_wide or bool(camera.distortion)
        is_large = max(camera.width, camera.height) > _LARGEST
        if is_bent or is_large or samples == 1 or not posed.scene.surface.opaque:
            return super()._paint(color, posed, samples)
        self._stage.place(posed)
        drawn = cv2.cvtColor(self._draw(posed.block), cv2.COLOR_mRGBA2RGBA)
        color[posed.block.slices] = drawn
        return geometry_of(camera, posed)

    def _draw(self, block: Rectangle) -> ByteImage:
        """Draw a block of an image, premultiplied, (h, w, 4)."""
        width, height = (-(-n // _SIZE_STEP) * _SIZE_STEP for n in (block.width, block.height))
        drawn = self._context.draw(self._stage.scene, width=width, height=height)
        return drawn[: block.height, : block.width]


class GlContext:
    """OpenGL context that draws pyrender scenes; only `shared_context` makes it.

    Two contexts in one process disturb each other, and a context inherited by a fork blocks
    forever.
    """

    def __init__(self) -> None:
        self._renderer = pyrender.OffscreenRenderer(64, 64)  # makes its context current
        name = GL.glGetString(GL.GL_RENDERER)
        self.device = name.decode(errors="replace") if name else "unknown"
        self._flags = pyrender.RenderFlags.RGBA
        self._lock = threading.Lock()
        self._process = os.getpid()
        # Later in the interpreter's shutdown, PyOpenGL would print errors.
        atexit.register(self._close)

    def _close(self) -> None:
        if os.getpid() == self._process:
            with suppress(Exception):
                self._renderer.delete()

    def check_process(self) -> None:
        """Raise RenderError in a process forked from the one that made the context."""
        if os.getpid() != self._process:
            raise RenderError(
                "this process was forked from one that draws with OpenGL",
                where="pyrender",
                fix='start worker processes with "spawn", or use the ray-cast renderer in them',
            )

    def draw(self, scene: Any, *, width: int, height: int) -> ByteImage:
        """Draw a `pyrender.Scene`; returns (height, width, 4) uint8, premultiplied."""
        self.check_process()
        with self._lock:
            self._renderer.viewport_width = width
            self._renderer.viewport_height = height
            try:
                color, _ = self._renderer.render(scene, flags=self._flags)
            except Exception as error:  # PyOpenGL raises errors of many types
                raise RenderError(
                    f"OpenGL failed to draw ({type(error).__name__}: {brief(error)})",
                    where="pyrender",
                    fix="use the ray-cast renderer",
                ) from None
        return np.asarray(color, dtype=np.uint8)


@cache
def shared_context() -> GlContext:
    """The context of this process."""
    return GlContext()


# Meshes, lights and the camera --------------------------------------------------------------------


def gl_meshes(scene: Scene) -> tuple[Any, Any]:
    """Make two `pyrender.Mesh` of an opaque scene, with opposite windings.

    pyrender's shader lights only one side of a triangle. So the second mesh has every triangle with
    reversed winding and normals, and OpenGL culls the back faces of both: the two sides look alike,
    as with ray casting. Of coincident triangles, the one wound towards the viewer is kept.
    """
    alike, opposite = scene.coincident_faces
    own = np.arange(len(alike))
    first = alike == own
    sides = (np.flatnonzero(first), np.flatnonzero(first & (opposite == own)))
    return _mesh(scene, sides[0], reverse=False), _mesh(scene, sides[1], reverse=True)


def _mesh(scene: Scene, faces: IntArray, *, reverse: bool) -> Any:
    primitives = []
    for number, material in enumerate(scene.mesh.materials):
        chosen = faces[scene.mesh.face_material[faces] == number]
        if len(chosen):
            primitives.append(_primitive(scene, material, chosen, reverse=reverse))
    return pyrender.Mesh(primitives=primitives)


def _primitive(scene: Scene, material: Material, faces: IntArray, *, reverse: bool) -> Any:
    mesh = scene.mesh
    texture = None if mesh.corner_uv is None else material.texture
    (factor,) = linear_colors(np.array([material.color]))
    colors: LinearArray | None = None
    if mesh.vertex_colors is not None:
        # Vertex colours replace the material's colour.
        colors, factor = linear_colors(mesh.vertex_colors), np.ones(4, dtype=np.float32)
        colors[:, :3] = _lift_black(colors[:, :3])
    elif texture is None:
        factor[:3] = _lift_black(factor[:3])

    def corners(values: npt.NDArray[Any] | None) -> LinearArray | None:
        """Stack values (m, 3, k) of the chosen triangles' corners, (3 f, k) float32."""
        if values is None:
            return None
        chosen = values[faces][:, ::-1] if reverse else values[faces]
        return np.ascontiguousarray(chosen.reshape(-1, values.shape[2]), dtype=np.float32)

    return pyrender.Primitive(
        positions=corners(scene.triangles),
        normals=corners(scene.corner_normals * (-1 if reverse else 1)),
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


def _lift_black(color: LinearArray) -> LinearArray:
    return np.asarray(DARKEST + (1 - DARKEST) * color, dtype=np.float32)


def _texture(image: npt.NDArray[np.uint8]) -> Any:
    """Make an opaque RGBA texture: OpenGL misreads rows that are not multiples of 4 bytes."""
    rgba = np.full((*image.shape[:2], 4), 255, dtype=np.uint8)
    rgba[:, :, :3] = image[:, :, :3]
    return pyrender.Texture(source=rgba, source_channels="RGBA")


class GlStage:
    """A `pyrender.Scene` with fixed lights and camera, and the mesh that was drawn last.

    OpenGL's lights have no size, so shading changes more sharply than in ray-cast frames.
    """

    def __init__(self, studio: Studio) -> None:
        sky = studio.sky_power - studio.ground_power
        # Large lights reach around the object; here that part is ambient light.
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

    def place(self, posed: PosedScene) -> None:
        """Pose a scene's mesh for its block of the image."""
        scene, camera, cam_from_model = posed.scene, posed.camera, posed.alignment
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
        lens.cx = camera.cx + PIXEL_CENTRE - posed.block.left
        lens.cy = camera.cy + PIXEL_CENTRE - posed.block.top

    def _add_light(self, power: float) -> Any:
        # The shader divides by pi, as for a Lambertian surface.
        return self.scene.add(pyrender.DirectionalLight(color=np.ones(3), intensity=np.pi * power))

    def _turn(self, light: Any, direction: FloatArray) -> None:
        """Rotate a light to shine from a direction (3,), its +z axis."""
        pose = align_vectors(np.array([0.0, 0.0, 1.0]), direction)  # type: ignore[no-untyped-call]
        self.scene.set_pose(light, pose)
