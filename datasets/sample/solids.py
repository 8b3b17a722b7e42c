"""Closed solids of one colour, the parts of the sample models.

Boxes come from trimesh; the rest is a `loft`, a surface through a row of closed outlines, because a
part around the plane x = 0 must be exactly mirror symmetric, also in its tessellation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, IntArray

Color = tuple[int, int, int]
"""Red, green and blue, 0 to 255."""
Point = tuple[float, float, float]

_WELD_DECIMALS = 8
_TINY_AREA = 1e-12


@dataclass(frozen=True, eq=False)
class Solid:
    """A closed surface of one colour."""

    vertices: FloatArray  # (n, 3), all different
    faces: IntArray  # (m, 3), counter-clockwise as seen from outside
    color: Color

    @classmethod
    def from_triangles(cls, vertices: npt.ArrayLike, faces: npt.ArrayLike, color: Color) -> Solid:
        """Weld coinciding vertices, drop triangles without area, turn the surface outward."""
        points = np.round(np.asarray(vertices, dtype=float), _WELD_DECIMALS) + 0.0
        welded, inverse = np.unique(points, axis=0, return_inverse=True)
        triangles = inverse.reshape(-1)[np.asarray(faces, dtype=np.int64)]
        a, b, c = welded[triangles].transpose(1, 0, 2)
        doubled_area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        solid = cls(welded, triangles[doubled_area > _TINY_AREA], color)
        return solid if solid.volume >= 0 else replace(solid, faces=solid.faces[:, ::-1])

    @property
    def volume(self) -> float:
        """The enclosed volume; negative where the faces look inward."""
        corners = self.vertices[self.faces] - self.vertices.mean(axis=0)
        return float(np.linalg.det(corners).sum() / 6)

    def with_vertices(self, vertices: npt.ArrayLike) -> Solid:
        """The solid with its vertices at other places (n, 3)."""
        return Solid.from_triangles(vertices, self.faces, self.color)

    def mirrored(self) -> Solid:
        """The mirror image under x -> -x."""
        return replace(self, vertices=self.vertices * (-1, 1, 1), faces=self.faces[:, ::-1])


def both_sides(*solids: Solid) -> list[Solid]:
    """The solids together with their mirror images under x -> -x."""
    return [*solids, *(solid.mirrored() for solid in solids)]


# Outlines and curves ------------------------------------------------------------------------------


def ellipse(width: float, height: float, *, count: int, exponent: float = 2.0) -> FloatArray:
    """An outline (count, 2): a superellipse ``|x/a|^exponent + |y/b|^exponent = 1`` (Lame curve).

    It starts at the top and is mirror symmetric in its first coordinate.
    """
    angle = 2 * np.pi * np.arange(count) / count
    unit = np.round(np.stack([np.sin(angle), np.cos(angle)], axis=1), 12)
    half = np.array([width, height]) / 2
    return np.asarray(np.sign(unit) * np.abs(unit) ** (2.0 / exponent) * half)


def rounded_rectangle(
    width: float, height: float, *, radius: float = 0.0, steps: int = 2
) -> FloatArray:
    """An outline (n, 2): a rectangle with round corners, starting at the middle of its top."""
    radius = max(min(radius, 0.499 * width, 0.499 * height), 0.0)
    angle = np.linspace(0, np.pi / 2, steps + 1)
    arc = np.stack([np.sin(angle), np.cos(angle)], axis=1)
    upper = np.array([width, height]) / 2 - radius + radius * arc
    top = np.array([[0.0, height / 2]])
    right = np.concatenate([upper, [[width / 2, 0.0]], upper[::-1] * (1, -1)])
    return np.concatenate([top, right, -top, right[::-1] * (-1, 1)])


def smooth_curve(knots: npt.ArrayLike, count: int) -> FloatArray:
    """A Catmull-Rom spline (count, d) through knots (k, d)."""
    points = np.asarray(knots, dtype=float)
    padded = np.concatenate([[2 * points[0] - points[1]], points, [2 * points[-1] - points[-2]]])
    position = np.linspace(0, len(points) - 1, count)
    segment = np.minimum(position.astype(int), len(points) - 2)
    t = (position - segment)[:, None]
    p0, p1, p2, p3 = (padded[segment + k] for k in range(4))
    square, cube = 2 * p0 - 5 * p1 + 4 * p2 - p3, 3 * p1 - p0 - 3 * p2 + p3
    return np.asarray(0.5 * (2 * p1 + (p2 - p0) * t + square * t**2 + cube * t**3))


def at_height(outline: FloatArray, y: float) -> FloatArray:
    """An outline (n, 2) in the horizontal plane at a height, (n, 3)."""
    return np.insert(outline, 1, y, axis=1)


# Solids -------------------------------------------------------------------------------------------


def loft(outlines: npt.ArrayLike, color: Color) -> Solid:
    """Join a row of closed outlines (k, n, 3), n even, by a surface and close its two ends.

    Point ``j`` of one is joined with point ``j`` of the next. An end is closed by strips between
    the points ``j`` and ``n - j`` and a spine in the middle of them, so outlines should be
    symmetric in that order. An outline may shrink to a line or a point.
    """
    rings = np.asarray(outlines, dtype=float)
    # An end is one more outline that has collapsed onto its spine.
    opposite = -np.arange(rings.shape[1])
    spines = (rings[[0, -1]] + rings[[0, -1]][:, opposite]) / 2
    rings = np.concatenate([spines[:1], rings, spines[1:]])
    count, size = rings.shape[:2]
    start = np.arange(count - 1)[:, None] * size
    here = np.arange(size)[None, :]
    sides = np.stack([start + here, start + (here + 1) % size], axis=-1).reshape(-1, 2)
    quads = np.concatenate([sides, sides[:, ::-1] + size], axis=1)
    vertices = rings.reshape(-1, 3)
    return Solid.from_triangles(vertices, _cut_quads(vertices, quads), color)


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


def box(center: npt.ArrayLike, size: npt.ArrayLike, color: Color) -> Solid:
    """A box with sharp edges."""
    import trimesh

    block = trimesh.creation.box(extents=np.asarray(size, dtype=float))
    return Solid.from_triangles(block.vertices + np.asarray(center), block.faces, color)


def rounded_box(
    center: npt.ArrayLike,
    size: npt.ArrayLike,
    color: Color,
    *,
    radius: float,
    corner_radius: float | None = None,
    steps: int = 2,
) -> Solid:
    """An upright box with rounded edges; ``steps`` flat pieces make a quarter circle.

    ``radius`` is that of the horizontal edges, ``corner_radius`` that of the vertical ones.
    """
    width, height, depth = np.asarray(size, dtype=float)
    radius = min(radius, 0.49 * height, 0.45 * width, 0.45 * depth)
    corner = radius if corner_radius is None else corner_radius
    angle = np.linspace(0, np.pi / 2, steps + 1)
    inset = radius * (1 - np.sin(angle))
    level = -height / 2 + radius * (1 - np.cos(angle))
    insets, levels = np.concatenate([inset, inset[::-1]]), np.concatenate([level, -level[::-1]])
    rings = [
        at_height(
            rounded_rectangle(width - 2 * i, depth - 2 * i, radius=corner - i, steps=steps), y
        )
        for i, y in zip(insets, levels, strict=True)
    ]
    return loft(np.array(rings) + np.asarray(center, dtype=float), color)


def stacked(
    levels: Sequence[tuple[float, float, float, float]], color: Color, *, radius: float
) -> Solid:
    """A body through rounded rectangles (y, width, z_front, z_rear), from the lowest up."""
    rings = [
        at_height(rounded_rectangle(width, rear - front, radius=radius, steps=3), y)
        + (0, 0, (front + rear) / 2)
        for y, width, front, rear in levels
    ]
    return loft(rings, color)


def sweep(
    path: npt.ArrayLike | Sequence[npt.ArrayLike],
    section: FloatArray,
    color: Color,
    *,
    scales: npt.ArrayLike = 1.0,
    side: npt.ArrayLike | None = None,
) -> Solid:
    """Move an outline (n, 2) along a path (k, 3), ``scales`` (k,) or (k, 2) times as large.

    The outline's first coordinate is along ``side``, made perpendicular to the path: by default
    along x, or z where the path runs along x.
    """
    points = np.asarray(path, dtype=float)
    tangent = _normalized(np.gradient(points, axis=0))
    if side is None:
        side = (1, 0, 0) if np.abs(tangent[:, 0]).max() < 0.9 else (0, 0, 1)
    along = np.asarray(side, dtype=float)
    first = _normalized(along - (tangent @ along)[:, None] * tangent)
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
    return sweep([start, end], outline, color, scales=[1.0, taper])


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
    return sweep([start, end], outline, color, scales=[1.0, taper], side=side)


def lathe(
    profile: npt.ArrayLike,
    color: Color,
    *,
    center: npt.ArrayLike = (0, 0, 0),
    count: int,
    depth: npt.ArrayLike = 1.0,
    exponent: npt.ArrayLike = 2.0,
) -> Solid:
    """Turn a profile (k, 2) of radius and height around a vertical axis, in ``count`` = 4 i points.

    ``depth``, one or (k,), is the extent along z relative to x; ``exponent`` is 2 for circles, more
    for rounded squares (see `ellipse`).
    """
    points = np.asarray(profile, dtype=float)
    shape = np.broadcast_arrays(points[:, 0], points[:, 1], depth, exponent)
    rings = [
        at_height(ellipse(2 * r, 2 * r * share, count=count, exponent=power), y)
        for r, y, share, power in zip(*shape, strict=True)
    ]
    return loft(np.array(rings) + np.asarray(center, dtype=float), color)


def ellipsoid(center: npt.ArrayLike, size: npt.ArrayLike, color: Color, *, count: int) -> Solid:
    """An ellipsoid of the given full extents (3,)."""
    angle = np.linspace(0, np.pi, count // 2 + 1)
    unit = lathe(np.stack([np.sin(angle), -np.cos(angle)], axis=1), color, count=count)
    return unit.with_vertices(unit.vertices * np.asarray(size, dtype=float) / 2 + center)


def wheel(center: npt.ArrayLike, profile: npt.ArrayLike, color: Color, *, count: int) -> Solid:
    """Turn a profile (radius, distance outward along x) around an axis along x."""
    upright = lathe(profile, color, count=count)
    return upright.with_vertices(upright.vertices[:, [1, 0, 2]] + np.asarray(center, dtype=float))


def sheet(grid: npt.ArrayLike, thickness: float, color: Color) -> Solid:
    """A curved plate: a grid of points (rows, columns, 3), thickened to both sides."""
    points = np.asarray(grid, dtype=float)
    normal = _normalized(np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1)))
    upper, lower = points + normal * thickness / 2, points - normal * thickness / 2
    # Each row becomes an outline around the plate's section: over it and back underneath.
    rings = [points[:, :1], upper, points[:, -1:], lower[:, ::-1]]
    return loft(np.concatenate(rings, axis=1), color)


def _normalized(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
