"""An aligned object, its shape, views and frames; the export formats by their files' endings."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import numpy as np

from cadalign.arrays import FloatArray, as_positive
from cadalign.errors import InputError, quote
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.io.files import as_path, keeping, made_folder, printable, refuse_nul
from cadalign.io.images import ByteImage, read_image
from cadalign.io.meshes.files import write_mesh

Frame = Literal["camera", "rig", "model"]
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
    name: str = "model"
    metres: float = 1.0
    sources: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        if not self.views:
            raise InputError("give at least one view", where="views")
        object.__setattr__(self, "metres", as_positive(self.metres, name="metres"))
        poses = [view.cam_from_model for view in self.views]
        poses += [] if self.rig_from_model is None else [self.rig_from_model]
        for pose in poses:
            if np.abs(pose.scale / poses[0].scale - 1).max() > _SAME:
                what = f"{pose.scale.tolist()} in one view, {poses[0].scale.tolist()} in the first"
                raise InputError(what, where="scale", fix="all views show one object")

    def frame_from_model(self, frame: Frame) -> Alignment:
        """Pose and stretch in a frame: the first view's camera, the rig, or the model's own.

        In the model's frame the object is stretched only.

        Raises
        ------
        InputError
            If the views have no rig.
        """
        first = self.views[0].cam_from_model
        if frame == "camera":
            return first
        if frame == "model":
            return Alignment(np.eye(3), np.zeros(3), first.scale)
        if self.rig_from_model is None:
            what = "the views have no known motion, so there is no rig"
            raise InputError(what, where="frame", fix="take camera, or give cam_from_rig")
        return self.rig_from_model

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


class Format(NamedTuple):
    """An export format, whose name is the ending of its files."""

    about: str  # what is written
    write: Callable[[Path, AlignedObject, Frame], object]


def _glb(path: Path, exported: AlignedObject, frame: Frame) -> None:
    from cadalign.export.glb import write_glb  # loads trimesh

    write_glb(path, exported, frame=frame)


def _mesh_in_metres(exported: AlignedObject, frame: Frame) -> Mesh:
    return exported.placed_mesh(frame).stretched(exported.metres)


FORMATS: dict[str, Format] = {
    "glb": Format("textured model, cameras and photos, for viewers", _glb),
    "obj": Format(
        "the mesh, with vertex colours",
        lambda path, *given: write_mesh(path, _mesh_in_metres(*given), kind="obj"),
    ),
    "ply": Format(
        "the mesh, with vertex colours",
        lambda path, *given: write_mesh(path, _mesh_in_metres(*given), kind="ply"),
    ),
}
"""The formats by name."""


def format_of(path: str | os.PathLike[str]) -> str:
    """Name of the format that a path's ending means.

    Raises
    ------
    InputError
        If none has this ending.

    Examples
    --------
    >>> format_of("out/chair.glb")
    'glb'
    """
    path = as_path(path)
    name = path.suffix.lower().removeprefix(".")
    if name not in FORMATS:
        what, fix = "the name does not tell the format", f"give the format: {', '.join(FORMATS)}"
        raise InputError(what, where=printable(path), fix=fix)
    return name


def export_object(
    path: str | os.PathLike[str],
    exported: AlignedObject,
    *,
    format: str | None = None,
    frame: Frame = "camera",
) -> Path:
    """Write an aligned object for another tool.

    Parameters
    ----------
    path : path-like
        The file; folders above it are made.
    exported : AlignedObject
    format : {"glb", "obj", "ply"}, optional
        By default what the path's ending means.
    frame : {"camera", "rig", "model"}
        Frame of the exported coordinates: the first photo's camera, the frame that cameras of known
        motion share, or the stretched model's own.

    Returns
    -------
    Path
        What was written.

    Raises
    ------
    InputError
        If the format or frame is not known, or the object lacks what it needs.
    DataError
        If a photo cannot be read, or the file cannot be written or is one that the object was read
        from.
    """
    path = as_path(path)
    refuse_nul(path)
    name = format_of(path) if format is None else format
    if name not in FORMATS:
        fix = f"known are {', '.join(FORMATS)}"
        raise InputError(f"unknown format {quote(name)}", where="format", fix=fix)
    if frame not in FRAMES:
        fix = f"known are {', '.join(FRAMES)}"
        raise InputError(f"unknown frame {quote(frame)}", where="frame", fix=fix)
    made_folder(path.parent)
    photos = (view.image for view in exported.views if isinstance(view.image, Path))
    with keeping([*exported.sources, *photos]):
        FORMATS[name].write(path, exported, frame)
    return path
