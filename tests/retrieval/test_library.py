"""Libraries of CAD models: contents, files, and errors."""

from __future__ import annotations

import logging
import os
import struct
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from cadalign import Library
from cadalign.datasets import KeypointNet, write_sample_dataset
from cadalign.errors import DataError, InputError
from cadalign.retrieval import LibraryModel
from cadalign.retrieval.models import SEAL

HEADER = 64


def make_model(number: int, *, category: str = "box", keypoints: int = 8) -> LibraryModel:
    rng = np.random.default_rng(number)
    xyz = rng.uniform(-0.3, 0.3, (keypoints, 3))
    bounds = np.array([xyz.min(axis=0), xyz.max(axis=0)])
    return LibraryModel(category, f"{number:04d}", xyz, rng.permutation(keypoints), bounds)


@pytest.fixture
def library() -> Library:
    return Library.from_models([make_model(number) for number in range(12)])


@pytest.fixture
def file(library: Library, tmp_path: Path) -> Path:
    library.save(tmp_path / "boxes.cadalign")
    return tmp_path / "boxes.cadalign"


def assert_same(one: LibraryModel, other: LibraryModel) -> None:
    assert one.key == other.key
    assert one.mesh_path == other.mesh_path
    np.testing.assert_array_equal(one.xyz, other.xyz)
    np.testing.assert_array_equal(one.ids, other.ids)
    np.testing.assert_array_equal(one.bounds, other.bounds)


# --- contents --------------------------------------------------------------------------------


def test_library_of_a_data_set_has_bounds_and_meshes(sample_root: Path) -> None:
    dataset = KeypointNet(sample_root)
    library = Library.from_models(dataset)
    assert library.keys == tuple(sorted(dataset.ids()))
    for model in dataset:
        held = library[model.key]
        order = np.argsort(model.keypoints.ids)
        np.testing.assert_array_equal(held.ids, model.keypoints.ids[order])
        np.testing.assert_array_equal(held.xyz, model.keypoints.xyz[order])
        np.testing.assert_array_equal(held.bounds, model.load_mesh().bounds)
        assert held.mesh_path == model.mesh_path


def test_categories_can_be_chosen(sample_root: Path) -> None:
    dataset = KeypointNet(sample_root)
    chairs = Library.from_models(dataset.subset(categories=["chair"]))
    assert chairs.categories == ("chair",)


