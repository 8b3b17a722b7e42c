"""Compiled test which rotations map a model's keypoints onto themselves."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.compile import kernel

_STILL = 1e-12  # square of a way that is none


@kernel
def rotations_onto_themselves(
    centered: FloatArray,
    equivalent: BoolArray,
    rotations: FloatArray,
    most_square: float,
    most_of_way: float,
) -> BoolArray:
    """Mask (g,) of the rotations (g, 3, 3) that map the points (k, 3) onto one another.

    A rotation takes each point to the nearest that is ``equivalent`` (k, k) to it: to within
    ``most_square``, a square, and, as on a thin model a wrong angle is within that, to within the
    share ``most_of_way`` of the square of the way between the two points. No two points go to the
    same, and not all stay where they are.
    """
    count = centered.shape[0]
    squares = np.empty(count)
    for i in range(count):
        x, y, z = centered[i, 0], centered[i, 1], centered[i, 2]
        squares[i] = x * x + y * y + z * z
    found = np.zeros(rotations.shape[0], dtype=np.bool_)
    taken = np.empty(count, dtype=np.int64)  # by which rotation a point was last reached
    taken[:] = -1
    for g in range(rotations.shape[0]):
        fits, moves = True, False
        for i in range(count):
            a, b, c = centered[i, 0], centered[i, 1], centered[i, 2]
            x = rotations[g, 0, 0] * a + rotations[g, 0, 1] * b + rotations[g, 0, 2] * c
            y = rotations[g, 1, 0] * a + rotations[g, 1, 1] * b + rotations[g, 1, 2] * c
            z = rotations[g, 2, 0] * a + rotations[g, 2, 1] * b + rotations[g, 2, 2] * c
            nearest, least = i, np.inf
            for j in range(count):
                if equivalent[i, j]:
                    product = x * centered[j, 0] + y * centered[j, 1] + z * centered[j, 2]
                    gap = squares[i] + squares[j] - 2 * product  # rotations keep lengths
                    if gap < least:
                        nearest, least = j, gap
            product = a * centered[nearest, 0] + b * centered[nearest, 1] + c * centered[nearest, 2]
            way = squares[i] + squares[nearest] - 2 * product
            near = least <= most_square and (least <= most_of_way * way or way < _STILL)
            if not near or taken[nearest] == g:
                fits = False
                break
            taken[nearest] = g
            moves = moves or nearest != i
        found[g] = fits and moves
    return found
