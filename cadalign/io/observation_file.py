"""The declared fields of observation files, and their conversion to and from images.

The format is described in docs/formats/observation.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import UNSET, Meta, UnsetType

from cadalign.arrays import FloatArray
from cadalign.errors import DataError, quote
from cadalign.geometry.camera import Camera
from cadalign.geometry.pixels import PixelOrigin, check_pixels, shift_of, unmeasured
from cadalign.io.documents import (
    Document,
    Finite,
    Index,
    NotNegative,
    PathText,
    Point3,
    Positive,
    Text,
    convert,
    path_from,
    require_unique,
    written_path,
)
from cadalign.io.evidence import EVIDENCE, ImageEvidence, ObservedImage, Size

_Row4 = tuple[Finite, Finite, Finite, Finite]
_PATHS = ("mask", "depth")
_COLUMNS = ("name", "semantic_id", "sigma", "score")  # of all keypoints, or of none


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


class FocalPriorFields(Document, omit_defaults=True):
    """The entry ``fit.focal_prior``."""

    focal: Positive
    relative_sigma: Positive
    source: str = ""


class FitFields(Document):
    """The entry ``fit``; fields that are not given keep the defaults of `cadalign.fit`."""

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


class SizeFields(Document):
    """The entry ``size``."""

    width: Positive | None = None
    height: Positive | None = None
    length: Positive | None = None
    # A tuple of three beside a number makes msgspec 0.22 crash in garbage collection.
    sigma: Positive | list[Positive] | None = None


class ViewFields(Document, kw_only=True):
    """One entry of ``views``; its last fields are those of `ImageEvidence`."""

    camera: Any  # in the form of `Camera.from_dict`
    pixel_origin: PixelOrigin = "center"  # of the keypoints' uv
    image: PathText | None = None
    keypoints: list[KeypointFields] = msgspec.field(default_factory=list)
    mask: PathText | None = None
    mask_sigma: Positive | None = None
    depth: PathText | None = None
    depth_scale: Positive | None = None
    depth_sigma: Positive | None = None
    up: Point3 | None = None
    up_sigma_deg: Positive | None = None
    camera_height: Positive | None = None
    camera_height_sigma: Positive | None = None
    cam_from_rig: tuple[_Row4, _Row4, _Row4, _Row4] | None = None


class ObservationFields(ViewFields, kw_only=True):
    """A file: fields of its only image, or ``views``, and what is known of the object."""

    camera: Any = UNSET
    views: Annotated[list[ViewFields], Meta(min_length=1)] | None = None
    model: PathText | None = None
    shape: PathText | None = None
    size: SizeFields | None = None
    object: Text | None = None
    up_axis: Literal["x", "y", "z"] | None = "y"
    symmetry: Any = None  # in a form of `Symmetry.from_dict`
    unfinished: Any = None  # the annotator's
    init: Any = None  # in the form of `Alignment.from_dict`
    fit: FitFields = msgspec.field(default_factory=FitFields)


def read_fields(data: Any) -> tuple[ObservationFields, Sequence[ViewFields]]:
    """Check the parsed form of a file; returns its fields and those of its views.

    Raises DataError if a field is missing, unknown or invalid.
    """
    read: ObservationFields = convert(data, ObservationFields)
    sigma = read.fit.sigma
    if read.views is not None:
        for name in ViewFields.__struct_fields__:
            if name in data:
                fix = "give it in each of the views"
                raise DataError("given beside `views`", where=name, fix=fix)
        if isinstance(sigma, list):
            fix = "give one for all, or `sigma` of every keypoint"
            raise DataError("a list, but there are several views", where="fit.sigma", fix=fix)
        return read, read.views
    if read.camera is UNSET:
        raise DataError("missing", where="camera")
    if not read.keypoints and read.init is None and read.mask is None:
        raise DataError("missing", where="keypoints", fix="give keypoints, `mask` or `init`")
    if isinstance(sigma, list) and len(sigma) != len(read.keypoints):
        what = f"{len(sigma)} numbers for {len(read.keypoints)} keypoints"
        raise DataError(what, where="fit.sigma", fix="give one for each, or one for all")
    return read, (read,)


def read_image_fields(
    read: ViewFields, folder: Path | None, *, needs_xyz: bool = True
) -> ObservedImage:
    """An image from its checked fields; paths are relative to ``folder``.

    A missing ``xyz`` is zero, or refused where it is needed. Raises InputError if the camera is
    invalid, or fields contradict each other.
    """
    for field in ("name", "semantic_id"):
        require_unique(read.keypoints, field)
    camera, points_2d = Camera.from_dict(read.camera), _pixels(read.keypoints)
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
    evidence = {name: getattr(read, name) for name in EVIDENCE}
    for name in _PATHS:
        evidence[name] = evidence[name] and path_from(evidence[name], folder)
    return ObservedImage(
        points_3d=np.array(places, dtype=float).reshape(-1, 3),
        points_2d=points_2d - shift_of(read.pixel_origin),
        camera=camera,
        sigma=sigma,
        ids=None if ids is None else np.array(ids, dtype=np.int64),
        names=None if names is None else tuple(names),
        scores=scores,
        image=None if read.image is None else path_from(read.image, folder),
        depths=depths if np.isfinite(depths).any() else None,
        not_found=tuple(sorted(set(range(len(read.keypoints))).difference(kept))),
        evidence=ImageEvidence(**evidence),
    )


def _pixels(keypoints: Sequence[KeypointFields]) -> FloatArray:
    """Pixels (n, 2) of keypoints; NaN where they were not found."""
    pixels = np.array([each.uv or (None, None) for each in keypoints], dtype=float).reshape(-1, 2)
    half = np.isnan(pixels) & ~np.isnan(pixels[:, ::-1])
    for row, column in np.argwhere(np.isinf(pixels) | half).tolist():
        value = (keypoints[row].uv or ())[column]
        what, where = f"{quote(value)} is not a finite number", f"keypoints[{row}].uv[{column}]"
        raise DataError(what, where=where)
    return pixels


def read_size(read: SizeFields | None) -> Size | None:
    """The known lengths, if there are any.

    Raises InputError if it has no length, or neither one standard deviation nor three.
    """
    return None if read is None else Size(**msgspec.structs.asdict(read))


def write_image_fields(image: ObservedImage, folder: Path | None) -> dict[str, Any]:
    """Camera, keypoints, photo and evidence of an image as they are written."""
    keypoints: list[dict[str, Any]] = [
        {"xyz": xyz, "uv": uv}
        for xyz, uv in zip(image.points_3d.tolist(), image.points_2d.tolist(), strict=True)
    ]
    for name, values in (
        ("sigma", image.sigma),
        ("semantic_id", image.ids),
        ("name", image.names),
        ("score", image.scores),
        ("depth", image.depths),
    ):
        if values is not None:
            listed = values.tolist() if isinstance(values, np.ndarray) else values
            for keypoint, value in zip(keypoints, listed, strict=True):
                if value == value:  # an unknown depth is NaN
                    keypoint[name] = value
    data: dict[str, Any] = {
        "camera": image.camera.to_dict(pixel_origin="corner"),
        "pixel_origin": "center",
        "keypoints": keypoints,
    }
    if image.image is not None:
        data["image"] = written_path(image.image, folder=folder)
    for name, value in image.evidence.given.items():
        if isinstance(value, Path):
            data[name] = written_path(value, folder=folder)
        else:
            data[name] = value.tolist() if isinstance(value, np.ndarray) else value
    return data


def _column(keypoints: Mapping[int, KeypointFields], name: str) -> Any:
    """One optional field of all keypoints, by rows, as a list; None where none has it."""
    values = {row: getattr(keypoint, name) for row, keypoint in keypoints.items()}
    missing = [row for row, value in values.items() if value is None]
    if len(missing) == len(values):
        return None
    if missing:
        raise DataError(
            "missing, though other keypoints have it",
            where=f"keypoints[{missing[0]}].{name}",
            fix="give it for all keypoints or for none",
        )
    return list(values.values())
