"""Observation files (one object's keypoints in one or more images) and camera files.

docs/formats/observation.md describes the observation file. A camera file is a calibration matrix as
text, or JSON in COLMAP's form.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import UNSET, Meta, UnsetType

from cadalign.errors import DataError, InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.symmetry import Symmetry
from cadalign.io.documents import (
    Document,
    PathText,
    Positive,
    Text,
    convert,
    name_file,
    name_part,
    read_json,
    written_path,
)
from cadalign.io.evidence import (
    ObservedImage,
    Size,
    ViewFields,
    read_image_fields,
    write_image_fields,
)
from cadalign.io.files import as_path, once_per_file, read_text, write_json
from cadalign.io.kinds import (
    CAMERA,
    CAMERA_FIX,
    OBSERVATION,
    kind_of,
    refuse_other,
    refuse_other_file,
)
from cadalign.io.pretrained import category_of, shape_path


class FocalPriorFields(Document, omit_defaults=True):
    """The entry ``fit.focal_prior``."""

    focal: Positive
    relative_sigma: Positive
    source: str = ""


class FitFields(Document):
    """The entry ``fit``; missing fields have the defaults of `cadalign.fit`."""

    method: Text | UnsetType = UNSET
    sigma: Positive | list[Positive] | UnsetType | None = UNSET
    loss: Text | UnsetType = UNSET
    loss_scale: Positive | UnsetType = UNSET
    stretch: Text | UnsetType | None = UNSET
    stretch_sigma: Positive | UnsetType | None = UNSET
    focal: Literal["known", "estimate"] | UnsetType = UNSET
    focal_prior: FocalPriorFields | Literal["usual"] | UnsetType | None = UNSET
    shape_sigma: Positive | UnsetType = UNSET
    image: bool | UnsetType = UNSET


class ObservationFields(ViewFields, kw_only=True):
    """A file: the fields of its only image, or ``views``, and the fields of the object."""

    camera: Any = UNSET
    views: Annotated[list[ViewFields], Meta(min_length=1)] | None = None
    model: Path | None = None
    shape: PathText | None = None
    size: Size | None = None
    object: Text | None = None
    up_axis: Literal["x", "y", "z"] | None = "y"
    symmetry: Any = None  # in a form of `Symmetry.from_dict`
    unfinished: Any = None  # the annotator's
    init: Any = None  # in the form of `Alignment.from_dict`
    fit: FitFields = msgspec.field(default_factory=FitFields)


def _read_fields(data: Any, folder: Path | None) -> tuple[ObservationFields, Sequence[ViewFields]]:
    """Check the parsed form of a file; returns its fields and the fields of its views.

    Raises DataError if a field is missing, unknown or invalid.
    """
    read: ObservationFields = convert(data, ObservationFields, folder=folder)
    sigma = read.fit.sigma
    if read.views is not None:
        for name in ViewFields.__struct_fields__:
            if name in data:
                fix = "give it in each of the views"
                raise DataError("not allowed beside `views`", where=name, fix=fix)
        if isinstance(sigma, list):
            fix = "give one number for all, or `sigma` of every keypoint"
            raise DataError("a list, but there are several views", where="fit.sigma", fix=fix)
        return read, read.views
    if read.camera is UNSET:
        raise DataError("missing", where="camera")
    if "keypoints" not in data and read.init is None and read.mask is None:
        raise DataError("missing", where="keypoints", fix="give keypoints, `mask` or `init`")
    if isinstance(sigma, list) and len(sigma) != len(read.keypoints):
        what = f"{len(sigma)} numbers for {len(read.keypoints)} keypoints"
        raise DataError(what, where="fit.sigma", fix="give one for each, or one for all")
    return read, (read,)


@dataclass(frozen=True, eq=False)
class Observation(ObservedImage):
    """An object in one or several images; it extends the first image.

    Parameters
    ----------
    points_3d, points_2d, camera, sigma, ids, names, scores, image, depths, evidence
        The first image, as for `ObservedImage`.
    model : Path, optional
        The CAD model.
    fit_options : mapping
        Keyword arguments for `cadalign.fit`, as in the file.
    others : tuple of ObservedImage
        The other images.
    size : Size, optional
        Known lengths of the object.
    shape : Path, optional
        File of a learned shape that replaces the model.
    symmetry : Symmetry, optional
        Symmetry of the model.
    init : Alignment, optional
        Initial alignment, as for `cadalign.align`.
    object_name : str, optional
        Name of the object.
    up_axis : {"y", "x", "z"} or None
        The model's axis that points up, as for `cadalign.Model`.
    draft : mapping, optional
        Annotator state that is not usable as evidence yet; the field ``unfinished`` of the file.
    """

    model: Path | None = None
    fit_options: Mapping[str, Any] = field(default_factory=dict)
    others: tuple[ObservedImage, ...] = field(default=(), kw_only=True)
    size: Size | None = field(default=None, kw_only=True)
    shape: Path | None = field(default=None, kw_only=True)
    symmetry: Symmetry | None = field(default=None, kw_only=True)
    init: Alignment | None = field(default=None, kw_only=True)
    object_name: str | None = field(default=None, kw_only=True)
    up_axis: Literal["x", "y", "z"] | None = field(default="y", kw_only=True)
    draft: Mapping[str, Any] | None = field(default=None, kw_only=True)

    @property
    def views(self) -> tuple[ObservedImage, ...]:
        """All images, the first one first."""
        return (self, *self.others)

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that the observation names, and the materials beside the model."""
        named = [self.model, self.shape]
        if self.model is not None:
            named.append(Path(f"{os.path.splitext(self.model)[0]}.mtl"))
        for view in self.views:
            named += [view.image, view.evidence.mask]
        return tuple(each for each in named if each is not None)

    @property
    def is_plain(self) -> bool:
        """True if the observation has only keypoints in one image."""
        further = self.others, self.size, self.init, self.evidence.given
        return self.depths is None and not any(map(bool, further))

    @classmethod
    def load(cls, path: str | Path, *, needs_xyz: bool | None = None) -> Observation:
        """Read an observation file.

        Parameters
        ----------
        path : str or Path
            The file.
        needs_xyz : bool, optional
            Whether every keypoint must have ``xyz``; a missing one becomes zero otherwise. By
            default True unless the file names a learned shape.

        Raises
        ------
        DataError
            If the file is missing, is not JSON, or a field is missing, unknown or invalid; the
            message names file and field.
        """
        path = as_path(path)
        data = read_json(path, OBSERVATION)
        with name_file(path):
            return cls.from_dict(data, folder=path.parent, needs_xyz=needs_xyz)

    @classmethod
    def from_dict(
        cls, data: Mapping[str, Any], *, folder: Path | None = None, needs_xyz: bool | None = None
    ) -> Observation:
        """Convert the parsed form of an observation file; paths are relative to ``folder``.

        `load` describes ``needs_xyz``.
        """
        refuse_other(OBSERVATION, kind_of(data))
        read, fields = _read_fields(data, folder)
        needs_xyz = read.shape is None if needs_xyz is None else needs_xyz
        images = []
        for number, each in enumerate(fields):
            with nullcontext() if each is read else name_part(f"views[{number}]"):
                images.append(read_image_fields(each, needs_xyz=needs_xyz))
        first, *others = images
        options = msgspec.to_builtins(read.fit)
        if first.not_found and isinstance(options.get("sigma"), list):
            options["sigma"] = np.delete(options["sigma"], first.not_found).tolist()
        with name_part("init"):
            init = None if read.init is None else Alignment.from_dict(read.init)
        return cls(
            **vars(first),
            model=read.model,
            fit_options=options,
            others=tuple(others),
            size=read.size,
            shape=None if read.shape is None else shape_path(read.shape, folder),
            symmetry=None if read.symmetry is None else Symmetry.from_dict(read.symmetry),
            init=init,
            object_name=read.object,
            up_axis=read.up_axis,
            draft=read.unfinished,
        )

    def to_dict(self, *, folder: Path | None = None) -> dict[str, Any]:
        """Convert to the parsed form of an observation file; paths are relative to ``folder``.

        Every ``pixel_origin`` is written.
        """
        needs_xyz = self.shape is None
        written = [write_image_fields(view, folder, needs_xyz=needs_xyz) for view in self.views]
        data: dict[str, Any] = {"views": written} if self.others else written[0]
        further = {
            "model": self.model and written_path(self.model, folder=folder),
            "shape": self.shape
            and (category_of(self.shape) or written_path(self.shape, folder=folder)),
            "object": self.object_name,
            "size": self.size and msgspec.to_builtins(self.size),
            "symmetry": self.symmetry and self.symmetry.to_dict(),
            "init": self.init and self.init.to_dict(),
            "unfinished": self.draft,
            "fit": self.fit_options,
        }
        data |= {name: value for name, value in further.items() if value}
        return data if self.up_axis == "y" else data | {"up_axis": self.up_axis}

    def save(self, path: str | Path) -> None:
        """Write an observation file, with paths relative to it."""
        path = as_path(path)
        write_json(path, self.to_dict(folder=path.parent))


