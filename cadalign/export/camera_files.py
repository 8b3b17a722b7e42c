"""Trajectories in the forms of TUM and KITTI."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.geometry.rotations import quat_wxyz_from_rotation
from cadalign.io.files import write_text


def write_tum(path: Path, times: FloatArray, poses: FloatArray) -> None:
    """Write times (P,) [s] and poses (P, 12), rotations by rows and translations.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp(), "track.tum")
    >>> write_tum(path, np.array([0.5]), np.array([[1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 2.0]]))
    >>> [float(number) for number in path.read_text().split()]
    [0.5, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 1.0]
    """
    lines = []
    for time, pose in zip(times, poses, strict=True):
        w, x, y, z = quat_wxyz_from_rotation(pose[:9].reshape(3, 3))
        lines.append(_line([time, *pose[9:], x, y, z, w]))
    write_text(path, "".join(lines))


def write_kitti(path: Path, poses: FloatArray) -> None:
    """Write poses (P, 12), rotations by rows and translations, a matrix (3, 4) a line."""
    matrices = np.concatenate([poses[:, :9].reshape(-1, 3, 3), poses[:, 9:, None]], axis=2)
    write_text(path, "".join(map(_line, matrices.reshape(-1, 12).tolist())))


def _line(numbers: list[float]) -> str:
    return " ".join(f"{number + 0.0:.9f}" for number in numbers) + "\n"
