"""Convex hulls of silhouettes, for a mesh that is only similar to the object.

What lies between legs, or a hole, differs from object to object more than the outermost points do,
which keypoints and the box describe. The silhouette of a convex hull is the convex hull of the
silhouette, so that masks and meshes compare by their hulls as they do by themselves.
"""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import cv2
import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.fitting.contours.loop import ViewContour, contour_view
from cadalign.fitting.contours.surface import PosedSurface, Warped
from cadalign.fitting.joint.view import View
from cadalign.geometry.mesh import Mesh
from cadalign.shapes.warp import linear_warp
from cadalign.solvers.joint.evidence import Shape, State, points_of

_BORDER = 3  # [px], within which a mask may go on outside of the image
_LEAST_AREA = 0.003  # of a piece of the mask, relative to the largest
_QHULL = "QJ Pp"  # joggled, for a flat mesh has a hull, too


class ConvexSurface:
    """The convex hull of a mesh whose keypoints are warped to the object's.

    ``source`` (n, 3) are the mesh's keypoints, ``rows`` (n,) their numbers in the shape.
    """

    is_exact = False

    def __init__(self, mesh: Mesh, source: FloatArray, rows: IntArray) -> None:
        outer = np.unique(_hull_faces(mesh.vertices))
        self._rows = rows
        self._warp = linear_warp(mesh.vertices[outer], mesh.bounds, source)

    def at(self, shape: Shape, state: State) -> PosedSurface:
        """See `Surface`."""
        points = points_of(shape, state) / np.exp(state.log_scales)
        vertices = self._warp.apply(points[self._rows], np.sort(points[-2:], axis=0))
        mesh = Mesh(vertices, _hull_faces(vertices))
        return Warped(mesh, self._warp, self._rows, shape.modes, state.coefficients)


def hull_contour(contour: ViewContour, view: View) -> ViewContour | None:
    """The contour of the convex hull of a view's mask; None where the mask leaves the image."""
    inside = np.asarray(view.mask_image) >= 0.5
    if inside.sum() > inside[_BORDER:-_BORDER, _BORDER:-_BORDER].sum():
        return None
    hull = replace(view, mask=_hull_of(inside))
    return contour_view(contour.image, hull, f"views[{contour.image}].mask")


def _hull_of(inside: BoolArray) -> BoolArray:
    pieces, _ = cv2.findContours(
        inside.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE
    )
    largest = max(cv2.contourArea(piece) for piece in pieces)
    kept = [piece for piece in pieces if cv2.contourArea(piece) >= _LEAST_AREA * largest]
    filled = np.zeros(inside.shape, dtype=np.uint8)
    cv2.fillConvexPoly(filled, cv2.convexHull(np.concatenate(kept)), 1)
    return filled > 0


def _hull_faces(vertices: FloatArray) -> IntArray:
    from scipy.spatial import ConvexHull  # takes longer to import than all that is compiled

    return cast(IntArray, ConvexHull(vertices, qhull_options=_QHULL).simplices.astype(np.int64))
