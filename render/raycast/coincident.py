"""Faces that lie in the same place: which of them is seen."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.geometry.edges import number_rows


def coincident_faces(vertices: FloatArray, faces: IntArray) -> tuple[IntArray, IntArray]:
    """Find, for each triangle, the first with the same corners wound alike, and the other way.

    Modellers such as SketchUp write every face twice, wound both ways, with the materials of its
    front and of its back. The one to show is wound towards the viewer. Both results are (m,) int;
    where no triangle is wound the other way, the two are the same.
    """
    corners = number_rows(vertices)[faces]
    place = number_rows(np.sort(corners, axis=1))
    a, b, c = corners.T
    # Sorting takes an even or odd number of swaps: that is the winding.
    winding = (((a > b) ^ (b > c)) ^ (a > c)).astype(np.int64)
    none = len(faces)
    first = np.full((place.max() + 1, 2), none)
    np.minimum.at(first, (place, winding), np.arange(none))
    alike = first[place, winding]
    opposite = first[place, 1 - winding]
    return alike, np.where(opposite < none, opposite, alike)
