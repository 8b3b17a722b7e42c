"""Intersection of two oriented boxes: clipped edges and volume."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import kernel

_PARALLEL = 1e-14  # component across a face, over the edge's length, of a parallel edge
_CORNERS = 42  # bound on a polygon's corners after 6 cuts: 10 without rounding
_NODE = 1.0 / np.sqrt(3.0)


@kernel
def clip_edges(
    extents: FloatArray, clip: FloatArray, axes: FloatArray, center: FloatArray, ends: FloatArray
) -> int:
    """Clip a box's edges to another box; write their ends and return the number of ends.

    The boxes have the side lengths ``extents`` and ``clip``. ``axes`` (columns), ``center`` and
    ``ends`` (24, 3) of the first box are in the frame of the second.
    """
    count = 0
    start = np.empty(3)
    step = np.empty(3)
    for along in range(3):
        one, other = (along + 1) % 3, (along + 2) % 3
        for corner in range(4):
            a = extents[one] * (0.5 if corner % 2 else -0.5)
            b = extents[other] * (0.5 if corner // 2 else -0.5)
            enter, leave = 0.0, 1.0
            for c in range(3):
                step[c] = axes[c, along] * extents[along]
                start[c] = center[c] + axes[c, one] * a + axes[c, other] * b - 0.5 * step[c]
                half = 0.5 * clip[c]
                if abs(step[c]) <= _PARALLEL * extents[along]:
                    if abs(start[c]) > half * (1.0 + 1e-12):
                        leave = -1.0
                    continue
                first, last = (-half - start[c]) / step[c], (half - start[c]) / step[c]
                enter = max(enter, min(first, last))
                leave = min(leave, max(first, last))
            if enter <= leave:
                for c in range(3):
                    ends[count, c] = start[c] + enter * step[c]
                    ends[count + 1, c] = start[c] + leave * step[c]
                count += 2
    return count


@kernel
def intersection_volume(
    first: FloatArray, second: FloatArray, axes: FloatArray, center: FloatArray
) -> float:
    """Compute the volume of the intersection of two boxes.

    The boxes have the side lengths ``first`` and ``second``. ``axes`` (columns) and ``center`` of
    the second are in the frame of the first. Vertices of the intersection are ends of clipped
    edges. Between the vertices' x coordinates, the area of the section at x is quadratic, so Gauss'
    rule with two nodes integrates it exactly. Boxes may share faces, edges or corners.
    """
    ends = np.empty((24, 3))
    places = np.empty(48)
    count = clip_edges(second, first, axes, center, ends)
    for i in range(count):
        places[i] = ends[i, 0]
    back = np.empty((3, 3))
    origin = np.zeros(3)
    for i in range(3):
        for j in range(3):
            back[i, j] = axes[j, i]
            origin[i] -= axes[j, i] * center[j]
    more = clip_edges(first, second, back, origin, ends)
    for i in range(more):
        x = center[0]
        for j in range(3):
            x += axes[0, j] * ends[i, j]
        places[count + i] = x
    count += more
    for i in range(1, count):
        x = places[i]
        k = i
        while k > 0 and places[k - 1] > x:
            places[k] = places[k - 1]
            k -= 1
        places[k] = x
    room = np.empty((2, _CORNERS, 2))
    volume = 0.0
    for i in range(count - 1):
        half = 0.5 * (places[i + 1] - places[i])
        if half > 0.0:
            middle = 0.5 * (places[i + 1] + places[i])
            for node in (-_NODE, _NODE):
                x = middle + node * half
                volume += half * _section_area(first, second, axes, center, x, room)
    return volume


@kernel
def _section_area(
    first: FloatArray,
    second: FloatArray,
    axes: FloatArray,
    center: FloatArray,
    x: float,
    room: FloatArray,
) -> float:
    """Compute the area of the section of the intersection at x in the frame of the first box.

    ``room`` (2, `_CORNERS`, 2) is scratch space.
    """
    for corner in range(4):
        right = corner == 1 or corner == 2
        room[0, corner, 0] = 0.5 * first[1] if right else -0.5 * first[1]
        room[0, corner, 1] = 0.5 * first[2] if corner >= 2 else -0.5 * first[2]
    count = 4
    now = 0
    for face in range(6):
        k = face // 2
        sign = 1.0 if face % 2 else -1.0
        a, b = sign * axes[1, k], sign * axes[2, k]
        limit = (
            0.5 * second[k] - sign * axes[0, k] * (x - center[0]) + a * center[1] + b * center[2]
        )
        kept = 0
        for i in range(count):  # Sutherland and Hodgman's clipping
            y, z = room[now, i, 0], room[now, i, 1]
            next_y, next_z = room[now, (i + 1) % count, 0], room[now, (i + 1) % count, 1]
            over, next_over = a * y + b * z - limit, a * next_y + b * next_z - limit
            if over <= 0.0:
                room[1 - now, kept, 0] = y
                room[1 - now, kept, 1] = z
                kept += 1
            if (over < 0.0 and next_over > 0.0) or (over > 0.0 and next_over < 0.0):
                share = over / (over - next_over)
                room[1 - now, kept, 0] = y + share * (next_y - y)
                room[1 - now, kept, 1] = z + share * (next_z - z)
                kept += 1
        count = kept
        now = 1 - now
    area = 0.0
    for i in range(2, count):
        y, z = room[now, 0, 0], room[now, 0, 1]
        area += (room[now, i - 1, 0] - y) * (room[now, i, 1] - z)
        area -= (room[now, i - 1, 1] - z) * (room[now, i, 0] - y)
    return 0.5 * area
