"""Frames of ScanNet scenes: photos with intrinsics and poses."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.photos.photo import existing, first_existing
from cadalign.errors import DataError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.rotations import nearest_rotation
from cadalign.io.documents import in_file
from cadalign.io.files import damaged, listed, read_text
from cadalign.io.images import photo_size

# The intrinsics of the colour images, as SensReader and as scannet_frames_25k name them.
_INTRINSICS = (Path("intrinsic", "intrinsic_color.txt"), Path("intrinsics_color.txt"))
_IMAGES = (".jpg", ".jpeg", ".png")


@dataclass(frozen=True)
class ScanNetFrame:
    """One frame of a ScanNet scene."""

    frame_id: str  # its number, as its file writes it
    image_path: Path
    pose_path: Path  # (4, 4), the scan's coordinates from the camera's
    intrinsics_path: Path  # (4, 4), of photos of this size

    def camera(self) -> Camera:
        """Read the intrinsics; integer pixels are taken for pixel centres."""
        matrix = read_matrix(self.intrinsics_path, (4, 4))
        width, height = photo_size(self.image_path)
        (fx, _, cx), (_, fy, cy) = matrix[:2, :3].tolist()
        with in_file(self.intrinsics_path):
            return Camera(width, height, fx, fy, cx, cy)

    def cam_from_scan(self) -> Alignment:
        """Read the pose: the camera's coordinates from the scan's [m].

        Raises DataError if it is no pose, such as ScanNet's -inf of a frame whose tracking was
        lost.
        """
        pose = read_matrix(self.pose_path, (4, 4))
        with in_file(self.pose_path):
            rotation = nearest_rotation(pose[:3, :3]).T
        return Alignment(rotation, -rotation @ pose[:3, 3], np.ones(3))


def list_frames(folders: Iterable[Path], scene: str) -> tuple[ScanNetFrame, ...]:
    """List a scene's frames, in the first folder that has any, in order of their numbers.

    Two layouts are known::

        <scene>/color/<frame>.jpg, pose/<frame>.txt, intrinsic/intrinsic_color.txt
        scannet_<scene's number>_<frame>.jpg, ..._<frame>_pose.txt, scannet_<...>_intr.txt
    """
    for folder in folders:
        found = (*_in_scene_folder(folder / scene), *_beside_each_other(folder, scene))
        if found:
            return tuple(sorted(found, key=lambda frame: (len(frame.frame_id), frame.frame_id)))
    return ()


def _in_scene_folder(folder: Path) -> Iterator[ScanNetFrame]:
    intrinsics = first_existing(folder / name for name in _INTRINSICS)
    if intrinsics is None:
        return
    for image in listed(folder / "color", "*"):
        if image.suffix.lower() in _IMAGES:
            yield ScanNetFrame(image.stem, image, folder / "pose" / f"{image.stem}.txt", intrinsics)


def _beside_each_other(folder: Path, scene: str) -> Iterator[ScanNetFrame]:
    prefix = f"scannet_{scene.removeprefix('scene')}_"
    intrinsics = folder / f"{prefix}intr.txt"
    if not existing(intrinsics):
        return
    for pose in folder.glob(f"{prefix}*_pose.txt"):
        stem = pose.name.removesuffix("_pose.txt")
        images = (folder / f"{stem}{suffix}" for suffix in _IMAGES)
        image = first_existing(images) or folder / f"{stem}.jpg"
        yield ScanNetFrame(stem.removeprefix(prefix), image, pose, intrinsics)


def read_matrix(path: Path, shape: tuple[int | None, int]) -> FloatArray:
    """Read a text file of a matrix, a row on each line; None for any number of rows.

    Raises DataError if it cannot be read, or is not a matrix of finite numbers of this shape.
    """
    text = read_text(path)
    rows = [line.split() for line in text.splitlines() if line.strip()]
    try:
        matrix = np.array(rows, dtype=np.float64)
    except ValueError:
        raise damaged("not a table of numbers", path) from None
    rows_wanted, columns = shape
    if matrix.shape != (rows_wanted or len(matrix), columns):
        wanted = f"{rows_wanted or 'some'} rows of {columns} numbers"
        raise damaged(f"shape {matrix.shape}, expected {wanted}", path)
    if not np.isfinite(matrix).all():
        raise DataError("some of its numbers are not finite", where=str(path))
    return matrix