@dataclass(frozen=True)
class ObservationChanges:
    """A camera or focal length that replaces an observation's."""

    camera: Path | None = None  # file of the calibrated camera, see `read_camera`
    focal: Positive | None = None  # focal length of all cameras [px]

    def read_camera(self, size: tuple[int, int] | None) -> Camera | None:
        """Read the camera, or None; ``size`` is the photo's, for a file with only a matrix."""
        return None if self.camera is None else read_camera(self.camera, size=size)

    def apply(self, observation: Observation, where: str | None = None) -> Observation:
        """Replace an observation's camera and focal length; ``where`` is the observation's file.

        Raises InputError if a camera is given and the observation has several views.
        """
        own = observation.camera
        camera = self.read_camera((own.width, own.height))
        if camera is not None and observation.others:
            what = f"the file has {len(observation.views)} views, but the camera is for one"
            raise InputError(what, where=where, fix="write cameras into its `views`")
        changed = observation if camera is None else replace(observation, camera=camera)
        focal = self.focal
        if focal is None:
            return changed
        # The new focal length replaces the file's options about it.
        kept = {key: given for key, given in changed.fit_options.items() if "focal" not in key}
        others = [replace(view, camera=view.camera.replace_focal(focal)) for view in changed.others]
        camera = changed.camera.replace_focal(focal)
        return replace(changed, camera=camera, others=tuple(others), fit_options=kept)


