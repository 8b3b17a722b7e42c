"""Silhouettes of a mesh along directions all around, whole and cut off, free of affine maps.

Whitened by its second moments, a silhouette is known up to a turn or a reflection of the plane
whatever the affine map that it went through. What an occluder or the image's border leaves of it is
another silhouette, with moments of its own: so each one is kept whole and cut by straight lines.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.estimation.contours.contour import Image, sampled
from cadalign.estimation.contours.surface import caster_of, corners_of
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.raycaster import RayCaster

_DIRECTIONS = 400  # over half of the sphere, 7 degrees apart
_CELLS = 80  # of a silhouette's image
_TURNS = 64
_RINGS = 24
_OUTERMOST = 3.0  # [standard deviations], of the rings
_LEAST_CELLS = 4
_CELL_VARIANCE = 1e-3  # that every silhouette has at least
_CUT_EVERY = 2  # directions, of which the silhouettes are cut
_CUT_SHARES = (0.15, 0.3)  # of the area that lies beyond a line
_CUT_ANGLES = 12
_OUTLINE_CELLS = 40
_OUTLINE_EVERY = 2  # directions, and rings and turns


class Whitened(NamedTuple):
    """Silhouettes by their first and second moments, N of them.

    ``mean`` (N, 2) and ``spread`` (N, 2, 2), the square root of the covariance, and ``rings``
    (N, `_RINGS`, `_TURNS`): the share in 255ths that is covered at these radii and angles, after
    both are removed.
    """

    mean: FloatArray
    spread: FloatArray
    rings: npt.NDArray[np.uint8]


class Atlas(NamedTuple):
    """A model's silhouettes; of each one the ``base`` (N, 2, 3), the axes of its image."""

    caster: RayCaster
    corners: FloatArray
    bases: FloatArray
    views: Whitened


def whitened(image: Image, corner: FloatArray, cell: float) -> Whitened:
    """One silhouette (h, w), whose cell (0, 0) lies at ``corner``."""
    return _sampled(image, *_uncut(_cells(image)), corner, cell)


def overlaps(views: Whitened, query: Whitened) -> FloatArray:
    """Intersections over unions (2, N, turns) of silhouettes and one that is turned.

    The query's mirror image comes second.
    """
    rings = query.rings[0].astype(np.float32) / 255
    count, turns = rings.shape
    weights = np.repeat(_radii(count), turns)
    around = (np.arange(turns)[:, None] + np.arange(turns)) % turns
    mirrored = np.roll(rings[:, ::-1], 1, axis=1)
    turned = [each[:, around].transpose(0, 2, 1).reshape(-1, turns) for each in (rings, mirrored)]
    weighted = np.hstack(turned) * weights[:, None].astype(np.float32)
    flat = views.rings.reshape(len(views.rings), -1).astype(np.float32) / 255
    common = (flat @ weighted).reshape(len(flat), 2, turns).transpose(1, 0, 2)
    areas = flat @ weights.astype(np.float32)
    return np.asarray(common / (areas[:, None] + weighted[:, 0].sum() - common), dtype=np.float64)


def turn_of(number: int, *, mirrored: bool) -> FloatArray:
    """The turn (2, 2) of one of the overlaps, from the silhouette's plane to the query's."""
    angle = 2 * np.pi * number / _TURNS
    cosine, sine = np.cos(angle), np.sin(angle)
    turn = np.array([[cosine, -sine], [sine, cosine]])
    return np.diag([1.0, -1.0]) @ turn if mirrored else turn


def _radii(count: int) -> FloatArray:
    return np.asarray(_OUTERMOST * (np.arange(count) + 0.5) / count)


@lru_cache(maxsize=16)
def atlas_of(mesh: Mesh) -> Atlas:
    """The whole silhouettes of a mesh, rendered once."""
    return _atlas(mesh, 1, _uncut)


@lru_cache(maxsize=16)
def cut_atlas_of(mesh: Mesh) -> Atlas:
    """Parts of a mesh's silhouettes that straight lines leave, rendered once."""
    return _atlas(mesh, _CUT_EVERY, _cuts)


def outline_of(mesh: Mesh) -> Whitened:
    """Coarse silhouettes of a mesh, to be compared with many others' by `coarse` ones."""
    return coarse(_atlas(mesh, _OUTLINE_EVERY, _uncut, cells=_OUTLINE_CELLS).views)


def coarse(views: Whitened) -> Whitened:
    """Silhouettes with fewer rings and turns: means of neighbours."""
    count, rings, turns = len(views.rings), _RINGS // _OUTLINE_EVERY, _TURNS // _OUTLINE_EVERY
    parts = views.rings.reshape(count, rings, _OUTLINE_EVERY, turns, _OUTLINE_EVERY)
    return views._replace(rings=np.rint(parts.mean(axis=(2, 4))).astype(np.uint8))


