"""KITTI's text files: labels of objects, and projection matrices."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import DataError, InputError, quote
from cadalign.geometry.box import Box
from cadalign.geometry.camera import Camera
from cadalign.io.files import damaged, read_text

# The numbers after an object's type: truncated, occluded, alpha, bbox 4, dimensions h w l,
# location 3, rotation_y; a detector's score may follow.
_NUMBERS = 14
# The car's frame from KITTI's object frame (x forward, y down, z left at rotation_y = 0).
_OBJECT_FROM_CAR = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


@dataclass(frozen=True, eq=False)
class KittiLabel:
    """One line of a label file.

    Parameters
    ----------
    kind : str
        The object's type, such as "Car".
    numbers : (14,) float
        What follows the type.
    frame, track : int, optional
        The tracking benchmark's first two columns.
    """

    kind: str
    numbers: FloatArray
    frame: int | None = None
    track: int | None = None

    @property
    def flags(self) -> frozenset[str]:
        """Some of "truncated" and "occluded"."""
        found = {"truncated": self.numbers[0] > 0, "occluded": self.numbers[1] > 0}
        return frozenset(name for name, is_set in found.items() if is_set)

    @property
    def bbox(self) -> FloatArray:
        """Left, top, right and bottom [px], (4,) float."""
        return self.numbers[3:7]

    def box(self, shift: FloatArray) -> Box:
        """The object's box in the frame of a camera that lies ``shift`` off the reference."""
        height, width, length, x, y, z, rotation_y = self.numbers[7:14]
        dims = np.array([height, width, length])
        return car_box(dims, np.array([x, y, z]) + shift, float(rotation_y))


def car_box(dims_hwl: FloatArray, location: FloatArray, rotation_y: float) -> Box:
    """The box of a car from KITTI's numbers.

    Its axes are the car's: x to its left, y to its rear, z up; its extents width, length, height.

    Parameters
    ----------
    dims_hwl : (3,) float
        Height, width and length [m].
    location : (3,) float
        The centre of its bottom in the camera frame [m].
    rotation_y : float
        The rotation about the camera's y [rad]; 0 for a car that heads along the camera's x.

    Raises
    ------
    InputError
        If a dimension is not positive.
    """
    height, width, length = dims_hwl.tolist()
    if not min(height, width, length) > 0:
        raise InputError(f"{dims_hwl.tolist()} are not positive", where="dimensions")
    cosine, sine = np.cos(rotation_y), np.sin(rotation_y)
    turn = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
    center = location - np.array([0, height / 2, 0])
    return Box(center, turn @ _OBJECT_FROM_CAR, np.array([width, length, height]))


def yaw_of_car(rotation: FloatArray) -> float:
    """KITTI's rotation_y [rad] of a rotation (3, 3) from the car's frame to the camera's.

    Examples
    --------
    >>> box = car_box(np.ones(3), np.array([0.0, 0.0, 9.0]), 0.7)
    >>> round(yaw_of_car(box.rotation), 12)
    0.7
    """
    forward = -rotation[:, 1]
    return float(np.arctan2(-forward[2], forward[0]))


def read_labels(path: Path, *, tracking: bool) -> list[KittiLabel | DataError]:
    """Read a label file; a bad line is the reason why, in its place.

    Parameters
    ----------
    path : Path
    tracking : bool
        Whether frame and track come before the type.

    Raises
    ------
    DataError
        If the file cannot be read.
    """
    lines = read_text(path).splitlines()
    found: list[KittiLabel | DataError] = []
    for number, line in enumerate(lines, start=1):
        if line.strip():
            try:
                found.append(_label(line.split(), tracking=tracking))
            except InputError as error:
                found.append(DataError(error.what, where=f"{path}, line {number}"))
    return found


def _label(fields: list[str], *, tracking: bool) -> KittiLabel:
    skipped = 2 if tracking else 0
    if len(fields) not in (skipped + 1 + _NUMBERS, skipped + 2 + _NUMBERS):
        raise InputError(f"{len(fields)} columns, expected {skipped + 1 + _NUMBERS}")
    try:
        numbers = np.array(fields[skipped + 1 : skipped + 1 + _NUMBERS], dtype=np.float64)
        frame, track = map(int, fields[:2]) if tracking else (None, None)
    except ValueError:
        raise InputError(f"{quote(' '.join(fields))} are not a label's numbers") from None
    if not np.isfinite(numbers).all():
        raise InputError("some of its numbers are not finite")
    return KittiLabel(fields[skipped], numbers, frame, track)


def read_projection(path: Path, size: tuple[int, int]) -> tuple[Camera, FloatArray]:
    """Read the left colour camera's matrix P2 from a calibration file.

    Returns
    -------
    camera : Camera
    shift : (3,) float
        What is added to the reference camera's coordinates, in which locations are given, to get
        this camera's [m].

    Raises
    ------
    DataError
        If it cannot be read, or holds no valid P2.
    """
    lines = read_text(path).splitlines()
    for line in lines:
        name, _, rest = line.partition(" ")
        if name.rstrip(":") != "P2":
            continue
        try:
            matrix = np.array(rest.split(), dtype=np.float64).reshape(3, 4)
        except ValueError:
            raise damaged("P2 is not a 3 x 4 matrix", path) from None
        try:
            k = matrix[:, :3]
            camera = Camera(*size, k[0, 0], k[1, 1], k[0, 2], k[1, 2])
        except InputError as error:
            raise DataError(error.what, where=f"{path}: P2") from None
        return camera, np.asarray(np.linalg.solve(k, matrix[:, 3]))
    raise damaged("there is no line P2", path)
