"""A small textured object with pose, stretch and photo, for tests of the export."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from cadalign import Alignment, Camera, Mesh
from cadalign.arrays import FloatArray
from cadalign.export import AlignedObject, ExportView
from cadalign.geometry.mesh import Material
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.io.images import write_image

CAMERA = Camera(320, 240, 400.0, 390.0, 140.3, 131.2)
LENS = Camera(320, 240, 300.0, 295.0, 150.3, 126.2, (-0.25, 0.08, 0.002, -0.001))
POSE = Alignment(rotation_from_vector(np.array([0.5, 0.6, 0.2])), [0.05, -0.1, 3.0], [1, 1.4, 0.7])
KEYPOINTS = np.array([[-0.5, -0.4, -0.5], [0.5, -0.4, -0.5], [0.5, 0.3, 0.5], [0.0, 0.9, 0.0]])


def wedge() -> Mesh:
    """A wedge of two materials, one textured and one red, with no symmetry."""
    corners = np.array(
        [
            [-0.5, -0.4, -0.5],
            [0.5, -0.4, -0.5],
            [0.5, -0.4, 0.5],
            [-0.5, -0.4, 0.5],
            [0.3, 0.5, 0.4],
            [0.0, 0.9, 0.0],
        ]
    )
    faces = np.array(
        [[0, 1, 2], [0, 2, 3], [0, 5, 1], [1, 5, 4], [1, 4, 2], [2, 4, 3], [3, 4, 5], [3, 5, 0]]
    )
    rng = np.random.default_rng(0)
    texture = rng.integers(0, 256, (8, 8, 3), dtype=np.uint8)
    uv = np.round(rng.uniform(0, 1, (len(faces), 3, 2)), 3)
    return Mesh(
        corners,
        faces,
        corner_uv=uv,
        materials=(
            Material("cloth", (1.0, 1.0, 1.0, 1.0), texture),
            Material("red", (0.8, 0.1, 0.2, 1.0)),
        ),
        face_material=np.array([0, 0, 1, 1, 0, 1, 0, 0]),
    )


def photo_of(camera: Camera) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    """A smooth photo whose colours encode the pixel."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    red, green = 255 * columns / camera.width, 255 * rows / camera.height
    return np.stack([red, green, np.full_like(red, 90.0)], axis=2).astype(np.uint8)


def aligned(folder: Path, *, camera: Camera = CAMERA, **fields: Any) -> AlignedObject:
    """The wedge in one photo, which is written to ``folder``."""
    path = folder / "000007.png"
    write_image(path, photo_of(camera))
    return AlignedObject((ExportView(camera, POSE, path),), **{"mesh": wedge(), **fields})


def turned(view: ExportView, angle: float) -> tuple[ExportView, FloatArray]:
    """View of the object from a camera moved about it, and the motion from the first camera."""
    pose, motion = view.cam_from_model, np.eye(4)
    motion[:3, :3] = rotation_from_vector(np.array([0.0, angle, 0.0]))
    motion[:3, 3] = pose.translation - motion[:3, :3] @ pose.translation
    rotation = motion[:3, :3] @ pose.rotation
    other = Alignment(rotation, pose.translation, pose.scale)
    return ExportView(view.camera, other), motion
