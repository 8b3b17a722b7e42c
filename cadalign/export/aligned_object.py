"""An aligned object as all export formats take it: its shape, its views, and the frames."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from cadalign.arrays import FloatArray, as_positive
from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment
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
    """

    camera: Camera
    cam_from_model: Alignment
    image: Path | str | ByteImage | None = None

    def __post_init__(self) -> None:
        self.camera.require_focal()
        if isinstance(self.image, str):
            object.__setattr__(self, "image", Path(self.image))

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
    mesh : Mesh
        The object's mesh in the model's frame before the stretch, warped where a shape was
        estimated.
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
        If there is no view, or the views' stretches differ.
    """

    views: tuple[ExportView, ...]
    mesh: Mesh
    rig_from_model: Alignment | None = None
    world_from_cam: FloatArray | None = None
    name: str = "model"
    metres: float = 1.0
    sources: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        if not self.views:
            raise InputError("give at least one view", where="views")
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
        placing = self.frame_from_model(frame)
        return replace(self.mesh, vertices=placing.apply(self.mesh.vertices))
