"""File format of shape models: a sealed MessagePack document.

See `cadalign.io.files` for the header. The document holds the fields of `cadalign.ShapeModel`;
arrays are little-endian numbers with their shape.
"""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from cadalign.errors import InputError
from cadalign.io.documents import Count, Document, Finite, Index, NotNegative, PathText, Positive
from cadalign.io.files import Seal, read_bytes
from cadalign.shapes.box_margins import BoxMargins
from cadalign.shapes.parts import KeypointId, Reflection, ShapeComponent, TrainingShapes
from cadalign.shapes.tails import FewKeypoints

SEAL = Seal(
    magic=b"cadalign shape\n\0",
    version=1,
    noun="shape file",
    fix="learn it with: cadalign shape learn",
)
_MAX_BYTES = 1 << 30  # of thousands of models with hundreds of keypoints each

Axis = Literal["x", "y", "z"]
Label = Index | str


class _Array(Document):
    """Little-endian numbers in C order."""

    shape: Annotated[list[Count], Meta(max_length=3)]
    data: bytes

    @classmethod
    def of(cls, array: npt.NDArray[np.float32] | npt.NDArray[np.float64]) -> _Array:
        return cls(list(array.shape), array.astype(array.dtype.newbyteorder("<")).tobytes())

    def read(self, kind: str) -> npt.NDArray[Any]:
        numbers = np.frombuffer(self.data, dtype=kind) if self.data else np.empty(0, dtype=kind)
        if math.prod(self.shape) != len(numbers):
            raise InputError(f"{len(numbers)} numbers are not of the shape {self.shape}")
        return numbers.reshape(self.shape).astype(np.dtype(kind).newbyteorder("="))


class _Component(Document):
    weight: Positive
    mean: _Array
    modes: _Array
    residual_sigma: NotNegative


class _Reflection(Document):
    axis: Axis
    offset: Finite
    pairs: list[tuple[Label, Label]]


class _Training(Document):
    model_ids: list[str]
    points_3d: _Array
    mesh_paths: list[PathText | None]


class _Margins(Document):
    margins: _Array
    tolerances: _Array


class _Few(Document):
    typical: Positive
    share: Positive


class _Shape(Document):
    category: str
    ids: list[Label]
    components: list[_Component]
    has_box: bool
    up_axis: Axis | None
    reflection: _Reflection | None
    training: _Training | None
    unit: str
    inflation: Positive = 1.0  # files of before have none of these
    degrees_of_freedom: Positive | None = None
    box_margins: _Margins | None = None
    few_keypoints: _Few | None = None


class ShapeFields(NamedTuple):
    """The fields of a `cadalign.ShapeModel`."""

    category: str
    ids: tuple[KeypointId, ...]
    components: tuple[ShapeComponent, ...]
    has_box: bool
    up_axis: Axis | None
    reflection: Reflection | None
    training: TrainingShapes | None
    unit: str
    inflation: float
    degrees_of_freedom: float | None
    box_margins: BoxMargins | None
    few_keypoints: FewKeypoints | None


def write_shape(path: str | os.PathLike[str], model: ShapeFields) -> None:
    """Write a shape model's file atomically."""
    mirror, training, margins = model.reflection, model.training, model.box_margins
    few = model.few_keypoints
    document = _Shape(
        category=model.category,
        ids=list(model.ids),
        components=[
            _Component(
                each.weight, _Array.of(each.mean), _Array.of(each.modes), each.residual_sigma
            )
            for each in model.components
        ],
        has_box=model.has_box,
        up_axis=model.up_axis,
        reflection=None
        if mirror is None
        else _Reflection(mirror.axis, mirror.offset, list(mirror.pairs)),  # type: ignore[arg-type]
        training=None
        if training is None
        else _Training(
            list(training.model_ids),
            _Array.of(training.points_3d),
            [None if each is None else str(each) for each in training.mesh_paths],
        ),
        unit=model.unit,
        inflation=model.inflation,
        degrees_of_freedom=model.degrees_of_freedom,
        box_margins=None
        if margins is None
        else _Margins(_Array.of(margins.margins), _Array.of(margins.tolerances)),
        few_keypoints=None if few is None else _Few(few.typical, few.share),
    )
    SEAL.write(Path(path), msgspec.msgpack.encode(document))


def read_shape(path: str | os.PathLike[str]) -> ShapeFields:
    """Read and check a shape model's file."""
    file = Path(path)
    payload = SEAL.unwrap(read_bytes(file, most=_MAX_BYTES), str(file))
    try:
        return _fields(msgspec.msgpack.decode(payload, type=_Shape))
    except (msgspec.DecodeError, InputError, ValueError, RecursionError) as error:
        raise SEAL.error(f"is invalid: {str(error)[:200]}", str(file)) from None


def _fields(read: _Shape) -> ShapeFields:
    components = tuple(
        ShapeComponent(
            each.weight, each.mean.read("<f8"), each.modes.read("<f8"), each.residual_sigma
        )
        for each in read.components
    )
    mirror, training, few = read.reflection, read.training, read.few_keypoints
    return ShapeFields(
        category=read.category,
        ids=tuple(read.ids),
        components=components,
        has_box=read.has_box,
        up_axis=read.up_axis,
        reflection=None
        if mirror is None
        else Reflection(mirror.axis, mirror.offset, tuple(mirror.pairs)),
        training=None
        if training is None
        else TrainingShapes(
            tuple(training.model_ids),
            training.points_3d.read("<f4"),
            tuple(None if each is None else Path(each) for each in training.mesh_paths),
        ),
        unit=read.unit,
        inflation=read.inflation,
        degrees_of_freedom=read.degrees_of_freedom,
        box_margins=_box_margins(read.box_margins),
        few_keypoints=None if few is None else FewKeypoints(few.typical, few.share),
    )


def _box_margins(read: _Margins | None) -> BoxMargins | None:
    if read is None:
        return None
    return BoxMargins(read.margins.read("<f8"), read.tolerances.read("<f8"))
