"""Keypoints and further evidence of an object in one image, and their fields in a file.

docs/formats/observation.md describes the format.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct

from cadalign.arrays import FloatArray, IntArray, as_floats, as_points, as_positive
from cadalign.errors import DataError, InputError, require_kind
from cadalign.geometry.camera import Camera
from cadalign.geometry.pixels import PixelOrigin, check_pixels, missing_pixels, shift_of
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
_LISTED = 8  # maximum number of rows in a message
_Row4 = tuple[Finite, Finite, Finite, Finite]


class ImageEvidence(Document, kw_only=True, eq=False):
    """Evidence in an image beyond keypoints; None for unknown values. The mask is a file.

    `cadalign.View` describes the fields.

    Raises
    ------
    InputError
        If a standard deviation is given without its measurement.
    """

    mask: Path | None = None
    mask_sigma: Positive | None = None
    depth_sigma: Positive | None = None  # of the keypoints' depths
    up: Point3 | None = None
    up_sigma_deg: Positive | None = None
    camera_height: Positive | None = None
    camera_height_sigma: Positive | None = None
    cam_from_rig: tuple[_Row4, _Row4, _Row4, _Row4] | None = None

    def __post_init__(self) -> None:
        if self.mask is not None:
            self.mask = as_path(self.mask, "mask")
        for name in self.given:
            measured = name.partition("_sigma")[0]
            if measured not in (*self.sources, "depth"):
                what, fix = f"given without {measured}", f"give {measured}, too"
                raise InputError(what, where=name, fix=fix)

    @property
    def given(self) -> dict[str, Any]:
        """The known fields, by name."""
        names = ImageEvidence.__struct_fields__
        return {name: value for name in names if (value := getattr(self, name)) is not None}

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the known fields, without standard deviations."""
        return tuple(name for name in self.given if "_sigma" not in name)


class Size(Struct, frozen=True, eq=False, omit_defaults=True, forbid_unknown_fields=True):
    """Known lengths of an object's box along the model's axes.

    Parameters
    ----------
    width, height, length : float, optional
        Lengths along x, y, z; the estimated pose and size have the same unit.
    sigma : float
        Relative standard deviation of the lengths: 0.01 is 1 %.

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
    sigma: Positive = 0.01

    def __post_init__(self) -> None:
        for name in (*LENGTHS, "sigma"):
            if (value := getattr(self, name)) is not None:
                msgspec.structs.force_setattr(self, name, as_positive(value, name=name))
        if np.isnan(self.lengths).all():
            raise InputError("no length is given", fix="give width, height or length")

    @property
    def lengths(self) -> FloatArray:
        """Lengths (3,) along x, y, z; NaN where unknown."""
        return np.array([getattr(self, name) for name in LENGTHS], dtype=float)

    @property
    def deviations(self) -> FloatArray:
        """Standard deviations (3,) of the lengths; NaN where unknown."""
        return np.asarray(self.lengths * self.sigma)


@dataclass(frozen=True, eq=False)
class ObservedImage:
    """Keypoints of an object in one image, and further evidence in the image.

    Parameters
    ----------
    points_3d : (n, 3) float
        Model points [model units].
    points_2d : (n, 2) float
        Image points [px].
    camera : Camera
        The photo's camera.
    sigma : (n,) float, optional
        Standard deviation of each image point [px].
    ids : (n,) int, optional
        Semantic id of each keypoint, the same on all models of a category.
    names : tuple of n str, optional
        Name of each keypoint.
    scores : (n,) float, optional
        Confidence in each keypoint, for the ``scores`` of `cadalign.fit`.
    image : Path, optional
        The photo.
    depths : (n,) float, optional
        Depth of each keypoint [model units]; NaN where unknown.
    evidence : ImageEvidence
        Further evidence.
    not_found : tuple of int
        Rows of the file's keypoints that are left out because their pixels are not measurements;
        see `cadalign.geometry.pixels.missing_pixels`.

    Raises
    ------
    InputError
        If shapes don't match, or a value is NaN or infinite.
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
        checked: dict[str, Any] = {"points_3d": points_3d}
        each = (len(points_3d),)
        shapes = {"points_2d": (*each, 2), "sigma": each, "scores": each, "depths": each}
        for name, shape in shapes.items():
            if (value := getattr(self, name)) is not None:
                checked[name] = as_floats(value, name=name, shape=shape, finite=name != "depths")
        if self.image is not None:
            checked["image"] = as_path(self.image, "image")
        for name, value in checked.items():
            object.__setattr__(self, name, value)

    @property
    def labels(self) -> tuple[str | int, ...]:
        """Labels of the keypoints in messages: unique names, or rows in the file."""
        count = len(self.points_2d) + len(self.not_found)
        if self.names is not None and len(set(self.names)) == len(self.names):
            return self.names
        return tuple(row for row in range(count) if row not in self.not_found)

    @property
    def text_of_not_found(self) -> str:
        """A note about keypoints that are left out; empty if there are none."""
        if not self.not_found:
            return ""
        count, rows = len(self.not_found), ", ".join(map(str, self.not_found[:_LISTED]))
        rows += ", ..." if count > _LISTED else ""
        return (
            f"{count} of {count + len(self.points_2d)} keypoints are not found and left out "
            f"(rows {rows}): their pixels are missing, (0, 0), or identical"
        )


