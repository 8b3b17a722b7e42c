"""Outputs of shape models: their file, and a picture of mean and modes.

The file is a sealed MessagePack document; see `cadalign.io.files` for the header. It holds the
fields of `cadalign.ShapeModel` and of its parts, arrays as little-endian numbers with their shape.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_args

import msgspec
import numpy as np
from msgspec import Meta

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import DataError, InputError
from cadalign.geometry.alignment import BOX_EDGES, bounds_corners
from cadalign.io.documents import Count, Document, PathText, in_file
from cadalign.io.files import Seal, as_path, printable, read_bytes, refuse_input, write_whole
from cadalign.shapes.parts import BOX_ROWS, ShapeComponent

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from cadalign.shapes.model import ShapeModel


Kind = TypeVar("Kind")
SEAL = Seal(
    magic=b"cadalign shape\n\0",
    version=1,
    noun="shape file",
    fix="learn it with: cadalign shape learn",
)
_MAX_BYTES = 1 << 30  # of thousands of models with hundreds of keypoints each
_MODES = 4  # of a picture
_DEVIATIONS = 2.0
_CELL = 2.9  # inches
_AZIMUTH, _ELEVATION = np.radians(32.0), np.radians(18.0)
_GREY, _LESS, _MORE, _BOX = "#8a8f98", "#2a6fbb", "#d9622b", "#c3c7cd"
_COMMON = 0.25  # share of the training models whose keypoints are joined by lines
_LABELLED = 40  # keypoints, above which their ids would cover one another


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
        model = msgspec.convert(document, kind, dec_hook=_read)
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        cause = error.__cause__
        if isinstance(cause, InputError) and str(cause) == str(error):  # of the model as a whole
            with in_file(file):
                raise cause from None
        what, _, place = str(error).partition(" - at `$.")
        join = "." if isinstance(cause, InputError) and cause.where else ": "
        what = f"{place.rstrip('`')}{join}{what}" if place else what
        raise SEAL.error(f"is invalid: {what[:200]}", str(file)) from None
    return model


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
    """Draw a row for each component: the mean with its box and ids, then the first modes.

    A mode is drawn at -2 (blue) and +2 (orange) standard deviations from the mean (grey). Raises
    DataError if no picture has the path's ending, or the file cannot be written.
    """
    from matplotlib.figure import Figure

    modes = max(1, min(_MODES, max(len(each.modes) for each in model.components)))
    rows, columns = len(model.components), modes + 1
    figure = Figure(figsize=(columns * _CELL, rows * _CELL + 0.45), layout="constrained")
    refuse_input(path)
    if path.suffix[1:].lower() not in figure.canvas.get_supported_filetypes():
        what, fix = "is no picture's name", "end it in .png, .jpg, .svg or .pdf"
        raise DataError(what, where=printable(path), fix=fix)
    figure.suptitle(
        f"{model.category}: mean, and -{_DEVIATIONS:g} (blue) to +{_DEVIATIONS:g} (orange) "
        f"standard deviations along its first modes",
        fontsize=10,
    )
    axes = figure.subplots(rows, columns, squeeze=False)
    for row, component in zip(axes, model.components, strict=True):
        _draw_component(row, model, component)
    write_whole(path, lambda unfinished: figure.savefig(unfinished, dpi=110))


def _skeleton(points: FloatArray) -> list[tuple[int, int]]:
    """Pairs of points that lines join: the shortest tree that holds all."""
    from scipy.sparse.csgraph import minimum_spanning_tree
    from scipy.spatial.distance import pdist, squareform

    tree = minimum_spanning_tree(squareform(pdist(points))).tocoo()
    return list(zip(tree.row.tolist(), tree.col.tolist(), strict=True))


def _draw_component(row: Sequence[Axes], model: ShapeModel, component: ShapeComponent) -> None:
    view = _view(model.up_axis)
    points = component.mean[:-BOX_ROWS]
    common = _common(model)
    chosen = np.flatnonzero(common)
    pairs = [(int(chosen[a]), int(chosen[b])) for a, b in _skeleton(points[chosen])]
    for axes in row:
        axes.set_aspect("equal")
        axes.set_axis_off()
    _draw_mean(row[0], model, component, view, pairs, common)
    total = float(np.trace(component.covariance))
    for number, axes in enumerate(row[1:]):
        if number >= len(component.modes):
            continue
        mode = component.modes[number]
        share = 100 * float((mode**2).sum()) / total if total else 0.0
        axes.set_title(f"mode {number + 1}: {share:.0f} % of the variance", fontsize=8)
        shapes = [(0.0, _GREY), (-_DEVIATIONS, _LESS), (_DEVIATIONS, _MORE)]
        for deviations, color in shapes:
            moved = (component.mean + deviations * mode) @ view
            _draw_skeleton(axes, moved[:-BOX_ROWS], pairs, common, color)
        ends = [(component.mean + side * mode)[:-BOX_ROWS] @ view for side in (-2.0, 2.0)]
        for start, end in zip(*ends, strict=True):
            axes.plot(*np.transpose([start, end]), color=_GREY, lw=0.5, alpha=0.5, zorder=1)


def _draw_mean(
    axes: Axes,
    model: ShapeModel,
    component: ShapeComponent,
    view: FloatArray,
    pairs: list[tuple[int, int]],
    common: BoolArray,
) -> None:
    title = (
        "mean" if len(model.components) == 1 else f"{100 * component.weight:.0f} % of the models"
    )
    axes.set_title(title, fontsize=8)
    low, high = component.mean[-BOX_ROWS:]
    seen = bounds_corners(low, high) @ view
    for first, second in BOX_EDGES:
        axes.plot(*seen[[first, second]].T, color=_BOX, lw=0.7, zorder=0)
    flat = component.mean[:-BOX_ROWS] @ view
    _draw_skeleton(axes, flat, pairs, common, "#30343b")
    if len(flat) > _LABELLED:
        return
    for label, place in zip(model.ids, flat, strict=True):
        axes.annotate(
            str(label),
            place,
            xytext=(3, 3),
            textcoords="offset points",
            fontsize=6,
            color="#5b616b",
        )


def _draw_skeleton(
    axes: Axes, flat: FloatArray, pairs: list[tuple[int, int]], common: BoolArray, color: str
) -> None:
    for first, second in pairs:
        axes.plot(*flat[[first, second]].T, color=color, lw=1.3, solid_capstyle="round", zorder=2)
    for chosen, size in ((common, 14), (~common, 5)):
        x, y = flat[chosen].T
        axes.scatter(x, y, s=size, color=color, zorder=3, linewidths=0)


def _common(model: ShapeModel) -> BoolArray:
    """The keypoints that a good part of the training models have; all if there are none."""
    if model.training is None:
        return np.ones(len(model.ids), dtype=bool)
    shares = np.isfinite(model.training.points_3d[..., 0]).mean(axis=0)
    common = np.asarray(shares >= _COMMON)
    return common if common.sum() > 1 else np.ones(len(model.ids), dtype=bool)


def _view(up_axis: str | None) -> FloatArray:
    """Projection to the picture's plane, (3, 2) float: slightly from the right and from above."""
    right, up, towards = {
        "x": ([0, 1, 0], [1, 0, 0], [0, 0, -1]),
        "z": ([1, 0, 0], [0, 0, 1], [0, -1, 0]),
    }.get(up_axis or "y", ([1, 0, 0], [0, 1, 0], [0, 0, 1]))
    frame = np.array([right, up, towards], dtype=float).T
    horizontal = [np.cos(_AZIMUTH), 0, -np.sin(_AZIMUTH)]
    vertical = [
        -np.sin(_ELEVATION) * np.sin(_AZIMUTH),
        np.cos(_ELEVATION),
        -np.sin(_ELEVATION) * np.cos(_AZIMUTH),
    ]
    return np.asarray(frame @ np.array([horizontal, vertical]).T)
