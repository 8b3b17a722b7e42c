"""Only regular files of limited size are read as inputs."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from cadalign import Camera, FocalPrior, Library, Result, Results, ShapeModel
from cadalign.datasets import (
    BlindPnP,
    Colmap,
    KeypointNet,
    ModelKeypoints,
    Pascal3D,
    Pix3D,
    Scan2CAD,
    ShapeNet,
    load_mesh,
    open_correspondences,
    open_photos,
    read_image_keypoints,
)
from cadalign.datasets.pascal3d import read_structs
from cadalign.datasets.photo import read_matrix
from cadalign.datasets.records import read_list
from cadalign.datasets.unpickling import load_pickle
from cadalign.errors import CadalignError, DataError, InputError
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.io.evidence import ImageEvidence
from cadalign.io.files import read_bytes, read_text
from cadalign.io.images import photo_size, read_grey, read_photo
from cadalign.io.observation import Observation, read_camera

BYTES = 2**33


@dataclass(frozen=True)
class Reader:
    """One kind of input: the ending of its files, and their reader."""

    ending: str
    read: Callable[[Path], object]


def same(*endings: str, read: Callable[[Path], object]) -> list[Reader]:
    return [Reader(ending, read) for ending in endings]


READERS = [
    *same(".obj", ".ply", ".stl", ".off", ".glb", ".gltf", read=load_mesh),
    *same(".png", read=read_photo),
    *same(".png", read=read_grey),
    *same(".json", read=Observation.load),
    *same(".json", ".csv", read=read_image_keypoints),
    *same(".json", ".txt", read=lambda path: read_camera(path, size=(4, 4))),
    *same(".shape", read=ShapeModel.open),
    *same(".cadalign", read=Library.open),
    *same(".pkl", read=load_pickle),
    *same(".mat", read=lambda path: read_structs(path, "record")),
    *same(".json", read=read_list),
    *same(".txt", read=lambda path: read_matrix(path, (3, 3))),
]


@pytest.fixture(autouse=True)
def _not_for_ever() -> Iterator[None]:
    """Fail where a reader waits for a pipe."""
    signal.alarm(20)
    yield
    signal.alarm(0)


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.ending)
def test_pipes_and_devices_are_refused(tmp_path: Path, reader: Reader) -> None:
    pipe, device = tmp_path / f"pipe{reader.ending}", tmp_path / f"zero{reader.ending}"
    os.mkfifo(pipe)
    device.symlink_to("/dev/zero")
    for path in (pipe, device):
        with pytest.raises(CadalignError, match="not a regular file") as caught:
            reader.read(path)
        assert str(caught.value).startswith(str(path))


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.ending)
def test_huge_files_are_refused(tmp_path: Path, reader: Reader) -> None:
    if reader.ending == ".cadalign":
        pytest.skip("mapped into memory")
    path = tmp_path / f"huge{reader.ending}"
    path.touch()
    os.truncate(path, BYTES)
    with pytest.raises(DataError, match=f"{BYTES} bytes, more than the limit of"):
        reader.read(path)


def test_runs_are_no_pipes(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "run.json")
    with pytest.raises(DataError, match=r"run\.json: not a regular file"):
        RunFolder(tmp_path).read_config()


def test_no_more_is_read_than_a_file_had(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"\xef\xbb\xbfone\r\ntwo\rthree\n")
    assert read_text(path) == "one\ntwo\nthree\n"
    assert len(read_bytes(path)) == 18
    with pytest.raises(DataError) as caught:
        read_bytes(path, most=5)
    assert str(caught.value) == f"{path}: the file has 18 bytes, more than the limit of 5"


class Opened:
    """An object that converts to a path of bytes, which is refused."""

    def __fspath__(self) -> bytes:
        return b"chair.obj"


@pytest.mark.parametrize("given", [3, None, 2.5, ["chair.obj"], {}, b"chair.obj", Opened()])
@pytest.mark.parametrize(
    "read",
    [
        *dict.fromkeys(each.read for each in READERS),
        *(KeypointNet, ShapeNet, Scan2CAD, Pix3D, Pascal3D),
        *(Colmap, BlindPnP, open_correspondences),
        *(open_photos, ModelKeypoints.load, Result.load, Results.open),
        *(FocalPrior.from_exif, photo_size),
    ],
)
def test_other_types_are_refused_as_paths(given: Any, read: Callable[[Any], object]) -> None:
    with pytest.raises(InputError, match=r"expected a path, got .*; give a str or a pathlib.Path"):
        read(given)


def test_texts_are_paths_of_cameras_and_observations(tmp_path: Path) -> None:
    camera = Camera(4, 4, 5.0, 5.0, 1.5, 1.5)
    matrix = tmp_path / "camera.txt"
    matrix.write_text("5 0 1.5 0 5 1.5 0 0 1")
    assert read_camera(str(matrix), size=(4, 4)) == camera
    evidence = ImageEvidence(mask=str(tmp_path / "mask.png"))  # type: ignore[arg-type]
    photo: Any = str(tmp_path / "photo.png")
    seen = Observation([[0, 0, 0]], [[1, 1]], camera, image=photo, evidence=evidence)  # type: ignore[arg-type]
    seen.save(tmp_path / "seen.json")
    read = Observation.load(tmp_path / "seen.json")
    assert (read.image, read.evidence.mask) == (tmp_path / "photo.png", tmp_path / "mask.png")
