"""The declared fields of observation files, and their conversion to and from images.

The format is described in docs/formats/observation.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, cast

import msgspec
import numpy as np
from msgspec import UNSET, Meta, UnsetType

from cadalign.arrays import FloatArray
from cadalign.errors import DataError, quote
from cadalign.geometry.alignment import Alignment
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
from cadalign.io.evidence import ImageEvidence, ObservedImage, Size

_Row4 = tuple[Finite, Finite, Finite, Finite]
_EVIDENCE: dict[str, Any] = {
    "mask": PathText,
    "mask_sigma": Positive,
    "depth": PathText,
    "depth_scale": Positive,
    "depth_sigma": Positive,
    "up": Point3,
    "up_sigma_deg": Positive,
    "camera_height": Positive,
    "camera_height_sigma": Positive,
    "cam_from_rig": tuple[_Row4, _Row4, _Row4, _Row4],
}
_PATHS = ("mask", "depth")
_COLUMNS = ("name", "semantic_id", "sigma", "score")  # of all keypoints, or of none
Declared = TypeVar("Declared", bound=Document)


def _with_evidence(fields: type[Declared]) -> type[Declared]:
    """The declared fields with those of an image's evidence beyond keypoints."""
    added: list[tuple[str, Any, Any]] = [
        (name, each | None, None) for name, each in _EVIDENCE.items()
    ]
    extended = msgspec.defstruct(fields.__name__, added, bases=(fields,), kw_only=True)
    return cast("type[Declared]", extended)


class SeenKeypoint(Document, kw_only=True):
    """Fields of a keypoint that a photo, or its detector, gives."""

    semantic_id: Index | None = None
    sigma: Positive | None = None
    score: NotNegative | None = None
    depth: Positive | None = None


class KeypointFields(SeenKeypoint, kw_only=True):
    """One entry of ``keypoints``."""

    xyz: Point3
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


