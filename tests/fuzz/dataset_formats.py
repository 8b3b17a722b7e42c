"""Files of data sets, shapes, cameras and estimates to fuzz, beside those of `fuzz.readers`."""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from fuzz.mutations import Format
from PIL import Image
from support.gltf_files import CORNERS, POSITIONS, VIEWS, write_gltf
from support.photo_data import read_whole, write_text
from support.photo_sets import WRITERS

from cadalign import Alignment, Camera, ShapeModel
from cadalign.datasets import load_mesh
from cadalign.datasets.coco import decode_segmentation
from cadalign.io.documents import read_json
from cadalign.io.files import Seal
from cadalign.io.images import read_grey, read_photo
from cadalign.io.observation import read_camera
from cadalign.shapes.outputs import SEAL

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
POINTS = np.random.default_rng(3).uniform(-0.4, 0.4, (8, 3))
POSE = Alignment(np.eye(3), np.array([0.0, 0.0, 3.0]), [1.0, 1.2, 0.8])
PIXELS = CAMERA.project(POSE.apply(POINTS))

# Of each data set of photos the files that a mutation may stand in.
_CHANGED = {
    "Pix3D": ("pix3d.json", "model/m.obj", "model/k.txt", "mask/0.png"),
    "Scan2CAD": (
        "full_annotations.json",
        "scans/scene0000_00/intrinsic/intrinsic_color.txt",
        "scans/scene0000_00/pose/0.txt",
    ),
    "PASCAL3D+": ("Annotations/chair_pascal/1.mat", "CAD/chair.mat"),
}


def _photo_set(kind: str, changed: str) -> Format:
    """A file of a data set; whatever is in it, the rest is read, or the folder refused."""

    def write(folder: Path) -> Path:
        root = WRITERS[kind](folder / "set")
        return root / changed

    depth = len(Path(changed).parts) - 1
    return Format(f"{kind} {changed}", write, lambda path: read_whole(path.parents[depth]))


# --- shapes, results, estimates, masks, cameras ------------------------------------------------


def _write_shape(folder: Path) -> Path:
    directions = np.random.default_rng(0).normal(size=(2, 8, 3))
    ShapeModel.from_basis(POINTS, directions, [0.1, 0.1]).save(folder / "a.shape")
    return folder / "a.shape"


def sealed(seal: Seal) -> Callable[[bytes], bytes]:
    """Let a file's header tell the length and the checksum of what it holds."""

    def with_header(data: bytes) -> bytes:
        payload = data[64:]
        checksum = hashlib.blake2b(payload, digest_size=32).digest()
        head = (seal.magic, seal.version, 0, len(payload), checksum)
        return struct.pack("<16sIIQ32s", *head) + payload

    return with_header


_POLYGONS = [[1.0, 0.0, 30.0, 0.0, 30.0, 20.0, 1.0, 20.0], [40, 30, 50.5, 30, 45, 45]]
_RUNS = {"size": [48, 64], "counts": [2, 40, 3000, 30]}
_TEXT = {"size": [2, 4], "counts": "242"}


def _mask(name: str, segmentation: Any, width: int, height: int) -> Format:
    return Format(
        f"coco mask of {name}",
        lambda folder: write_text(folder / "mask.json", json.dumps(segmentation)),
        lambda path: decode_segmentation(read_json(path), width=width, height=height),
    )


def _write_matrix(ending: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        path = folder / f"K.{ending}"
        by_rows = {"matrix": CAMERA.matrix.tolist(), "width": 64, "height": 48}
        return write_text(
            path, json.dumps(by_rows) if ending == "json" else "60 0 31\n0 60 23\n0 0 1\n"
        )

    return write


def _read_camera(path: Path) -> object:
    return read_camera(path, size=(64, 48))


# --- pictures and scenes -----------------------------------------------------------------------


def write_picture(ending: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        pixels = np.random.default_rng(1).integers(0, 255, (20, 30, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / f"photo.{ending}")
        return folder / f"photo.{ending}"

    return write


def _write_depth(folder: Path) -> Path:
    depth = np.arange(600, dtype=np.uint16).reshape(20, 30)
    Image.fromarray(depth).save(folder / "depth.png")
    return folder / "depth.png"


def _write_scene(folder: Path) -> Path:
    """A scene with a texture and copies of a mesh."""
    more = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], "<f4").tobytes()
    write_picture("png")(folder)
    attributes = {"POSITION": 0, "TEXCOORD_0": 2}
    primitive = {"attributes": attributes, "indices": 1, "material": 0}
    return write_gltf(
        folder / "scene.gltf",
        more=more,
        nodes=[{"mesh": 0, "children": [1, 2]}, {"mesh": 0, "scale": [1, 1, -1]}, {"mesh": 0}],
        meshes=[{"primitives": [primitive]}],
        materials=[{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "extensions": {
            "KHR_texture_transform": {"offset": [0.5, 0], "rotation": 0.1, "scale": [2, 2]}}}}}],
        textures=[{"source": 0}],
        images=[{"uri": "photo.png"}],
        bufferViews=[*VIEWS, {"buffer": 0, "byteOffset": 60, "byteLength": 32, "byteStride": 8}],
        accessors=[POSITIONS, CORNERS, POSITIONS | {"bufferView": 2, "type": "VEC2"}],
    )  # fmt: skip


FORMATS = (
    *(_photo_set(kind, changed) for kind, names in _CHANGED.items() for changed in names),
    Format("shape", _write_shape, ShapeModel.open),
    Format("forged shape", _write_shape, ShapeModel.open, sealed(SEAL)),
    _mask("polygons", _POLYGONS, 64, 48),
    _mask("runs", _RUNS, 64, 48),
    _mask("compressed runs", _TEXT, 4, 2),
    *(
        Format(f"camera {ending}", _write_matrix(ending), _read_camera)
        for ending in ("txt", "json")
    ),
    *(
        Format(f"image {ending}", write_picture(ending), read_photo)
        for ending in ("webp", "bmp", "tiff", "gif", "tga", "ppm")
    ),
    Format("depth image", _write_depth, read_grey),
    Format("gltf", _write_scene, load_mesh),
)
