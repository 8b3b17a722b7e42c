"""Read JSON documents of declared types, with errors that name the file and the field.

A format is declared as a `Document`: its fields, their types, meaning and defaults. `convert`
checks data against it without coercion (neither ``true`` nor ``"1"`` is a number) and refuses
unknown fields. Formats of other programs are declared as a `ForeignDocument`, whose unknown fields
are ignored. Further checks are made in ``__post_init__``, which raises
`cadalign.errors.InputError`; `convert` completes the place in the error.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
from msgspec import Meta, Struct

from cadalign.errors import CadalignError, DataError, InputError, brief, quote, unknown_name
from cadalign.io.files import read_text
from cadalign.io.kinds import kind_of, refuse_other, refuse_other_file

_MAX = sys.float_info.max
Finite = Annotated[float, Meta(ge=-_MAX, le=_MAX)]
Positive = Annotated[float, Meta(gt=0, le=_MAX)]
NotNegative = Annotated[float, Meta(ge=0, le=_MAX)]
Index = Annotated[int, Meta(ge=-(2**63) + 1, le=2**63 - 1)]
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
_PATH = r"\A[^\0]+\Z"
_FILE_NAME = r"\A(?!\.{1,2}\Z)[^/\\\0]+\Z"
_FIELD_END = b'":'
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")
_SURROGATE_ERROR = r"a text has an unpaired surrogate, such as \ud800"
Text = Annotated[str, Meta(pattern=r"\S")]
PathText = Annotated[str, Meta(pattern=_PATH)]
Id = Annotated[str, Meta(pattern=_FILE_NAME)]  # a part of paths, which must not leave a folder
Point2 = tuple[Finite, Finite]
Point3 = tuple[Finite, Finite, Finite]

T = TypeVar("T")


class Document(Struct, forbid_unknown_fields=True):
    """Base of cadalign's formats; unknown fields are refused."""


def require_unique(keypoints: Sequence[Any], field: str) -> None:
    """Raise InputError if two keypoints have the same value of a field, other than None."""
    first: dict[Any, int] = {}
    for row, keypoint in enumerate(keypoints):
        value = getattr(keypoint, field)
        if value is not None and first.setdefault(value, row) != row:
            what = f"{value!r} occurs twice, first in keypoints[{first[value]}]"
            raise InputError(what, where=f"keypoints[{row}].{field}")


class ForeignDocument(Struct):
    """Base of other programs' formats; unknown fields are ignored."""


def read_json(path: Path, wanted: str | None = None) -> Any:
    """Read a JSON file; errors name the file and the line.

    ``wanted`` is a kind of `cadalign.io.kinds`; a file of another known kind raises DataError.
    """
    try:
        data = parse_json(read_text(path), str(path))
    except DataError:
        if wanted is not None:
            refuse_other_file(path, wanted)
        raise
    if wanted is not None:
        refuse_other(wanted, kind_of(data), path)
    return data


def parse_json(text: str | bytes, where: str) -> Any:
    """Parse JSON; bytes are one line of a file, named by ``where``.

    Raises DataError, with ``where`` and the line, if the JSON is not valid or a field occurs twice
    in one object.
    """
    is_line = isinstance(text, bytes)
    if isinstance(text, bytes):  # several times faster, for files of many lines
        with suppress(msgspec.MsgspecError, UnicodeError, RecursionError):
            line = msgspec.json.decode(text)
            if msgspec.json.encode(line).count(_FIELD_END) == text.count(_FIELD_END):
                return line  # no field occurs twice
    try:
        with name_file(where):
            text = str(text, "utf-8") if isinstance(text, bytes) else text
            data = json.loads(text, object_pairs_hook=_unique_fields)
        if _SURROGATE.search(text):  # may be one of a pair
            json.dumps(data, ensure_ascii=False).encode("utf-8")
        return data
    except json.JSONDecodeError as error:
        where = where if is_line else f"{where}, line {error.lineno}"
        reason = error.msg
    except UnicodeEncodeError:
        reason = _SURROGATE_ERROR
    except RecursionError:
        reason = "nested too deeply"
    except ValueError as error:  # an integer of thousands of digits, or bytes that are not UTF-8
        reason = brief(error)
    raise DataError(f"not valid JSON: {reason}", where=where)