def _atlas(
    mesh: Mesh,
    every: int,
    parts_of: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
    *,
    cells: int = _CELLS,
) -> Atlas:
    """Silhouettes along directions, and the parts of each by their moments and lines."""
    caster, corners = caster_of(mesh), corners_of(mesh)
    middle = corners.mean(axis=0)
    reach = float(np.linalg.norm(corners - middle, axis=1).max())
    bases, views = [], []
    for direction in _half_sphere(_DIRECTIONS)[::every]:
        base = np.linalg.svd(direction[None])[2][1:]
        across = (corners - middle) @ base.T
        low, high = across.min(axis=0), across.max(axis=0)
        cell = float((high - low).max()) / cells or 1.0
        places = low[:, None] + cell * np.arange(cells + 1)
        grid = np.stack(np.meshgrid(places[0], places[1]), axis=-1).reshape(-1, 2)
        # Rays from afar: their origin is one point, so that they are almost parallel.
        eye = middle - 60 * reach * direction
        rays = (grid / (60 * reach)) @ base + direction
        image = caster.covered(eye, rays).reshape(cells + 1, cells + 1).astype(np.float32)
        points = _cells(image)
        if len(points) < _LEAST_CELLS:
            continue
        moments, lines = parts_of(points)
        views.append(_sampled(image, moments, lines, low + base @ middle, cell))
        bases.append(np.broadcast_to(base, (len(moments), 2, 3)))
    rows = [np.concatenate(column) for column in zip(*views, strict=True)]
    return Atlas(caster, corners, np.concatenate(bases), Whitened(*rows))


def _half_sphere(count: int) -> FloatArray:
    """Directions (count, 3) spread evenly: a Fibonacci lattice."""
    k = np.arange(count) + 0.5
    z = 1 - k / count
    angle = np.pi * (1 + 5**0.5) * k
    radius = np.sqrt(1 - z**2)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])


def _cells(image: Image) -> FloatArray:
    rows, columns = np.nonzero(image > 0.5)
    return np.column_stack([columns, rows]).astype(float)


def _terms(points: FloatArray) -> FloatArray:
    """1, x, y, x², xy, y² of points (n, 2), as (6, n)."""
    x, y = points.T
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y])


def _uncut(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    return _terms(points).sum(axis=1)[None], np.array([[0.0, 0.0, np.inf]])


def _cuts(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Moments (N, 6) of what lines leave, and the lines (N, 3): kept is ``n x <= c``.

    Their directions are spread evenly after whitening.
    """
    angles = 2 * np.pi * np.arange(_CUT_ANGLES) / _CUT_ANGLES
    root = np.linalg.cholesky(np.cov(points.T) + _CELL_VARIANCE * np.eye(2))
    normals = np.column_stack([np.cos(angles), np.sin(angles)]) @ np.linalg.inv(root)
    terms = _terms(points)
    last = [max(int((1 - share) * len(points)) - 1, 2) for share in _CUT_SHARES]
    moments: list[FloatArray] = []
    lines: list[list[float]] = []
    for normal in normals:
        along = points @ normal
        order = np.argsort(along)
        moments.append(np.cumsum(terms[:, order], axis=1)[:, last].T)
        lines.extend([*normal, along[order[k]]] for k in last)
    return np.concatenate(moments), np.array(lines)


def _sampled(
    image: Image, moments: FloatArray, lines: FloatArray, corner: FloatArray, cell: float
) -> Whitened:
    """Moments (N, 6) of the parts of an image that lines (N, 3) leave."""
    count = moments[:, 0]
    mean = moments[:, 1:3] / count[:, None]
    xx, xy, yy = (moments[:, 3:] / count[:, None]).T
    square = np.stack([xx, xy, xy, yy], axis=1).reshape(-1, 2, 2)
    square -= mean[:, :, None] * mean[:, None, :]
    variances, axes = np.linalg.eigh(square + _CELL_VARIANCE * np.eye(2))
    spread = (axes * np.sqrt(np.maximum(variances, _CELL_VARIANCE))[:, None]) @ axes.mT
    angles = 2 * np.pi * np.arange(_TURNS) / _TURNS
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    rays = (_radii(_RINGS)[:, None, None] * circle).reshape(-1, 2)
    places = mean[:, None] + rays @ spread
    padded = np.asarray(np.pad(image, 1), dtype=np.float32)
    covered = sampled(padded, places.reshape(-1, 2) + 1).reshape(len(mean), -1)
    kept = (places @ lines[:, :2, None])[..., 0] <= lines[:, 2:]
    rings = np.rint(255 * covered * kept).astype(np.uint8).reshape(-1, _RINGS, _TURNS)
    return Whitened(corner + cell * mean, cell * spread, rings)
