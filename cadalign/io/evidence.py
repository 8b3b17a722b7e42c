"""One image of an object: keypoints, evidence beyond them, and the fields of both in a file.

The format is described in docs/formats/observation.md.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct

from cadalign.arrays import FloatArray, IntArray, as_floats, as_one_or_each, as_points, as_positive
from cadalign.errors import DataError, InputError, quote, require_kind
from cadalign.geometry.camera import Camera
from cadalign.geometry.pixels import PixelOrigin, check_pixels, shift_of, unmeasured
from cadalign.io.documents import (
    Document,
    Finite,
    Index,
    NotNegative,
    Point3,
    Positive,
    Text,
    require_unique,
    written_path,
)
from cadalign.io.files import as_path

LENGTHS = ("width", "height", "length")
"""Names of the lengths along the model's x, y and z."""
_LENGTH_SIGMA = 0.01  # relative
_LISTED = 8  # rows of keypoints in a message
_COLUMNS = ("name", "semantic_id", "sigma", "score")  # of all keypoints, or of none
_REFINED = {
    "mask_sigma": "mask",
    "depth_scale": "depth",
    "depth_sigma": "depth",
    "up_sigma_deg": "up",
    "camera_height_sigma": "camera_height",
}
"""The field without which a field means nothing."""
_Row4 = tuple[Finite, Finite, Finite, Finite]


