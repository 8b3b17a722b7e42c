"""Scan2CAD's form: every photo as the frame of a scan of its own, with the stretched model in it.

The scan's z points up. Keypoints are pairs: on the CAD model, and on the scan, where the marked
pixel's ray has the depth of the model's keypoint.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.export.photo_sets.annotated import AnnotatedPhoto, converted
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.rotations import quat_wxyz_from_rotation
from cadalign.io.files import write_json, write_text, writing

_LEAST = 0.9  # of the cosine between an axis and up that another axis is taken


def write_scan2cad_set(
    folder: Path, numbered: Iterable[tuple[int, AnnotatedPhoto]]
) -> list[InputError]:
    """Write the photos that the form can hold; returns why the others were left out."""
    scans, problems = converted(numbered, partial(_scan, folder))
    write_json(folder / "full_annotations.json", scans)
    return problems


def upright_rotation(up: FloatArray) -> FloatArray:
    """A rotation (3, 3) that takes a direction of length 1 to z."""
    beside = np.eye(3)[0 if abs(up[0]) < _LEAST else 1]
    x = beside - (beside @ up) * up
    x /= np.linalg.norm(x)
    return np.array([x, np.cross(up, x), up])


def _scan(folder: Path, number: int, photo: AnnotatedPhoto) -> dict[str, Any]:
    photo.require_plain_camera("Scan2CAD")
    scene = f"scene{number:04d}_00"
    place = folder / "scans" / scene
    for name in ("pose", "intrinsic"):
        with writing(place / name):
            (place / name).mkdir(parents=True, exist_ok=True)
    photo.copy_image(place / "color" / "0")
    intrinsics, scan_from_cam = np.eye(4), np.eye(4)
    intrinsics[:3, :3] = photo.camera.matrix
    turn = upright_rotation(photo.upwards)
    scan_from_cam[:3, :3] = turn
    write_text(place / "pose" / "0.txt", _matrix_text(scan_from_cam))
    write_text(place / "intrinsic" / "intrinsic_color.txt", _matrix_text(intrinsics))
    exported = photo.exported
    model_id = f"{number:06d}-{exported.name}"
    models = folder / "ShapeNetCore.v2" / photo.category / model_id / "models"
    photo.write_model(models / "model_normalized.obj", is_stretched=False)
    pose = photo.pose
    in_camera = pose.apply(photo.points)
    rows = [row for row, name in enumerate(photo.names) if name in photo.marked]
    pixels = np.array([photo.marked[photo.names[row]] for row in rows]).reshape(-1, 2)
    rays = np.column_stack([photo.camera.normalize(pixels), np.ones(len(rows))])
    seen = rays * in_camera[rows, 2:]
    low, high = exported.bounds
    model = {
        "trs": _trs(Alignment(turn @ pose.rotation, turn @ pose.translation, photo.scale)),
        "id_cad": model_id,
        "catid_cad": photo.category,
        "sym": "__SYM_NONE",
        "bbox": ((high - low) / 2).tolist(),
        "center": ((high + low) / 2).tolist(),
        "keypoints_cad": {"position": (in_camera[rows] @ turn.T).ravel().tolist()},
        "keypoints_scan": {"position": (seen @ turn.T).ravel().tolist()},
    }
    return {
        "id_scan": scene,
        "trs": _trs(Alignment.identity()),
        "n_aligned_models": 1,
        "aligned_models": [model],
    }


def _matrix_text(matrix: FloatArray) -> str:
    return "".join(" ".join(f"{value:.17g}" for value in row) + "\n" for row in matrix.tolist())


def _trs(alignment: Alignment) -> dict[str, Any]:
    return {
        "translation": alignment.translation.tolist(),
        "rotation": np.asarray(quat_wxyz_from_rotation(alignment.rotation)).tolist(),
        "scale": alignment.scale.tolist(),
    }
