"""Options that commands share, and errors that name the options of the command line."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from cadalign.cli.common import JsonOption, UsageError
from cadalign.errors import DataError, InputError, refuse_unused
from cadalign.io.documents import read_json
from cadalign.io.kinds import OBSERVATION, is_of_many
from cadalign.io.observation import DetectorOptions, ObservationChanges

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


_FLAGS = {"fov_x": "--fov", "number": "--object"}
"""Options of the command line whose name differs from the argument's."""


@contextmanager
def name_flags(*options: DataclassInstance, **others: str) -> Iterator[None]:
    """Make errors about fields of options name the options of the command line.

    ``others`` are the flags of further arguments, by name.
    """
    flags = _FLAGS | flags_of(*options) | others
    try:
        yield
    except DataError as error:
        if (error.fix or "").startswith("known are "):  # fields of a file, not options
            raise
        raise DataError(error.what, where=error.where, fix=add_flags(error.fix, flags)) from None
    except InputError as error:
        where = flags.get(str(error.where), error.where)
        what = str(add_flags(error.what, flags))
        raise InputError(what, where=where, fix=add_flags(error.fix, flags)) from None


def flags_of(*options: DataclassInstance) -> dict[str, str]:
    """Return the flags of options, by the names of their fields."""
    names = [field.name for each in options for field in fields(each)]
    return {name: "--" + name.replace("_", "-") for name in names}


def add_flags(text: str | None, flags: Mapping[str, str]) -> str | None:
    """Replace names in backquotes or with an underscore by their flags."""
    for name, flag in flags.items():
        if text is not None:
            text = text.replace(f"`{name}`", flag)
            if "_" in name:
                text = re.sub(rf"(?<![\w-]){name}(?!\w)", flag, text)
    return text


@dataclass(frozen=True, kw_only=True)
class ManyCommand(JsonOption, DetectorOptions):
    """Options of commands on one or many observations."""

    out: Path | None = None
    observations: Annotated[
        tuple[Path, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="OBSERVATION ...", help_behavior_hint="(required)"),
    ]
    """A JSON file with the camera and keypoints, and optionally the image, the model and further
    evidence. For a run: several files, folders of files, JSON lines (.jsonl), or a detector's
    keypoint file (COCO JSON or CSV) with --camera and --model or --shape."""
    picture: bool = True
    """Draw the box and keypoints over the photo (overlay.png); for a run, write report.html."""
    workers: int | None = None
    """Number of processes of a run: -1 for one per core, 0 to use none. By default -1, or 0 for
    fewer than 200 observations."""
    dask: str | None = None
    """Address of a Dask scheduler. Its workers are used instead of local processes."""

    @property
    def first(self) -> Path:
        """The first observation; raises UsageError if none is given."""
        if not self.observations:
            fix = "give a JSON file with camera and keypoints, or a folder of such files"
            raise UsageError("no observation is given", where="OBSERVATION", fix=fix)
        return self.observations[0]

    def read_single(self) -> Any:
        """Read the JSON of a single observation; returns None if there may be several.

        Raises InputError if an option that only affects runs is given for a single observation.
        """
        path, data = self.first, None
        if path.suffix.lower() == ".json" and os.path.isfile(path):
            data = read_json(path)
        if len(self.observations) > 1 or is_of_many(path, data):
            return None
        data = read_json(path, OBSERVATION) if data is None else data
        names = "workers", "dask", *DetectorOptions.__dataclass_fields__
        refuse_unused(self, names, "on one observation")
        return data


@dataclass(frozen=True, kw_only=True)
class CameraOptions:
    """The calibrated camera."""

    camera: Path | None = None
    """Camera calibration file: a 3 x 3 matrix K as text, or JSON with COLMAP's fields (model,
    width, height, params)."""
    focal: float | None = None
    """Focal length [px]; overrides the value in the files."""

    @property
    def changes(self) -> ObservationChanges:
        """The camera that replaces the camera of an observation."""
        focal = None if isinstance(self.focal, str) else self.focal  # "estimate" or "known"
        return ObservationChanges(self.camera, focal=focal)
