"""MATLAB's files: numbers and texts as written; errors name damaged files."""

from __future__ import annotations

import zlib
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from cadalign.datasets.pascal3d import list_structs, read_structs
from cadalign.errors import DataError

TYPES = ("i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8")
RECORD = {
    "filename": "2008_000001.jpg",
    "size": {"width": 500.0, "height": 375.0},
    "objects": np.array(
        [
            {"class": "chair", "bbox": np.array([1.0, 2, 30, 40]), "difficult": False},
            {"class": "sofa \u00e9", "bbox": np.zeros((0, 4)), "view": ""},
        ],
        dtype=object,
    ),
    "names": np.array(["a", "bc"], dtype=object),
    **{kind: np.array([[1, 2], [3, 4]], dtype=kind) for kind in TYPES},
}


def write(path: Path, *, compressed: bool = False) -> bytes:
    savemat(
        path, {"record": RECORD, "other": 1.5}, do_compression=compressed, long_field_names=True
    )
    return path.read_bytes()


@pytest.mark.parametrize("compressed", [False, True])
def test_fields_are_as_they_were_written(tmp_path: Path, compressed: bool) -> None:
    write(tmp_path / "a.mat", compressed=compressed)
    (record,) = read_structs(tmp_path / "a.mat", "record")
    assert tuple(record) == tuple(RECORD)
    assert (record["filename"], record["names"]) == ("2008_000001.jpg", ["a", "bc"])
    for kind in TYPES:
        np.testing.assert_array_equal(record[kind], [[1, 2], [3, 4]])
    assert list_structs(record["size"]) == [{"width": 500.0, "height": 375.0}]
    chair, sofa = list_structs(record["objects"])
    assert (chair["class"], sofa["class"]) == ("chair", "sofa \u00e9")
    assert chair["difficult"] == 0.0
    assert sofa["bbox"] is sofa["view"] is None
    assert list_structs(record["names"]) == list_structs(None) == []


@pytest.mark.filterwarnings("error")
def test_damage_to_compressed_files_is_found(tmp_path: Path) -> None:
    data = write(tmp_path / "a.mat", compressed=True)
    path = tmp_path / "b.mat"
    for place in range(len(data)):
        path.write_bytes(data[:place])
        # The record is whole where only the variable behind it is cut off.
        assert_refused_or_whole(path)
        path.write_bytes(data[:place] + bytes([data[place] ^ 0x15]) + data[place + 1 :])
        assert_refused_or_whole(path)


def assert_refused_or_whole(path: Path) -> None:
    with suppress(DataError):
        (record,) = read_structs(path, "record")
        assert tuple(record) == tuple(RECORD)
        np.testing.assert_array_equal(record["f8"], RECORD["f8"])


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda data: b"", ""),
        (lambda data: b"not MATLAB's", ""),
        (lambda data: data[:100], ""),
        (lambda data: data[:-50], "it is cut short"),
        (lambda data: data[:124] + b"\0\2" + data[126:], ".*v7.3"),
        (lambda data: data[:128] + bomb(), "a variable is cut short, or has more than"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, change: Any, reason: str) -> None:
    path = tmp_path / "a.mat"
    path.write_bytes(change(write(path)))
    with pytest.raises(DataError, match=rf"not a MATLAB file that can be read \({reason}") as error:
        read_structs(path, "record")
    assert error.value.where == str(path)


def bomb() -> bytes:
    content = zlib.compress(bytes(2**26 + 2**24))
    return (15).to_bytes(4, "little") + len(content).to_bytes(4, "little") + content


def test_files_without_the_structs_are_refused(tmp_path: Path) -> None:
    write(tmp_path / "a.mat")
    for name in ("other", "missing"):
        with pytest.raises(DataError, match=f"there are no structs named {name}"):
            read_structs(tmp_path / "a.mat", name)
