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
      "model": "chair.obj"
    }

``camera`` is COLMAP's form, principal point in COLMAP's convention (the top-left corner of the
image is (0, 0)), see `cadalign.Camera.from_dict`; an unknown focal length is ``null`` there, or
``{"width": 640, "height": 480}`` is all that is given. ``xyz`` is in model units, ``uv`` in pixels
with integers at pixel centres, of the photo as it is seen: turned upright where EXIF says so.
``sigma`` [px], ``semantic_id``, ``name`` and ``confidence`` (a detector's score, not negative) are
optional, each given for all keypoints or for none. ``image`` and ``model`` are optional paths,
relative to the file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, IntArray, as_floats, as_points
from cadalign.errors import DataError
from cadalign.geometry.camera import Camera
from cadalign.io.files import write_json
from cadalign.io.json_file import (
    as_index,
    as_number,
    as_object,
    as_text,
    in_file,
    read_json,
    refuse_unknown,
    written_path,
)

_FIELDS = {"camera", "keypoints", "image", "model"}
_KEYPOINT_FIELDS = {"xyz", "uv", "sigma", "semantic_id", "name", "confidence"}


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
        What each keypoint means; the same number on all models of a category.
    names : tuple of n str, optional
        What each keypoint is called.
    confidences : (n,) float, optional
        How much each keypoint is trusted, for the ``confidences`` of `cadalign.fit`.
    image, model : Path, optional
        The photo and the CAD model.
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

    def __post_init__(self) -> None:
        points_3d = as_points(self.points_3d, name="points_3d", dimension=3)
        points_2d = as_floats(self.points_2d, name="points_2d", shape=(len(points_3d), 2))
        object.__setattr__(self, "points_3d", points_3d)
        object.__setattr__(self, "points_2d", points_2d)
        for name in ("sigma", "confidences"):
            value = getattr(self, name)
            if value is not None:
                checked = as_floats(value, name=name, shape=(len(points_3d),))
                object.__setattr__(self, name, checked)

    @classmethod
    def load(cls, path: str | Path) -> Observation:
        """Read an observation file.

        Raises
        ------
        DataError
            If the file is missing, is not JSON, or a field is missing, unknown or invalid; the
            message names file and field.
        """
        path = Path(path)
        data = read_json(path)
        with in_file(path):
            return cls.from_dict(data, folder=path.parent)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], *, folder: Path | None = None) -> Observation:
        """Read the parsed form of an observation file; paths are relative to ``folder``."""
        data = as_object(data, where=None)
        refuse_unknown(data, _FIELDS, where="top level")
        for name in ("camera", "keypoints"):
            if name not in data:
                raise DataError("missing", where=name)
        keypoints = data["keypoints"]
        if not isinstance(keypoints, list) or not keypoints:
            raise DataError("expected a list of at least one keypoint", where="keypoints")
        for i, keypoint in enumerate(keypoints):
            _check_keypoint(keypoint, where=f"keypoints[{i}]")
        names = _column(keypoints, "name", np.str_)
        return cls(
            points_3d=np.array([keypoint["xyz"] for keypoint in keypoints], dtype=float),
            points_2d=np.array([keypoint["uv"] for keypoint in keypoints], dtype=float),
            camera=Camera.from_dict(data["camera"]),
            sigma=_column(keypoints, "sigma", np.float64),
            semantic_ids=_column(keypoints, "semantic_id", np.int64),
            names=None if names is None else tuple(names.tolist()),
            confidences=_column(keypoints, "confidence", np.float64),
            image=_path(data, "image", folder),
            model=_path(data, "model", folder),
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
        for name, path in (("image", self.image), ("model", self.model)):
            if path is not None:
                data[name] = written_path(path, folder=folder)
        return data

    def save(self, path: str | Path) -> None:
        """Write an observation file; paths are written relative to it."""
        write_json(Path(path), self.to_dict(folder=Path(path).parent))


def _check_keypoint(keypoint: Any, *, where: str) -> None:
    """Refuse a keypoint that lacks a field or holds something else than finite numbers."""
    keypoint = as_object(keypoint, where=where)
    refuse_unknown(keypoint, _KEYPOINT_FIELDS, where=where)
    for name, length in (("xyz", 3), ("uv", 2)):
        if name not in keypoint:
            raise DataError("missing", where=f"{where}.{name}")
        as_floats(keypoint[name], name=f"{where}.{name}", shape=(length,))
    if "sigma" in keypoint and not as_number(keypoint["sigma"], where=f"{where}.sigma") > 0:
        raise DataError("is not positive", where=f"{where}.sigma")
    if as_number(keypoint.get("confidence", 0.0), where=f"{where}.confidence") < 0:
        raise DataError("is negative", where=f"{where}.confidence")
    as_text(keypoint.get("name", "none"), where=f"{where}.name")
    as_index(keypoint.get("semantic_id", 0), where=f"{where}.semantic_id")


def _column(keypoints: list[Any], name: str, kind: Any) -> npt.NDArray[Any] | None:
    """One optional field of all keypoints."""
    present = [name in keypoint for keypoint in keypoints]
    if not any(present):
        return None
    if not all(present):
        raise DataError(
            "missing, though other keypoints have it",
            where=f"keypoints[{present.index(False)}].{name}",
            fix="give it for all keypoints or for none",
        )
    return np.array([keypoint[name] for keypoint in keypoints], dtype=kind)


def _path(data: Mapping[str, Any], name: str, folder: Path | None) -> Path | None:
    value = data.get(name)
    if value is None:
        return None
    if not isinstance(value, str):
        raise DataError(f"{value!r} is not a path", where=name)
    return folder / value if folder is not None else Path(value)
