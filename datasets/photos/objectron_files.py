"""Objectron's annotation files: protocol buffers, or the same messages as JSON.

The messages are those of ``annotation_data.proto``, ``object.proto`` and
``a_r_capture_metadata.proto``. In JSON, the fields have the names of the messages or their
camel-case forms, as protobuf's ``MessageToJson`` writes them. Protocol buffers are read by a table
of each message's fields, see https://protobuf.dev/programming-guides/encoding/.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from cadalign.errors import DataError, InputError
from cadalign.io.documents import Finite, ForeignDocument, convert, in_file, read_json
from cadalign.io.files import read_bytes

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_MAX_VARINT = 10


# Fields of messages by number: name and kind, "int", "float", "double", "text" or the fields of a
# message; in a list if it is one, of which numbers may be packed.
Fields = dict[int, tuple[str, Any]]
_POINT_2D: Fields = {1: ("x", "float"), 2: ("y", "float"), 3: ("depth", "float")}
_KEYPOINT: Fields = {1: ("id", "int"), 3: ("point_2d", _POINT_2D)}
_ANNOTATION: Fields = {
    1: ("object_id", "int"),
    2: ("keypoints", [_KEYPOINT]),
    3: ("visibility", "float"),
}
_CAMERA: Fields = {
    5: ("image_resolution_width", "int"),
    6: ("image_resolution_height", "int"),
    8: ("projection_matrix", ["float"]),
    9: ("view_matrix", ["float"]),
}
_FRAME: Fields = {1: ("frame_id", "int"), 2: ("annotations", [_ANNOTATION]), 3: ("camera", _CAMERA)}
_OBJECT: Fields = {
    1: ("id", "int"),
    2: ("category", "text"),
    4: ("rotation", ["float"]),
    5: ("translation", ["float"]),
    6: ("scale", ["float"]),
}
_OBJECTS, _FRAMES = 1, 2
# MessageToJson's name of a field whose name has a digit after an underscore.
_JSON_NAMES = {"point2d": "point_2d"}
_CAPITAL = re.compile(r"(?<=[a-z0-9])([A-Z])")

_Three = Annotated[list[Finite], Meta(min_length=3, max_length=3)]
_Nine = Annotated[list[Finite], Meta(min_length=9, max_length=9)]
_Sixteen = Annotated[list[Finite], Meta(min_length=16, max_length=16)]


class ObjectronKeypoint(ForeignDocument):
    """One of the nine keypoints of a box: its centre, id 0, and its corners.

    Its x and y are in the photo, held upright: 0 at the left and upper border, 1 at the others.
    """

    point_2d: dict[str, Finite]
    id: int = 0


class ObjectronAnnotation(ForeignDocument):
    """An object in a frame."""

    keypoints: list[ObjectronKeypoint]
    object_id: int = 0
    visibility: Finite = 1.0


class ArCamera(ForeignDocument):
    """ARKit's camera: of the sensor, which lies on its side."""

    image_resolution_width: Annotated[int, Meta(ge=1, le=2**20)]
    image_resolution_height: Annotated[int, Meta(ge=1, le=2**20)]
    projection_matrix: _Sixteen
    view_matrix: _Sixteen


class ObjectronFrame(ForeignDocument):
    """A frame of the video."""

    camera: ArCamera
    annotations: list[Any] = msgspec.field(default_factory=list)
    frame_id: int = 0


class WorldObject(ForeignDocument):
    """An object: a box in the world's coordinates [m]."""

    rotation: _Nine
    translation: _Three
    scale: _Three
    id: int = 0
    category: str = "object"


@dataclass(frozen=True)
class Sequence:
    """A sequence's objects and frames, not yet checked."""

    path: Path  # the file
    objects: list[Any]
    frames: list[Any]  # messages as bytes, or as parsed JSON

    def frame(self, number: int) -> ObjectronFrame:
        """Decode a frame; raises DataError if it is no valid frame."""
        where = f"frame_annotations[{number}]"
        found: ObjectronFrame = self._decode(self.frames[number], _FRAME, ObjectronFrame, where)
        return found

    def object(self, object_id: int) -> WorldObject:
        """Decode the object of an id; raises InputError if there is none, otherwise as `frame`."""
        for number, message in enumerate(self.objects):
            found: WorldObject = self._decode(message, _OBJECT, WorldObject, f"objects[{number}]")
            if found.id == object_id:
                return found
        raise InputError(f"there is no object {object_id}", where="object_id")

    def _decode(self, message: Any, fields: Fields, kind: Any, where: str) -> Any:
        with in_file(self.path):
            try:
                data = decode(message, fields) if isinstance(message, bytes) else message
            except InputError as error:
                raise DataError(error.what, where=where) from None
            return convert(data, kind, where)


