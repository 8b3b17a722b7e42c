"""Fuzz the readers: small valid files of every format, mutated from a seed, in bounded memory."""

from __future__ import annotations

import json
import pickle
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from fuzz import dataset_formats
from fuzz.dataset_formats import CAMERA, PIXELS, POINTS, sealed, write_picture
from fuzz.mutations import Format
from PIL import Image

import cadalign
from cadalign import FocalPrior, Library, Result, fit
from cadalign.datasets import (
    BlindPnP,
    Colmap,
    KeypointNet,
    ModelKeypoints,
    load_mesh,
    read_image_keypoints,
)
from cadalign.io.images import photo_size, read_photo
from cadalign.io.observation import Observation
from cadalign.report.headline import headline_of
from cadalign.report.runs import read_runs
from cadalign.retrieval import LibraryModel
from cadalign.retrieval.models import SEAL

# --- formats ------------------------------------------------------------------------------------


def _text(name: str, text: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        (folder / name).write_text(text, encoding="utf-8")
        return folder / name

    return write


def _json(name: str, value: Any) -> Callable[[Path], Path]:
    return _text(name, json.dumps(value, indent=1))


_OBJ = (
    "mtllib box.mtl\n"
    + "".join(f"v {x} {y} {z}\n" for x in (0, 1) for y in (0, 1) for z in (0, 1))
    + "vt 0 0\nvt 1 0\nvt 1 1\nvn 0 0 1\nusemtl red\nf 1/1/1 2/2/1 4/3/1\nf 5 6 8 7\nl 1 2\n"
    "usemtl blue\nf -1//1 -2//1 -3//1\nf 1 2 \\\n 5\n"
)
_MTL = "newmtl red\nKd 1 0 0\nd 0.5\nmap_Kd -s 1 1 1 wood.png\nnewmtl blue\nKd 0 0 1\nNs 10\n"


def _write_obj(folder: Path) -> Path:
    (folder / "box.mtl").write_text(_MTL)
    Image.fromarray(np.full((4, 4, 3), 90, np.uint8)).save(folder / "wood.png")
    return _text("box.obj", _OBJ)(folder)


def _write_mtl(folder: Path) -> Path:
    _write_obj(folder)
    return folder / "box.mtl"


def _export(name: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        box = trimesh.creation.box()
        box.visual.vertex_colors = np.full((8, 4), 200, np.uint8)
        box.export(folder / name)
        return folder / name

    return write


def _seal_png(data: bytes) -> bytes:
    """A PNG file whose chunks have right checksums."""
    sealed, place = data[:8], 8
    while place + 12 <= len(data):
        length = min(int.from_bytes(data[place : place + 4], "big"), len(data) - place - 12)
        body = data[place + 4 : place + 8 + length]
        sealed += length.to_bytes(4, "big") + body + zlib.crc32(body).to_bytes(4, "big")
        place += 12 + length
    return sealed


def _write_photo(folder: Path) -> Path:
    """A JPEG with EXIF data."""
    exif = Image.Exif()
    exif[0x0112] = 6
    exif[0x8769] = {0x920A: 35.0, 0xA405: 50, 0xA20E: 4000.0, 0xA210: 3, 0xA002: 40, 0xA003: 30}
    path = folder / "photo.jpg"
    Image.new("RGB", (40, 30), "red").save(path, exif=exif)
    return path


def _read_photo(path: Path) -> object:
    return FocalPrior.from_exif(path), photo_size(path), read_photo(path)


def _write_run(changed: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        sweep = {"sweep": "points", "values": (8,), "runs": 2, "methods": ("optimal", "limit")}
        cadalign.evaluate(experiment="simulate", out=folder / "run", **sweep, workers=0)
        return folder / "run" / changed

    return write


_OBSERVATION = {
    "camera": {"model": "PINHOLE", "width": 64, "height": 48, "params": [60, 60, 32, 24]},
    "keypoints": [
        {"xyz": xyz, "uv": uv, "sigma": 1.0, "semantic_id": k, "name": f"corner {k}", "score": 0.5}
        for k, (xyz, uv) in enumerate(zip(POINTS.tolist(), PIXELS.tolist(), strict=True))
    ],
}
_IMAGES_TOLD = {"mask": "a.png", "mask_sigma": 1.5}
_NUMBERS_TOLD = {"depth_sigma": 0.01, "camera_height": 1.4, "camera_height_sigma": 0.02}
_POSE_TOLD = {"up": [0, -1, 0], "up_sigma_deg": 1.0, "cam_from_rig": np.eye(4).tolist()}
_EVIDENCE = {
    "views": [_OBSERVATION | _IMAGES_TOLD | _NUMBERS_TOLD | _POSE_TOLD],
    "size": {"width": 1.0, "sigma": 0.1},
    "shape": "a.shape",
    "model": "a.obj",
}
_COCO = {
    "images": [{"id": 1, "file_name": "a.jpg", "width": 64, "height": 48}],
    "categories": [{"id": 1, "name": "chair", "keypoints": ["a", "b", "c"]}],
    "annotations": [
        {"id": 1, "image_id": 1, "category_id": 1, "score": 0.5}
        | {"keypoints": [1, 2, 2, 3, 4, 1, 0, 0, 0]}
    ],
}
_KEYPOINTNET = [
    {
        "class_id": "03001627",
        "model_id": "abc",
        "keypoints": [
            {
                "xyz": xyz,
                "rgb": [1, 2, 3],
                "semantic_id": k,
                "pcd_info": {"point_index": k},
                "mesh_info": {"face_index": k, "face_uv": [0.2, 0.3, 0.5]},
            }
            for k, xyz in enumerate(POINTS.tolist())
        ],
        "symmetries": {
            "reflection": [{"kp_indexes": [0, 1]}],
            "rotation": [{"kp_indexes": [2, 3], "is_circle": False, "circle": {}}],
        },
    }
]
_MODEL_KEYPOINTS = {
    "format": "cadalign model keypoints",
    "version": 1,
    "keypoints": [
        {"name": f"k{k}", "xyz": xyz, "semantic_id": k} for k, xyz in enumerate(POINTS.tolist())
    ],
}
_CAMERAS = "# cameras\n1 PINHOLE 64 48 60 60 32 24\n2 OPENCV 64 48 60 60 32 24 .1 0 0 0\n"
_IMAGES = "1 1 0 0 0 0 0 3 1 a.jpg\n10 10 1 20 20 2 5 5 -1\n2 .5 .5 .5 .5 0 0 3 2 b.jpg\n\n"
_SCENE_POINTS = "1 0.1 0.2 0.3 255 0 0 0.5 1 0\n2 -.1 .2 .1 0 0 255 0.1 1 1 2 0\n"


def _colmap(changed: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        texts = ("cameras", _CAMERAS), ("images", _IMAGES), ("points3D", _SCENE_POINTS)
        for name, text in texts:
            (folder / f"{name}.txt").write_text(text)
        return folder / f"{changed}.txt"

    return write


def _write_blind_pnp(folder: Path) -> Path:
    root = folder / "nyu_train"
    root.mkdir()
    rows = np.hstack([CAMERA.normalize(PIXELS), POINTS])
    values = {"matches": [rows], "R": [np.eye(3)], "t": [np.array([0, 0, 3.0])]}
    for name, value in values.items():
        (root / f"{name}.pkl").write_bytes(pickle.dumps(value, protocol=2))
    return root / "matches.pkl"


def _write_fit(folder: Path) -> Path:
    result = fit(POINTS, PIXELS, CAMERA)
    return _text("fit.json", json.dumps(result.to_dict()))(folder)


def _write_library(folder: Path) -> Path:
    bounds = np.array([POINTS.min(axis=0), POINTS.max(axis=0)])
    models = [LibraryModel("box", f"{k}", POINTS, np.arange(8), bounds) for k in range(3)]
    Library.from_models(models).save(folder / "boxes.cadalign")
    return folder / "boxes.cadalign"


def _read_library(path: Path) -> object:
    library = Library.open(path)
    return list(library), library.retrieve(PIXELS, np.arange(8), CAMERA)


def _read_annotations(path: Path) -> object:
    dataset = KeypointNet(path.parent.parent)
    return [model.keypoints for model in dataset], dataset.problems


def _write_annotations(folder: Path) -> Path:
    (folder / "annotations").mkdir()
    return _json("chair.json", _KEYPOINTNET)(folder / "annotations")


def _read_run(path: Path) -> object:
    return headline_of(read_runs([path.parent]))


FORMATS = {
    kind.name: kind
    for kind in (
        Format("obj", _write_obj, load_mesh),
        Format("mtl", _write_mtl, lambda path: load_mesh(path.with_name("box.obj"))),
        Format("ply", _export("box.ply"), load_mesh),
        Format("stl", _export("box.stl"), load_mesh),
        Format("glb", _export("box.glb"), load_mesh),
        Format("off", _export("box.off"), load_mesh),
        Format("image", write_picture("png"), read_photo),
        Format("sealed image", write_picture("png"), read_photo, _seal_png),
        Format("photo", _write_photo, _read_photo),
        Format("observation", _json("o.json", _OBSERVATION), Observation.load),
        Format("evidence", _json("e.json", _EVIDENCE), Observation.load),
        Format("coco", _json("c.json", _COCO), read_image_keypoints),
        Format("csv", _text("k.csv", "name,u,v,score\na,1,2,.5\nb,3,4,.1\n"), read_image_keypoints),
        Format("keypointnet", _write_annotations, _read_annotations),
        Format("model keypoints", _json("m.keypoints.json", _MODEL_KEYPOINTS), ModelKeypoints.load),
        *(
            Format(f"colmap {name}", _colmap(name), lambda path: list(Colmap(path.parent)))
            for name in ("cameras", "images", "points3D")
        ),
        Format("blind pnp", _write_blind_pnp, lambda path: list(BlindPnP(path.parent))),
        Format("fit", _write_fit, Result.load),
        Format("library", _write_library, _read_library),
        Format("forged library", _write_library, _read_library, sealed(SEAL)),
        *(
            Format(f"run {name}", _write_run(name), _read_run)
            for name in ("run.json", "results.parquet", "timings.parquet")
        ),
        *dataset_formats.FORMATS,
    )
}