@dataclass(frozen=True, kw_only=True)
class DetectorOptions:
    """Model and photos for a detector's keypoints, and the selection of keypoints."""

    model: Path | None = None
    """For a detector's file: the model's NAME.keypoints.json, or the mesh beside that file.
    Keypoints are paired by name, otherwise by semantic id, otherwise by order. With --shape, the
    shape's keypoints by default."""
    images: Path | None = None
    """Folder of the photos of a detector's file; by default the folder of that file."""
    min_score: float = 0.0
    """Lowest score of a detector's keypoints that are used."""
    ignore_unknown: bool = False
    """Leave out a detector's keypoints that the model lacks."""


@once_per_file(64)  # many observations may share a camera file
def read_camera(path: str | os.PathLike[str], *, size: tuple[int, int] | None = None) -> Camera:
    """Read a camera from a file.

    Parameters
    ----------
    path : path-like
        JSON in the form of `Camera.from_dict`, where a matrix may lack width and height; or text
        of 3 x 3 numbers, the rows of a calibration matrix.
    size : tuple of 2 int, optional
        Width and height of the photo [px], for a matrix whose file lacks them.

    Raises
    ------
    DataError
        If the file cannot be read, holds no camera, or lacks the image's size.
    """
    path = as_path(path)
    if path.suffix.lower() == ".json":
        form = read_json(path, CAMERA)
    else:
        refuse_other_file(path, CAMERA)
        try:
            numbers = np.array(read_text(path).replace(",", " ").split(), dtype=float)
            form = {"matrix": numbers.reshape(3, 3)}
        except ValueError:
            is_list = path.name == "cameras.txt"
            what = "COLMAP's list of cameras, not one" if is_list else "not a calibration matrix"
            raise DataError(what, where=str(path), fix=CAMERA_FIX) from None
    if isinstance(form, dict) and "matrix" in form and not {"width", "height"} <= set(form):
        if size is None:
            what = "the file has only a matrix, and the size of the image is unknown"
            raise DataError(what, where=str(path), fix="give the photo, or add width and height")
        form |= {"width": size[0], "height": size[1]}
    with name_file(path):
        return Camera.from_dict(form)
