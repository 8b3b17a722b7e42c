"""Observations: one object's keypoints in one or more images, as a JSON file; files of cameras.

The file is described in docs/formats/observation.md. A camera is a calibration matrix as text,
NumPy array or JSON, or in COLMAP's form.
"""

from __future__ import annotations

import io
import os
import warnings
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from cadalign.errors import DataError, InputError, brief
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.symmetry import Symmetry
from cadalign.io.documents import (
    Positive,
    in_file,
    parse_json,
    path_from,
    read_json,
    within,
    written_path,
)
from cadalign.io.evidence import ObservedImage, Size
from cadalign.io.files import as_path, once_per_file, read_bytes, read_text, write_json
from cadalign.io.kinds import (
    CAMERA,
    CAMERA_FIX,
    MATRIX_NAMES,
    OBSERVATION,
    kind_of,
    other_kind,
    refuse_other_file,
)
from cadalign.io.observation_file import (
    read_fields,
    read_image_fields,
    read_size,
    write_image_fields,
)


@dataclass(frozen=True, eq=False)
class Observation(ObservedImage):
    """An object in one image, or in several: this is the first one.

    Parameters
    ----------
    points_3d, points_2d, camera, sigma, ids, names, scores, image, depths, evidence
        Camera of the first image, as for `ObservedImage`.
    model : Path, optional
        The CAD model.
    fit_options : mapping
        Keyword arguments for `cadalign.fit` where they are not its defaults, as the file has them.
    others : tuple of ObservedImage
        The other images.
    size : Size, optional
        Known lengths of the object.
    shape : Path, optional
        File of the learned shape that takes the model's place.
    symmetry : Symmetry, optional
        Symmetry of the model.
    init : Alignment, optional
        Where to start, as for `cadalign.align`.
    object_name : str, optional
        Name of the object.
    up_axis : {"y", "x", "z"} or None
        The model's axis that points up, as for `cadalign.Model`.
    unfinished : mapping, optional
        What is marked and cannot be used yet, for the annotator.
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
    unfinished: Mapping[str, Any] | None = field(default=None, kw_only=True)

    @property
    def views(self) -> tuple[ObservedImage, ...]:
        """All images, the first one first."""
        return (self, *self.others)

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that it names, and the materials beside the model."""
        named: list[Any] = [self.model, self.shape]
        if self.model is not None:
            named.append(Path(f"{os.path.splitext(self.model)[0]}.mtl"))
        for view in self.views:
            named += [view.image, *view.evidence.given.values()]
        return tuple(each for each in named if isinstance(each, Path))

    @property
    def is_plain(self) -> bool:
        """True where nothing but keypoints in one image is known."""
        further = self.others, self.size, self.init, self.evidence.given
        return self.depths is None and not any(map(bool, further))

    def __repr__(self) -> str:
        counts = ", ".join(str(len(view.points_2d)) for view in self.views)
        source = "" if self.image is None else f"{self.image.name!r}, "
        return f"Observation({source}{len(self.views)} views with {counts} keypoints)"

    @classmethod
    def load(cls, path: str | Path, *, needs_xyz: bool | None = None) -> Observation:
        """Read an observation file.

        Parameters
        ----------
        path : str or Path
        needs_xyz : bool, optional
            Whether keypoints must have ``xyz``, which is zero otherwise where it is missing; by
            default unless the file names a learned shape.

        Raises
        ------
        DataError
            If the file is missing, is not JSON, or a field is missing, unknown or invalid; the
            message names file and field.
        """
        path = as_path(path)
        data = read_json(path, OBSERVATION)
        with in_file(path):
            return cls.from_dict(data, folder=path.parent, needs_xyz=needs_xyz)

    @classmethod
    def from_dict(
        cls, data: Mapping[str, Any], *, folder: Path | None = None, needs_xyz: bool | None = None
    ) -> Observation:
        """Read the parsed form of an observation file; paths are relative to ``folder``.

        ``needs_xyz`` is that of `load`.
        """
        if error := other_kind(Path(), OBSERVATION, kind_of(data)):
            raise DataError(error.what, fix=error.fix)
        read, fields = read_fields(data)
        if needs_xyz is None:
            needs_xyz = read.shape is None
        images = []
        for number, each in enumerate(fields):
            with nullcontext() if each is read else within(f"views[{number}]"):
                images.append(read_image_fields(each, folder, needs_xyz=needs_xyz))
        first, *others = images
        options = msgspec.to_builtins(read.fit)
        if first.not_found and isinstance(options.get("sigma"), list):
            options["sigma"] = np.delete(options["sigma"], first.not_found).tolist()
        with within("init"):
            init = None if read.init is None else Alignment.from_dict(read.init)
        return cls(
            **vars(first),
            model=None if read.model is None else path_from(read.model, folder),
            fit_options=options,
            others=tuple(others),
            size=read_size(read.size),
            shape=None if read.shape is None else path_from(read.shape, folder),
            symmetry=None if read.symmetry is None else Symmetry.from_dict(read.symmetry),
            init=init,
            object_name=read.object,
            up_axis=read.up_axis,
            unfinished=read.unfinished,
        )

    def to_dict(self, *, folder: Path | None = None) -> dict[str, Any]:
        """The parsed form of an observation file, its paths relative to ``folder``.

        Every ``pixel_origin`` is stated.
        """
        written = [write_image_fields(view, folder) for view in self.views]
        data: dict[str, Any] = {"views": written} if self.others else written[0]
        further = {
            "model": self.model and written_path(self.model, folder=folder),
            "shape": self.shape and written_path(self.shape, folder=folder),
            "object": self.object_name,
            "size": self.size and self.size.given,
            "symmetry": self.symmetry and self.symmetry.to_dict(),
            "init": self.init and self.init.to_dict(),
            "unfinished": dict(self.unfinished or {}) or None,
            "fit": dict(self.fit_options) or None,
        }
        data |= {name: value for name, value in further.items() if value is not None}
        return data if self.up_axis == "y" else data | {"up_axis": self.up_axis}

    def save(self, path: str | Path) -> None:
        """Write an observation file; paths are written relative to it."""
        path = as_path(path)
        write_json(path, self.to_dict(folder=path.parent))


