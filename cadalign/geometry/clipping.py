"""Volume of the intersection of two oriented boxes."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import kernel

_PLACES = 96
_CORNERS = 42  # bound on a polygon's corners after 6 cuts: 10 without rounding
_NODE = 1.0 / np.sqrt(3.0)


@kernel
def intersection_volume(
    first: FloatArray, second: FloatArray, axes: FloatArray, center: FloatArray
) -> float:
    """Compute the volume of the intersection of two boxes.

    The boxes have the side lengths ``first`` and ``second``. ``axes`` (columns) and ``center`` of
    the second are in the frame of the first. Vertices of the intersection are corners of the boxes,
    and points where an edge of one box crosses a face of the other. Between the x coordinates of
    all these points, the area of the section at x is quadratic, so Gauss' rule with two nodes
    integrates it exactly. Boxes may share faces, edges or corners.
    """
    places = np.empty(_PLACES)
    count = _cut_places(0.5 * first, 0.5 * second, axes, center, places)
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
        low, high = max(places[i], -0.5 * first[0]), min(places[i + 1], 0.5 * first[0])
        half = 0.5 * (high - low)
        if half > 0.0:
            for node in (-_NODE, _NODE):
                x = 0.5 * (low + high) + node * half
                volume += half * _section_area(first, second, axes, center, x, room)
    return volume


@kernel
def _cut_places(
    first: FloatArray, second: FloatArray, axes: FloatArray, center: FloatArray, places: FloatArray
) -> int:
    """Write the x coordinates between which to integrate; returns their number.

    ``first`` and ``second`` are half the side lengths.
    """
    count = 0
    for along in range(3):
        for corner in range(4):
            one, other = (along + 1) % 3, (along + 2) % 3
            a, b = (1.0 if corner % 2 else -1.0), (1.0 if corner // 2 else -1.0)
            # An edge of the second box, from its middle, with faces of the first.
            middle = center + axes[:, one] * a * second[one] + axes[:, other] * b * second[other]
            step = axes[:, along] * second[along]
            # An edge of the first box along x, with faces of the second.
            offset = axes[1, along] * (a * first[1] - center[1])
            offset += axes[2, along] * (b * first[2] - center[2])
            for sign in (-1.0, 1.0):
                places[count] = middle[0] + sign * step[0]
                count += 1
                for c in range(1, 3):
                    if step[c] != 0.0:
                        way = sign * first[c] - middle[c]
                        places[count] = middle[0] + step[0] * way / step[c]
                        count += 1
                if axes[0, along] != 0.0:
                    places[count] = center[0] + (sign * second[along] - offset) / axes[0, along]
                    count += 1
    return count


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
