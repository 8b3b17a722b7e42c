"""A pyrender scene with the studio's lights, a camera, and one mesh at a time."""

from __future__ import annotations

from typing import Any
from weakref import ref

import numpy as np
import numpy.typing as npt
import pyrender

from cadalign.arrays import FloatArray, IntArray
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.conventions import OPENGL_AXES, opengl_from_model, opengl_projection
from cadalign.geometry.mesh import Material
from cadalign.render.drawing.canvas import LinearArray, linear_from_srgb
from cadalign.render.raycast.surface import DARKEST, Studio, color_channels
from cadalign.render.scene import Scene

_ROUGHNESS = 0.55
# OpenGL's own number; pyrender exports no name for it.
_TRIANGLES = 4


def gl_meshes(scene: Scene) -> tuple[Any, Any]:
    """Make the `pyrender.Mesh` pair of an opaque scene; done once per scene.

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
    textured = material.texture is not None and mesh.corner_uv is not None
    factor = np.asarray(material.color, dtype=np.float32)
    factor[:3] = linear_from_srgb(factor[:3])
    attributes: list[FloatArray | LinearArray] = [
        scene.triangles[faces],
        scene.corner_normals[faces] * (-1 if turned else 1),
    ]
    if textured and mesh.corner_uv is not None:
        attributes.append(mesh.corner_uv[faces])
    if mesh.vertex_colors is not None:
        colors = mesh.vertex_colors.astype(np.float32)
        colors[:, :3] = _lifted(linear_from_srgb(colors[:, :3]))
        attributes.append(colors[mesh.faces[faces]])
        # Vertex colours take the place of the material's.
        factor = np.ones(4, dtype=np.float32)
    elif not textured:
        factor[:3] = _lifted(factor[:3])
    rows = [_corners(attribute, turned=turned) for attribute in attributes]
    first, indices = _welded(np.concatenate(rows, axis=1))
    kept = iter(attribute[first] for attribute in rows)
    return pyrender.Primitive(
        positions=next(kept),
        normals=next(kept),
        texcoord_0=next(kept) if textured else None,
        color_0=next(kept) if mesh.vertex_colors is not None else None,
        indices=indices.reshape(-1, 3),
        material=pyrender.MetallicRoughnessMaterial(
            alphaMode="OPAQUE",
            baseColorFactor=factor,
            metallicFactor=0.0,
            roughnessFactor=_ROUGHNESS,
            baseColorTexture=_texture(material.texture) if textured else None,
        ),
        mode=_TRIANGLES,
    )


def _welded(rows: LinearArray) -> tuple[IntArray, IntArray]:
    """First occurrence of each distinct row, and the number of each row among these."""
    packed = np.ascontiguousarray(rows).view(np.dtype((np.void, rows.shape[1] * 4))).ravel()
    _, first, number = np.unique(packed, return_index=True, return_inverse=True)
    # In the order of first use, which graphics cards and their imitations like best.
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return first[order], rank[number.ravel()]


def _corners(values: FloatArray | LinearArray, *, turned: bool) -> LinearArray:
    """Values (f, 3, k) of triangles' corners one after the other, (3 f, k) float32."""
    ordered = values[:, ::-1] if turned else values
    return np.ascontiguousarray(ordered.reshape(-1, values.shape[2]), dtype=np.float32)


def _lifted(color: LinearArray) -> LinearArray:
    return np.asarray(DARKEST + (1 - DARKEST) * color, dtype=np.float32)


def _texture(image: npt.NDArray[np.uint8] | None) -> Any:
    """An opaque RGBA texture: rows of other widths than 4 bytes a pixel would be misread."""
    if image is None:
        return None
    rgba = np.full((*image.shape[:2], 4), 255, dtype=np.uint8)
    rgba[:, :, :3] = color_channels(image)
    return pyrender.Texture(source=rgba, source_channels="RGBA")


_NEAR_SHARE = 1e-4
# The clipping planes stand this far off the model, in diagonals.
_CLEARANCE = 0.01
# Half of the sky's light comes from above; the shader gives the ground's to all sides alike.
_SKY_SHARE = 0.5


class WindowCamera(pyrender.Camera):  # type: ignore[misc]
    """A camera with a projection matrix of ours."""

    def __init__(self) -> None:
        super().__init__(znear=0.1, zfar=1.0)
        self.near, self.far = 0.1, 1.0
        self.projection: FloatArray = np.eye(4)

    def get_projection_matrix(self, width: object = None, height: object = None) -> FloatArray:
        """The projection matrix, in pyrender's terms."""
        return self.projection


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
            self._add_light(power, _pose_towards(OPENGL_AXES * direction))
        self._sky = self._add_light(_SKY_SHARE * sky, np.eye(4))
        self._camera = WindowCamera()
        self.scene.add(self._camera, pose=np.eye(4))
        self._nodes: tuple[Any, ...] = ()
        self._shown: ref[Scene] | None = None

    def place(self, scene: Scene, cam_from_model: Alignment, sides: tuple[bool, bool]) -> None:
        """Put a scene's mesh where it is seen; ``sides``: draw front faces, draw back faces."""
        if self._shown is None or self._shown() is not scene:
            for node in self._nodes:
                self.scene.remove_node(node)
            self._nodes = tuple(self.scene.add(mesh) for mesh in scene.derived(gl_meshes))
            self._shown = ref(scene)
        for node, drawn in zip(self._nodes, sides, strict=True):
            self.scene.set_pose(node, opengl_from_model(cam_from_model))
            node.mesh.is_visible = drawn
        up = opengl_from_model(cam_from_model)[:3, 1]
        self.scene.set_pose(self._sky, _pose_towards(up))
        depth = scene.used_vertices @ cam_from_model.linear[2] + cam_from_model.translation[2]
        slack = _CLEARANCE * scene.diagonal * float(cam_from_model.scale.max())
        self._camera.far = float(depth.max()) + slack
        self._camera.near = max(float(depth.min()) - slack, _NEAR_SHARE * self._camera.far)

    def look(self, camera: Camera, window: tuple[int, int, int, int]) -> None:
        """Choose the part of an image that is drawn: left, top, width, height [px]."""
        self._camera.projection = opengl_projection(
            camera, near=self._camera.near, far=self._camera.far, window=window
        )

    def _add_light(self, power: float, pose: FloatArray) -> Any:
        # The shader divides by pi, as a surface spreads its light over the hemisphere.
        light = pyrender.DirectionalLight(color=np.ones(3), intensity=np.pi * power)
        return self.scene.add(light, pose=pose)


def _pose_towards(direction: npt.NDArray[np.float64]) -> FloatArray:
    """A pose (4, 4) whose +z axis, from where pyrender's lights shine, has this direction."""
    axis = direction / np.linalg.norm(direction)
    aside = np.cross([0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [1.0, 0.0, 0.0], axis)
    aside /= np.linalg.norm(aside)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([aside, np.cross(axis, aside), axis])
    return pose
