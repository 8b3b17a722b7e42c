"""Observations: one image's keypoints with their model points, as a JSON file.

The file holds one object::

    {
      "camera": {"model": "PINHOLE", "width": 640, "height": 480,
                 "params": [935.0, 935.0, 320.0, 240.0]},
      "keypoints": [
        {"xyz": [0.11, 0.42, -0.08], "uv": [351.2, 204.9], "sigma": 1.0, "semantic_id": 3,
         "name": "back, top left", "confidence": 0.93},
        ...
      ],
      "image": "photo.png",
      "model": "chair.obj",
      "shape": "chair.shape",
      "fit": {"sigma": null, "loss": "linear"}
    }

``camera`` is COLMAP's form, principal point in COLMAP's convention (the top-left corner of the
image is (0, 0)), see `cadalign.Camera.from_dict`; an unknown focal length is ``null`` there, or
``{"width": 640, "height": 480}`` is all that is given. ``xyz`` is in model units, ``uv`` in pixels
with integers at pixel centres, of the photo as it is seen: turned upright where EXIF says so.
``sigma`` [px], ``semantic_id``, ``name`` and ``confidence`` (a detector's score, not negative) are
optional, each given for all keypoints or for none. ``image`` and ``model`` are optional paths,
relative to the file. ``fit`` holds options for `cadalign.fit` where they are not its defaults:
``method``, ``sigma`` (one for all keypoints or a list, in place of theirs; ``null`` estimates it),
``loss``, ``loss_scale``, ``stretch``, ``scale_prior_sigma``, ``known_axis`` and ``focal``; and
``shape_sigma``, that of `cadalign.Model`. ``shape``, optional, is a file of `cadalign shape learn`,
which takes the model's place.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import UNSET, Meta, UnsetType

from cadalign.arrays import FloatArray, IntArray, as_floats, as_points
from cadalign.errors import DataError
from cadalign.geometry.camera import Camera
from cadalign.io.documents import (
    Document,
    Labelled,
    NotNegative,
    PathText,
    Point2,
    Point3,
    Positive,
    Text,
    convert,
    in_file,
    path_from,
    read_json,
    written_path,
)
from cadalign.io.files import write_json


class _Keypoint(Labelled, kw_only=True):
    """One entry of ``keypoints``, as the module's documentation describes it."""

    xyz: Point3
    uv: Point2
    sigma: Positive | None = None
    name: Text | None = None
    confidence: NotNegative | None = None


class _FitFields(Document):
    """The entry ``fit``; fields that are not given keep the defaults of `cadalign.fit`."""

    method: Text | UnsetType = UNSET
    sigma: Positive | list[Positive] | UnsetType | None = UNSET
    loss: Text | UnsetType = UNSET
    loss_scale: Positive | UnsetType = UNSET
    stretch: Text | UnsetType | None = UNSET
    scale_prior_sigma: Positive | UnsetType | None = UNSET
    known_axis: Text | UnsetType = UNSET
    focal: Literal["known", "estimate"] | UnsetType = UNSET
    shape_sigma: Positive | UnsetType = UNSET


class _ObservationFile(Document):
    """The file's only object."""

    camera: Any  # in the form of `Camera.from_dict`
    keypoints: Annotated[list[_Keypoint], Meta(min_length=1)]
    image: PathText | None = None
    model: PathText | None = None
    fit: _FitFields = msgspec.field(default_factory=_FitFields)
    shape: PathText | None = None