def with_lens(camera: Camera, focal: float | None = None, *, fov: float | None = None) -> Camera:
    """The camera with a known focal length [px] or horizontal field of view [degrees], if given.

    Raises InputError if both are given, or one is not possible.
    """
    if fov is None:
        return camera if focal is None else camera.with_focal(focal)
    if focal is not None:
        raise InputError("given beside the focal length", where="fov", fix="give one of the two")
    return camera.with_focal(Camera.from_fov(camera.width, camera.height, fov_x=fov).fx)


@dataclass(frozen=True)
class ObservationChanges:
    """A camera in the place of those of observations."""

    camera: Path | None = None  # file of the calibrated camera, see `read_camera`
    focal: Positive | None = None  # focal length of all cameras [px]
    fov: Positive | None = None  # or their horizontal field of view [degrees]

    def read_camera(self, size: tuple[int, int] | None) -> Camera | None:
        """The camera, if there is one; ``size`` is the photo's, for a file of a matrix alone."""
        return None if self.camera is None else _read_camera(self.camera, size=size)

    def applied_to(self, observation: Observation, where: str | None = None) -> Observation:
        """The observation with all of this in the place of its own; ``where`` is its file.

        Raises InputError if the observation has several views, which one camera does not fit.
        """
        own = observation.camera
        camera = self.read_camera((own.width, own.height))
        if camera is not None and observation.others:
            what = f"the file has {len(observation.views)} views, the camera is for one"
            raise InputError(what, where=where, fix="write cameras into its `views`")
        changed = observation if camera is None else replace(observation, camera=camera)
        if self.focal is None and self.fov is None:
            return changed
        # Options of the fit about the focal length are left out.
        kept = {key: given for key, given in changed.fit_options.items() if "focal" not in key}
        lens = partial(with_lens, focal=self.focal, fov=self.fov)
        views = tuple(replace(view, camera=lens(view.camera)) for view in changed.others)
        return replace(changed, camera=lens(changed.camera), others=views, fit_options=kept)


