"""Ray casting on triangle meshes: Embree finds the triangle, float64 arithmetic the point."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from cadalign.arrays import FloatArray
from cadalign.geometry.mesh import Mesh, face_normals

FaceArray = npt.NDArray[np.int32]
SingleArray = npt.NDArray[np.float32]

# Embree uses float32. Directions are perturbed by more than its rounding error, so that a ray
# exactly through a shared edge does not slip between the two triangles.
_NUDGE = np.array([1.1e-6, 0.7e-6, -0.9e-6])
# Rays from farther away, in mesh radii, are started near the mesh to limit rounding errors.
_FAR_ORIGIN = 8.0
# Sine of the angle between ray and triangle below which the intersection with the triangle's plane
# is clipped to the triangle's extent.
_GRAZING = 1e-3


class EmbreeEngine:
    """Embree through embreex, for vertices (n, 3) and faces (m, 3); thread-safe."""

    def __init__(self, vertices: SingleArray, faces: FaceArray) -> None:
        self._scene = EmbreeScene()
        TriangleMesh(self._scene, vertices, faces)
        # Embree builds the hierarchy on the first query, which is not thread-safe.
        self._scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))

    def first_faces(self, origins: SingleArray, directions: SingleArray) -> FaceArray:
        """First triangle on each ray (n, 3), (n,) int32; -1 without a hit."""
        found: FaceArray = self._scene.run(origins, directions)
        return found

    def occlusion_mask(
        self, origins: SingleArray, directions: SingleArray, reach: float
    ) -> npt.NDArray[np.bool_]:
        """Mask (n,) of rays that hit anything before ``origin + reach * direction``."""
        far = np.full(len(origins), reach, dtype=np.float32)
        return np.asarray(self._scene.run(origins, directions, far, query="OCCLUDED") >= 0)


class Open3DEngine:
    """Embree through Open3D, which uses all cores; see `EmbreeEngine`."""

    def __init__(self, vertices: SingleArray, faces: FaceArray) -> None:
        import open3d

        self._tensor = open3d.core.Tensor
        self._no_hit = np.uint32(open3d.t.geometry.RaycastingScene.INVALID_ID)
        self._scene = open3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._tensor(np.ascontiguousarray(vertices)),
            self._tensor(np.ascontiguousarray(faces.astype(np.uint32))),
        )
        # The hierarchy is built on the first query, which is not thread-safe.
        self.first_faces(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))

    def first_faces(self, origins: SingleArray, directions: SingleArray) -> FaceArray:
        """See `EmbreeEngine`."""
        found = self._scene.cast_rays(self._rays(origins, directions))["primitive_ids"].numpy()
        return np.asarray(np.where(found == self._no_hit, -1, found.astype(np.int32)), np.int32)

    def occlusion_mask(
        self, origins: SingleArray, directions: SingleArray, reach: float
    ) -> npt.NDArray[np.bool_]:
        """See `EmbreeEngine`."""
        rays = self._rays(origins, directions)
        return np.asarray(self._scene.test_occlusions(rays, tnear=0.0, tfar=reach).numpy(), bool)

    def _rays(self, origins: SingleArray, directions: SingleArray) -> Any:
        return self._tensor(np.concatenate([origins, directions], axis=1))


class RayCaster:
    """Ray caster on a mesh, with an immutable bounding volume hierarchy; thread-safe.

    ``normals`` (m, 3) are the faces' unit normals, computed if not given.
    """

    def __init__(
        self,
        mesh: Mesh,
        normals: FloatArray | None = None,
        *,
        engine: type[EmbreeEngine | Open3DEngine] = EmbreeEngine,
    ) -> None:
        low, high = self.bounds = mesh.bounds
        self._center = (low + high) / 2
        # A mesh of a single point has radius 0, which cannot be divided by.
        self._radius = float(np.linalg.norm(high - low)) / 2 or 1.0
        self._triangles = mesh.triangles
        self._normals = face_normals(self._triangles) if normals is None else normals
        unit = (mesh.vertices - self._center) / self._radius
        self._engine = engine(unit.astype(np.float32), mesh.faces.astype(np.int32))

    def first_hits(
        self, origin: FloatArray, directions: FloatArray, *, start: FloatArray | None = None
    ) -> tuple[FaceArray, FloatArray]:
        """Find the first triangle on each ray (n, 3) from one point, beyond ``start`` (n,).

        Returns triangle numbers (n,), -1 without a hit, and distances (n,), infinite without a hit.
        ``start`` and distances are in units of each direction's length.
        """
        face = self._engine.first_faces(*self._rays(origin, directions, start))
        return face, self._distances(origin, directions, face)

    def hit_mask(self, origin: FloatArray, directions: FloatArray) -> npt.NDArray[np.bool_]:
        """Mask (n,) of rays (n, 3) from one point that hit anything."""
        return self._engine.occlusion_mask(*self._rays(origin, directions), np.inf)

    def occlusion_mask(
        self, origins: FloatArray, directions: FloatArray, *, reach: float
    ) -> npt.NDArray[np.bool_]:
        """Mask (n,) of rays (n, 3) that hit anything within ``reach`` times their direction.

        Computed in single precision.
        """
        unit = (origins - self._center) / self._radius
        return self._engine.occlusion_mask(
            unit.astype(np.float32), (directions / self._radius).astype(np.float32), reach
        )

    def _rays(
        self, origin: FloatArray, directions: FloatArray, start: FloatArray | None = None
    ) -> tuple[SingleArray, SingleArray]:
        """Origins and directions (n, 3) for the engine, in units of the mesh's radius."""
        origin = (origin - self._center) / self._radius
        length = np.sqrt(np.einsum("nk,nk->n", directions, directions))
        unit = directions / length[:, None]
        origins: FloatArray
        if start is None and origin @ origin < _FAR_ORIGIN**2:
            origins = np.empty((len(directions), 3), dtype=np.float32)
            origins[:] = origin
        else:
            begin = np.maximum(-(unit @ origin) - 1.01, 0.0)
            if start is not None:
                begin = np.maximum(begin, start * length / self._radius)
            origins = origin + begin[:, None] * unit
        unit += _NUDGE
        return origins.astype(np.float32, copy=False), unit.astype(np.float32)

    def _distances(self, origin: FloatArray, directions: FloatArray, face: FaceArray) -> FloatArray:
        """Distances (n,) of `first_hits`, in double precision."""
        distance = np.full(len(face), np.inf)
        hit = np.flatnonzero(face >= 0)
        found, along = face[hit], directions[hit]
        normals = self._normals[found]
        towards = np.einsum("nk,nk->n", normals, along)
        height = np.einsum("nk,nk->n", self._triangles[found, 0] - origin, normals)
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = height / towards
        length = np.sqrt(np.einsum("nk,nk->n", along, along))
        grazing = np.flatnonzero(~(np.abs(towards) > _GRAZING * length))
        if len(grazing):
            corners = self._triangles[found[grazing]] - origin
            along = along[grazing]
            extent = np.einsum("nck,nk->nc", corners, along) / length[grazing, None] ** 2
            low, high = extent.min(axis=1), extent.max(axis=1)
            held = np.clip(crossing[grazing], low, high)
            crossing[grazing] = np.where(np.isnan(held), (low + high) / 2, held)
        distance[hit] = crossing
        return distance
