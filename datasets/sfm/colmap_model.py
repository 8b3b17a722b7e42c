"""Content of COLMAP's files, text or binary."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from cadalign.arrays import FloatArray, IntArray

INVALID_POINT = -1
"""The point id of an observation that belongs to no point."""


@dataclass(frozen=True, eq=False)
class ColmapView:
    """One image's entry.

    Parameters
    ----------
    quat_wxyz : (4,) float
        Rotation, camera from world, scalar first.
    translation : (3,) float
        Translation, camera from world.
    camera_id : int
        The camera's number.
    points_2d : (n, 2) float
        Observations in COLMAP's pixels, whose centres are at (0.5, 0.5).
    point_ids : (n,) int
        The points that they show, or `INVALID_POINT`.
    """

    quat_wxyz: FloatArray
    translation: FloatArray
    camera_id: int
    points_2d: FloatArray
    point_ids: IntArray


ColmapImage = tuple[str, Callable[[], ColmapView]]
"""An image's name, and the function that reads the rest of its entry."""

ColmapPoints = tuple[IntArray, FloatArray]
"""Numbers (m,) and coordinates (m, 3) of all points, in file order."""

CameraTable = dict[int, dict[str, Any]]
"""Cameras in the form that `cadalign.Camera.from_dict` reads, by number."""
