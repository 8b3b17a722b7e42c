"""Closed solids that the sample models are put together from.

Everything is a `loft`: a surface through a row of closed outlines. Solids face outward, and the
outlines used have their mirror images under x -> -x among their own points, so that what
is built around the plane x = 0 is exactly mirror symmetric.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, IntArray
from cadalign.datasets.sample.outlines import ellipse, rounded_rectangle

Color = tuple[int, int, int]
"""Red, green and blue, 0 to 255."""

_WELD_DECIMALS = 8
_TINY_AREA = 1e-12


@dataclass(frozen=True, eq=False)
class Solid:
    """A part of a model: a closed surface of one colour.

    Parameters
    ----------
    vertices : (n, 3) float
        Positions, each only once.
    faces : (m, 3) int
        Triangles, counter-clockwise as seen from outside.
    color : tuple of 3 int
        Red, green and blue, 0 to 255.
    """

    vertices: FloatArray
    faces: IntArray
    color: Color

    @classmethod
    def from_triangles(cls, vertices: npt.ArrayLike, faces: npt.ArrayLike, color: Color) -> Solid:
        """Weld coinciding vertices, drop triangles without area, turn the surface outward.

        Examples
        --------
        >>> corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
        >>> inward = [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]]
        >>> solid = Solid.from_triangles(corners, inward, (200, 0, 0))
        >>> bool(solid.volume > 0)
        True
        """
        points = np.round(np.asarray(vertices, dtype=float), _WELD_DECIMALS) + 0.0
        welded, inverse = np.unique(points, axis=0, return_inverse=True)
        triangles = inverse.reshape(-1)[np.asarray(faces, dtype=np.int64)]
        corners = welded[triangles]
        doubled_area = np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        )
        solid = cls(welded, triangles[doubled_area > _TINY_AREA], color)
        return solid if solid.volume >= 0 else replace(solid, faces=solid.faces[:, ::-1])

    @property
    def volume(self) -> float:
        """The enclosed volume; negative where the faces look inward."""
        corners = self.vertices[self.faces] - self.vertices.mean(axis=0)
        return float(np.linalg.det(corners).sum() / 6)

    def mirrored(self) -> Solid:
        """The mirror image under x -> -x."""
        return replace(self, vertices=self.vertices * (-1, 1, 1), faces=self.faces[:, ::-1])


def both_sides(*solids: Solid) -> list[Solid]:
    """The solids together with their mirror images under x -> -x."""
    return [*solids, *(solid.mirrored() for solid in solids)]


def loft(outlines: npt.ArrayLike, color: Color) -> Solid:
    """Join a row of closed outlines by a surface and close its two ends.

    Parameters
    ----------
    outlines : (k, n, 3) float
        ``k`` outlines of ``n`` points each, ``n`` even; point ``j`` of one is joined with point
        ``j`` of the next. An end is closed by strips between the points ``j`` and ``n - j`` and a
        spine in the middle of them, so outlines should be symmetric in that order. An outline may
        shrink to a line or a point.
    color : tuple of 3 int
        Red, green and blue, 0 to 255.
    """
    rings = np.asarray(outlines, dtype=float)
    count, size = rings.shape[:2]
    start = np.arange(count - 1)[:, None] * size
    here = np.arange(size)[None, :]
    quads = np.stack([start + here, start + (here + 1) % size], axis=-1).reshape(-1, 2)
    quads = np.concatenate([quads, quads[:, ::-1] + size], axis=1)
    faces = [_cut_quads(rings.reshape(-1, 3), quads)]
    vertices = [rings.reshape(-1, 3)]
    total = count * size
    for ring, offset, flip in ((rings[0], 0, True), (rings[-1], (count - 1) * size, False)):
        spine, cap = _cap(ring, offset, total)
        vertices.append(spine)
        faces.append(cap[:, ::-1] if flip else cap)
        total += len(spine)
    return Solid.from_triangles(np.concatenate(vertices), np.concatenate(faces), color)


def _cut_quads(vertices: FloatArray, quads: IntArray) -> IntArray:
    """Cut quads (m, 4) into triangles along the shorter diagonal, mirror images alike."""
    a, b, c, d = (vertices[quads[:, k]] for k in range(4))
    longer = np.linalg.norm(a - c, axis=1) - np.linalg.norm(b - d, axis=1)
    # Where both diagonals are equally long, the side of x = 0 decides: that is the same for a quad
    # and the mirror image of it.
    equal = np.abs(longer) < 1e-9
    use_bd = np.where(equal, (a + b + c + d)[:, 0] > 0, longer > 0)[:, None]
    first = np.where(use_bd, quads[:, [0, 1, 3]], quads[:, [0, 1, 2]])
    second = np.where(use_bd, quads[:, [1, 2, 3]], quads[:, [0, 2, 3]])
    return np.concatenate([first, second])


def _cap(ring: FloatArray, offset: int, spine_offset: int) -> tuple[FloatArray, IntArray]:
    """Close an outline whose points j and n - j face each other."""
    size = len(ring)
    half = np.arange(size // 2 + 1)
    spine = (ring[half] + ring[-half]) / 2
    here, there = half[:-1], half[1:]
    right, left = offset + half, offset + (-half) % size
    middle = spine_offset + half
    faces = [
        np.stack([right[here], right[there], middle[there]], -1),
        np.stack([right[here], middle[there], middle[here]], -1),
        np.stack([left[there], left[here], middle[there]], -1),
        np.stack([left[here], middle[here], middle[there]], -1),
    ]
    return spine, np.concatenate(faces)


def rounded_box(
    center: npt.ArrayLike,
    size: npt.ArrayLike,
    color: Color,
    *,
    radius: float = 0.0,
    corner_radius: float | None = None,
    steps: int = 2,
) -> Solid:
    """A box with its edges rounded, upright.

    Parameters
    ----------
    center, size : (3,) float
        Centre and full side lengths.
    color : tuple of 3 int
        Red, green and blue, 0 to 255.
    radius : float
        Radius of the horizontal edges.
    corner_radius : float, optional
        Radius of the vertical edges; by default the same.
    steps : int
        Flat pieces of a quarter circle.
    """
    width, height, depth = np.asarray(size, dtype=float)
    radius = min(radius, 0.49 * height, 0.45 * width, 0.45 * depth)
    corner = radius if corner_radius is None else corner_radius
    angle = np.linspace(0, np.pi / 2, steps + 1)
    inset = radius * (1 - np.sin(angle))
    level = -height / 2 + radius * (1 - np.cos(angle))
    rings = [
        np.insert(
            rounded_rectangle(width - 2 * i, depth - 2 * i, radius=corner - i, steps=steps), 1, y, 1
        )
        for i, y in zip(
            np.concatenate([inset, inset[::-1]]), np.concatenate([level, -level[::-1]]), strict=True
        )
    ]
    return loft(np.array(rings) + np.asarray(center, dtype=float), color)


def stacked(
    levels: Sequence[tuple[float, float, float, float]],
    color: Color,
    *,
    radius: float = 0.05,
    steps: int = 3,
) -> Solid:
    """A body between rounded rectangles that lie one above the other.

    Parameters
    ----------
    levels : sequence of (y, width, z_front, z_rear)
        The rectangles, from the lowest to the highest.
    color : tuple of 3 int
        Red, green and blue, 0 to 255.
    radius : float
        Radius of their corners.
    steps : int
        Flat pieces of a quarter circle.
    """
    rings = []
    for y, width, front, rear in levels:
        outline = rounded_rectangle(width, rear - front, radius=radius, steps=steps)
        rings.append(np.insert(outline + np.array([0, (front + rear) / 2]), 1, y, axis=1))
    return loft(np.array(rings), color)


def box(center: npt.ArrayLike, size: npt.ArrayLike, color: Color) -> Solid:
    """A box with sharp edges."""
    half = np.asarray(size, dtype=float) / 2
    square = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)], dtype=float)
    corners = np.concatenate([np.insert(square, 1, level, axis=1) for level in (-1, 1)]) * half
    quads = [(0, 1, 2, 3), (7, 6, 5, 4), (0, 4, 5, 1), (1, 5, 6, 2), (2, 6, 7, 3), (3, 7, 4, 0)]
    faces = [corner for a, b, c, d in quads for corner in ((a, b, c), (a, c, d))]
    return Solid.from_triangles(corners + np.asarray(center, dtype=float), faces, color)


def sweep(
    path: npt.ArrayLike,
    section: FloatArray,
    color: Color,
    *,
    scales: npt.ArrayLike = 1.0,
    side: npt.ArrayLike | None = None,
) -> Solid:
    """Move an outline along a path.

    Parameters
    ----------
    path : (k, 3) float
        Points of the path.
    section : (n, 2) float
        The outline across the path: its first coordinate along ``side``, its second across.
    color : tuple of 3 int
        Red, green and blue, 0 to 255.
    scales : (k,) or (k, 2) float
        How much larger the outline is at each point.
    side : (3,) float, optional
        Direction of the outline's first coordinate, made perpendicular to the path; by default x,
        or z where the path runs along x.
    """
    points = np.asarray(path, dtype=float)
    tangent = np.gradient(points, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    if side is None:
        side = (1, 0, 0) if np.abs(tangent[:, 0]).max() < 0.9 else (0, 0, 1)
    first = (
        np.asarray(side, dtype=float) - (tangent @ np.asarray(side, dtype=float))[:, None] * tangent
    )
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(tangent, first)
    scale = np.asarray(scales, dtype=float)
    scale = np.broadcast_to(scale[:, None] if scale.ndim == 1 else scale, (len(points), 2))
    outline = section[None] * scale[:, None, :]
    rings = points[:, None] + outline[..., :1] * first[:, None] + outline[..., 1:] * second[:, None]
    return loft(rings, color)


def rod(
    start: npt.ArrayLike,
    end: npt.ArrayLike,
    radius: float,
    color: Color,
    *,
    end_radius: float | None = None,
    sides: int = 12,
) -> Solid:
    """A round bar between two points, tapered where ``end_radius`` differs."""
    taper = 1.0 if end_radius is None else end_radius / radius
    outline = ellipse(2 * radius, 2 * radius, count=sides)
    path = np.array([start, end], dtype=float)
    return sweep(path, outline, color, scales=[1.0, taper])


def beam(
    start: npt.ArrayLike,
    end: npt.ArrayLike,
    size: tuple[float, float],
    color: Color,
    *,
    taper: float = 1.0,
    side: npt.ArrayLike | None = None,
    bevel: bool = True,
) -> Solid:
    """A bar of rectangular section between two points; ``size`` is along and across ``side``."""
    outline = rounded_rectangle(*size, radius=0.18 * min(size) * bevel, steps=int(bevel))
    path = np.array([start, end], dtype=float)
    return sweep(path, outline, color, scales=[1.0, taper], side=side)


def lathe(
    profile: npt.ArrayLike,
    color: Color,
    *,
    center: npt.ArrayLike = (0, 0, 0),
    count: int = 32,
    depth: npt.ArrayLike = 1.0,
    exponent: npt.ArrayLike = 2.0,
) -> Solid:
    """Turn a profile around a vertical axis.

    Parameters
    ----------
    profile : (k, 2) float
        Radius and height.
    color : tuple of 3 int
        Red, green and blue, 0 to 255.
    center : (3,) float
        Where the axis's origin is.
    count : int
        Points around the axis, a multiple of 4.
    depth : float or (k,) float
        Extent along z relative to x.
    exponent : float or (k,) float
        2 for circles, more for rounded squares; see `ellipse`.
    """
    points = np.asarray(profile, dtype=float)
    exponents = np.broadcast_to(np.asarray(exponent, dtype=float), len(points))
    depths = np.broadcast_to(np.asarray(depth, dtype=float), len(points))
    rings = [
        np.insert(ellipse(2 * r, 2 * r * share, count=count, exponent=float(power)), 1, y, axis=1)
        for (r, y), share, power in zip(points, depths, exponents, strict=True)
    ]
    return loft(np.array(rings) + np.asarray(center, dtype=float), color)


def ellipsoid(
    center: npt.ArrayLike, size: npt.ArrayLike, color: Color, *, count: int = 16
) -> Solid:
    """An ellipsoid of the given full extents (3,)."""
    angle = np.linspace(0, np.pi, count // 2 + 1)
    unit = lathe(np.stack([np.sin(angle), -np.cos(angle)], axis=1), color, count=count)
    return Solid.from_triangles(
        unit.vertices * np.asarray(size, dtype=float) / 2 + np.asarray(center, dtype=float),
        unit.faces,
        color,
    )


def wheel(center: npt.ArrayLike, profile: npt.ArrayLike, color: Color, *, count: int = 24) -> Solid:
    """Turn a profile (radius, distance outward along x) around an axis along x."""
    upright = lathe(profile, color, count=count)
    turned = upright.vertices[:, [1, 0, 2]]
    return Solid.from_triangles(turned + np.asarray(center, dtype=float), upright.faces, color)


def sheet(grid: npt.ArrayLike, thickness: float, color: Color) -> Solid:
    """A curved plate: a grid of points (rows, columns, 3), thickened to both sides."""
    points = np.asarray(grid, dtype=float)
    along, across = np.gradient(points, axis=0), np.gradient(points, axis=1)
    normal = np.cross(along, across)
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    upper, lower = points + normal * thickness / 2, points - normal * thickness / 2
    # Each row becomes an outline around the plate's section: over it and back underneath.
    rings = [points[:, :1], upper, points[:, -1:], lower[:, ::-1]]
    return loft(np.concatenate(rings, axis=1), color)
