"""CAD model in the annotator: exact points on its full mesh, and its simplified display."""

from __future__ import annotations

import json
from functools import cached_property

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, as_floats
from cadalign.datasets.models.model_keypoints import ModelKeypoint
from cadalign.errors import InputError
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.raycaster import FaceArray
from cadalign.geometry.simplify import simplify
from cadalign.render.drawing.color import bytes_from_linear
from cadalign.render.scene import Scene

MOST_FACES = 150_000  # that are displayed
_SAMPLES = 96
_SAMPLED_FROM = 20_000
_NEAREST_SAMPLES = 2e-3  # in diagonals
# Depth beneath the surface at which markers can still be clicked [diagonals]: keypoints sit in
# corners, where rays to them graze other parts. The page uses the same value.
_BENEATH = 0.02
_EXACT = 1e-6


class CadModel:
    """A mesh that can be clicked on; centre and diagonal are its box's [model units]."""

    def __init__(self, mesh: Mesh) -> None:
        self.scene = Scene(mesh)
        low, high = self.scene.bounds
        self.center: FloatArray = (low + high) / 2
        self.diagonal = self.scene.diagonal
        if not self.diagonal > 0:
            raise InputError("all vertices of the mesh coincide", where=mesh.source)

    def to_display(self, xyz: npt.ArrayLike) -> FloatArray:
        """Turn model coordinates (..., 3) into the page's: centred, with a diagonal of 1."""
        return np.asarray((np.asarray(xyz, dtype=float) - self.center) / self.diagonal)

    def from_display(self, xyz: npt.ArrayLike) -> FloatArray:
        """Turn the page's coordinates (..., 3) into model coordinates."""
        return np.asarray(np.asarray(xyz, dtype=float) * self.diagonal + self.center)

    def pick(self, origin: npt.ArrayLike, direction: npt.ArrayLike) -> ModelKeypoint | None:
        """Intersect a ray, in model coordinates, with the surface; None if it misses."""
        start = as_floats(origin, name="origin", shape=(3,))
        along = as_floats(direction, name="direction", shape=(3,))
        if not along.any():
            raise InputError("the vector is zero", where="direction")
        face, distance = self.scene.caster.first_hits(start, along[None])
        if face[0] < 0 or not np.isfinite(distance[0]):
            return None
        return self._on_triangle(int(face[0]), start + distance[0] * along)

    def is_seen(self, origin: npt.ArrayLike, xyz: npt.ArrayLike) -> bool:
        """True if a point on the surface, or slightly beneath it, is visible from ``origin``."""
        start = as_floats(origin, name="origin", shape=(3,))
        sight = as_floats(xyz, name="xyz", shape=(3,)) - start
        length = float(np.linalg.norm(sight))
        if not length > 0:
            return True
        _, distance = self.scene.caster.first_hits(start, sight[None])
        return bool(distance[0] >= 1 - _BENEATH * self.diagonal / length)

    @cached_property
    def samples(self) -> tuple[ModelKeypoint, ...]:
        """Vertices by farthest-point sampling, starting with the one farthest from the centre."""
        mesh = self.scene.mesh
        used, first = np.unique(mesh.faces, return_index=True)
        step = -(-len(used) // _SAMPLED_FROM)
        used, first = used[::step], first[::step]
        points = mesh.vertices[used]
        gaps = np.linalg.norm(points - self.center, axis=1)
        chosen: list[int] = []
        for _ in range(min(_SAMPLES, len(points))):
            farthest = int(np.argmax(gaps))
            if chosen and gaps[farthest] <= _NEAREST_SAMPLES * self.diagonal:
                break
            own = np.linalg.norm(points - points[farthest], axis=1)
            gaps = np.minimum(gaps, own) if chosen else own
            chosen.append(farthest)
        return tuple(self._on_triangle(int(first[row]) // 3, points[row]) for row in chosen)

    @cached_property
    def sample_points(self) -> FloatArray:
        """The positions of `samples`, (k, 3) float."""
        return np.array([point.xyz for point in self.samples])

    @cached_property
    def light_scene(self) -> Scene:
        """The mesh with at most as many faces as are displayed, for what need not be exact."""
        mesh = self.scene.mesh
        if len(mesh.faces) <= MOST_FACES:
            return self.scene
        small = simplify(mesh, max_faces=MOST_FACES)
        return Scene(Mesh(small.vertices, small.faces))

    def _on_triangle(self, triangle: int, xyz: FloatArray) -> ModelKeypoint:
        """Make a keypoint of a point on a triangle, with the file's face number and barycentrics.

        Barycentrics refer to the first triangle of a polygon: on its other triangles some weights
        are negative. They are left out if the polygon is not flat.
        """
        mesh = self.scene.mesh
        face = int(mesh.polygon[triangle])
        corners = mesh.vertices[mesh.faces[np.searchsorted(mesh.polygon, face)]]
        edges = (corners[1:] - corners[0]).T
        if np.linalg.matrix_rank(edges) == 2:
            first, second = np.linalg.lstsq(edges, xyz - corners[0], rcond=None)[0]
            weights = np.array([1 - first - second, first, second])
        else:
            weights = np.array([1.0, 0.0, 0.0])
        x, y, z = xyz.tolist()
        if np.linalg.norm(weights @ corners - xyz) > _EXACT * self.diagonal:
            return ModelKeypoint(name="", xyz=(x, y, z))
        a, b, c = weights.tolist()
        return ModelKeypoint(name="", xyz=(x, y, z), face_index=face, barycentric=(a, b, c))


def display_bytes(model: CadModel, *, max_faces: int = MOST_FACES) -> bytes:
    """Encode the model for display, simplified to at most ``max_faces`` triangles.

    First the length of a JSON header (uint32, little-endian, a multiple of 4 with padding), and the
    header with ``shown`` and ``all``, the numbers of faces; then positions (faces, 3, 3) float32 in
    display coordinates, normals (faces, 3, 3) float32, and sRGB colours (faces, 3) uint8.
    """
    mesh = model.scene.mesh
    small = simplify(mesh, max_faces=max_faces)
    shown = Mesh(model.to_display(small.vertices), small.faces)
    header = json.dumps({"shown": len(small.faces), "all": len(mesh.faces)}).encode()
    header += b" " * (-len(header) % 4)
    weights = np.full((len(small.faces), 3), 1 / 3, dtype=np.float32)
    triangles: FaceArray = small.source.astype(np.int32)
    color = model.scene.surface.color(triangles, weights)
    return b"".join(
        [
            len(header).to_bytes(4, "little"),
            header,
            shown.triangles.astype("<f4").tobytes(),
            Scene(shown).corner_normals.astype("<f4").tobytes(),
            bytes_from_linear(color[:, :3]).tobytes(),
        ]
    )