def test_a_damaged_mesh_leaves_the_bounds_of_the_keypoints(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    root = write_sample_dataset(tmp_path / "sample", per_category=1, categories=["chair"])
    (model,) = KeypointNet(root)
    assert model.mesh_path is not None
    model.mesh_path.write_text("nonsense")
    with caplog.at_level(logging.WARNING, logger="cadalign"):
        library = Library.from_models(KeypointNet(root))
    assert "bounds are taken from the keypoints" in caplog.text
    held = library[model.key]
    assert held.mesh_path is None
    np.testing.assert_array_equal(held.bounds[0], model.keypoints.xyz.min(axis=0))


def test_the_order_of_models_does_not_matter(tmp_path: Path) -> None:
    models = [make_model(n, category=c) for n in range(5) for c in ("b", "a")]
    Library.from_models(models).save(tmp_path / "one")
    Library.from_models(models[::-1]).save(tmp_path / "other")
    assert (tmp_path / "one").read_bytes() == (tmp_path / "other").read_bytes()


def test_looking_up_an_unknown_model_is_refused(library: Library) -> None:
    assert library["box", "0003"].model_id == "0003"
    for key in (("box", "0003x"), ("car", "0003"), ("zebra", "9")):
        with pytest.raises(InputError, match="library: no model"):
            library[key]
    for key in ("box", 0, ("box",), ("box", 3), ("box", "0003", "x")):
        with pytest.raises(InputError, match=r"library: .* is not a model's category and id; give"):
            library[key]


def test_duplicated_models_and_semantic_ids_are_refused() -> None:
    with pytest.raises(InputError, match="the model '0001' of 'box' occurs twice; give every"):
        Library.from_models([make_model(1), make_model(2), make_model(1)])
    Library.from_models([make_model(1), make_model(1, category="crate")])
    model = make_model(1)
    with pytest.raises(InputError, match="box, model 0001, ids: the semantic id 3 occurs"):
        replace(model, ids=np.array([3, 1, 2, 3, 4, 5, 6, 7]))


def test_malformed_models_are_refused() -> None:
    model = make_model(1)
    with pytest.raises(InputError, match=r"model 0001, xyz: shape \(8, 2\)"):
        replace(model, xyz=model.xyz[:, :2])
    with pytest.raises(InputError, match="NaN or infinite values in row 2"):
        replace(model, xyz=np.where(np.arange(8)[:, None] == 2, np.nan, model.xyz))
    with pytest.raises(InputError, match=r"expected whole numbers of shape \(8,\)"):
        replace(model, ids=np.arange(8.0))
    with pytest.raises(InputError, match=r"expected whole numbers of shape \(8,\)"):
        replace(model, ids=np.arange(7))


# --- files -----------------------------------------------------------------------------------


def test_a_saved_library_is_the_same_when_opened(sample_root: Path, tmp_path: Path) -> None:
    library = Library.from_models(KeypointNet(sample_root))
    library.save(tmp_path / "library")
    opened = Library.open(tmp_path / "library")
    assert len(opened) == len(library)
    assert opened.fingerprint == library.fingerprint
    for one, other in zip(opened, library, strict=True):
        assert_same(one, other)


def test_an_opened_library_cannot_be_changed(file: Path) -> None:
    table = Library.open(file)
    for array in (table.xyz, table.ids, table.bounds, table.offsets):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_a_library_without_models_can_be_saved_and_opened(tmp_path: Path) -> None:
    Library.from_models([]).save(tmp_path / "empty")
    empty = Library.open(tmp_path / "empty")
    assert len(empty) == 0
    assert empty.categories == ()
    assert list(empty) == []


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="nowhere: no such file"):
        Library.open(tmp_path / "nowhere")
    for content in (b"", b"cadalign", b"ARROW1\0\0" + bytes(200)):
        (tmp_path / "other").write_bytes(content)
        with pytest.raises(DataError, match="other: not a library file; build it with: cadalign l"):
            Library.open(tmp_path / "other")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(DataError, match="not a regular file"):
        Library.open(tmp_path / "pipe")


def test_another_version_is_refused_and_both_are_named(file: Path) -> None:
    content = bytearray(file.read_bytes())
    struct.pack_into("<I", content, 16, 7)
    file.write_bytes(content)
    with pytest.raises(DataError, match="has version 7, but this cadalign reads version 2; build"):
        Library.open(file)


def test_a_library_that_cannot_be_written_says_so(library: Library, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot be written"):
        library.save(tmp_path / "nowhere" / "library")


def test_forged_tables_are_refused_when_opened(library: Library, file: Path) -> None:
    payload = msgspec.msgpack.decode(file.read_bytes()[HEADER:])
    bad, floats = library.offsets.copy(), library.xyz.copy()
    bad[3:5] = 10**9, 0
    floats[3] = np.nan
    forged = [
        ("offsets", bad.tobytes()),
        ("offsets", payload["offsets"][:-8]),
        ("offsets", payload["offsets"] + b"1"),
        ("ids", payload["ids"][:-8]),
        ("ids", None),
        ("xyz", floats.tobytes()),
        ("xyz", payload["xyz"][:-8]),
        ("bounds", np.full((12, 2, 3), np.inf).tobytes()),
        ("bounds", payload["bounds"][48:]),
        ("meshes", [None]),
        ("meshes", [3] * 12),
        ("keys", [["box", "0001"]] * 12),
        ("keys", payload["keys"][::-1]),
        ("names", {"seat": "3"}),
    ]
    for name, entry in forged:
        SEAL.write(file, msgspec.msgpack.encode(payload | {name: entry}))
        with pytest.raises(DataError, match="the library file is invalid: "):
            Library.open(file)
    SEAL.write(file, b"not a document")
    with pytest.raises(DataError, match="the library file is invalid: "):
        Library.open(file)
