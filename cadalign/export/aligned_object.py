"""An aligned object as all export formats take it: its shape, its views, and the frames."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from cadalign.arrays import FloatArray, as_floats, as_points, as_positive
from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment, extent
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.rotations import nearest_rigid
from cadalign.io.images import ByteImage, read_image

Frame = Literal["camera", "rig", "world", "model"]
FRAMES: tuple[Frame, ...] = get_args(Frame)

_SAME = 1e-6


@dataclass(frozen=True, eq=False)
class ExportView:
    """One photo of the object.

    Parameters
    ----------
    camera : Camera
    cam_from_model : Alignment
        Pose and stretch in this camera.
    image : path or (h, w, 3) uint8, optional
        The photo.
    points_2d : (n, 2) float, optional
        Keypoints observed in it [px].
    ids : tuple of n int or str
        Which keypoints of the object these are.
    """

    camera: Camera
    cam_from_model: Alignment
    image: Path | str | ByteImage | None = None
    points_2d: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    ids: tuple[Hashable, ...] = ()

    def __post_init__(self) -> None:
        self.camera.require_focal()
        if isinstance(self.image, str):
            object.__setattr__(self, "image", Path(self.image))
        points = as_floats(self.points_2d, name="points_2d", shape=(len(self.ids), 2))
        object.__setattr__(self, "points_2d", points)

    def read_image(self) -> ByteImage | None:
        """The photo's pixels, None where there is none.

        Raises
        ------
        DataError
            If it cannot be read, or has another size than the camera.
        """
        if isinstance(self.image, Path):
            return read_image(self.image, self.camera)
        if isinstance(self.image, np.ndarray) and self.image.shape[:2] != (
            self.camera.height,
            self.camera.width,
        ):
            size = f"{self.image.shape[1]} x {self.image.shape[0]}"
            what = f"the image is {size}, the camera {self.camera.width} x {self.camera.height}"
            raise InputError(what, where="image", fix="give the camera of this image")
        return None if self.image is None else np.asarray(self.image, dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class AlignedObject:
    """An object with its estimated pose, stretch and shape.

    Parameters
    ----------
    views : tuple of ExportView
        Its photos, at least one. All have the same stretch.
    points_3d : (k, 3) float
        The object's keypoints in the model's frame, before the stretch.
    ids : tuple of k int or str
    mesh : Mesh, optional
        The object's mesh, warped where a shape was estimated, in the same frame.
    rig_from_model : Alignment, optional
        Pose and stretch in the frame that views of known motion share.
    world_from_cam : (4, 4) float, optional
        Pose of the first camera in a world of your own.
    name : str
        The model's name.
    metres : float
        Length of one unit of the camera frame [m].
    sources : tuple of Path
        The files that it was read from, which no export writes over; nor over its photos.

    Raises
    ------
    InputError
        If there is no view, shapes don't match, or the views' stretches differ.
    """

    views: tuple[ExportView, ...]
    points_3d: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    ids: tuple[Hashable, ...] = ()
    mesh: Mesh | None = None
    rig_from_model: Alignment | None = None
    world_from_cam: FloatArray | None = None
    name: str = "model"
    metres: float = 1.0
    sources: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        if not self.views:
            raise InputError("give at least one view", where="views")
        points = as_points(self.points_3d, name="points_3d", dimension=3)
        if len(points) != len(self.ids):
            raise InputError(f"{len(self.ids)} for {len(points)} keypoints", where="ids")
        object.__setattr__(self, "points_3d", points)
        object.__setattr__(self, "metres", as_positive(self.metres, name="metres"))
        if self.world_from_cam is not None:
            world = nearest_rigid(self.world_from_cam, where="world_from_cam")
            object.__setattr__(self, "world_from_cam", world)
        poses = [view.cam_from_model for view in self.views]
        poses += [] if self.rig_from_model is None else [self.rig_from_model]
        for pose in poses:
            if np.abs(pose.scale / poses[0].scale - 1).max() > _SAME:
                what = f"{pose.scale.tolist()} in one view, {poses[0].scale.tolist()} in the first"
                raise InputError(what, where="scale", fix="all views show one object")

    @property
    def bounds(self) -> FloatArray:
        """Lowest and highest coordinates of mesh, or keypoints, in the model's frame (2, 3)."""
        if self.mesh is not None:
            return self.mesh.bounds
        if not len(self.points_3d):
            raise InputError("there is neither a mesh nor a keypoint", where="mesh", fix="give one")
        return extent(self.points_3d)

    def require_mesh(self) -> Mesh:
        """The mesh.

        Raises
        ------
        InputError
            If there is none.
        """
        if self.mesh is None:
            what = "there is no mesh of the model to write"
            raise InputError(what, where="mesh", fix="give one, or an observation with a `model`")
        return self.mesh

    def frame_from_model(self, frame: Frame) -> Alignment:
        """Pose and stretch in a frame: the first view's camera, the rig, the world, or the model's.

        In the model's frame the object is stretched only.

        Raises
        ------
        InputError
            If the frame is not known.
        """
        first = self.views[0].cam_from_model
        if frame == "camera":
            return first
        if frame == "model":
            return Alignment(np.eye(3), np.zeros(3), first.scale)
        if frame == "rig":
            if self.rig_from_model is None:
                what = "the views have no known motion, so there is no rig"
                raise InputError(what, where="frame", fix="take camera, or give cam_from_rig")
            return self.rig_from_model
        if self.world_from_cam is None:
            what = "the camera's pose in the world is not known"
            raise InputError(what, where="frame", fix="give world_from_cam")
        turn, shift = self.world_from_cam[:3, :3], self.world_from_cam[:3, 3]
        return Alignment(turn @ first.rotation, turn @ first.translation + shift, first.scale)

    def frame_from_cam(self, frame: Frame, number: int) -> FloatArray:
        """The rigid pose (4, 4) of a view's camera in a frame, by the object that both see."""
        there, here = self.frame_from_model(frame), self.views[number].cam_from_model
        matrix = np.eye(4)
        matrix[:3, :3] = there.rotation @ here.rotation.T
        matrix[:3, 3] = there.translation - matrix[:3, :3] @ here.translation
        return matrix

    def placed_mesh(self, frame: Frame) -> Mesh:
        """The mesh, stretched and placed in a frame [units of the camera frame]."""
        mesh, placing = self.require_mesh(), self.frame_from_model(frame)
        return replace(mesh, vertices=placing.apply(mesh.vertices))