# Files --------------------------------------------------------------------------------------------


class KeypointFields(Document, kw_only=True):
    """One entry of ``keypoints``."""

    xyz: Point3 | None = None  # required with a mesh
    uv: tuple[float | None, float | None] | None  # null if not found
    name: Text | None = None
    semantic_id: Index | None = None
    sigma: Positive | None = None
    score: NotNegative | None = None
    depth: Positive | None = None


class ViewFields(ImageEvidence, kw_only=True):
    """One entry of ``views``."""

    camera: Any  # in the form of `Camera.from_dict`
    pixel_origin: PixelOrigin = "center"  # of the keypoints' uv
    image: Path | None = None
    keypoints: list[KeypointFields] = msgspec.field(default_factory=list)


def read_image_fields(read: ViewFields, *, needs_xyz: bool = True) -> ObservedImage:
    """Convert an image's checked fields.

    A missing ``xyz`` becomes zero, or raises DataError if ``needs_xyz``. Raises InputError if the
    camera is invalid, or fields contradict each other.
    """
    for name in ("name", "semantic_id"):
        require_unique(read.keypoints, name)
    camera = Camera.from_dict(read.camera)
    pixels = [each.uv or (None, None) for each in read.keypoints]
    points_2d = np.array(pixels, dtype=float).reshape(-1, 2)  # NaN for None
    is_found = ~missing_pixels(points_2d)
    points_2d = points_2d[is_found]
    check_pixels(points_2d, camera.width, camera.height, where="keypoints.uv")
    keypoints = {row: each for row, each in enumerate(read.keypoints) if is_found[row]}
    for row, each in keypoints.items():
        if needs_xyz and each.xyz is None:
            fix = "give it, or name a category as `shape`"
            raise DataError("missing", where=f"keypoints[{row}].xyz", fix=fix)
    places = [each.xyz or (0, 0, 0) for each in keypoints.values()]
    depths = np.array([each.depth for each in keypoints.values()], dtype=float)
    names, ids = _column(keypoints, "name"), _column(keypoints, "semantic_id")
    return ObservedImage(
        points_3d=np.array(places, dtype=float).reshape(-1, 3),
        points_2d=points_2d - shift_of(read.pixel_origin),
        camera=camera,
        sigma=_column(keypoints, "sigma"),
        ids=None if ids is None else np.array(ids, dtype=np.int64),
        names=None if names is None else tuple(names),
        scores=_column(keypoints, "score"),
        image=read.image,
        depths=depths if np.isfinite(depths).any() else None,
        not_found=tuple(np.flatnonzero(~is_found).tolist()),
        evidence=ImageEvidence(**read.given),
    )


def _column(keypoints: Mapping[int, KeypointFields], name: str) -> Any:
    """One optional field of all keypoints as a list; None if no keypoint has it."""
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


def write_image_fields(
    image: ObservedImage, folder: Path | None, *, needs_xyz: bool = True
) -> dict[str, Any]:
    """Convert camera, keypoints, photo and evidence of an image to the fields of a file.

    Unless it ``needs_xyz``, they are left out if all are zero.
    """
    columns = {
        "xyz": image.points_3d if needs_xyz or image.points_3d.any() else None,
        "uv": image.points_2d,
        "sigma": image.sigma,
        "semantic_id": image.ids,
        "name": image.names,
        "score": image.scores,
        "depth": image.depths,
    }
    known = {name: np.asarray(each).tolist() for name, each in columns.items() if each is not None}
    rows = [dict(zip(known, row, strict=True)) for row in zip(*known.values(), strict=True)]
    data: dict[str, Any] = {
        "camera": image.camera.to_dict() | {"pixel_origin": "corner"},
        "pixel_origin": "center",
        # An unknown depth is NaN.
        "keypoints": [
            {name: value for name, value in row.items() if value == value} for row in rows
        ],
    }
    for name, value in {"image": image.image, **image.evidence.given}.items():
        if value is not None:
            is_path = isinstance(value, Path)
            data[name] = written_path(value, folder=folder) if is_path else np.array(value).tolist()
    return data
