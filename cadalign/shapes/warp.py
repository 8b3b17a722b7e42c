"""Warping of meshes, such that their keypoints come to given places.

A stretch along the axes carries the mesh as a whole; what it leaves is interpolated by radial basis
functions: the thin plate spline of three dimensions, whose kernel is r (Duchon, "Splines minimizing
rotation-invariant semi-norms in Sobolev spaces", 1977), its tip rounded to a multiquadric (Hardy,
"Multiquadric equations of topography and other irregular surfaces", 1971). Kernels of faster growth
overshoot and fold the mesh where near keypoints move apart.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, as_floats, as_points
from cadalign.errors import InputError
from cadalign.geometry.alignment import bounds_corners
from cadalign.geometry.mesh import Mesh
from cadalign.shapes.parts import checked_box

# Lengths relative to the diagonal of mesh and keypoints.
_ROUNDING = 0.02  # of the kernel's tip, at most
_MARGIN = 0.25  # from the mesh to the corners around it, which follow the stretch alone
_COINCIDENT = 1e-6


def warp_mesh(
    mesh: Mesh, source: npt.ArrayLike, target: npt.ArrayLike, *, bounds: npt.ArrayLike
) -> Mesh:
    """Warp a mesh such that its keypoints come to given places.

    Keypoints may be coplanar, or few. For coincident ones the mean of the targets counts; otherwise
    the warp is exact at the keypoints. Far from all keypoints it is a stretch along the axes.

    Parameters
    ----------
    mesh : Mesh
    source : (n, 3) float
        Keypoints of the mesh [model units].
    target : (n, 3) float
        The places that they come to [model units].
    bounds : (2, 3) float
        Least and greatest corner of the box that the mesh shall about fill.

    Returns
    -------
    Mesh
        With the same faces and colours.

    Raises
    ------
    InputError
        If there are no keypoints, shapes don't match, or a value is NaN or infinite.

    Examples
    --------
    >>> corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    >>> square = Mesh(corners, [[0, 1, 2], [0, 2, 3]])
    >>> taller = warp_mesh(square, corners, corners * [1, 2, 1], bounds=[[0, 0, 0], [1, 2, 0]])
    >>> bool(np.allclose(taller.vertices, corners * [1, 2, 1]))
    True
    """
    places = as_points(source, name="source", dimension=3)
    targets = as_floats(target, name="target", shape=(len(places), 3))
    if not len(places):
        raise InputError("no keypoints", where="source")
    corners = checked_box(bounds, "bounds")
    warp = linear_warp(mesh.vertices, mesh.bounds, places)
    return replace(mesh, vertices=warp.apply(targets, corners))


class LinearWarp(NamedTuple):
    """A warp of p points as a linear map of n keypoints' places and the box to fill.

    ``by_keypoints`` (p, n) holds for every axis alike, ``by_least`` and ``by_greatest`` (p, 3) are
    the weights of the box's corners along each axis, ``constant`` (p, 3) holds for all places.
    """

    by_keypoints: FloatArray
    by_least: FloatArray
    by_greatest: FloatArray
    constant: FloatArray

    def apply(self, target: FloatArray, bounds: FloatArray) -> FloatArray:
        """The points (p, 3) where the keypoints come to ``target`` (n, 3), the box to a box."""
        return self.constant + self.derivative(target, bounds)

    def derivative(self, target: FloatArray, bounds: FloatArray) -> FloatArray:
        """Displacements (p, 3) by those of the keypoints (n, 3) and of the box's corners (2, 3)."""
        of_box = self.by_least * bounds[0] + self.by_greatest * bounds[1]
        return np.asarray(self.by_keypoints @ target + of_box)


def linear_warp(points: FloatArray, box: FloatArray, source: FloatArray) -> LinearWarp:
    """The warp of points (p, 3) of a mesh, with its ``box`` (2, 3) and keypoints (n, 3)."""
    diagonal = float(np.linalg.norm(np.ptp(np.vstack([box, source]), axis=0))) or 1.0
    # Of coincident keypoints there is one place, which takes the mean of their targets.
    gaps = np.linalg.norm(source[:, None] - source, axis=2)
    first = (gaps <= _COINCIDENT * diagonal).argmax(axis=1)
    same = np.unique(first)[:, None] == first
    merging = np.asarray(same / same.sum(axis=1, keepdims=True))
    places = merging @ source
    weights = _weights(points, box, places, diagonal)
    extents = box[1] - box[0]
    flat = extents <= _COINCIDENT * extents.max()
    safe = np.where(flat, np.inf, extents)

    middle = box.mean(axis=0)
    share, share_there = (points - middle) / safe, (places - middle) / safe
    return LinearWarp(
        weights @ merging,
        0.5 - share - weights @ (0.5 - share_there),
        0.5 + share - weights @ (0.5 + share_there),
        flat * (points - middle - weights @ (places - middle)),
    )


def _weights(
    points: FloatArray, box: FloatArray, places: FloatArray, diagonal: float
) -> FloatArray:
    """Shares (p, n) of the keypoints' displacements in those of points."""
    from scipy.interpolate import RBFInterpolator
    from scipy.spatial.distance import pdist

    # The kernel's tip is rounded less where keypoints are near each other.
    rounding = min(_ROUNDING * diagonal, float(pdist(places).min(initial=diagonal)))
    everything = np.vstack([box, places])
    margin = _MARGIN * diagonal
    around = bounds_corners(everything.min(axis=0) - margin, everything.max(axis=0) + margin)
    shares = RBFInterpolator(
        np.vstack([places, around]),
        np.eye(len(places) + len(around), len(places)),
        kernel="multiquadric",
        epsilon=1 / rounding,
        degree=0,
    )
    return np.asarray(shares(points))