def _unique_fields(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Build an object; raises DataError if a field occurs twice."""
    fields = dict(pairs)
    if len(fields) != len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        what = f"the field {quote(twice)} occurs twice in one object"
        raise DataError(what, fix="remove one of them")
    return fields


def convert(
    data: Any, kind: type[T] | Any, where: str = "", *, folder: Path | None = None
) -> T | Any:
    """Convert parsed JSON to a `Document`, or to any type of a document's field.

    ``where`` is the place of ``data``; a `DataError` adds the path of the field, such as
    ``keypoints[3].uv``. Paths in ``data`` are relative to ``folder``.
    """

    def read(_: type, text: Any) -> Path:  # Path is the only declared type that JSON lacks
        if not isinstance(text, str) or not text or "\0" in text:
            raise InputError(f"{quote(text)} is not a path")
        return path_from(text, folder)

    try:
        with suppress(msgspec.ValidationError, IndexError):  # also by NumPy arrays and numbers
            return msgspec.convert(data, kind, dec_hook=read)
        with suppress(AttributeError, TypeError, RecursionError):
            data = msgspec.to_builtins(data, enc_hook=lambda each: each.tolist())
        return msgspec.convert(data, kind, dec_hook=read)
    except msgspec.ValidationError as error:
        raise _convert_error(error, data, kind, where) from None
    except UnicodeEncodeError:
        raise DataError(_SURROGATE_ERROR, where=where or None) from None


@contextmanager
def name_file(path: Path | str) -> Iterator[None]:
    """Add the file, or file and line, to the place of errors about its content."""
    try:
        yield
    except CadalignError as error:
        whole, part = str(path), error.where or ""
        if part != whole and not part.startswith((f"{whole}: ", f"{whole}, ")):
            part = whole + (", " if part.startswith("line ") else ": " if part else "") + part
        raise DataError(error.what, where=part, fix=error.fix) from None


@contextmanager
def name_part(place: str) -> Iterator[None]:
    """Add a part of a file, such as ``frames[3]``, to the place of errors about its content."""
    try:
        yield
    except CadalignError as error:
        where = ".".join(part for part in (place, error.where) if part)
        raise DataError(error.what, where=where or None, fix=error.fix) from None


def path_from(text: str, folder: Path | None) -> Path:
    """Convert a path written in a file, which is relative to the file's folder."""
    path = Path(text) if folder is None else folder / text
    # Resolve "..", so that a path outside the folder equals the path that was written.
    return path.resolve() if ".." in Path(text).parts and folder is not None else path


def written_path(path: Path, *, folder: Path | None) -> str:
    """Convert a path to the text for a file in a folder: relative to the folder."""
    if folder is None:
        return str(path)
    for base in (folder, folder.resolve()):
        if path.is_relative_to(base):
            return path.relative_to(base).as_posix()
    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()


_STEP = re.compile(r"\[(?P<row>\d+|\.\.\.)\]|\.?(?P<name>[^.\[\]]+)")
_FIELD = re.compile(r"Object (missing required|contains unknown) field `(.*)", re.DOTALL)
_EXPECTED = re.compile(r"Expected `(?P<kinds>[^`]*)`(?P<rule>.*)", re.DOTALL)
_WORDS = {
    "float": "a finite number",
    "int": "a whole number",
    "str": "a text",
    "bool": "true or false",
    "array": "a list",
    "object": "an object",
}
_PATTERN_WORDS = {repr(_PATH): "a path", repr(_FILE_NAME): "an id"}


def _convert_error(error: msgspec.ValidationError, data: Any, kind: Any, where: str) -> DataError:
    """Convert msgspec's error: name the value and its problem, its place, the fix."""
    text, _, path = str(error).removesuffix("`").partition(" - at `$")
    value = data
    for step in _STEP.finditer(path):
        where += step[0] if step["row"] else f".{step['name']}" if where else step["name"]
        with suppress(KeyError, IndexError, TypeError, ValueError):  # msgspec names no map's key
            value = value[int(step["row"]) if step["row"] else step["name"]]
    if isinstance(cause := error.__cause__, InputError):
        where = ".".join(part for part in (where, cause.where) if part)
        return DataError(cause.what, where=where or None, fix=cause.fix)
    if field := _FIELD.fullmatch(text):
        is_missing, name = field[1] == "missing required", field[2].removesuffix("`")
        fields = _parts_at(kind, path, "fields")
        lacking = [each.encode_name for each in fields if each.required]
        lacking = [name] if is_missing else [each for each in lacking if each not in value]
        known = sorted(each.encode_name for each in fields)
        if lacking:
            place = f"{where}.{lacking[0]}" if where else lacking[0]
            more = "" if is_missing else f", and there is an unknown field {quote(name)}"
            fix = None if is_missing else f"known are {', '.join(known)}"
            return DataError(f"missing{more}", where=place, fix=fix)
        refused = unknown_name("field", name, known)
        return DataError(refused.what, where=where or "top level", fix=refused.fix)
    if text.startswith("Invalid enum value"):
        allowed = ", ".join(map(repr, _parts_at(kind, path, "values")))
        return DataError(f"{quote(value)} is not one of {allowed}", where=where or None)
    return DataError(f"{quote(value)} is not {_translate_expectation(text)}", where=where or None)


def _translate_expectation(text: str) -> str:
    """Translate msgspec's "Expected ..."."""
    found = _EXPECTED.fullmatch(text)
    if found is None:  # a number too large for a float
        return "a finite number"
    kinds = [kind for kind in found["kinds"].split(" | ") if kind != "null"]
    words = " or ".join(_WORDS.get(kind, kind) for kind in kinds)
    rule, _, _ = found["rule"].partition(", got")
    if " matching regex " in rule:
        return _PATTERN_WORDS.get(rule.removeprefix(" matching regex "), words)
    if rule == " > 0.0":
        return "a positive number"
    bound = rule.replace("length >= ", "at least ").replace("length ", "")
    return words if str(_MAX) in rule else words + bound


def _parts_at(kind: Any, path: str, name: str) -> list[Any]:
    """Fields or enum values of the types at a path; empty if a field's name mimics a path."""
    kind = msgspec.inspect.type_info(kind)
    for step in _STEP.finditer(path):
        if isinstance(kind, msgspec.inspect.UnionType):  # an optional type
            kind = next(k for k in kind.types if not isinstance(k, msgspec.inspect.NoneType))
        if isinstance(kind, msgspec.inspect.StructType | msgspec.inspect.DataclassType):
            types = {each.encode_name: each.type for each in kind.fields}
            kind = types.get(step["name"])
        else:
            kind = getattr(kind, "value_type" if step["row"] == "..." else "item_type", None)
    kinds = kind.types if isinstance(kind, msgspec.inspect.UnionType) else (kind,)
    return [part for each in kinds for part in getattr(each, name, ())]