def read_sequence(path: Path) -> Sequence:
    """Read an annotation file, ``.pbdata`` or ``.json``; its messages are decoded later.

    Raises DataError if it cannot be read, or is no such file.
    """
    if path.suffix == ".json":
        data = _snake_case(read_json(path))
        if not isinstance(data, dict) or not isinstance(data.get("frame_annotations"), list):
            raise DataError("there are no frame_annotations", where=str(path))
        objects, frames = data.get("objects"), data["frame_annotations"]
        return Sequence(path, objects if isinstance(objects, list) else [], frames)
    content = read_bytes(path)
    messages: dict[int, list[bytes]] = {_OBJECTS: [], _FRAMES: []}
    try:
        for number, _, value in entries(content):
            if number in messages and isinstance(value, bytes):
                messages[number].append(value)
    except InputError as error:
        raise DataError(error.what, where=str(path), fix="get it again") from None
    if not messages[_FRAMES]:
        raise DataError("there are no frame_annotations", where=str(path))
    return Sequence(path, messages[_OBJECTS], messages[_FRAMES])


def _snake_case(value: Any) -> Any:
    """JSON with the names of the messages' fields in the place of their camel-case forms."""
    if isinstance(value, list):
        return [_snake_case(each) for each in value]
    if isinstance(value, dict):
        return {
            _JSON_NAMES.get(
                name, _CAPITAL.sub(lambda found: f"_{found[1].lower()}", name)
            ): _snake_case(each)
            for name, each in value.items()
        }
    return value


def decode(data: bytes, fields: Fields) -> dict[str, Any]:
    """Decode a message; unknown fields are skipped, lists without entries are empty.

    Raises InputError if the data are no such message, or cut short.
    """
    found: dict[str, Any] = {name: [] for name, kind in fields.values() if isinstance(kind, list)}
    for number, wire, value in entries(data):
        if number not in fields:
            continue
        name, kind = fields[number]
        if isinstance(kind, list):
            found[name] += _values(kind[0], wire, value)
        elif values := _values(kind, wire, value):
            found[name] = values[-1]
    return found


def entries(data: bytes) -> Iterator[tuple[int, int, Any]]:
    """The entries of a message, in order: field number, wire type, and the value.

    Raises InputError if the data are cut short, or no message.
    """
    place = 0
    while place < len(data):
        tag, place = _varint(data, place)
        number, wire = tag >> 3, tag & 7
        if wire == _VARINT:
            value: Any
            value, place = _varint(data, place)
            yield number, wire, value
            continue
        length = {_FIXED64: 8, _FIXED32: 4}.get(wire)
        if wire == _BYTES:
            length, place = _varint(data, place)
        if length is None or number == 0:
            raise InputError(f"not a protocol buffer at byte {place}")
        if place + length > len(data):
            raise InputError(f"cut short: {length} bytes are missing from byte {place} on")
        yield number, wire, data[place : place + length]
        place += length


def _varint(data: bytes, place: int) -> tuple[int, int]:
    value = 0
    for step, byte in enumerate(data[place : place + _MAX_VARINT]):
        value |= (byte & 0x7F) << (7 * step)
        if byte < 0x80:
            return value, place + step + 1
    raise InputError(f"cut short or no protocol buffer at byte {place}")


def _values(kind: str | Fields, wire: int, value: Any) -> list[Any]:
    """The values of one entry: one, or those that are packed in it."""
    if not isinstance(kind, str):
        return [decode(_as_bytes(value, wire), kind)]
    if kind == "text":
        try:
            return [_as_bytes(value, wire).decode("utf-8")]
        except UnicodeDecodeError:
            raise InputError("a text is not UTF-8") from None
    if kind == "int":
        if wire == _VARINT:
            return [value - 2**64 if value >= 2**63 else value]
        return list(_packed_ints(_as_bytes(value, wire)))
    code = "f" if kind == "float" else "d"
    size = struct.calcsize(code)
    if wire == _VARINT or len(value) % size:
        raise InputError(f"{kind} numbers of the wrong length")
    return list(struct.unpack(f"<{len(value) // size}{code}", value))


def _packed_ints(data: bytes) -> Iterator[int]:
    place = 0
    while place < len(data):
        value, place = _varint(data, place)
        yield value


def _as_bytes(value: Any, wire: int) -> bytes:
    if wire != _BYTES:
        raise InputError("a number where a text or message is expected")
    return bytes(value)
