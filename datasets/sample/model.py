"""Sample models: closed parts of one colour, joined to one mesh with keypoints on its surface.

The parts are boxes, lathes and beams. All but sharp boxes are lofts, surfaces through a row of
closed outlines, because a part around the plane x = 0 must be exactly mirror symmetric, also in its
tessellation.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import numpy.typing as npt
import trimesh

from cadalign.arrays import FloatArray
from cadalign.geometry.mesh import Mesh, join

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Kind = TypeVar("Kind", bound="DataclassInstance")
Color = tuple[int, int, int]
"""Red, green and blue, 0 to 255."""
Point = tuple[float, float, float]
Level = tuple[float, float, float, float]
"""A rectangle across a body: height y, width, z of its front and of its rear."""

_WELD_DECIMALS = 8
_TINY_AREA = 5e-13
_CREASE_DEGREES = 35.0


def palette(text: str) -> tuple[Color, ...]:
    """Colours by their hexadecimal digits, such as ``"b02428 202228"``."""
    return tuple((red, green, blue) for red, green, blue in map(bytes.fromhex, text.split()))


def pick(rng: np.random.Generator, colors: Sequence[Color]) -> Color:
    return colors[int(rng.integers(len(colors)))]


def varied(kind: Kind, rng: np.random.Generator, **factors: tuple[float, float]) -> Kind:
    """A kind with some of its measures drawn anew: between two factors of what they were."""
    drawn = {name: getattr(kind, name) * rng.uniform(*two) for name, two in factors.items()}
    return replace(kind, **drawn)


def part(vertices: npt.ArrayLike, faces: npt.ArrayLike, color: Color) -> Mesh:
    """Weld coinciding vertices, drop triangles without area, turn the surface outward."""
    points = np.round(np.asarray(vertices, dtype=float), _WELD_DECIMALS) + 0.0
    welded, inverse = np.unique(points, axis=0, return_inverse=True)
    triangles = inverse.reshape(-1)[np.asarray(faces, dtype=np.int64)]
    corners = welded[triangles]
    if np.linalg.det(corners - welded.mean(axis=0)).sum() < 0:  # six times the volume
        triangles = triangles[:, ::-1]
    colors = np.tile((*color, 255), (len(welded), 1)) / 255
    return Mesh(welded, triangles[_areas(corners) > _TINY_AREA], vertex_colors=colors)


def _areas(triangles: FloatArray) -> FloatArray:
    functions: Any = trimesh.triangles
    return np.asarray(functions.area(triangles))


def both_sides(*parts: Mesh) -> list[Mesh]:
    """The parts together with their mirror images under x -> -x."""
    mirrored = (replace(p, vertices=p.vertices * (-1, 1, 1), faces=p.faces[:, ::-1]) for p in parts)
    return [*parts, *mirrored]


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
    top = np.array([[0.0, height / 2]])
    right = np.concatenate([upper, [[width / 2, 0.0]], upper[::-1] * (1, -1)])
    return np.concatenate([top, right, -top, right[::-1] * (-1, 1)])


def stack(levels: Sequence[Level], color: Color, *, radius: float) -> Mesh:
    """A body through rectangles with round corners, from the lowest up."""
    rings = [
        np.insert(rectangle(width, rear - front, radius=radius, steps=3), 1, y, axis=1)
        + (0, 0, (front + rear) / 2)
        for y, width, front, rear in levels
    ]
    return loft(rings, color)


def box(
    center: npt.ArrayLike, size: Point, color: Color, *, radius: float = 0.0, steps: int = 2
) -> Mesh:
    """A box; ``steps`` flat pieces make a quarter circle of its rounded edges."""
    middle, (width, height, depth) = np.asarray(center, dtype=float), size
    if radius == 0:
        block = trimesh.creation.box(extents=size)
        return part(block.vertices + middle, block.faces, color)
    radius = min(radius, 0.49 * height, 0.45 * width, 0.45 * depth)
    angle = np.linspace(0, np.pi / 2, steps + 1)
    lower = np.stack([1 - np.sin(angle), 1 - np.cos(angle)], axis=1) * radius - (0, height / 2)
    rings = [
        np.insert(rectangle(width - 2 * i, depth - 2 * i, radius=radius - i, steps=steps), 1, y, 1)
        for i, y in np.concatenate([lower, lower[::-1] * (1, -1)])
    ]
    return loft(np.array(rings) + middle, color)


def beam(
    path: npt.ArrayLike | Sequence[npt.ArrayLike],
    size: tuple[float, float],
    color: Color,
    *,
    scales: Sequence[float | tuple[float, float]] = (1.0,),
    side: Point | None = None,
    radius: float | None = None,
) -> Mesh:
    """Extrude a rectangle along a path (k, 3), ``scales`` (k,) or (k, 2) times as large.

    ``size`` is along ``side``, made perpendicular to the path, and across it; by default ``side``
    is x, or z where the path runs along x.
    """
    points = np.asarray(path, dtype=float)
    tangent = trimesh.unitize(np.gradient(points, axis=0))
    along = side or ((1, 0, 0) if np.abs(tangent[:, 0]).max() < 0.9 else (0, 0, 1))
    first = trimesh.unitize(along - (tangent @ along)[:, None] * tangent)
    section = rectangle(*size, radius=radius or 0.18 * min(size), steps=2 if radius else 1)
    x, y = np.split(section * np.reshape(scales, (len(scales), 1, -1)), 2, axis=2)
    return loft(
        points[:, None] + (x * first[:, None] + y * np.cross(tangent, first)[:, None]), color
    )


def lathe(
    profile: npt.ArrayLike,
    color: Color,
    *,
    center: npt.ArrayLike = (0, 0, 0),
    count: int = 24,
    depth: npt.ArrayLike = 1.0,
    exponent: npt.ArrayLike = 2.0,
    sideways: bool = False,
) -> Mesh:
    """Turn a profile (k, 2) of radius and height around a vertical axis, in ``count`` = 4 i points.

    ``depth``, one or (k,), is the extent along z relative to x; ``exponent`` is 2 for circles, more
    for rounded squares: sections are superellipses ``|x/a|^exponent + |z/b|^exponent = 1``. The
    axis of a ``sideways`` part is along x, its heights are distances outward.
    """
    radius, height = np.asarray(profile, dtype=float).T[..., None]
    angle = 2 * np.pi * np.arange(count) / count
    unit = np.round([np.sin(angle), np.cos(angle)], 12)[:, None]
    across, along = radius * np.sign(unit) * np.abs(unit) ** (2 / np.reshape(exponent, (-1, 1)))
    axis, along = np.broadcast_to(height, across.shape), along * np.reshape(depth, (-1, 1))
    rings = np.stack([axis, across, along] if sideways else [across, axis, along], axis=2)
    return loft(rings + np.asarray(center, dtype=float), color)


def ellipsoid(center: Point, size: Point, color: Color, *, count: int) -> Mesh:
    """An ellipsoid of the given full extents (3,)."""
    angle = np.linspace(0, np.pi, count // 2 + 1)
    profile = np.stack([size[0] * np.sin(angle), -size[1] * np.cos(angle)], axis=1) / 2
    return lathe(profile, color, center=center, count=count, depth=size[2] / size[0])


# Models -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Draft:
    """A model in its builder's units, y up and the front at -z."""

    parts: Sequence[Mesh]
    places: Mapping[int, Point]  # by semantic id; keypoints land on the surface's nearest point
    mirrored: tuple[tuple[int, int], ...] = ()  # semantic ids that a mirror plane exchanges
    turned: tuple[tuple[int, ...], ...] = ()  # semantic ids that a rotation about y permutes
    round: bool = False  # any rotation about y is one: each group of them lies on a circle


