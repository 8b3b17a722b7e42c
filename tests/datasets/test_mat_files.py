"""MATLAB's files: read as SciPy reads them, and refused where they are damaged."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fuzz.mutations import mutate
from scipy.io import loadmat, savemat

from cadalign.datasets.photos.mat_files import read_structs, read_variables
from cadalign.errors import DataError, InputError

RECORD = {
    "filename": "2008_000001.jpg",
    "size": {"width": 500.0, "height": 375.0},
    "objects": np.array(
        [
            {"class": "chair", "bbox": np.array([1.0, 2, 30, 40]), "difficult": False},
            {"class": "sofa \u00e9", "bbox": np.zeros((0, 4)), "view": "", "names": ["a", "bc"]},
        ],
        dtype=object,
    ),
    "pixels": np.arange(24, dtype=np.uint8).reshape(2, 3, 4),
    "counts": np.arange(6, dtype=np.int16).reshape(2, 3),
}


def write(path: Path, *, compressed: bool = False) -> bytes:
    savemat(
        path, {"record": RECORD, "other": 1.5}, do_compression=compressed, long_field_names=True
    )
    return path.read_bytes()


def assert_same(expected: Any, found: Any) -> None:
    """Compare what SciPy reads with what is read here."""
    if hasattr(expected, "_fieldnames"):
        assert list(found) == expected._fieldnames
        for name in found:
            assert_same(getattr(expected, name), found[name])
    elif isinstance(expected, str):
        assert found == expected
    elif np.asarray(expected).dtype.kind == "O":
        pairs = zip(np.ravel(expected), np.ravel(found), strict=True)
        for one, other in pairs:
            assert_same(one, other)
    elif np.asarray(expected).dtype.kind == "U":
        assert (list(expected) or "") == found
    else:
        assert np.array_equal(found, expected)


@pytest.mark.parametrize("compressed", [False, True])
def test_files_are_read_as_scipy_reads_them(tmp_path: Path, compressed: bool) -> None:
    data = write(tmp_path / "a.mat", compressed=compressed)
    found = read_variables(data)
    expected = loadmat(tmp_path / "a.mat", squeeze_me=True, struct_as_record=False)
    assert list(found) == ["record", "other"]
    for name in found:
        assert_same(expected[name], found[name])
    assert list(read_variables(data, ["other"])) == ["other"]


@pytest.mark.long
def test_real_files_are_read_as_scipy_reads_them(real_data: Path) -> None:
    files = sorted((real_data / "real" / "pascal3d").rglob("*.mat"))
    assert files
    for path in sorted(files, key=lambda path: path.stat().st_size)[:-3]:
        found = read_variables(path.read_bytes())
        for name, value in loadmat(path, squeeze_me=True, struct_as_record=False).items():
            if not name.startswith("__"):
                assert_same(value, found[name])


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.filterwarnings("error")
def test_no_mutation_ends_the_process(tmp_path: Path, compressed: bool) -> None:
    data = write(tmp_path / "a.mat", compressed=compressed)
    path = tmp_path / "b.mat"
    outcomes = set()
    for seed in range(600):
        path.write_bytes(mutate(data, np.random.default_rng(seed)))
        try:
            (record,) = read_structs(path, "record")
            outcomes.add(len(record.names))
        except DataError:
            outcomes.add(None)
    assert {None, 5} <= outcomes


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda data: data[:100], "it does not begin as one of version 5 to 7 does"),
        (lambda data: data[:-50], "it is cut short"),
        (lambda data: data[:124] + b"\0\2" + data[126:], "it is of version 7.3; save it with"),
        (lambda data: data[:128] + nested(80), "it is nested too deeply"),
        (lambda data: data[:128] + array([2**30, 2**30]), "0 numbers for an array of the shape"),
        (
            lambda data: data[:128] + array([2**30, 2**30], kind=1),
            "an array of 1152921504606846976 values is cut short",
        ),
        (lambda data: data[:128] + bomb(), "a variable has more than"),
    ],
)
def test_files_that_are_none_are_refused(tmp_path: Path, change: Any, reason: str) -> None:
    path = tmp_path / "a.mat"
    path.write_bytes(change(write(path)))
    with pytest.raises(DataError) as caught:
        read_structs(path, "a")
    assert f"a.mat: not a .mat file that can be read ({reason}" in str(caught.value)


def element(kind: int, content: bytes) -> bytes:
    return struct.pack("<II", kind, len(content)) + content + bytes(-len(content) % 8)


def array(shape: list[int], *, kind: int = 6, body: bytes = b"") -> bytes:
    flags = element(6, struct.pack("<II", kind, 0))
    body = body or (element(9, b"") if kind == 6 else b"")
    return element(14, flags + element(5, struct.pack("<ii", *shape)) + element(1, b"a") + body)


def nested(depth: int) -> bytes:
    inner = array([0, 0])
    for _ in range(depth):
        inner = array([1, 1], kind=1, body=inner)
    return inner


def bomb() -> bytes:
    return element(15, zlib.compress(bytes(2**26 + 2**24)))


def test_numbers_and_texts_of_all_types(tmp_path: Path) -> None:
    values = {
        kind: np.array([[1, 2], [3, 4]], dtype=kind)
        for kind in ("i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8")
    }
    values["rows"] = np.array(["ab ", "cde"])
    savemat(tmp_path / "a.mat", values)
    found = read_variables((tmp_path / "a.mat").read_bytes())
    assert found.pop("rows") == ["ab ", "cde"]
    for name, value in found.items():
        np.testing.assert_array_equal(value, values[name])
    with pytest.raises(InputError):
        read_variables(b"")
