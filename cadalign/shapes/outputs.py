"""Outputs of shape models: their file, a sealed MessagePack document, and cards in notebooks.

See `cadalign.io.files` for the header. The document holds the fields of `cadalign.ShapeModel` and
of its parts, arrays as little-endian numbers with their shape.
"""

from __future__ import annotations

import math
import os
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_args

import msgspec
import numpy as np
from msgspec import Meta

from cadalign.errors import InputError
from cadalign.io.documents import Count, Document, PathText, in_file
from cadalign.io.files import Seal, as_path, read_bytes
from cadalign.notebook import card, draw_picture
from cadalign.shapes.parts import BOX_ROWS

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
        _check_known(document, model)
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


def _check_known(document: Any, made: Any) -> None:
    """Refuse fields of a document that what was made of it does not have."""
    if isinstance(made, tuple):
        for entry, part in zip(document, made, strict=True):
            _check_known(entry, part)
    elif is_dataclass(made):
        unknown = document.keys() - {each.name for each in fields(made)}
        if unknown:
            raise InputError(f"unknown field {min(unknown)!r}")
        for name, entry in document.items():
            _check_known(entry, getattr(made, name))


_SHOWN_MODES = 5
# Rows are the picture's right and up for each up axis, seen obliquely.
_OBLIQUE = {"x": ((0, 1, 0.4), (1, 0, 0.3)), "y": ((1, 0, 0.4), (0, 1, 0.3)),
            "z": ((1, 0.4, 0), (0, 0.3, 1))}  # fmt: skip


def shape_html(model: ShapeModel) -> str:
    """HTML of a shape model: its mean keypoints and their standard deviations, and a table."""
    largest = max(model.components, key=lambda component: component.weight)
    total = max(float(np.trace(largest.covariance)), 1e-300)
    shares = ", ".join(f"{100 * share / total:.0f}" for share in largest.variance[:_SHOWN_MODES])
    rows = [
        ("category", model.category),
        ("keypoints", str(len(model.ids))),
        ("models", "given" if model.training is None else str(len(model.training))),
        ("components", str(len(model.components))),
        ("modes", f"{len(largest.modes)}; the first hold {shares or '0'} % of the variance"),
        ("up axis", model.up_axis or "unknown"),
        ("unit", model.unit),
    ]
    return card("ShapeModel", rows, picture=draw_picture(lambda axes: _draw(axes, model)))


def _draw(axes: Axes, model: ShapeModel) -> None:
    largest = max(model.components, key=lambda component: component.weight)
    view = np.array(_OBLIQUE[model.up_axis or "y"], dtype=float)
    keypoints = largest.mean[:-BOX_ROWS] @ view.T
    moved = largest.modes[:, :-BOX_ROWS] @ view.T
    spread = np.sqrt((moved**2).sum(axis=0) + largest.residual_sigma**2)
    x, y = keypoints.T
    x_std, y_std = spread.T
    axes.errorbar(x, y, xerr=x_std, yerr=y_std, fmt="o", color="#3366cc", ecolor="0.6")
    for label, place in zip(model.ids, keypoints, strict=True):
        axes.annotate(str(label), place, xytext=(4, 4), textcoords="offset points", fontsize=7)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.15)
    axes.set_axis_off()