@dataclass(frozen=True, eq=False)
class SampleKeypoint:
    """A keypoint on the surface."""

    semantic_id: int
    xyz: FloatArray  # (3,) [model units]
    face_index: int
    barycentric: FloatArray  # (3,) weights of the face's corners, of sum 1
    vertex_index: int  # of the nearest vertex


@dataclass(frozen=True, eq=False)
class SampleModel:
    """A finished model: the diagonal of its bounding box is 1, the front is at -z.

    Its symmetries are those of its `Draft`.
    """

    category: str
    model_id: str
    mesh: Mesh  # with vertex colours; coordinates are exact in single precision
    keypoints: tuple[SampleKeypoint, ...]  # ordered by semantic id
    mirrored: tuple[tuple[int, int], ...]
    turned: tuple[tuple[int, ...], ...]
    round: bool


def mirrored_places(pairs: Mapping[tuple[int, int], Point]) -> dict[int, Point]:
    """Places of pairs of semantic ids: at the given one and at its mirror image under x -> -x."""
    rights = {right: place for (right, _), place in pairs.items()}
    return rights | {left: (-x, y, z) for (_, left), (x, y, z) in pairs.items()}


def finish(draft: Draft, *, category: str, model_id: str, offset: FloatArray) -> SampleModel:
    """Join a draft's parts, scale the mesh, and set the keypoints on its surface.

    The centre of the bounding box comes to ``offset`` (3,).
    """
    whole = split_creases(join(draft.parts, f"{category} {model_id}"))
    center, diagonal = whole.bounds.mean(axis=0), np.linalg.norm(np.ptp(whole.bounds, axis=0))
    # The file holds single precision: the mesh and what is computed from it agree with that.
    scaled = ((whole.vertices - center) / diagonal + offset).astype(np.float32).astype(np.float64)
    faces = whole.faces[_areas(scaled[whole.faces]) > _TINY_AREA]  # rounding flattens some
    mesh = Mesh(scaled, faces, vertex_colors=whole.vertex_colors, source=whole.source)
    keypoints, triangles = [], mesh.triangles
    places = [(np.array(place) - center) / diagonal + offset for place in draft.places.values()]
    found = dict(zip(draft.places, closest_barycentric(triangles, places), strict=True))
    for semantic_id, (face, weights) in sorted(found.items()):
        xyz = weights @ triangles[face]
        vertex = int(np.argmin(np.linalg.norm(mesh.vertices - xyz, axis=1)))
        keypoints.append(SampleKeypoint(semantic_id, xyz, face, weights, vertex))
    kept = draft.mirrored, draft.turned, draft.round
    return SampleModel(category, model_id, mesh, tuple(keypoints), *kept)