class StartFields(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The entry ``init``."""

    rotation: tuple[Point3, Point3, Point3]
    translation: Point3
    scale: Point3 = (1.0, 1.0, 1.0)

    @classmethod
    def of(cls, alignment: Alignment) -> StartFields:
        """The entry of an alignment."""
        return cast("StartFields", convert(alignment.to_dict(), cls))

    @property
    def alignment(self) -> Alignment:
        """The alignment; raises InputError if the rotation is none, or a scale is not positive."""
        return Alignment(np.array(self.rotation), np.array(self.translation), np.array(self.scale))


@_with_evidence
class ViewFields(Document, kw_only=True):
    """One entry of ``views``."""

    camera: Any  # in the form of `Camera.from_dict`
    pixel_origin: PixelOrigin = "center"  # of the keypoints' uv
    image: PathText | None = None
    keypoints: list[KeypointFields] = msgspec.field(default_factory=list)


class _ObjectFields(Document, kw_only=True):
    """Fields of a file beyond those of its images."""

    model: PathText | None = None
    shape: PathText | None = None
    size: SizeFields | None = None
    object: Text | None = None
    up_axis: Literal["x", "y", "z"] | None = "y"
    symmetry: Any = None  # in a form of `Symmetry.from_dict`
    unfinished: Any = None  # the annotator's
    init: StartFields | None = None
    fit: FitFields = msgspec.field(default_factory=FitFields)


@_with_evidence
class OneView(_ObjectFields, kw_only=True):
    """A file of one image."""

    camera: Any  # as of `ViewFields`
    pixel_origin: PixelOrigin = "center"
    image: PathText | None = None
    keypoints: Annotated[list[KeypointFields], Meta(min_length=1)]


class StartedView(OneView, kw_only=True):
    """A file of one image with a mask or a start, which needs no keypoints."""

    keypoints: list[KeypointFields] = msgspec.field(default_factory=list)


class SeveralViews(_ObjectFields, kw_only=True):
    """A file of several images."""

    views: Annotated[list[ViewFields], Meta(min_length=1)]


def read_fields(data: Any) -> tuple[OneView | SeveralViews, tuple[ViewFields | OneView, ...]]:
    """Check the parsed form of a file; returns its fields and those of its views.

    Raises DataError if a field is missing, unknown or invalid.
    """
    if not isinstance(data, Mapping) or "views" not in data:
        given = data if isinstance(data, Mapping) else {}
        needs_none = given.get("init") is not None or given.get("mask") is not None
        one: OneView = convert(data, StartedView if needs_none else OneView)
        sigma = one.fit.sigma
        if isinstance(sigma, list) and len(sigma) != len(one.keypoints):
            what = f"{len(sigma)} numbers for {len(one.keypoints)} keypoints"
            raise DataError(what, where="fit.sigma", fix="give one for each, or one for all")
        return one, (one,)
    several: SeveralViews = convert(data, SeveralViews)
    if isinstance(several.fit.sigma, list):
        fix = "give one for all, or `sigma` of every keypoint"
        raise DataError("a list, but there are several views", where="fit.sigma", fix=fix)
    return several, tuple(several.views)


def read_image_fields(read: ViewFields | OneView, folder: Path | None) -> ObservedImage:
    """An image from its checked fields; paths are relative to ``folder``.

    Raises InputError if the camera is invalid, or fields contradict each other.
    """
    for field in ("name", "semantic_id"):
        require_unique(read.keypoints, field)
    columns = {name: _column(read.keypoints, name) for name in _COLUMNS}
    camera = Camera.from_dict(read.camera)
    pixels = [each.uv or (None, None) for each in read.keypoints]
    points_2d = np.array(pixels, dtype=float).reshape(-1, 2)
    bad = np.argwhere(np.isinf(points_2d) | (np.isnan(points_2d) != np.isnan(points_2d[:, ::-1])))
    for row, column in bad:
        if not np.isfinite(points_2d[row, column]):
            what = f"{quote(pixels[row][column])} is not a finite number"
            raise DataError(what, where=f"keypoints[{row}].uv[{column}]")
    kept = np.flatnonzero(~unmeasured(points_2d)).tolist()
    lost = tuple(sorted(set(range(len(pixels))).difference(kept)))
    columns = {
        name: None if column is None else [column[row] for row in kept]
        for name, column in columns.items()
    }
    keypoints, points_2d = [read.keypoints[row] for row in kept], points_2d[kept]
    ids, names = columns["semantic_id"], columns["name"]
    check_pixels(points_2d, camera.width, camera.height, where="keypoints.uv")
    evidence = {name: getattr(read, name) for name in _EVIDENCE}
    for name in _PATHS:
        evidence[name] = evidence[name] and path_from(evidence[name], folder)
    return ObservedImage(
        points_3d=np.array([each.xyz for each in keypoints]).reshape(-1, 3),
        points_2d=points_2d - shift_of(read.pixel_origin),
        camera=camera,
        sigma=columns["sigma"],
        ids=None if ids is None else np.array(ids, dtype=np.int64),
        names=None if names is None else tuple(names),
        scores=columns["score"],
        image=None if read.image is None else path_from(read.image, folder),
        depths=_depths(keypoints),
        not_found=lost,
        evidence=ImageEvidence(**evidence),
    )


def read_size(read: SizeFields | None) -> Size | None:
    """The known lengths, if there are any.

    Raises InputError if it has no length, or neither one standard deviation nor three.
    """
    return None if read is None else Size(**msgspec.structs.asdict(read))


def write_image_fields(
    image: ObservedImage, folder: Path | None, *, states_origins: bool = False
) -> dict[str, Any]:
    """Camera, keypoints, photo and evidence of an image as they are written.

    ``states_origins`` writes the pixel conventions of camera and keypoints, which are the defaults.
    """
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
    camera = image.camera.to_dict(pixel_origin="corner" if states_origins else None)
    data: dict[str, Any] = {"camera": camera}
    if states_origins:
        data["pixel_origin"] = "center"
    data["keypoints"] = keypoints
    if image.image is not None:
        data["image"] = written_path(image.image, folder=folder)
    for name, value in image.evidence.given.items():
        if isinstance(value, Path):
            data[name] = written_path(value, folder=folder)
        else:
            data[name] = value.tolist() if isinstance(value, np.ndarray) else value
    return data


def fill_xyz(data: Any) -> Any:
    """The parsed form of a file, with zeros for the ``xyz`` of keypoints that have none."""
    if not isinstance(data, Mapping):
        return data
    if isinstance(views := data.get("views"), list):
        return {**data, "views": [fill_xyz(view) for view in views]}
    keypoints = data.get("keypoints")
    if not isinstance(keypoints, list):
        return data
    filled = [
        {"xyz": [0.0, 0.0, 0.0], **each} if isinstance(each, Mapping) else each
        for each in keypoints
    ]
    return {**data, "keypoints": filled}


def _column(keypoints: Sequence[KeypointFields], name: str) -> Any:
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


def _depths(keypoints: Sequence[KeypointFields]) -> FloatArray | None:
    """Depths of the keypoints, NaN where unknown; None where all are."""
    depths = np.array([each.depth for each in keypoints], dtype=float)  # NaN for None
    return depths if np.isfinite(depths).any() else None
