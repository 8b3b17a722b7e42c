"""Tiny data sets of photos, written in the layouts of the public ones."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

import cadalign.datasets
from cadalign.errors import DataError
from support.files import TETRAHEDRON, write_json


def write_photo(path: Path, width: int = 64, height: int = 48, *, grey: bool = False) -> Path:
    """Write a photo of one colour; a grey one may be a mask."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("L" if grey else "RGB", (width, height), 90 if grey else (90, 120, 150)).save(path)
    return path


def write_text(path: Path, text: str) -> Path:
    """Write a text file into a folder that is created where it is missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def matrix_text(matrix: np.ndarray) -> str:
    """A matrix as ScanNet writes it."""
    return "\n".join(" ".join(f"{value:.9g}" for value in row) for row in matrix) + "\n"


def rigid(seed: int, translation: tuple[float, float, float]) -> np.ndarray:
    """A random rotation with a translation, (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    matrix[:3, 3] = translation
    return matrix


# --- Scan2CAD --------------------------------------------------------------------------------


def trs(matrix: np.ndarray, scale: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> dict[str, Any]:
    """A rigid matrix and a scale in Scan2CAD's form."""
    x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat()
    return {
        "translation": matrix[:3, 3].tolist(),
        "rotation": [w, x, y, z],
        "scale": list(scale),
    }


def scan2cad_model(world_from_model: np.ndarray, **changes: Any) -> dict[str, Any]:
    """One aligned model: a chair of the scale 1, 2, 0.5 with the box's half sides 0.3."""
    scale = (1.0, 2.0, 0.5)
    corners = np.array([[0.3, 0.3, 0.3], [-0.3, 0.3, 0.3], [0.3, -0.3, 0.3], [0.3, 0.3, -0.3]])
    on_cad = corners * scale @ world_from_model[:3, :3].T + world_from_model[:3, 3]
    model = {
        "trs": trs(world_from_model, scale),
        "id_cad": "abc",
        "catid_cad": "03001627",
        "sym": "__SYM_ROTATE_UP_2",
        "bbox": [0.3, 0.3, 0.3],
        "center": [0.0, 0.0, 0.0],
        "keypoints_cad": {"n_keypoints": 4, "position": on_cad.ravel().tolist()},
        "keypoints_scan": {"n_keypoints": 4, "position": (on_cad + 0.01).ravel().tolist()},
    }
    return {**model, **changes}


def write_scan2cad(root: Path, *, scenes: int = 1, frames: int = 2, **changes: Any) -> np.ndarray:
    """Write scenes whose chair stands 3 m in front of the camera; returns cam_from_model's rigid
    part, (4, 4), which is the same in all frames."""
    cam_from_model = rigid(1, (0.1, -0.2, 3.0))
    world_from_scan = rigid(2, (1.0, 2.0, 3.0))
    scans = []
    for scene in range(scenes):
        name = f"scene{scene:04d}_00"
        scan_from_cam = rigid(3 + scene, (0.5, 1.0, -1.0))
        folder = root / "scans" / name
        write_text(
            folder / "intrinsic" / "intrinsic_color.txt",
            matrix_text(np.array([[50, 0, 31.5, 0], [0, 50, 23.5, 0], [0, 0, 1, 0], [0, 0, 0, 1]])),
        )
        for frame in range(frames):
            write_photo(folder / "color" / f"{frame}.jpg")
            write_text(folder / "pose" / f"{frame}.txt", matrix_text(scan_from_cam))
        world_from_model = world_from_scan @ scan_from_cam @ cam_from_model
        scans.append(
            {
                "id_scan": name,
                "trs": trs(world_from_scan),
                "n_aligned_models": 1,
                "aligned_models": [scan2cad_model(world_from_model, **changes)],
            }
        )
    write_json(root / "full_annotations.json", scans)
    mesh = root / "ShapeNetCore.v2" / "03001627" / "abc" / "models" / "model_normalized.obj"
    write_text(mesh, TETRAHEDRON)
    return cam_from_model


# --- damage ----------------------------------------------------------------------------------


def read_whole(root: Path) -> int:
    """Open the data set in a folder and read all that it holds; the number of photos."""
    dataset = cadalign.datasets.open(root)
    count = 0
    for photo in dataset:
        count += 1
        readers: list[Any] = [photo.read_image]
        for found in photo.objects:
            readers += [found.read_mask]
            if found.model is not None:
                readers += [found.model.load_mesh, found.model.load_keypoints]
        for read in readers:
            with suppress(DataError):
                read()
    return count


def assert_damage_is_told(root: Path, *, seed: int = 0) -> None:
    """Cut, change, empty and remove each file below a folder in turn: nothing but a DataError.

    Raises
    ------
    AssertionError
        If the whole data set has no photo.
    """
    assert read_whole(root) > 0
    rng = np.random.default_rng(seed)
    for path in sorted(path for path in root.rglob("*") if path.is_file()):
        good = path.read_bytes()
        cuts = [good[: int(share * len(good))] for share in (0.0, 0.3, 0.6, 0.97)]
        changed = np.frombuffer(good, dtype=np.uint8).copy()
        changed[rng.integers(len(good), size=3)] = rng.integers(256, size=3)
        for content in (*cuts, changed.tobytes(), None):
            if content is None:
                path.unlink()
            else:
                path.write_bytes(content)
            with suppress(DataError):
                read_whole(root)
        path.write_bytes(good)
