"""Reading JSON documents against declared types, with errors that name the file and the field.

A format is declared as a `Document`: its fields, their types, meaning and defaults. `convert`
checks data against it without coercion (``true`` is no number, ``"1"`` is no number) and refuses
unknown fields. Formats of other programs are a `ForeignDocument`, whose further fields are ignored.
What the types cannot express is checked in ``__post_init__``, which raises
`cadalign.errors.InputError`; its place is completed here.
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
import numpy as np
from msgspec import Meta, Struct

from cadalign.errors import CadalignError, DataError, InputError, brief, quote, unknown
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
_HALF_CHARACTER = re.compile(r"\\u[dD][89a-fA-F]")
_HALF_REASON = r"a text has half of a character, such as \ud800 without its second half"
Text = Annotated[str, Meta(pattern=r"\S")]
PathText = Annotated[str, Meta(pattern=_PATH)]
Id = Annotated[str, Meta(pattern=_FILE_NAME)]  # becomes a part of paths and must not leave a folder
Point2 = tuple[Finite, Finite]
Point3 = tuple[Finite, Finite, Finite]

T = TypeVar("T")


class Document(Struct, forbid_unknown_fields=True):
    """Base of declared formats; unknown fields are refused."""


def require_unique(keypoints: Sequence[Any], field: str) -> None:
    """Refuse a field's value, other than None, that two of the keypoints have."""
    first: dict[Any, int] = {}
    for row, keypoint in enumerate(keypoints):
        value = getattr(keypoint, field)
        if value is not None and first.setdefault(value, row) != row:
            what = f"{value!r} occurs twice, first in keypoints[{first[value]}]"
            raise InputError(what, where=f"keypoints[{row}].{field}")


class ForeignDocument(Struct):
    """Base of declared formats of other programs; unknown fields are ignored."""


def read_json(path: Path, wanted: str | None = None) -> Any:
    """Read a JSON file; errors name the file and the line.

    A file of another known kind than ``wanted``, of `cadalign.io.kinds`, is refused by its kind.
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
    """Parse JSON of any content, bytes if it is one line; errors name its place and the line.

    Raises DataError if it is no valid JSON, or a field stands twice in one object.
    """
    is_line = isinstance(text, bytes)
    if isinstance(text, bytes):  # of hundreds of thousands, several times as fast
        with suppress(msgspec.MsgspecError, UnicodeError, RecursionError):
            line = msgspec.json.decode(text)
            if msgspec.json.encode(line).count(_FIELD_END) == text.count(_FIELD_END):
                return line  # no field stands twice
    try:
        with in_file(where):
            text = str(text, "utf-8") if isinstance(text, bytes) else text
            data = json.loads(text, object_pairs_hook=_distinct)
        if _HALF_CHARACTER.search(text):  # perhaps one half of two
            json.dumps(data, ensure_ascii=False).encode("utf-8")
        return data
    except json.JSONDecodeError as error:
        where = where if is_line else f"{where}, line {error.lineno}"
        reason = error.msg
    except UnicodeEncodeError:
        reason = _HALF_REASON
    except RecursionError:
        reason = "nested too deeply"
    except ValueError as error:  # a whole number of thousands of digits, or bytes that are no text
        reason = brief(error)
    raise DataError(f"not valid JSON: {reason}", where=where)


def _distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of fields, none of which may stand twice."""
    fields = dict(pairs)
    if len(fields) != len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        what = f"the field {quote(twice)} stands twice in one object"
        raise DataError(what, fix="leave one of the two out")
    return fields


def convert(
    data: Any, kind: type[T] | Any, where: str = "", *, folder: Path | None = None
) -> T | Any:
    """Convert parsed JSON to a `Document`, or to any type of which its fields can be.

    ``where`` is the place of ``data``: a `DataError` names the path of the field below it, as
    ``keypoints[3].uv``. Declared paths are relative to ``folder``.
    """

    def read(_: type, text: Any) -> Path:  # a path is the only declared type that JSON lacks
        if not isinstance(text, str) or not text or "\0" in text:
            raise InputError(f"{quote(text)} is not a path")
        return path_from(text, folder)

    try:
        with suppress(msgspec.ValidationError):  # perhaps of NumPy's arrays and numbers
            return msgspec.convert(data, kind, dec_hook=read)
        with suppress(TypeError, RecursionError):
            data = msgspec.to_builtins(data, enc_hook=_plain)
        return msgspec.convert(data, kind, dec_hook=read)
    except msgspec.ValidationError as error:
        raise _located(error, data, kind, where) from None
    except UnicodeEncodeError:
        raise DataError(_HALF_REASON, where=where or None) from None


@contextmanager
def in_file(path: Path | str) -> Iterator[None]:
    """Let errors about a file's content name the file, or the file and a line."""
    try:
        yield
    except CadalignError as error:
        whole, part = str(path), error.where or ""
        if part != whole and not part.startswith(f"{whole}: "):
            part = whole + (", " if part.startswith("line ") else ": " if part else "") + part
        raise DataError(error.what, where=part, fix=error.fix) from None


@contextmanager
def within(place: str) -> Iterator[None]:
    """Let errors about a part of a file's content name the part, as ``frames[3]``."""
    try:
        yield
    except CadalignError as error:
        where = ".".join(part for part in (place, error.where) if part)
        raise DataError(error.what, where=where or None, fix=error.fix) from None


def path_from(text: str, folder: Path | None) -> Path:
    """The path that a file in a folder writes relative to the folder."""
    path = Path(text) if folder is None else folder / text
    # Such that a path outside the folder is the one that was written, with no ".." in its midst.
    return path.resolve() if ".." in Path(text).parts and folder is not None else path


def written_path(path: Path, *, folder: Path | None) -> str:
    """A path as it is written into a file: relative to the folder that it is read relative to."""
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


def _plain(value: Any) -> Any:
    """NumPy's array or number as Python's."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(type(value))


def _located(error: msgspec.ValidationError, data: Any, kind: Any, where: str) -> DataError:
    """The library's error as ours: the value and its problem, its path, the remedy."""
    text, _, path = str(error).removesuffix("`").partition(" - at `$")
    value = data
    for step in _STEP.finditer(path):
        where += step[0] if step["row"] else f".{step['name']}" if where else step["name"]
        value = _entry(value, step)
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
        refused = unknown("field", name, known)
        return DataError(refused.what, where=where or "top level", fix=refused.fix)
    if text.startswith("Invalid enum value"):
        allowed = ", ".join(map(repr, _parts_at(kind, path, "values")))
        return DataError(f"{quote(value)} is not one of {allowed}", where=where or None)
    return DataError(f"{quote(value)} is not {_wanted(text)}", where=where or None)


def _entry(value: Any, step: re.Match[str]) -> Any:
    try:
        return value[int(step["row"])] if step["row"] else value[step["name"]]
    except (KeyError, IndexError, TypeError, ValueError):  # the key of a map is not told
        return value


def _wanted(text: str) -> str:
    """The library's "Expected ..." in this project's words."""
    found = _EXPECTED.fullmatch(text)
    if found is None:  # a number beyond all floats
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
    """The fields or values of the types declared at a path; none within a hostile field name."""
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
