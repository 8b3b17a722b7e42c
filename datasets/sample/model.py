"""From solids and named places to a finished sample model: one mesh and its keypoints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from cadalign.arrays import FloatArray, IntArray
from cadalign.datasets.sample.solids import Solid
from cadalign.geometry.mesh import Mesh

_CREASE_DEGREES = 35.0


@dataclass(frozen=True)
class Place:
    """Where a keypoint is meant to be: it lands on the nearest point of the surface.

    Parameters
    ----------
    semantic_id : int
        Which point of the category it is.
    position : tuple of 3 float
        In the draft's own units.
    """

    semantic_id: int
    position: tuple[float, float, float]


@dataclass(frozen=True)
class Draft:
    """A model as its builder makes it, in whatever units suit it, y up and the front at -z.

    Parameters
    ----------
    solids : tuple of Solid
        The parts.
    places : tuple of Place
        The keypoints, ordered by semantic id.
    mirrored : tuple of (int, int)
        Semantic ids that a mirror plane of the model exchanges.
    turned : tuple of tuple of int
        Groups of semantic ids that a rotation about y takes into each other.
    round : bool
        Whether any rotation about y does, so that each group lies on a circle.
    """

    solids: tuple[Solid, ...]
    places: tuple[Place, ...]
    mirrored: tuple[tuple[int, int], ...] = ()
    turned: tuple[tuple[int, ...], ...] = ()
    round: bool = False


@dataclass(frozen=True, eq=False)
class SampleKeypoint:
    """A keypoint on the surface.

    Parameters
    ----------
    semantic_id : int
        Which point of the category it is.
    xyz : (3,) float
        Its position [model units].
    face_index : int
        The face it lies in.
    barycentric : (3,) float
        Weights of the face's corners, summing to 1.
    vertex_index : int
        The vertex nearest to it.
    """

    semantic_id: int
    xyz: FloatArray
    face_index: int
    barycentric: FloatArray
    vertex_index: int


@dataclass(frozen=True, eq=False)
class SampleModel:
    """A finished model: the diagonal of its bounding box is 1, the front is at -z.

    Parameters
    ----------
    category : str
        The category's name.
    model_id : str
        The model's name within the data set.
    mesh : Mesh
        The surface with vertex colours; coordinates are exact in single precision.
    keypoints : tuple of SampleKeypoint
        Ordered by semantic id.
    mirrored, turned, round
        The symmetries, as in `Draft`.
    """

    category: str
    model_id: str
    mesh: Mesh
    keypoints: tuple[SampleKeypoint, ...]
    mirrored: tuple[tuple[int, int], ...]
    turned: tuple[tuple[int, ...], ...]
    round: bool


def mirrored_places(
    pairs: Mapping[tuple[int, int], tuple[float, float, float]],
) -> list[Place]:
    """Two places for each position on the right: there, and its mirror image under x -> -x."""
    places = []
    for (right, left), (x, y, z) in pairs.items():
        places += [Place(right, (x, y, z)), Place(left, (-x, y, z))]
    return places


def finish(draft: Draft, *, category: str, model_id: str, offset: FloatArray) -> SampleModel:
    """Put a draft's parts together, scale it, and set its keypoints on the surface.

    Parameters
    ----------
    draft : Draft
        The parts and the places of the keypoints.
    category, model_id : str
        The model's names.
    offset : (3,) float
        Where the centre of the bounding box is to lie [model units].
    """
    vertices, faces, colors = _join(draft.solids)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    center, diagonal = (low + high) / 2, float(np.linalg.norm(high - low))
    # The file holds single precision: the mesh and what is computed from it agree with that.
    scaled = ((vertices - center) / diagonal + offset).astype(np.float32).astype(np.float64)
    faces = _with_area(scaled, faces)
    mesh = Mesh(scaled, faces, vertex_colors=colors, source=f"{category} {model_id}")
    wanted = np.array([place.position for place in draft.places])
    keypoints = _set_on_surface(
        mesh, (wanted - center) / diagonal + offset, [place.semantic_id for place in draft.places]
    )
    return SampleModel(
        category, model_id, mesh, keypoints, draft.mirrored, draft.turned, draft.round
    )


def _join(solids: Sequence[Solid]) -> tuple[FloatArray, IntArray, FloatArray]:
    """Concatenate parts: vertices, faces, and colours (n, 4) from 0 to 1."""
    vertices, faces, colors, total = [], [], [], 0
    for solid in solids:
        vertices.append(solid.vertices)
        faces.append(solid.faces + total)
        rgba = np.array([*solid.color, 255]) / 255
        colors.append(np.broadcast_to(rgba, (len(solid.vertices), 4)))
        total += len(solid.vertices)
    joined = np.concatenate(faces)
    positions, split = split_creases(np.concatenate(vertices), joined)
    split_colors = np.empty((len(positions), 4))
    split_colors[split] = np.concatenate(colors)[joined]
    return positions, split, split_colors


def _with_area(vertices: FloatArray, faces: IntArray) -> IntArray:
    """Leave out the faces that have no area left once the coordinates are rounded."""
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(faces[np.linalg.norm(normal, axis=1) > 1e-12])


def split_creases(
    vertices: FloatArray, faces: IntArray, *, crease: float = _CREASE_DEGREES
) -> tuple[FloatArray, IntArray]:
    """Double the vertices along sharp edges, so that shading stays smooth only where the shape is.

    Parameters
    ----------
    vertices : (n, 3) float
        Positions.
    faces : (m, 3) int
        Triangles.
    crease : float
        Faces that meet at a larger angle [degrees] don't share vertices.

    Returns
    -------
    vertices : (k, 3) float
    faces : (m, 3) int

    Examples
    --------
    >>> corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    >>> faces = np.array([[0, 2, 1], [0, 3, 2], [0, 1, 3], [1, 2, 3]])
    >>> len(split_creases(corners, faces)[0])
    12
    """
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # Every edge of every face, as (smaller vertex, larger vertex), with the numbers of the two
    # face corners at these vertices.
    corner = np.arange(faces.size).reshape(faces.shape)
    ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    end_corners = np.stack([corner, np.roll(corner, -1, axis=1)], axis=-1).reshape(-1, 2)
    swap = ends[:, 0] > ends[:, 1]
    ends[swap], end_corners[swap] = ends[swap][:, ::-1], end_corners[swap][:, ::-1]
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    ends, end_corners, face = ends[order], end_corners[order], order // 3
    neighbours = (ends[1:] == ends[:-1]).all(axis=1)
    smooth = np.einsum("ij,ij->i", normal[face[1:]], normal[face[:-1]]) > np.cos(np.radians(crease))
    joined = np.flatnonzero(neighbours & smooth)
    rows, columns = end_corners[joined].ravel(), end_corners[joined + 1].ravel()
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(faces.size, faces.size))
    count, label = connected_components(graph, directed=False)
    positions = np.empty((count, 3))
    positions[label] = corners.reshape(-1, 3)
    return positions, label.reshape(faces.shape).astype(np.int64)


def _set_on_surface(
    mesh: Mesh, wanted: FloatArray, semantic_ids: Sequence[int]
) -> tuple[SampleKeypoint, ...]:
    triangles = mesh.triangles
    centroid = triangles.mean(axis=1)
    radius = np.linalg.norm(triangles - centroid[:, None], axis=2).max(axis=1)
    keypoints = []
    for semantic_id, place in zip(semantic_ids, wanted, strict=True):
        face, barycentric = _closest(triangles, centroid, radius, place)
        xyz = barycentric @ triangles[face]
        vertex = int(np.argmin(np.linalg.norm(mesh.vertices - xyz, axis=1)))
        keypoints.append(SampleKeypoint(semantic_id, xyz, face, barycentric, vertex))
    return tuple(keypoints)


def _closest(
    triangles: FloatArray, centroid: FloatArray, radius: FloatArray, place: FloatArray
) -> tuple[int, FloatArray]:
    """The face nearest to a place, and the barycentric coordinates of the nearest point in it."""
    distance = np.linalg.norm(centroid - place, axis=1)
    candidates = np.flatnonzero(distance - radius <= distance.min())
    weights = closest_barycentric(triangles[candidates], place)
    nearest = np.einsum("mc,mcd->md", weights, triangles[candidates])
    best = int(np.argmin(np.linalg.norm(nearest - place, axis=1)))
    return int(candidates[best]), weights[best]


def closest_barycentric(triangles: FloatArray, point: FloatArray) -> FloatArray:
    """Barycentric coordinates (m, 3) of the point nearest to ``point`` (3,) in each triangle.

    That is the foot of the perpendicular where it lies inside, otherwise the nearest of the points
    nearest on the three edges.

    Examples
    --------
    >>> triangle = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])
    >>> closest_barycentric(triangle, np.array([0.25, 0.25, 3.0])).tolist()
    [[0.5, 0.25, 0.25]]
    >>> closest_barycentric(triangle, np.array([2.0, -1.0, 0.0])).tolist()
    [[0.0, 1.0, 0.0]]
    """
    candidates = [_foot(triangles, point)]
    for start, end in ((0, 1), (1, 2), (2, 0)):
        along = triangles[:, end] - triangles[:, start]
        reach = np.einsum("md,md->m", point - triangles[:, start], along)
        share = np.clip(reach / np.einsum("md,md->m", along, along), 0.0, 1.0)
        weights = np.zeros((len(triangles), 3))
        weights[:, start], weights[:, end] = 1 - share, share
        candidates.append(weights)
    choices = np.stack(candidates)
    positions = np.einsum("kmc,mcd->kmd", choices, triangles)
    distance = np.linalg.norm(positions - point, axis=2)
    distance[0][(choices[0] < 0).any(axis=1)] = np.inf
    return np.asarray(choices[np.argmin(distance, axis=0), np.arange(len(triangles))])


def _foot(triangles: FloatArray, point: FloatArray) -> FloatArray:
    """Barycentric coordinates (m, 3) of a point's projection into the planes of triangles."""
    first = triangles[:, 1] - triangles[:, 0]
    second = triangles[:, 2] - triangles[:, 0]
    normal = np.cross(first, second)
    offset = point - triangles[:, 0]
    squared = np.einsum("md,md->m", normal, normal)
    v = np.einsum("md,md->m", np.cross(offset, second), normal) / squared
    w = np.einsum("md,md->m", np.cross(first, offset), normal) / squared
    return np.stack([1 - v - w, v, w], axis=1)
