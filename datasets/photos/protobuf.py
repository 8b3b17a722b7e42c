"""Protocol buffers' wire format, read by a table of fields: for the few messages of a data set.

https://protobuf.dev/programming-guides/encoding/
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from cadalign.errors import InputError

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_MAX_VARINT = 10


@dataclass(frozen=True)
class Field:
    """One field of a message.

    Parameters
    ----------
    name : str
    kind : str or mapping
        "int", "float", "double", "text", or the fields of a message.
    repeated : bool
        Whether it is a list; numbers in it may be packed.
    """

    name: str
    kind: str | Mapping[int, Field]
    repeated: bool = False


def decode(data: bytes, fields: Mapping[int, Field]) -> dict[str, Any]:
    """Decode a message; unknown fields are skipped, lists without entries are empty.

    Raises
    ------
    InputError
        If the data are no such message, or cut short.
    """
    found: dict[str, Any] = {field.name: [] for field in fields.values() if field.repeated}
    for number, wire, value in entries(data):
        field = fields.get(number)
        if field is None:
            continue
        values = _values(field.kind, wire, value)
        if field.repeated:
            found[field.name] += values
        elif values:
            found[field.name] = values[-1]
    return found


def entries(data: bytes) -> Iterator[tuple[int, int, Any]]:
    """The entries of a message, in order: field number, wire type, and the value.

    Raises
    ------
    InputError
        If the data are cut short, or no message.
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


def _values(kind: str | Mapping[int, Field], wire: int, value: Any) -> list[Any]:
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
