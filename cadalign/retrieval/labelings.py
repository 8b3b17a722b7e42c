"""Mirrored labels of a model's keypoints, for detections that confuse left and right."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from cadalign.arrays import FloatArray, IntArray

_ALONG = 0.9  # share of a mirrored pair's distance that must lie along one axis


def mirrored_labelings(xyz: FloatArray, reflections: Iterable[tuple[int, int]]) -> list[IntArray]:
    """List the permutations of a model's keypoint labels under its reflections.

    All pairs that mirror each other across a plane x = const swap labels together; so do those
    across y = const and z = const, and any combination of these. Pairs along no axis, and planes
    that give a keypoint two labels, are left out; so is the identity. A permutation names, for
    each row of ``xyz``, the row that takes its label.

    Examples
    --------
    >>> xyz = np.array([[-1.0, 0, 0], [1.0, 0, 0], [0, 1.0, 0]])
    >>> mirrored_labelings(xyz, [(0, 1)])
    [array([1, 0, 2])]
    """
    planes: dict[int, list[tuple[int, int]]] = {}
    for first, second in reflections:
        apart = np.abs(xyz[first] - xyz[second])
        axis = int(np.argmax(apart))
        if apart[axis] > _ALONG * np.linalg.norm(apart):
            planes.setdefault(axis, []).append((first, second))
    found: list[IntArray] = [np.arange(len(xyz))]
    for axis in sorted(planes):
        rows = [row for pair in planes[axis] for row in pair]
        if len(set(rows)) < len(rows):
            continue
        swap = np.arange(len(xyz))
        for first, second in planes[axis]:
            swap[[first, second]] = second, first
        found += [swap[known] for known in found]
    unique = {labeling.tobytes(): labeling for labeling in found}
    return list(unique.values())[1:]