class ImageEvidence(Document, kw_only=True, eq=False):
    """Evidence of an image beyond keypoints, with files of mask and depth; None where unknown.

    `cadalign.View` describes the fields, and checks arrays.

    Raises
    ------
    InputError
        If a sigma or scale is given without its measurement.
    """

    mask: Path | None = None
    mask_sigma: Positive | None = None
    depth: Path | None = None
    depth_scale: Positive | None = None
    depth_sigma: Positive | None = None
    up: Point3 | None = None
    up_sigma_deg: Positive | None = None
    camera_height: Positive | None = None
    camera_height_sigma: Positive | None = None
    cam_from_rig: tuple[_Row4, _Row4, _Row4, _Row4] | None = None

    def __post_init__(self) -> None:
        given = self.given
        for name in given:
            # depth_sigma may be that of depths of the keypoints
            if name != "depth_sigma" and (missing := _REFINED.get(name, name)) not in given:
                what, fix = f"given without {missing}", f"give {missing}, too"
                raise InputError(what, where=name, fix=fix)
        for name in ("mask", "depth"):
            if name in given:
                setattr(self, name, as_path(given[name], name))

    @property
    def given(self) -> dict[str, Any]:
        """The fields that are known, by name."""
        names = ImageEvidence.__struct_fields__
        return {name: value for name in names if (value := getattr(self, name)) is not None}

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the fields that are known and are evidence by themselves."""
        return tuple(name for name in self.given if name not in _REFINED)


class Size(Struct, frozen=True, eq=False, omit_defaults=True, forbid_unknown_fields=True):
    """Known lengths of an object's box along the model's axes.

    Parameters
    ----------
    width, height, length : float, optional
        Along x, y, z [the unit in which pose and size are wanted].
    sigma : float or (3,) float, optional
        Standard deviation of the lengths, relative; by default 0.01, 1 %.

    Raises
    ------
    InputError
        If no length is given, or a value is not positive.

    Examples
    --------
    >>> Size(height=0.81, sigma=0.005).lengths.tolist()
    [nan, 0.81, nan]
    """

    width: Positive | None = None
    height: Positive | None = None
    length: Positive | None = None
    sigma: Any = None

    def __post_init__(self) -> None:
        for name in LENGTHS:
            if (value := getattr(self, name)) is not None:
                msgspec.structs.force_setattr(self, name, as_positive(value, name=name))
        if np.isnan(self.lengths).all():
            raise InputError("no length is given", fix="give width, height or length")
        if self.sigma is not None:
            as_one_or_each(self.sigma, name="sigma", count=3, entries="lengths")

    @property
    def lengths(self) -> FloatArray:
        """Lengths (3,) along x, y, z; NaN where unknown."""
        return np.array([getattr(self, name) for name in LENGTHS], dtype=float)

    @property
    def deviations(self) -> FloatArray:
        """Standard deviations (3,) of the lengths; NaN where unknown."""
        relative = np.asarray(_LENGTH_SIGMA if self.sigma is None else self.sigma, dtype=float)
        return np.asarray(self.lengths * relative)


@dataclass(frozen=True, eq=False)
class ObservedImage:
    """Keypoints of the object in one image, and further evidence of the image.

    Parameters
    ----------
    points_3d : (n, 3) float
        Model points [model units].
    points_2d : (n, 2) float
        Image points [px].
    camera : Camera
    sigma : (n,) float, optional
        Standard deviation of each image point [px].
    ids : (n,) int, optional
        Meaning of each keypoint; the same number on all models of a category.
    names : tuple of n str, optional
        Name of each keypoint.
    scores : (n,) float, optional
        Trust in each keypoint, for the ``scores`` of `cadalign.fit`.
    image : Path, optional
        The photo.
    depths : (n,) float, optional
        Depth of each keypoint [model units]; NaN where unknown.
    evidence : ImageEvidence
        What is known beyond keypoints.
    not_found : tuple of int
        Rows of the file's keypoints that are left out here: their pixels are no measurements, see
        `cadalign.geometry.pixels.unmeasured`.

    Raises
    ------
    InputError
        If shapes don't match, a value is NaN or infinite, or depths are given twice.
    """

    points_3d: FloatArray
    points_2d: FloatArray
    camera: Camera
    sigma: FloatArray | None = None
    ids: IntArray | None = None
    names: tuple[str, ...] | None = None
    scores: FloatArray | None = None
    image: Path | None = None
    depths: FloatArray | None = field(default=None, kw_only=True)
    evidence: ImageEvidence = field(default_factory=ImageEvidence, kw_only=True)
    not_found: tuple[int, ...] = field(default=(), kw_only=True)

    def __post_init__(self) -> None:
        require_kind(self.camera, Camera, "camera")
        points_3d = as_points(self.points_3d, name="points_3d", dimension=3)
        count = len(points_3d)
        checked: dict[str, Any] = {"points_3d": points_3d}
        checked["points_2d"] = as_floats(self.points_2d, name="points_2d", shape=(count, 2))
        for name in ("sigma", "scores", "depths"):
            if (value := getattr(self, name)) is not None:
                finite = name != "depths"
                checked[name] = as_floats(value, name=name, shape=(count,), finite=finite)
        if self.image is not None:
            checked["image"] = as_path(self.image, "image")
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        if self.depths is not None and self.evidence.depth is not None:
            what, fix = (
                "a depth image and depths of keypoints are given",
                "leave out one of the two",
            )
            raise InputError(what, where="depth", fix=fix)

    @property
    def labels(self) -> tuple[str | int, ...]:
        """Names of the keypoints in messages, or else their rows in the file."""
        count = len(self.points_2d) + len(self.not_found)
        if self.names is not None and len(set(self.names)) == len(self.names):
            return self.names
        return tuple(row for row in range(count) if row not in self.not_found)

    @property
    def text_of_not_found(self) -> str:
        """A note about the keypoints that are left out; empty where none is."""
        if not self.not_found:
            return ""
        count, rows = len(self.not_found), ", ".join(map(str, self.not_found[:_LISTED]))
        rows += ", ..." if count > _LISTED else ""
        return (
            f"{count} of {count + len(self.points_2d)} keypoints are not found and left out "
            f"(rows {rows}): their pixels are missing, (0, 0), or one and the same"
        )


# Files --------------------------------------------------------------------------------------------


class SeenKeypoint(Document, kw_only=True):
    """Fields of a keypoint that a photo, or its detector, gives."""

    semantic_id: Index | None = None
    sigma: Positive | None = None
    score: NotNegative | None = None
    depth: Positive | None = None


class KeypointFields(SeenKeypoint, kw_only=True):
    """One entry of ``keypoints``."""

    xyz: Point3 | None = None  # needed with a mesh
    uv: tuple[float | None, float | None] | None  # null, or NaN, where it was not found
    name: Text | None = None


class ViewFields(ImageEvidence, kw_only=True):
    """One entry of ``views``."""

    camera: Any  # in the form of `Camera.from_dict`
    pixel_origin: PixelOrigin = "center"  # of the keypoints' uv
    image: Path | None = None
    keypoints: list[KeypointFields] = msgspec.field(default_factory=list)


def read_image_fields(read: ViewFields, *, needs_xyz: bool = True) -> ObservedImage:
    """An image from its checked fields.

    A missing ``xyz`` is zero, or refused where it is needed. Raises InputError if the camera is
    invalid, or fields contradict each other.
    """
    for name in ("name", "semantic_id"):
        require_unique(read.keypoints, name)
    camera, points_2d = _camera(read.camera), _pixels(read.keypoints)
    kept = np.flatnonzero(~unmeasured(points_2d)).tolist()
    keypoints = {row: read.keypoints[row] for row in kept}
    points_2d = points_2d[kept]
    names, ids, sigma, scores = (_column(keypoints, name) for name in _COLUMNS)
    for row, each in keypoints.items():
        if needs_xyz and each.xyz is None:
            raise DataError("missing", where=f"keypoints[{row}].xyz")
    check_pixels(points_2d, camera.width, camera.height, where="keypoints.uv")
    places = [each.xyz or (0, 0, 0) for each in keypoints.values()]
    depths = np.array([each.depth for each in keypoints.values()], dtype=float)  # NaN for None
    return ObservedImage(
        points_3d=np.array(places, dtype=float).reshape(-1, 3),
        points_2d=points_2d - shift_of(read.pixel_origin),
        camera=camera,
        sigma=sigma,
        ids=None if ids is None else np.array(ids, dtype=np.int64),
        names=None if names is None else tuple(names),
        scores=scores,
        image=read.image,
        depths=depths if np.isfinite(depths).any() else None,
        not_found=tuple(sorted(set(range(len(read.keypoints))).difference(kept))),
        evidence=ImageEvidence(**read.given),
    )


def _camera(form: Any) -> Camera:
    """The camera of a form in a file, which most images of a run share."""
    try:
        return _camera_of(json.dumps(form))
    except (TypeError, ValueError, RecursionError):  # of NumPy's arrays
        return Camera.from_dict(form)


@lru_cache(maxsize=64)
def _camera_of(text: str) -> Camera:
    return Camera.from_dict(json.loads(text))


def _pixels(keypoints: Sequence[KeypointFields]) -> FloatArray:
    """Pixels (n, 2) of keypoints; NaN where they were not found."""
    pixels = np.array([each.uv or (None, None) for each in keypoints], dtype=float).reshape(-1, 2)
    if np.isfinite(pixels).all():
        return pixels
    half = np.isnan(pixels) & ~np.isnan(pixels[:, ::-1])
    for row, column in np.argwhere(np.isinf(pixels) | half).tolist():
        value = (keypoints[row].uv or ())[column]
        what, where = f"{quote(value)} is not a finite number", f"keypoints[{row}].uv[{column}]"
        raise DataError(what, where=where)
    return pixels


def _column(keypoints: Mapping[int, KeypointFields], name: str) -> Any:
    """One optional field of all keypoints, by rows, as a list; None where none has it."""
    values = [getattr(keypoint, name) for keypoint in keypoints.values()]
    missing = [row for row, value in zip(keypoints, values, strict=True) if value is None]
    if len(missing) == len(values):
        return None
    if missing:
        raise DataError(
            "missing, though other keypoints have it",
            where=f"keypoints[{missing[0]}].{name}",
            fix="give it for all keypoints or for none",
        )
    return values


def write_image_fields(image: ObservedImage, folder: Path | None) -> dict[str, Any]:
    """Camera, keypoints, photo and evidence of an image as they are written."""
    columns = {
        "xyz": image.points_3d,
        "uv": image.points_2d,
        "sigma": image.sigma,
        "semantic_id": image.ids,
        "name": image.names,
        "score": image.scores,
        "depth": image.depths,
    }
    known = {
        name: each.tolist() if isinstance(each, np.ndarray) else each
        for name, each in columns.items()
        if each is not None
    }
    rows = [dict(zip(known, row, strict=True)) for row in zip(*known.values(), strict=True)]
    data: dict[str, Any] = {
        "camera": image.camera.to_dict(pixel_origin="corner"),
        "pixel_origin": "center",
        # An unknown depth is NaN.
        "keypoints": [
            {name: value for name, value in row.items() if value == value} for row in rows
        ],
    }
    for name, value in {"image": image.image, **image.evidence.given}.items():
        if isinstance(value, Path):
            data[name] = written_path(value, folder=folder)
        elif value is not None:
            data[name] = np.asarray(value).tolist()
    return data
