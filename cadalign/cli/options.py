"""Options that commands share, and errors that name them as the command line does."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from cadalign.cli.common import JsonOption, OptionError, UsageError
from cadalign.errors import CadalignError, DataError, InputError, refuse_unused
from cadalign.geometry.camera import Camera
from cadalign.io.documents import convert
from cadalign.io.evidence import EVIDENCE, Size
from cadalign.io.observation import DetectorOptions, Observation, ObservationChanges
from cadalign.io.observation_file import SizeFields, read_size

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


@contextmanager
def named_as_flags(
    *options: DataclassInstance,
    kind: type[CadalignError] = InputError,
    others: Mapping[str, str] | None = None,
) -> Iterator[None]:
    """Let errors about fields of dataclasses of options name the command line's options.

    ``others`` are flags of further arguments by name. Their kind is `OptionError` while the
    command line is parsed.
    """
    flags = flags_of(*options) | dict(others or {})
    try:
        yield
    except DataError as error:
        if (error.fix or "").startswith("known are "):  # names of a file's fields, no options
            raise
        raise DataError(error.what, where=error.where, fix=with_flags(error.fix, flags)) from None
    except InputError as error:
        if error.where not in flags:
            raise
        where = flags[str(error.where)]
        raise kind(error.what, where=where, fix=with_flags(error.fix, flags)) from None


class FlaggedOptions:
    """A group of options of the library that refuse values by the names of their flags."""

    def __post_init__(self) -> None:
        """Check the options."""
        with named_as_flags(self, kind=OptionError):  # type: ignore[arg-type]
            super().__post_init__()  # type: ignore[misc]


def flags_of(*options: DataclassInstance) -> dict[str, str]:
    """The command line's options by the names of fields."""
    return {field.name: flag_of(field.name) for each in options for field in fields(each)}


def with_flags(fix: str | None, flags: Mapping[str, str]) -> str | None:
    """A remedy that names flags in the place of arguments of several words."""
    for name, flag in flags.items():
        if fix is not None and "_" in name:
            fix = re.sub(rf"(?<![\w-]){name}(?!\w)", flag, fix)
    return fix


def flag_of(name: str) -> str:
    """The command line's option for a field."""
    return "--" + name.replace("_", "-")


@dataclass(frozen=True, kw_only=True)
class ManyCommand(JsonOption, DetectorOptions):
    """Options of the commands on one observation, or on many."""

    out: Path | None = None
    observations: Annotated[
        tuple[Path, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="OBSERVATION ...", help_behavior_hint="(required)"),
    ]
    """A JSON file with camera and keypoints, optionally image, model and further evidence. Or many:
    several such files, folders, patterns in quotes, JSON lines (.jsonl), or a detector's file of
    keypoints (COCO's JSON, or CSV) with --camera and --model or --shape."""
    picture: bool = True
    """Draw box and keypoints over the photo, as overlay.png; of many observations, write a page."""
    workers: int | None = None
    """Processes for many observations; -1 for one for each core, 0 for none. By default -1, for few
    observations 0."""
    dask: str | None = None
    """Address of a Dask scheduler, whose workers are used instead."""
    pictures: int = 100
    """Number of observations, the first ones of many, whose photos the page shows."""

    def refuse_of_many(self, *used: str) -> None:
        """Refuse what is for many observations alone, but for ``used``; see `refuse_unused`."""
        names = {"workers", "dask", "pictures", *DetectorOptions.__dataclass_fields__}
        refuse_unused(self, names.difference(used), "on one observation")

    def first(self) -> Path:
        """The first observation; raises UsageError if none is given."""
        if not self.observations:
            fix = "give a JSON file with camera and keypoints, or a folder of such files"
            raise UsageError("no observation is given", where="OBSERVATION", fix=fix)
        return self.observations[0]


@dataclass(frozen=True, kw_only=True)
class CameraOptions:
    """The calibrated camera."""

    camera: Path | None = None
    """File of the calibrated camera: a matrix K as text, .npy or JSON, or JSON in COLMAP's form:
    model, width, height, params."""
    pixel_origin: Literal["center", "corner"] | None = None
    """Place of pixel (0, 0) for the camera's principal point: the centre of the top-left pixel
    (OpenCV) or the corner of the image (COLMAP); by default center for a matrix, and corner for
    COLMAP's form."""

    focal: float | None = None
    """Focal length [px], where no file has it, or in its place."""
    fov: float | None = None
    """Horizontal field of view [degrees], in the place of the focal length."""

    def read_camera(self, size: tuple[int, int] | None) -> Camera | None:
        """The camera of --camera; ``size`` is the photo's, for a file of a matrix alone."""
        return self.of_camera.read_camera(size)

    @property
    def of_camera(self) -> ObservationChanges:
        """The camera as what takes the place of an observation's."""
        if self.camera is None and self.pixel_origin is not None:
            raise InputError("given without --camera", where="--pixel-origin", fix="give both")
        focal: Any = self.focal
        if isinstance(focal, str):  # a word of the commands that estimate
            if self.fov is not None:
                what = f"given beside --focal {focal}"
                raise InputError(what, where="--fov", fix="give one of the two options")
            focal = None
        for name, value in (("focal", focal), ("fov", self.fov)):
            if value is not None and not 0 < value < (180 if name == "fov" else math.inf):
                bound = "between 0 and 180 degrees" if name == "fov" else "positive"
                raise InputError(f"{value:g} is not {bound}", where=f"--{name}")
        return ObservationChanges(self.camera, self.pixel_origin, focal=focal, fov=self.fov)


@dataclass(frozen=True, kw_only=True)
class EvidenceOptions:
    """Evidence beyond keypoints."""

    size: Annotated[dict[str, float] | None, tyro.conf.arg(metavar="NAME LENGTH ...")] = None
    """Known lengths of the object: width, height, length (along the model's x, y, z) and sigma,
    their relative standard deviation, as in --size height 0.91 sigma 0.005."""
    mask: Path | None = None
    """Mask of the object, a grey PNG of the photo's size."""
    mask_sigma: float | None = None
    """Standard deviation of the mask's contour [px]; estimated by default."""
    depth: Path | None = None
    """Depth image that is registered to the photo, a PNG of 16 bits; 0 where unknown."""
    depth_scale: float | None = None
    """Units per count of the depth image; 0.001 by default, millimetres to metres."""
    depth_sigma: float | None = None
    """Relative standard deviation of the depths; 0.01 by default."""
    up: tuple[float, float, float] | None = None
    """Upward direction in the camera's frame, whose y points down: 0 -1 0 for a level one."""
    up_sigma_deg: float | None = None
    """Standard deviation of this direction [degrees]; 1 by default."""
    camera_height: float | None = None
    """Height of the camera above the plane that the object stands on."""
    camera_height_sigma: float | None = None
    """Relative standard deviation of this height; 0.02 by default."""

    @property
    def given(self) -> dict[str, Any]:
        """The fields of evidence that are given, by name."""
        values = {name: getattr(self, name, None) for name in EVIDENCE}
        return {
            name: value.resolve() if isinstance(value, Path) else value
            for name, value in values.items()
            if value is not None
        }

    def add_to(self, observation: Observation, **others: Any) -> Observation:
        """An observation with the evidence of the options, which takes the place of its own.

        ``others`` are further fields.
        """
        with named_as_flags(self):
            evidence = others | self.given
            return ObservationChanges(evidence=evidence, size=self.known_size).applied_to(
                observation
            )

    @property
    def known_size(self) -> Size | None:
        """The known lengths."""
        if self.size is None:
            return None
        return read_size(convert(self.size, SizeFields, where="--size"))
