"""Parts of sample models: closed surfaces of one colour.

All but sharp boxes are lofts, surfaces through a row of closed outlines, because a part around the
plane x = 0 must be exactly mirror symmetric, also in its tessellation.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh

from cadalign.arrays import BoolArray, FloatArray
from cadalign.geometry.mesh import Mesh

Color = npt.ArrayLike
"""Red, green and blue, 0 to 255."""
Place = Sequence[float] | FloatArray


def read_designs(*categories: str) -> list[SimpleNamespace]:
    """The measures and colours of categories, from designs.toml."""
    designs = tomllib.loads(Path(__file__).with_name("designs.toml").read_text(encoding="utf-8"))
    return [SimpleNamespace(**designs[category]) for category in categories]


def chosen(kinds: dict[str, list[Any]], index: int) -> SimpleNamespace:
    """The measures of one kind out of lists over all, which take turns."""
    return SimpleNamespace(**{name: each[index % len(each)] for name, each in kinds.items()})


def part(vertices: npt.ArrayLike, faces: npt.ArrayLike, color: Color) -> Mesh:
    """Weld coinciding vertices, drop triangles without area, turn the surface outward."""
    points = np.round(np.asarray(vertices, dtype=float), 8) + 0.0
    welded, inverse = np.unique(points, axis=0, return_inverse=True)
    triangles = inverse.reshape(-1)[np.asarray(faces, dtype=np.int64)]
    corners = welded[triangles]
    if np.linalg.det(corners - welded.mean(axis=0)).sum() < 0:  # six times the volume
        triangles = triangles[:, ::-1]
    colors = np.tile(np.append(color, 255), (len(welded), 1)) / 255
    return Mesh(welded, triangles[has_area(corners)], vertex_colors=colors)


def has_area(triangles: FloatArray) -> BoolArray:
    a, b, c = triangles.swapaxes(0, 1)
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-12)


def loft(outlines: npt.ArrayLike, color: Color) -> Mesh:
    """Join a row of closed outlines (k, n, 3), n even, by a surface and close its two ends.

    Point ``j`` of one is joined with point ``j`` of the next. An end is closed by strips between
    the points ``j`` and ``n - j`` and a spine in the middle of them, so outlines should be
    symmetric in that order. An outline may shrink to a line or a point.
    """
    rings = np.asarray(outlines, dtype=float)
    # An end is one more outline that has collapsed onto its spine.
    spines = (rings[[0, -1]] + rings[[0, -1]][:, -np.arange(rings.shape[1])]) / 2
    rings = np.concatenate([spines[:1], rings, spines[1:]])
    index = np.arange(rings.shape[0] * rings.shape[1]).reshape(rings.shape[:2])
    after = np.roll(index, -1, axis=1)
    a, b, c, d = (each.reshape(-1) for each in (index[:-1], after[:-1], after[1:], index[1:]))
    vertices = rings.reshape(-1, 3)
    # Quads are cut along the other diagonal on the other side of x = 0.
    right = (vertices[a] + vertices[b] + vertices[c] + vertices[d])[:, 0] > 0
    first = np.stack([a, b, np.where(right, d, c)], axis=1)
    second = np.stack([np.where(right, b, a), c, d], axis=1)
    return part(vertices, np.concatenate([first, second]), color)


def rectangle(width: float, height: float, *, radius: float, steps: int) -> FloatArray:
    """An outline (n, 2) with round corners of ``steps`` pieces, from the middle of its top."""
    radius = max(min(radius, 0.499 * width, 0.499 * height), 0.0)
    angle = np.linspace(0, np.pi / 2, steps + 1)
    arc = np.stack([np.sin(angle), np.cos(angle)], axis=1)
    upper = np.array([width, height]) / 2 - radius + radius * arc
    right = np.concatenate([upper, [[width / 2, 0.0]], upper[::-1] * (1, -1)])
    top, bottom = [[0.0, height / 2]], [[0.0, -height / 2]]
    return np.concatenate([top, right, bottom, right[::-1] * (-1, 1)])


def stack(levels: Iterable[Sequence[Any]], color: Color, *, radius: float) -> Mesh:
    """A body through rectangles: a height, or those of front and rear, a width, z of both ends."""
    rings = []
    for height, width, front, rear in levels:
        x, z = rectangle(width, rear - front, radius=radius, steps=3).T
        z += (front + rear) / 2
        y = np.interp(z, (front, rear), np.broadcast_to(height, 2))
        rings.append(np.stack([x, y, z], axis=1))
    return loft(rings, color)


def box(center: Place, size: Place, color: Color, *, radius: float = 0.0) -> Mesh:
    """A box, its edges rounded by a radius."""
    width, height, depth = size
    radius = min(radius, 0.49 * height, 0.45 * width, 0.45 * depth)
    angle = np.linspace(0, np.pi / 2, 4 if radius else 1)
    inset, rise = radius - radius * np.stack([np.sin(angle), np.cos(angle)])
    levels = np.concatenate([rise - height / 2, height / 2 - rise[::-1]])
    scales = 1 - 2 * np.concatenate([inset, inset[::-1]])[:, None] / (width, depth)
    path = center + np.outer(levels, (0, 1, 0))
    return beam(path, (width, depth), color, scales=scales, radius=radius)


def beam(
    path: npt.ArrayLike,
    size: tuple[float, float],
    color: Color,
    *,
    scales: npt.ArrayLike = (1.0,),
    radius: float | None = None,
) -> Mesh:
    """Extrude a rectangle along a path (k, 3), ``scales`` (k,) or (k, 2) times as large.

    Its first side is along x, or along z where the path runs along x.
    """
    points = np.asarray(path, dtype=float)
    tangent = trimesh.unitize(np.gradient(points, axis=0))
    along = np.eye(3)[0 if np.abs(tangent[:, 0]).max() < 0.9 else 2]
    first = trimesh.unitize(along - (tangent @ along)[:, None] * tangent)
    steps, radius = (1, 0.18 * min(size)) if radius is None else (3, radius)
    section = rectangle(*size, radius=radius, steps=steps)
    x, y = np.split(section * np.reshape(scales, (np.shape(scales)[0], 1, -1)), 2, axis=2)
    rings = points[:, None] + (x * first[:, None] + y * np.cross(tangent, first)[:, None])
    return loft(rings, color)


def lathe(
    profile: npt.ArrayLike,
    color: Color,
    *,
    center: Place = (0.0, 0.0, 0.0),
    count: int = 24,
    sideways: bool = False,
) -> Mesh:
    """Turn a profile (k, 2) of radius and height around a vertical axis, in ``count`` = 4 i points.

    The axis of a ``sideways`` part is along x, its heights are distances outward.
    """
    radius, height = np.asarray(profile, dtype=float).T[..., None]
    angle = 2 * np.pi * np.arange(count) / count
    across, along = radius * np.round([np.sin(angle), np.cos(angle)], 12)[:, None]
    axis = np.broadcast_to(height, across.shape)
    rings = np.stack([axis, across, along] if sideways else [across, axis, along], axis=2)
    return loft(rings + center, color)


@dataclass
class Draft:
    """A model that is being built, in its builder's units, y up and the front at -z."""

    parts: list[Mesh] = field(default_factory=list)
    # By semantic id: keypoints land on the surface's nearest point.
    places: dict[int, Place] = field(default_factory=dict)
    # Semantic ids that a mirror plane exchanges, and that a rotation about y permutes.
    mirrored: list[tuple[int, int]] = field(default_factory=list)
    turned: list[tuple[int, ...]] = field(default_factory=list)
    # Any rotation about y is one: each group that is turned lies on a circle.
    round: bool = False

    def add(self, *parts: Mesh) -> None:
        self.parts += parts

    def add_pair(self, *parts: Mesh) -> None:
        """Add parts and their mirror images under x -> -x."""
        for right in parts:
            vertices, faces = right.vertices * (-1, 1, 1), right.faces[:, ::-1]
            self.parts += [right, replace(right, vertices=vertices, faces=faces)]

    def mark_pair(self, right: int, left: int, place: Place) -> None:
        """Set the places of two semantic ids: the given one and its mirror image."""
        x, y, z = place
        self.places |= {right: (x, y, z), left: (-x, y, z)}
        self.mirrored.append((right, left))
