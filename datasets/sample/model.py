"""Sample models: solids joined to one mesh, with keypoints on its surface."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh

from cadalign.arrays import FloatArray, IntArray
from cadalign.datasets.sample.solids import Point, Solid
from cadalign.geometry.mesh import Mesh

_CREASE_DEGREES = 35.0


@dataclass(frozen=True)
class Draft:
    """A model in its builder's units, y up and the front at -z."""

    solids: Sequence[Solid]
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
    vertices, faces, colors = _join(draft.solids)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    center, diagonal = (low + high) / 2, float(np.linalg.norm(high - low))
    # The file holds single precision: the mesh and what is computed from it agree with that.
    scaled = ((vertices - center) / diagonal + offset).astype(np.float32).astype(np.float64)
    a, b, c = scaled[faces].transpose(1, 0, 2)
    faces = faces[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-12]  # rounding flattens some
    mesh = Mesh(scaled, faces, vertex_colors=colors, source=f"{category} {model_id}")
    places = {
        k: (np.array(place) - center) / diagonal + offset for k, place in draft.places.items()
    }
    keypoints = _on_surface(mesh, places)
    symmetries = draft.mirrored, draft.turned, draft.round
    return SampleModel(category, model_id, mesh, keypoints, *symmetries)


def _join(solids: Sequence[Solid]) -> tuple[FloatArray, IntArray, FloatArray]:
    """Concatenate parts: vertices, faces, and colours (n, 4) from 0 to 1."""
    sizes = [len(solid.vertices) for solid in solids]
    first = np.cumsum(sizes) - sizes
    joined = np.concatenate([solid.faces + k for solid, k in zip(solids, first, strict=True)])
    colors = np.repeat([(*solid.color, 255) for solid in solids], sizes, axis=0) / 255
    positions, faces = split_creases(np.concatenate([solid.vertices for solid in solids]), joined)
    split_colors = np.empty((len(positions), 4))
    split_colors[faces] = colors[joined]
    return positions, faces, split_colors


def split_creases(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Double the vertices along sharp edges: new vertices and faces.

    Shading then stays smooth only where the shape is.
    """
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    smooth = mesh.face_adjacency_angles < np.radians(_CREASE_DEGREES)
    beside, ends = mesh.face_adjacency[smooth], mesh.face_adjacency_edges[smooth]
    # Of both faces at a smooth edge, the corners at its two ends: these remain one vertex.
    corner = (faces[beside][:, :, None] == ends[:, None, :, None]).argmax(axis=3)
    joined = (3 * beside[:, :, None] + corner).transpose(0, 2, 1).reshape(-1, 2)
    graph: Any = trimesh.graph
    label = graph.connected_component_labels(joined, node_count=faces.size)
    positions = np.empty((label.max() + 1, 3))
    positions[label] = vertices[faces].reshape(-1, 3)
    return positions, label.reshape(faces.shape).astype(np.int64)


def _on_surface(mesh: Mesh, places: Mapping[int, FloatArray]) -> tuple[SampleKeypoint, ...]:
    """Keypoints at the surface's nearest points to places (3,)."""
    keypoints = []
    for semantic_id, place in sorted(places.items()):
        face, weights = closest_barycentric(mesh.triangles, place)
        xyz = weights @ mesh.triangles[face]
        vertex = int(np.argmin(np.linalg.norm(mesh.vertices - xyz, axis=1)))
        keypoints.append(SampleKeypoint(semantic_id, xyz, face, weights, vertex))
    return tuple(keypoints)


def closest_barycentric(triangles: FloatArray, point: FloatArray) -> tuple[int, FloatArray]:
    """The triangle nearest to ``point`` (3,), and its nearest point's barycentric coordinates."""
    functions: Any = trimesh.triangles
    centroid = triangles.mean(axis=1)
    radius = np.linalg.norm(triangles - centroid[:, None], axis=2).max(axis=1)
    distance = np.linalg.norm(centroid - point, axis=1)
    near = np.flatnonzero(distance - radius <= distance.min())
    closest = functions.closest_point(triangles[near], np.broadcast_to(point, (len(near), 3)))
    best = int(np.argmin(np.linalg.norm(closest - point, axis=1)))
    face = int(near[best])
    weights = functions.points_to_barycentric(triangles[[face]], closest[[best]])[0].clip(0)
    return face, weights / weights.sum()
