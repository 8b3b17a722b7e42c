"""A pyrender scene with the studio's lights, a camera, and one mesh at a time."""

from __future__ import annotations

from typing import Any
from weakref import ref

import numpy as np
import numpy.typing as npt
import pyrender

from cadalign.arrays import FloatArray
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.conventions import OPENGL_AXES, opengl_from_model, opengl_projection
from cadalign.render.opengl.mesh import gl_meshes
from cadalign.render.raycast.shading import Studio
from cadalign.render.scene import Scene

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