def split_creases(mesh: Mesh) -> Mesh:
    """Double the vertices along sharp edges: shading then stays smooth only where the shape is."""
    shape = mesh.to_trimesh()
    smooth = shape.face_adjacency_angles < np.radians(_CREASE_DEGREES)
    beside, ends = shape.face_adjacency[smooth], shape.face_adjacency_edges[smooth]
    # Of both faces at a smooth edge, the corners at its two ends: these remain one vertex.
    corner = (mesh.faces[beside][:, :, None] == ends[:, None, :, None]).argmax(axis=3)
    joined = (3 * beside[:, :, None] + corner).transpose(0, 2, 1).reshape(-1, 2)
    graph: Any = trimesh.graph
    label = graph.connected_component_labels(joined, node_count=mesh.faces.size).astype(np.int64)
    origin = np.empty(label.max() + 1, dtype=np.int64)
    origin[label] = mesh.faces.reshape(-1)
    colors = None if mesh.vertex_colors is None else mesh.vertex_colors[origin]
    faces = label.reshape(mesh.faces.shape)
    return replace(mesh, vertices=mesh.vertices[origin], faces=faces, vertex_colors=colors)


def closest_barycentric(
    triangles: FloatArray, points: Sequence[FloatArray]
) -> Iterator[tuple[int, FloatArray]]:
    """The triangle nearest to each point (3,), and its nearest point's barycentric coordinates."""
    functions: Any = trimesh.triangles
    centroid = triangles.mean(axis=1)
    radius = np.linalg.norm(triangles - centroid[:, None], axis=2).max(axis=1)
    for point in points:
        distance = np.linalg.norm(centroid - point, axis=1)
        near = np.flatnonzero(distance - radius <= distance.min())
        closest = functions.closest_point(triangles[near], np.broadcast_to(point, (len(near), 3)))
        best = int(np.argmin(np.linalg.norm(closest - point, axis=1)))
        face = int(near[best])
        weights = functions.points_to_barycentric(triangles[[face]], closest[[best]])[0].clip(0)
        yield face, weights / weights.sum()
