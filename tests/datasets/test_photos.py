"""Common behaviour of all data sets of photos, and recognition of their format."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from support.files import write_json
from support.photo_data import write_scan2cad, write_text
from support.photo_sets import WRITERS, write_pix3d

import cadalign
import cadalign.datasets
from cadalign.datasets import CadModel, PhotoKeypoints, PhotoObject, Pix3D
from cadalign.datasets.formats import PHOTO_FORMATS
from cadalign.errors import DataError


def test_photos_are_asked_for_by_number_and_name(tmp_path):
    write_pix3d(tmp_path, photos=2)
    dataset = cadalign.datasets.open(tmp_path)
    assert [photo.name for photo in dataset] == list(dataset.names)
    assert dataset[1].name == dataset[-1].name == dataset[dataset.names[1]].name
    with pytest.raises(DataError, match="no photo 'x'"):
        dataset["x"]
    with pytest.raises(IndexError):
        dataset[2]
    assert repr(dataset) == f"Pix3D({str(tmp_path)!r}): 2 photos"


def test_data_sets_can_be_sent_to_other_processes(tmp_path):
    write_pix3d(tmp_path, photos=2)
    dataset = Pix3D(tmp_path)
    first = dataset[0]
    copy = pickle.loads(pickle.dumps(dataset))
    assert copy[0].objects[0].truth.cam_from_model == first.objects[0].truth.cam_from_model


def test_problems_are_counted_once_and_few_are_logged(tmp_path, caplog):
    write_json(tmp_path / "pix3d.json", [3] * 50)
    dataset = Pix3D(tmp_path)
    for _ in range(2):
        assert list(dataset) == []
    assert len(dataset.problems) == 50
    assert len(caplog.records) == 21
    assert "not logged" in caplog.records[-1].message


def test_files_may_begin_with_a_byte_order_mark(tmp_path):
    write_pix3d(tmp_path, photos=2)
    for path in tmp_path.rglob("*.json"):
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert len(list(cadalign.datasets.open(tmp_path))) == 2


@pytest.mark.parametrize("kind", WRITERS)
def test_hidden_files_of_mac_archives_are_ignored(tmp_path, kind):
    WRITERS[kind](tmp_path)
    names = cadalign.datasets.open(tmp_path).names
    for path in [path for path in tmp_path.rglob("*") if path.is_file()]:
        path.with_name(f"._{path.name}").write_bytes(b"\0\5\26\7\0\2\0\0Mac OS X")
    found = cadalign.datasets.open(tmp_path)
    assert found.names == names
    assert len(list(found)) == len(names)
    assert found.problems == {}


def test_missing_files_are_named(tmp_path):
    found = PhotoObject("3", "chair")
    with pytest.raises(DataError, match="object 3: this object has no mask"):
        found.read_mask()
    with pytest.raises(DataError, match="model x: there is no mesh"):
        CadModel("x").load_mesh()
    with pytest.raises(DataError, match=r"gone\.obj"):
        CadModel("x", tmp_path / "gone.obj").load_mesh()
    with pytest.raises(DataError, match="2 keypoints, 1 names"):
        PhotoKeypoints(np.zeros((2, 2)), ("a",))


def test_folders_are_recognised_or_known_formats_are_listed(tmp_path):
    with pytest.raises(DataError, match="no such folder"):
        cadalign.datasets.open(tmp_path / "gone")
    with pytest.raises(DataError, match="no such folder"):
        cadalign.datasets.open("a\0b")
    with pytest.raises(DataError) as caught:
        cadalign.datasets.open(tmp_path)
    for each in PHOTO_FORMATS:
        assert each.signature in str(caught.value)


@pytest.mark.parametrize("bad", ["[" * 9999 + "]" * 9999, '"\\ud800"', "1e999", "9" * 5000, "nul"])
@pytest.mark.parametrize("name", ["pix3d.json", "full_annotations.json"])
def test_hostile_entries_are_reported(tmp_path, name, bad):
    write_text(tmp_path / name, f"[{bad}]")
    with pytest.raises(DataError, match=name) as caught:
        cadalign.datasets.open(tmp_path)[0]
    assert len(str(caught.value)) < 2000


def test_readable_objects_are_returned_and_others_reported(tmp_path):
    write_scan2cad(tmp_path, scenes=2, frames=2)
    (tmp_path / "scans/scene0001_00/pose/1.txt").write_text("x")
    dataset = cadalign.datasets.open(tmp_path)
    photos = list(dataset)
    assert (dataset.kind, len(dataset), len(photos), len(dataset.problems)) == ("Scan2CAD", 4, 3, 1)
    assert [each.category for photo in photos for each in photo.objects] == ["chair"] * 3
