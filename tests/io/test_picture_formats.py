"""One reader decodes all pictures; it supports only raster formats and starts no program."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import PIL.EpsImagePlugin
import pytest
from PIL import Image
from support.gltf_files import CORNERS, POSITIONS, SQUARE, VIEWS, data_uri, write_gltf

from cadalign import FocalPrior
from cadalign.annotate.photos import PhotoFile
from cadalign.datasets import load_mesh
from cadalign.datasets.photo import PhotoObject
from cadalign.errors import DataError
from cadalign.io.images import photo_size, read_grey, read_mask, read_photo

ROOT = Path(__file__).resolve().parents[2]
EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 4 4\n%%EndComments\nshowpage\n%%EOF\n"
FACE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl a\nf 1/1 2/2 3/3\n"


def write_obj(folder: Path, picture: bytes) -> Path:
    (folder / "a.obj").write_text("mtllib a.mtl\n" + FACE)
    (folder / "a.mtl").write_text("newmtl a\nmap_Kd x.png\n")
    (folder / "x.png").write_bytes(picture)
    return folder / "a.obj"


def write_gltf_with(folder: Path, image: dict[str, Any], more: bytes = b"") -> Path:
    views = [{"buffer": 0, "byteOffset": 60, "byteLength": 32}]
    views += [{"buffer": 0, "byteOffset": 92, "byteLength": len(more)}]
    attributes = {"POSITION": 0, "TEXCOORD_0": 2}
    return write_gltf(
        folder / "a.gltf",
        more=SQUARE[:, :2].tobytes() + more,
        bufferViews=VIEWS + views,
        accessors=[POSITIONS, CORNERS, POSITIONS | {"bufferView": 2, "type": "VEC2"}],
        meshes=[{"primitives": [{"attributes": attributes, "indices": 1, "material": 0}]}],
        materials=[{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        textures=[{"source": 0}],
        images=[image],
    )


def write_gltf_beside(folder: Path, picture: bytes) -> Path:
    (folder / "x y.png").write_bytes(picture)
    return write_gltf_with(folder, {"uri": "x%20y.png"})


def write_gltf_embedded(folder: Path, picture: bytes) -> Path:
    return write_gltf_with(folder, {"uri": data_uri(picture)})


def write_gltf_in_buffer(folder: Path, picture: bytes) -> Path:
    return write_gltf_with(folder, {"bufferView": 3, "mimeType": "image/png"}, picture)


MODELS = [write_obj, write_gltf_beside, write_gltf_embedded, write_gltf_in_buffer]
READERS = [
    read_photo,
    photo_size,
    read_grey,
    FocalPrior.from_exif,
    lambda path: PhotoObject(object_id="a", category="a", mask_path=path).read_mask(),
    lambda path: PhotoFile(path, 4, 4).encode(),
]


@pytest.fixture
def started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file that the program ``gs``, first in PATH, writes whenever it is started."""
    log, programs = tmp_path / "started", tmp_path / "bin"
    programs.mkdir()
    (programs / "gs").write_text(f"#!/bin/sh\necho gs >> {log}\n")
    (programs / "gs").chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}:/usr/bin:/bin")
    monkeypatch.setattr(PIL.EpsImagePlugin, "gs_binary", None)
    return log


@pytest.mark.parametrize("name", ["x.png", "x.eps"])
@pytest.mark.parametrize("read", READERS)
def test_no_picture_starts_a_program(
    tmp_path: Path, started: Path, read: Callable[[Path], object], name: str
) -> None:
    (tmp_path / name).write_bytes(EPS)
    with pytest.raises(DataError, match=r"not an image that can be read \(its content is none of"):
        read(tmp_path / name)
    assert not started.exists()


@pytest.mark.parametrize("write", MODELS)
def test_no_texture_starts_a_program(
    tmp_path: Path,
    started: Path,
    write: Callable[[Path, bytes], Path],
    caplog: pytest.LogCaptureFixture,
) -> None:
    mesh = load_mesh(write(tmp_path, EPS))
    assert mesh.materials[0].texture is None
    assert "cannot be read (not an image" in caplog.text
    assert not started.exists()


@pytest.mark.parametrize("write", MODELS)
def test_textures_are_read(
    tmp_path: Path, write: Callable[[Path, bytes], Path], caplog: pytest.LogCaptureFixture
) -> None:
    pixels = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    Image.fromarray(pixels).save(tmp_path / "picture.png")
    mesh = load_mesh(write(tmp_path, (tmp_path / "picture.png").read_bytes()))
    np.testing.assert_array_equal(mesh.materials[0].texture, pixels)
    assert mesh.materials[0].color[:3] == ((0.7,) * 3 if write is write_obj else (1.0,) * 3)
    assert mesh.corner_uv is not None
    assert not caplog.records


@pytest.mark.parametrize("ending", ["png", "jpg", "webp", "bmp", "tiff", "gif", "tga", "ppm"])
def test_formats_that_are_promised_are_read(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"a.{ending}"
    Image.new("RGB", (8, 8), (250, 20, 20)).save(path)
    assert read_photo(path)[3, 3, 0] > 200


def test_photos_are_refused_as_masks(tmp_path: Path) -> None:
    Image.new("RGB", (64, 48)).save(tmp_path / "a.png")
    with pytest.raises(DataError, match=r"the image is a PNG of mode RGB; give a PNG of one grey"):
        read_mask(tmp_path / "a.png")


def test_one_module_decodes_pictures() -> None:
    others = re.compile(r"\bImage\.open\(|\bimread\(|\bimdecode\(|trimesh\.load\((?!io\.BytesIO)")
    files = [p for folder in ("cadalign", "datasets", "render", "scripts")
             for p in (ROOT / folder).rglob("*.py")]  # fmt: skip
    found = {p.relative_to(ROOT).as_posix() for p in files if others.search(p.read_text())}
    assert found == {"cadalign/io/images.py"}


def test_masks_are_not_zero_and_no_jpegs(tmp_path: Path) -> None:
    mask = np.zeros((48, 64), dtype=np.uint8)
    mask[11:37, 13:50] = 1  # a label, not a brightness
    Image.fromarray(mask).save(tmp_path / "mask.png")
    assert np.array_equal(read_mask(tmp_path / "mask.png"), mask > 0)
    Image.fromarray(255 * mask).save(tmp_path / "mask.jpg")
    with pytest.raises(DataError, match=r"a JPEG of mode L, whose compression changes values"):
        read_mask(tmp_path / "mask.jpg")