@once_per_file(64)
def _read_camera(path: Path, **given: Any) -> Camera:
    """One file for many observations."""

    return read_camera(path, **given)


@dataclass(frozen=True, kw_only=True)
class DetectorOptions:
    """Complements of a detector's file of keypoints, and which of its keypoints count."""

    model: Path | None = None
    """The model, whose keypoints those of a detector's file are paired with, by name, otherwise by
    semantic id, otherwise by order: NAME.keypoints.json, or the mesh that this lies beside. With
    --shape, the shape's by default."""
    images: Path | None = None
    """Folder of the photos that a detector's file names."""
    min_score: float = 0.0
    """Least score of a detector's keypoint that is kept."""
    ignore_unknown: bool = False
    """Leave out a detector's keypoints that the model does not have."""


_ARRAY = ".npy"
_MOST_BYTES = 2**20  # of an array, which has nine numbers


def read_camera(
    path: str | os.PathLike[str],
    *,
    size: tuple[int, int] | None = None,
) -> Camera:
    """Read a camera from a file.

    Parameters
    ----------
    path : path-like
        A calibration matrix K: text of 3 x 3 numbers, a ``.npy`` array, or JSON, bare or as
        ``matrix`` (also ``K``, ``camera_matrix``), by rows; or a camera in the form of
        `Camera.from_dict` as JSON.
    size : tuple of 2 int, optional
        Width and height of the photo [px], for a matrix whose file lacks them.

    Raises
    ------
    DataError
        If the file cannot be read, holds no camera, or lacks the image's size.
    """
    path = as_path(path)
    form = _read_form(path)
    if "matrix" in form and not {"width", "height"} <= set(form):
        if size is None:
            what = "the file has a matrix alone, and the size of the image is unknown"
            raise DataError(what, where=str(path), fix="give the photo, or width and height in it")
        form |= {"width": size[0], "height": size[1]}
    with in_file(path):
        return Camera.from_dict(form)


def _read_form(path: Path) -> dict[str, Any]:
    """The parsed form of a camera in a file."""
    if path.suffix.lower() == _ARRAY:
        return {"matrix": _read_array(path)}
    try:
        text = read_text(path)
        if path.suffix.lower() != ".json" and text.lstrip()[:1] not in ("{", "["):
            return {"matrix": _square(text.replace(",", " ").replace(";", " ").split(), path)}
        data = parse_json(text, str(path))
    except DataError:
        refuse_other_file(path, CAMERA)
        raise
    if error := other_kind(path, CAMERA, kind_of(data)):
        raise error
    form = {"matrix": data} if isinstance(data, list) else data
    if not isinstance(form, dict):
        what = f"camera: expected an object, got {type(data).__name__}"
        raise DataError(what, where=str(path), fix=CAMERA_FIX)
    name = next((name for name in MATRIX_NAMES if name in form), None)
    if name is not None and "params" not in form:
        form["matrix"] = _square(form.pop(name), path)
    return form


def _read_array(path: Path) -> Any:
    file = io.BytesIO(read_bytes(path, most=_MOST_BYTES))
    try:
        with warnings.catch_warnings(action="ignore"):
            values = np.lib.format.read_array(file, allow_pickle=False)
    except Exception as error:  # NumPy has Python parse the header, which raises what it likes
        what = f"not a NumPy array that can be read ({brief(error)})"
        raise DataError(what, where=str(path)) from None
    return _square(values, path)


def _square(values: Any, path: Path) -> Any:
    """A matrix (3, 3) of nine numbers by rows, however they are nested."""
    try:
        return np.asarray(values, dtype=float).reshape(3, 3)
    except (TypeError, ValueError, OverflowError):
        raise DataError("not a calibration matrix", where=str(path), fix=CAMERA_FIX) from None
