"""What COLMAP's text and binary files both hold."""

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


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """An image's name, and what reads the rest of its entry when it is asked for."""

    name: str
    read: Callable[[], ColmapView]


@dataclass(frozen=True, eq=False)
class ColmapPoints:
    """The points of a model: numbers (m,) int and coordinates (m, 3) float, in file order."""

    ids: IntArray
    xyz: FloatArray


CameraTable = dict[int, dict[str, Any]]
"""Cameras in the form that `cadalign.Camera.from_dict` reads, by number."""
