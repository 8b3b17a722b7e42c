"""Warping of meshes, such that their keypoints come to given places.

A stretch along the axes carries the mesh as a whole; what it leaves is interpolated by radial basis
functions: the thin plate spline of three dimensions, whose kernel is r (Duchon, "Splines minimizing
rotation-invariant semi-norms in Sobolev spaces", 1977), its tip rounded to a multiquadric (Hardy,
"Multiquadric equations of topography and other irregular surfaces", 1971). Kernels of faster growth
overshoot and fold the mesh where near keypoints move apart.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.interpolate import RBFInterpolator
from scipy.spatial.distance import pdist

from cadalign.arrays import FloatArray, as_floats, as_points
from cadalign.errors import InputError
from cadalign.geometry.mesh import Mesh

# Lengths relative to the diagonal of mesh and keypoints.
_ROUNDING = 0.02  # of the kernel's tip, at most
_MARGIN = 0.25  # from the mesh to the corners around it, which follow the stretch alone
_COINCIDENT = 1e-6
_PRIOR_SPREAD = 0.1  # keypoints that spread less along an axis barely tell its stretch
_LEAST_STRETCH = 0.1  # relative to that of all axes together


def warp_mesh(
    mesh: Mesh,
    source: npt.ArrayLike,
    target: npt.ArrayLike,
    *,
    bounds: npt.ArrayLike | None = None,
) -> Mesh:
    """Warp a mesh such that its keypoints come to given places.

    Keypoints may be coplanar, or few. Of coincident ones the mean of the targets counts; otherwise
    the warp is exact at the keypoints. Far from all keypoints it is a stretch along the axes.

    Parameters
    ----------
    mesh : Mesh
    source : (n, 3) float
        Keypoints of the mesh [model units].
    target : (n, 3) float
        The places that they come to [model units].
    bounds : (2, 3) float, optional
        Least and greatest corner of the box that the mesh shall about fill; by default the stretch
        is the one that fits the keypoints best.

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
    >>> taller = warp_mesh(square, corners, corners * [1, 2, 1])
    >>> bool(np.allclose(taller.vertices, corners * [1, 2, 1]))
    True
    """
    places = as_points(source, name="source", dimension=3)
    targets = as_floats(target, name="target", shape=(len(places), 3))
    if not len(places):
        raise InputError("no keypoints", where="source")
    box = mesh.bounds
    everything = np.vstack([box, places])
    diagonal = float(np.linalg.norm(np.ptp(everything, axis=0))) or 1.0
    places, targets = _merged(places, targets, _COINCIDENT * diagonal)
    if bounds is None:
        stretch = _stretch_of_keypoints(places, targets)
    else:
        stretch = _stretch_of_boxes(box, as_floats(bounds, name="bounds", shape=(2, 3)))
    corners = _corners(everything.min(axis=0), everything.max(axis=0), _MARGIN * diagonal)
    leaves = RBFInterpolator(
        np.vstack([places, corners]),
        np.vstack([targets - stretch(places), np.zeros_like(corners)]),
        kernel="multiquadric",
        epsilon=1 / _rounding(places, diagonal),
        degree=0,
    )
    return replace(mesh, vertices=stretch(mesh.vertices) + leaves(mesh.vertices))


def _rounding(places: FloatArray, diagonal: float) -> float:
    """Radius within which the kernel's tip is rounded: less where keypoints are near each other."""
    least = float(pdist(places).min()) if len(places) > 1 else diagonal
    return min(_ROUNDING * diagonal, least)


def _merged(
    places: FloatArray, targets: FloatArray, tolerance: float
) -> tuple[FloatArray, FloatArray]:
    """Replace coincident keypoints by one, which comes to the mean of their targets."""
    gaps = np.linalg.norm(places[:, None] - places, axis=2)
    first = (gaps <= tolerance).argmax(axis=1)
    kept = np.unique(first)
    means = np.array([targets[first == row].mean(axis=0) for row in kept])
    return places[kept], means


def _stretch_of_keypoints(
    places: FloatArray, targets: FloatArray
) -> Callable[[FloatArray], FloatArray]:
    """The shift and the stretch along each axis that fit best, drawn to an equal stretch of all."""
    centre, to = places.mean(axis=0), targets.mean(axis=0)
    offsets, moved = places - centre, targets - to
    total = float((offsets**2).sum())
    if not total:
        return lambda points: points - centre + to
    equal = float(np.sqrt((moved**2).sum() / total)) or 1.0
    weight = _PRIOR_SPREAD**2 * total
    stretch = ((offsets * moved).sum(axis=0) + weight * equal) / ((offsets**2).sum(axis=0) + weight)
    stretch = np.maximum(stretch, _LEAST_STRETCH * equal)
    return lambda points: (points - centre) * stretch + to


def _stretch_of_boxes(box: FloatArray, bounds: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """The shift and stretch that take one box to another; a flat axis is only shifted."""
    extents, wanted = box[1] - box[0], bounds[1] - bounds[0]
    if (wanted < 0).any():
        what = f"the least corner {bounds[0].tolist()} exceeds {bounds[1].tolist()}"
        raise InputError(what, where="bounds")
    flat = extents <= _COINCIDENT * extents.max()
    stretch = np.where(flat, 1.0, wanted / np.where(flat, 1.0, extents))
    return lambda points: (points - box.mean(axis=0)) * stretch + bounds.mean(axis=0)


def _corners(low: FloatArray, high: FloatArray, margin: float) -> FloatArray:
    ends = np.array([low - margin, high + margin])
    return np.array([[ends[corner >> axis & 1, axis] for axis in range(3)] for corner in range(8)])
