"""Parts of sample models: closed surfaces of one colour.

All parts are lofts: surfaces through a sequence of closed outlines. They make a part across the
plane x = 0 exactly mirror symmetric, also in its tessellation.
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
    """Read measures and colours of categories from designs.toml."""
    designs = tomllib.loads(Path(__file__).with_name("designs.toml").read_text(encoding="utf-8"))
    return [SimpleNamespace(**designs[category]) for category in categories]


def select_kind(kinds: dict[str, list[Any]], index: int) -> SimpleNamespace:
    """Select the measures of one kind from lists of all kinds; the index cycles through them."""
    return SimpleNamespace(**{name: each[index % len(each)] for name, each in kinds.items()})


def part(vertices: npt.ArrayLike, faces: npt.ArrayLike, color: Color) -> Mesh:
    """Build a mesh: merge equal vertices, drop triangles without area, orient it outward."""
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
    """Build a closed surface through a sequence of closed outlines (k, n, 3), n even.

    Point ``j`` of an outline is connected with point ``j`` of the next. Each end is closed by
    strips from the outline to a spine, the midpoints of the points ``j`` and ``n - j``. Outlines
    should therefore be symmetric in this order. An outline may be a line or a point.
    """
    rings = np.asarray(outlines, dtype=float)
    # An end is an outline that has collapsed onto its spine.
    spines = (rings[[0, -1]] + rings[[0, -1]][:, -np.arange(rings.shape[1])]) / 2
    rings = np.concatenate([spines[:1], rings, spines[1:]])
    index = np.arange(rings.shape[0] * rings.shape[1]).reshape(rings.shape[:2])
    after = np.roll(index, -1, axis=1)
    a, b, c, d = (each.reshape(-1) for each in (index[:-1], after[:-1], after[1:], index[1:]))
    vertices = rings.reshape(-1, 3)
    # The two sides of x = 0 use opposite diagonals of the quads.
    right = (vertices[a] + vertices[b] + vertices[c] + vertices[d])[:, 0] > 0
    first = np.stack([a, b, np.where(right, d, c)], axis=1)
    second = np.stack([np.where(right, b, a), c, d], axis=1)
    return part(vertices, np.concatenate([first, second]), color)


def rectangle(width: float, height: float, *, radius: float, steps: int) -> FloatArray:
    """A rectangular outline (n, 2) from the middle of its top, each corner in ``steps`` pieces."""
    radius = max(min(radius, 0.499 * width, 0.499 * height), 0.0)
    angle = np.linspace(0, np.pi / 2, steps + 1)
    arc = np.stack([np.sin(angle), np.cos(angle)], axis=1)
    upper = np.array([width, height]) / 2 - radius + radius * arc
    right = np.concatenate([upper, [[width / 2, 0.0]], upper[::-1] * (1, -1)])
    top, bottom = [[0.0, height / 2]], [[0.0, -height / 2]]
    return np.concatenate([top, right, bottom, right[::-1] * (-1, 1)])


def stack(levels: Iterable[Sequence[Any]], color: Color, *, radius: float) -> Mesh:
    """Loft rectangles, each (height or heights of front and rear, width, front z, rear z)."""
    rings = []
    for height, width, front, rear in levels:
        x, z = rectangle(width, rear - front, radius=radius, steps=3).T
        z += (front + rear) / 2
        y = np.interp(z, (front, rear), np.broadcast_to(height, 2))
        rings.append(np.stack([x, y, z], axis=1))
    return loft(rings, color)


def box(center: Place, size: Place, color: Color, *, radius: float = 0.0) -> Mesh:
    """Build a box with edges rounded by a radius."""
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
    """Extrude a rectangle along a path (k, 3), scaled by ``scales`` (k,) or (k, 2) at its points.

    The first side is along x, or along z if the path runs along x.
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
    """Revolve a profile (k, 2) of radius and height about a vertical axis.

    ``count``, the number of points around the axis, is a multiple of 4. If ``sideways``, the axis
    is along x.
    """
    radius, height = np.asarray(profile, dtype=float).T[..., None]
    angle = 2 * np.pi * np.arange(count) / count
    across, along = radius * np.round([np.sin(angle), np.cos(angle)], 12)[:, None]
    axis = np.broadcast_to(height, across.shape)
    rings = np.stack([axis, across, along] if sideways else [across, axis, along], axis=2)
    return loft(rings + center, color)


@dataclass
class Draft:
    """A model under construction, in its builder's units, y up and the front at -z."""

    parts: list[Mesh] = field(default_factory=list)
    # Keypoints by semantic id; they are projected to the surface's nearest point.
    places: dict[int, Place] = field(default_factory=dict)
    # Semantic ids that a reflection exchanges, and that a rotation about y permutes.
    mirror_pairs: list[tuple[int, int]] = field(default_factory=list)
    rotation_groups: list[tuple[int, ...]] = field(default_factory=list)
    # True if any rotation about y is a symmetry: each rotation group lies on a circle.
    is_round: bool = False

    def add(self, *parts: Mesh) -> None:
        self.parts += parts

    def add_pair(self, *parts: Mesh) -> None:
        """Add parts and their mirror images under x -> -x."""
        for right in parts:
            vertices, faces = right.vertices * (-1, 1, 1), right.faces[:, ::-1]
            self.parts += [right, replace(right, vertices=vertices, faces=faces)]

    def mark_pair(self, right: int, left: int, place: Place) -> None:
        """Set the place of a semantic id, and its mirror image as the place of another."""
        x, y, z = place
        self.places |= {right: (x, y, z), left: (-x, y, z)}
        self.mirror_pairs.append((right, left))
