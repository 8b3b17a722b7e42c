"""Outputs of shape models: their file, and a picture of the mean.

The file is a sealed MessagePack document; see `cadalign.io.files` for the header. It holds the
fields of `cadalign.ShapeModel` and of its parts, arrays as little-endian numbers with their shape.
"""

from __future__ import annotations

import math
import os
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_args

import msgspec
import numpy as np
from msgspec import Meta

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import DataError, InputError
from cadalign.geometry.alignment import BOX_EDGES, bounds_corners
from cadalign.io.documents import Count, Document, PathText, in_file
from cadalign.io.files import Seal, as_path, printable, read_bytes, refuse_input, write_whole
from cadalign.shapes.parts import BOX_ROWS

if TYPE_CHECKING:
    from cadalign.shapes.model import ShapeModel


Kind = TypeVar("Kind")
SEAL = Seal(
    magic=b"cadalign shape\n\0",
    version=1,
    noun="shape file",
    fix="learn it with: cadalign shape learn",
)
_MAX_BYTES = 1 << 30  # of thousands of models with hundreds of keypoints each
_COMMON = 0.25  # share of the training models whose keypoints are joined by lines
_CELL = 4.0  # inches
_AZIMUTH, _ELEVATION = 32.0, 18.0  # degrees
_GREY, _DARK = "#c3c7cd", "#30343b"


class _Array(Document):
    """Little-endian numbers in C order."""

    shape: Annotated[list[Count], Meta(max_length=3)]
    data: bytes


def write_shape(path: str | os.PathLike[str], model: Any) -> None:
    """Write a shape model's file atomically."""
    document = {each.name: getattr(model, each.name) for each in fields(model)}
    try:
        content = msgspec.msgpack.encode(document, enc_hook=_written)
    except (UnicodeEncodeError, OverflowError) as error:  # of a name, of a number as an id
        raise InputError(f"cannot be saved ({error})", where=model.category) from None
    SEAL.write(as_path(path), content)


def read_shape(path: str | os.PathLike[str], kind: type[Kind]) -> Kind:
    """Read and check a shape model's file; ``kind`` is `cadalign.ShapeModel`."""
    file = as_path(path)
    payload = SEAL.unwrap(read_bytes(file, most=_MAX_BYTES), str(file))
    try:
        document = msgspec.msgpack.decode(payload)
        return msgspec.convert(document, kind, dec_hook=_read)
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        cause = error.__cause__
        if isinstance(cause, InputError) and str(cause) == str(error):  # of the model as a whole
            with in_file(file):
                raise cause from None
        what, _, place = str(error).partition(" - at `$.")
        join = "." if isinstance(cause, InputError) and cause.where else ": "
        what = f"{place.rstrip('`')}{join}{what}" if place else what
        raise SEAL.error(f"is invalid: {what[:200]}", str(file)) from None


def _written(value: Any) -> Any:
    if isinstance(value, Path):
        return str(value)
    little = value.astype(value.dtype.newbyteorder("<"))
    return _Array(list(value.shape), little.tobytes())


def _read(kind: Any, value: Any) -> Any:
    try:
        if kind is Path:
            return Path(msgspec.convert(value, PathText))
        array = msgspec.convert(value, _Array)
    except msgspec.ValidationError as error:
        raise ValueError(str(error)) from None  # to which the library adds the place
    dtype = np.dtype(get_args(get_args(kind)[1])[0]).newbyteorder("<")
    numbers = np.frombuffer(array.data, dtype=dtype) if array.data else np.empty(0, dtype=dtype)
    if math.prod(array.shape) != len(numbers):
        raise InputError(f"{len(numbers)} numbers are not of the shape {array.shape}")
    return numbers.reshape(array.shape).astype(dtype.newbyteorder("="))


def draw_shape(path: Path, model: ShapeModel) -> None:
    """Draw the mean of each component, with its box and the keypoints' ids.

    Raises DataError if no picture has the path's ending, or the file cannot be written.
    """
    from matplotlib.figure import Figure

    columns = len(model.components)
    figure = Figure(figsize=(columns * _CELL, _CELL), layout="constrained")
    refuse_input(path)
    if path.suffix[1:].lower() not in figure.canvas.get_supported_filetypes():
        what, fix = "is no picture's name", "end it in .png, .jpg, .svg or .pdf"
        raise DataError(what, where=printable(path), fix=fix)
    space = {"projection": "3d", "proj_type": "ortho"}
    axes = figure.subplots(1, columns, squeeze=False, subplot_kw=space)
    for each, component in zip(axes[0], model.components, strict=True):
        each.set_title(f"{model.category}, {100 * component.weight:.0f} % of the models", size=9)
        _draw_mean(each, model, component.mean)
    write_whole(path, lambda unfinished: figure.savefig(unfinished, dpi=110))


def _draw_mean(axes: Any, model: ShapeModel, mean: FloatArray) -> None:
    points, common = mean[:-BOX_ROWS], np.ones(len(model.ids), dtype=bool)
    if model.training is not None:
        common = np.isfinite(model.training.points_3d[..., 0]).mean(axis=0) >= _COMMON
    chosen, corners = np.flatnonzero(common), bounds_corners(*mean[-BOX_ROWS:])
    for edge in BOX_EDGES:
        axes.plot(*corners[list(edge)].T, color=_GREY, lw=0.7)
    for pair in chosen[neighbour_pairs(points[chosen])]:
        axes.plot(*points[pair].T, color=_DARK, lw=1.3)
    axes.scatter(*points.T, s=np.where(common, 14, 5), color=_DARK, linewidths=0)
    for label, place in zip(model.ids, points, strict=True):
        axes.text(*place, f" {label}", fontsize=7, color=_DARK)
    axes.view_init(_ELEVATION, _AZIMUTH, vertical_axis=model.up_axis or "y")
    axes.set_aspect("equal")
    axes.set_axis_off()


def neighbour_pairs(points: FloatArray) -> IntArray:
    """Pairs (n, 2) of points that have no third one nearer to both, a skeleton of the shape.

    The relative neighbourhood graph (Toussaint, 1980), which holds the minimum spanning tree.
    """
    gaps = np.linalg.norm(points[:, None] - points, axis=2)
    blocked = (np.maximum(gaps[:, None, :], gaps[None, :, :]) < gaps[..., None]).any(axis=2)
    return np.argwhere(np.triu(~blocked, 1))
