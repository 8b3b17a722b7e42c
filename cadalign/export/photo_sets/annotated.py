"""One annotated photo, as all forms of data sets take it."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.export.aligned_object import AlignedObject
from cadalign.export.mesh_files import write_obj
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.io.files import writing
from cadalign.io.images import open_photo, read_photo, write_image

_COPIED = {"JPEG": ".jpg", "PNG": ".png"}
_ORIENTATION = 0x0112  # the EXIF tag
_LEVEL = (0.0, -1.0, 0.0)


@dataclass(frozen=True, eq=False)
class AnnotatedPhoto:
    """A photo with its aligned object and its keypoints.

    Parameters
    ----------
    exported : AlignedObject
        With a mesh, and with the photo as its only view. Its ids are the keypoints' names.
    image : Path
        The photo.
    category : str
        What the object is, such as ``chair``.
    mask : Path, optional
        Image of the object's pixels.
    up : (3,) float, optional
        Direction in the camera that is up in the scene; that of a level camera by default.
    """

    exported: AlignedObject
    image: Path
    category: str = "object"
    mask: Path | None = None
    up: FloatArray | None = None

    @property
    def camera(self) -> Camera:
        """The photo's camera."""
        return self.exported.views[0].camera

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the keypoints."""
        return tuple(str(name) for name in self.exported.ids)

    @property
    def pose(self) -> Alignment:
        """The pose of the stretched model, without stretch [m]."""
        aligned = self.exported.views[0].cam_from_model
        shift = aligned.translation * self.exported.metres
        return Alignment(aligned.rotation, shift, np.ones(3))

    @property
    def scale(self) -> FloatArray:
        """Metres per model unit along the model's axes, (3,) float."""
        return self.exported.views[0].cam_from_model.scale * self.exported.metres

    @property
    def points(self) -> FloatArray:
        """The keypoints on the stretched model, (k, 3) float [m]."""
        return self.exported.points_3d * self.scale

    @property
    def bounds(self) -> FloatArray:
        """Lowest and highest coordinates of the stretched model, (2, 3) float [m]."""
        return self.exported.bounds * self.scale

    @property
    def upwards(self) -> FloatArray:
        """The direction in the camera that is up in the scene, of length 1."""
        up = np.array(_LEVEL) if self.up is None else self.up
        return np.asarray(up / np.linalg.norm(up))

    @property
    def marked(self) -> dict[str, FloatArray]:
        """The pixels (2,) of the marked keypoints by their names."""
        view = self.exported.views[0]
        return {str(name): uv for name, uv in zip(view.ids, view.points_2d, strict=True)}

    @property
    def bbox(self) -> FloatArray:
        """Left, top, right and bottom of the object in the image, (4,) float [px]."""
        mesh = self.exported.placed_mesh("camera")
        pixels = self.camera.project_where_ahead(mesh.vertices)
        pixels = pixels[np.isfinite(pixels).all(axis=1)]
        if not len(pixels):
            raise InputError("the object lies behind the camera", where=self.image.name)
        size = np.array([self.camera.width, self.camera.height])
        low, high = (np.clip(f(axis=0), -0.5, size - 0.5) for f in (pixels.min, pixels.max))
        return np.concatenate([low, high])

    def stretched_mesh(self) -> Mesh:
        """The mesh, stretched [m]."""
        mesh = self.exported.require_mesh()
        return replace(mesh, vertices=mesh.vertices * self.scale)

    def require_plain_camera(self, form: str, *, distorted: bool = False) -> None:
        """Refuse lens distortion, for which a form has no place."""
        if any(self.camera.distortion) and not distorted:
            raise InputError(
                f"{form} has no place for lens distortion",
                where=self.image.name,
                fix="undistort the photo and annotate it again",
            )

    def copy_image(self, stem: Path) -> Path:
        """Copy the photo, upright; a file that is so already is copied as it is."""
        with writing(stem):
            stem.parent.mkdir(parents=True, exist_ok=True)
        with open_photo(self.image) as image:
            ending = _COPIED.get(image.format or "")
            is_upright = image.getexif().get(_ORIENTATION, 1) == 1
        if ending is None or not is_upright:
            path = stem.with_name(f"{stem.name}.png")
            write_image(path, read_photo(self.image))
            return path
        path = stem.with_name(f"{stem.name}{ending}")
        with writing(path):
            shutil.copyfile(self.image, path)
        return path

    def copy_mask(self, path: Path) -> Path | None:
        """Copy the mask as a PNG, 255 on the object; None without one."""
        if self.mask is None:
            return None
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        pixels = read_photo(self.mask).max(axis=2)
        write_image(path, np.where(pixels > 0, 255, 0).astype(np.uint8))
        return path

    def write_model(self, path: Path, *, is_stretched: bool) -> None:
        """Write the mesh as OBJ in its own frame: stretched [m], or as it is."""
        view = self.exported.views[0]
        metres = self.exported.metres
        if not is_stretched:
            pose = view.cam_from_model
            view = replace(view, cam_from_model=replace(pose, scale=np.ones(3)))
            metres = 1.0
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        plain = replace(self.exported, views=(view,), rig_from_model=None, metres=metres)
        write_obj(path, plain, frame="model")


def converted(
    numbered: Iterable[tuple[int, AnnotatedPhoto]],
    convert: Callable[[int, AnnotatedPhoto], dict[str, Any]],
) -> tuple[list[dict[str, Any]], list[InputError]]:
    """Entries of the photos that a form can hold, and why the others are left out."""
    entries, problems = [], []
    for number, photo in numbered:
        try:
            entries.append(convert(number, photo))
        except InputError as error:
            problems.append(error)
    return entries, problems