@dataclass(frozen=True, eq=False)
class Observation:
    """Keypoints on a model and in one image.

    Parameters
    ----------
    points_3d : (n, 3) float
        Model points [model units].
    points_2d : (n, 2) float
        Image points [px].
    camera : Camera
    sigma : (n,) float, optional
        Standard deviation of each image point [px].
    semantic_ids : (n,) int, optional
        Meaning of each keypoint; the same number on all models of a category.
    names : tuple of n str, optional
        Name of each keypoint.
    confidences : (n,) float, optional
        Trust in each keypoint, for the ``confidences`` of `cadalign.fit`.
    image, model : Path, optional
        The photo and the CAD model.
    fit_options : mapping
        Options of a fit where they are not the defaults of `cadalign.fit`; see the module.
    shape : Path, optional
        File of the learned shape that takes the model's place.
    """

    points_3d: FloatArray
    points_2d: FloatArray
    camera: Camera
    sigma: FloatArray | None = None
    semantic_ids: IntArray | None = None
    names: tuple[str, ...] | None = None
    confidences: FloatArray | None = None
    image: Path | None = None
    model: Path | None = None
    fit_options: Mapping[str, Any] = field(default_factory=dict)
    shape: Path | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        points_3d = as_points(self.points_3d, name="points_3d", dimension=3)
        points_2d = as_floats(self.points_2d, name="points_2d", shape=(len(points_3d), 2))
        object.__setattr__(self, "points_3d", points_3d)
        object.__setattr__(self, "points_2d", points_2d)
        for name in ("sigma", "confidences"):
            if (value := getattr(self, name)) is not None:
                checked = as_floats(value, name=name, shape=(len(points_3d),))
                object.__setattr__(self, name, checked)

    @classmethod
    def load(cls, path: str | Path, *, needs_xyz: bool = True) -> Observation:
        """Read an observation file.

        Parameters
        ----------
        path : str or Path
        needs_xyz : bool
            Whether keypoints must have ``xyz``, which is zero otherwise where it is missing.

        Raises
        ------
        DataError
            If the file is missing, is not JSON, or a field is missing, unknown or invalid; the
            message names file and field.
        """
        path = Path(path)
        data = read_json(path)
        if not needs_xyz:
            data = _with_xyz(data)
        with in_file(path):
            return cls.from_dict(data, folder=path.parent)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], *, folder: Path | None = None) -> Observation:
        """Read the parsed form of an observation file; paths are relative to ``folder``."""
        read: _ObservationFile = convert(data, _ObservationFile)
        sigma = read.fit.sigma
        if isinstance(sigma, list) and len(sigma) != len(read.keypoints):
            what = f"{len(sigma)} numbers for {len(read.keypoints)} keypoints"
            raise DataError(what, where="fit.sigma", fix="give one for each, or one for all")
        names = _column(read.keypoints, "name")
        ids = _column(read.keypoints, "semantic_id")
        return cls(
            points_3d=np.array([keypoint.xyz for keypoint in read.keypoints]),
            points_2d=np.array([keypoint.uv for keypoint in read.keypoints]),
            camera=Camera.from_dict(read.camera),
            sigma=_column(read.keypoints, "sigma"),
            semantic_ids=None if ids is None else np.array(ids, dtype=np.int64),
            names=None if names is None else tuple(names),
            confidences=_column(read.keypoints, "confidence"),
            image=None if read.image is None else path_from(read.image, folder),
            model=None if read.model is None else path_from(read.model, folder),
            fit_options=msgspec.to_builtins(read.fit),
            shape=None if read.shape is None else path_from(read.shape, folder),
        )

    def to_dict(self, *, folder: Path | None = None) -> dict[str, Any]:
        """The parsed form of an observation file, its paths relative to ``folder``."""
        keypoints: list[dict[str, Any]] = [
            {"xyz": xyz, "uv": uv}
            for xyz, uv in zip(self.points_3d.tolist(), self.points_2d.tolist(), strict=True)
        ]
        for name, values in (
            ("sigma", self.sigma),
            ("semantic_id", self.semantic_ids),
            ("name", self.names),
            ("confidence", self.confidences),
        ):
            if values is not None:
                listed = values.tolist() if isinstance(values, np.ndarray) else values
                for keypoint, value in zip(keypoints, listed, strict=True):
                    keypoint[name] = value
        data: dict[str, Any] = {"camera": self.camera.to_dict(), "keypoints": keypoints}
        for name, path in (("image", self.image), ("model", self.model), ("shape", self.shape)):
            if path is not None:
                data[name] = written_path(path, folder=folder)
        if self.fit_options:
            data["fit"] = dict(self.fit_options)
        return data

    def save(self, path: str | Path) -> None:
        """Write an observation file; paths are written relative to it."""
        write_json(Path(path), self.to_dict(folder=Path(path).parent))


def _with_xyz(data: Any) -> Any:
    """The parsed form of a file, with zeros for the ``xyz`` of keypoints that have none."""
    keypoints = data.get("keypoints") if isinstance(data, Mapping) else None
    if not isinstance(keypoints, list):
        return data
    filled = [
        {"xyz": [0.0, 0.0, 0.0], **each} if isinstance(each, Mapping) else each
        for each in keypoints
    ]
    return {**data, "keypoints": filled}


def _column(keypoints: list[_Keypoint], name: str) -> Any:
    """One optional field of all keypoints as a list; None where none has it."""
    values = [getattr(keypoint, name) for keypoint in keypoints]
    missing = [row for row, value in enumerate(values) if value is None]
    if len(missing) == len(values):
        return None
    if missing:
        raise DataError(
            "missing, though other keypoints have it",
            where=f"keypoints[{missing[0]}].{name}",
            fix="give it for all keypoints or for none",
        )
    return values
