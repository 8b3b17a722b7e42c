"""Volume of the intersection of two boxes."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import kernel

_CORNERS = 24  # of a side after 6 cuts: 10, and no more than these however sums are rounded
_SHRUNKEN = 1.0 - 1e-13  # the first box, so that no two faces lie in one plane


@kernel
def intersection_volume(
    first: FloatArray, second: FloatArray, axes: FloatArray, center: FloatArray
) -> float:
    """Compute the volume of the intersection of two boxes.

    The boxes have the side lengths ``first`` and ``second``; ``axes`` (columns) and ``center`` of
    the second are in the frame of the first. By the divergence theorem the volume is a third of the
    sum, over the intersection's sides, of area times distance from the origin. A side is a part of
    one box's face, cut off at the faces of the other (Sutherland and Hodgman).
    """
    back = np.ascontiguousarray(axes.T)
    origin = np.zeros(3)
    for i in range(3):
        for j in range(3):
            origin[i] -= axes[j, i] * center[j]
    room = np.empty((2, _CORNERS, 3))
    smaller = _SHRUNKEN * first
    # All pyramids have their apex in the centre of the first box.
    volume = _sides(smaller, second, axes, center, np.zeros(3), room)
    return volume + _sides(second, smaller, back, origin, origin, room)


@kernel
def _sides(
    own: FloatArray,
    other: FloatArray,
    axes: FloatArray,
    center: FloatArray,
    apex: FloatArray,
    room: FloatArray,
) -> float:
    """Sum, over the faces of a box, the volumes of pyramids on their parts inside another box.

    ``axes`` (columns), ``center`` and ``apex`` are in the box's frame.
    """
    volume = 0.0
    for face in range(6):
        k, sign = face // 2, 1.0 if face % 2 else -1.0
        a, b = (k + 1) % 3, (k + 2) % 3
        for corner in range(4):
            room[0, corner, k] = 0.5 * sign * own[k]
            room[0, corner, a] = 0.5 * own[a] * (1.0 if corner == 1 or corner == 2 else -1.0)
            room[0, corner, b] = 0.5 * own[b] * (1.0 if corner >= 2 else -1.0)
        count, now = 4, 0
        for cut in range(6):
            count = _cut(room, now, count, other, axes, center, cut)
            now = 1 - now
        area = 0.0
        for i in range(2, count):
            area += (room[now, i - 1, a] - room[now, 0, a]) * (room[now, i, b] - room[now, 0, b])
            area -= (room[now, i - 1, b] - room[now, 0, b]) * (room[now, i, a] - room[now, 0, a])
        volume += 0.5 * abs(area) * (0.5 * own[k] - sign * apex[k]) / 3.0
    return volume


@kernel
def _cut(
    room: FloatArray,
    now: int,
    count: int,
    other: FloatArray,
    axes: FloatArray,
    center: FloatArray,
    face: int,
) -> int:
    """Cut a polygon off at a face of a box, from ``room[now]`` to the other half; its corners."""
    k, sign = face // 2, 1.0 if face % 2 else -1.0
    kept = 0
    for i in range(count):
        j = (i + 1) % count
        over, next_over = -0.5 * other[k], -0.5 * other[k]
        for c in range(3):
            over += sign * axes[c, k] * (room[now, i, c] - center[c])
            next_over += sign * axes[c, k] * (room[now, j, c] - center[c])
        if over <= 0.0:
            room[1 - now, kept] = room[now, i]
            kept += 1
        if (over < 0.0 and next_over > 0.0) or (over > 0.0 and next_over < 0.0):
            share = over / (over - next_over)
            for c in range(3):
                room[1 - now, kept, c] = room[now, i, c] + share * (
                    room[now, j, c] - room[now, i, c]
                )
            kept += 1
    return kept
