"""Warping of meshes by target positions of their keypoints.

The mesh is stretched along the axes; radial basis functions interpolate the keypoints' remaining
displacements. The kernel is r, the thin plate spline in three dimensions (Duchon, "Splines
minimizing rotation-invariant semi-norms in Sobolev spaces", 1977), rounded near 0 to a multiquadric
(Hardy, "Multiquadric equations of topography and other irregular surfaces", 1971). Kernels that
grow faster overshoot and fold the mesh between near keypoints that move apart.
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
from cadalign.shapes.parts import check_box

# Lengths relative to the diagonal of mesh and keypoints.
_ROUNDING = 0.02  # largest radius of the kernel's rounding
_MARGIN = 0.25  # distance of the corners around the mesh, which follow the stretch alone
_COINCIDENT = 1e-6


def warp_mesh(
    mesh: Mesh, source: npt.ArrayLike, target: npt.ArrayLike, *, bounds: npt.ArrayLike
) -> Mesh:
    """Warp a mesh by moving its keypoints to target positions.

    The warp is exact at the keypoints; coincident keypoints move to the mean of their targets. Few
    or coplanar keypoints suffice. Far from all keypoints the warp is a stretch along the axes.

    Parameters
    ----------
    mesh : Mesh
    source : (n, 3) float
        Keypoints of the mesh [model units].
    target : (n, 3) float
        Target positions [model units].
    bounds : (2, 3) float
        Least and greatest corner of the target bounding box, which is filled approximately.

    Returns
    -------
    Mesh
        The warped mesh, with the same faces and colours.

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
    corners = check_box(bounds, "bounds")
    warp = linear_warp(mesh.vertices, mesh.bounds, places)
    return replace(mesh, vertices=warp.apply(targets, corners))


class LinearWarp(NamedTuple):
    """Warp of p points as a linear function of n keypoints' targets and the target box.

    ``keypoint_weights`` (p, n) are the weights of the targets along every axis, ``minimum_weights``
    and ``maximum_weights`` (p, 3) those of the box's corners along each axis. ``constant`` (p, 3)
    is added.
    """

    keypoint_weights: FloatArray
    minimum_weights: FloatArray
    maximum_weights: FloatArray
    constant: FloatArray

    def apply(self, target: FloatArray, bounds: FloatArray) -> FloatArray:
        """Warped points (p, 3) for keypoints' targets (n, 3) and a target box (2, 3)."""
        return self.constant + self.derivative(target, bounds)

    def derivative(self, target: FloatArray, bounds: FloatArray) -> FloatArray:
        """Displacements (p, 3) for displacements of targets (n, 3) and box corners (2, 3)."""
        of_box = self.minimum_weights * bounds[0] + self.maximum_weights * bounds[1]
        return np.asarray(self.keypoint_weights @ target + of_box)


def linear_warp(points: FloatArray, box: FloatArray, source: FloatArray) -> LinearWarp:
    """Make the warp of points (p, 3) of a mesh with bounds ``box`` (2, 3) and keypoints (n, 3)."""
    diagonal = float(np.linalg.norm(np.ptp(np.vstack([box, source]), axis=0))) or 1.0
    # Coincident keypoints are merged and take the mean of their targets.
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
    """Interpolation weights (p, n) of the keypoints' displacements at points (p, 3)."""
    from scipy.interpolate import RBFInterpolator
    from scipy.spatial.distance import pdist

    # The kernel is rounded less if keypoints are near each other.
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
