"""First hits of rays with a triangle mesh: embree finds the triangle, float64 the point."""

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

# Embree counts in float32. Rays are perturbed by more than its rounding, so that a ray which passes
# exactly through a shared edge does not slip between the two triangles (as 1 in 2,000 such rays
# did, none with this). At a distance of 4 model radii that moves the hit by 1e-5 radii.
_NUDGE = np.array([1.1e-6, 0.7e-6, -0.9e-6])
# Farther than this from the mesh, in its radii, rays are started nearer by, or rounding shows.
_FAR_ORIGIN = 8.0
# Sine of the angle below which a triangle is seen so nearly edge-on that the intersection with its
# plane is held to the triangle's own extent.
_GRAZING = 1e-3


class EmbreeEngine:
    """Embree by way of embreex, over vertices (n, 3) and faces (m, 3); safe in several threads."""

    def __init__(self, vertices: SingleArray, faces: FaceArray) -> None:
        self._scene = EmbreeScene()
        TriangleMesh(self._scene, vertices, faces)
        # Embree builds the hierarchy on the first query; let no two threads make that one at once.
        self._scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))

    def first_faces(self, origins: SingleArray, directions: SingleArray) -> FaceArray:
        """The first triangle on each of n rays (n, 3), (n,) int32; -1 where there is none."""
        found: FaceArray = self._scene.run(origins, directions)
        return found

    def blocked(
        self, origins: SingleArray, directions: SingleArray, reach: float
    ) -> npt.NDArray[np.bool_]:
        """Rays that hit anything before ``origin + reach * direction``, (n,) bool."""
        far = np.full(len(origins), reach, dtype=np.float32)
        return np.asarray(self._scene.run(origins, directions, far, query="OCCLUDED") >= 0)


class Open3DEngine:
    """Embree by way of Open3D, which casts with all cores by itself; see `EmbreeEngine`."""

    def __init__(self, vertices: SingleArray, faces: FaceArray) -> None:
        import open3d

        self._tensor = open3d.core.Tensor
        self._no_hit = np.uint32(open3d.t.geometry.RaycastingScene.INVALID_ID)
        self._scene = open3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._tensor(np.ascontiguousarray(vertices)),
            self._tensor(np.ascontiguousarray(faces.astype(np.uint32))),
        )
        # The hierarchy is built on the first query; let no two threads make that one at once.
        self.first_faces(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))

    def first_faces(self, origins: SingleArray, directions: SingleArray) -> FaceArray:
        """See `EmbreeEngine`."""
        found = self._scene.cast_rays(self._rays(origins, directions))["primitive_ids"].numpy()
        return np.asarray(np.where(found == self._no_hit, -1, found.astype(np.int32)), np.int32)

    def blocked(
        self, origins: SingleArray, directions: SingleArray, reach: float
    ) -> npt.NDArray[np.bool_]:
        """See `EmbreeEngine`."""
        rays = self._rays(origins, directions)
        return np.asarray(self._scene.test_occlusions(rays, tnear=0.0, tfar=reach).numpy(), bool)

    def _rays(self, origins: SingleArray, directions: SingleArray) -> Any:
        return self._tensor(np.concatenate([origins, directions], axis=1))


class RayCaster:
    """A bounding volume hierarchy over a mesh, then only read; safe in several threads.

    ``normals`` (m, 3) are the unit normals of its faces, where they are known already.
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
        # A mesh of a single point has no size; any radius serves.
        self._radius = float(np.linalg.norm(high - low)) / 2 or 1.0
        self._triangles = mesh.triangles
        self._normals = face_normals(self._triangles) if normals is None else normals
        unit = (mesh.vertices - self._center) / self._radius
        self._engine = engine(unit.astype(np.float32), mesh.faces.astype(np.int32))

    def first_hits(
        self, origin: FloatArray, directions: FloatArray, *, start: FloatArray | None = None
    ) -> tuple[FaceArray, FloatArray]:
        """Find the first triangle on each ray (n, 3) from one point, beyond ``start`` (n,).

        Its number is -1 and its distance infinite where there is none; ``start`` and distances,
        both (n,), count in the directions' own lengths.
        """
        face = self._engine.first_faces(*self._rays(origin, directions, start))
        return face, self._distances(origin, directions, face)

    def normals(self, face: FaceArray | npt.NDArray[np.int64]) -> FloatArray:
        """Unit normals (n, 3) of triangles (n,)."""
        return self._normals[face]

    def covered(self, origin: FloatArray, directions: FloatArray) -> npt.NDArray[np.bool_]:
        """Find the rays (n, 3) from one point that hit anything, (n,) bool."""
        return self._engine.blocked(*self._rays(origin, directions), np.inf)

    def blocked(
        self, origins: FloatArray, directions: FloatArray, *, reach: float
    ) -> npt.NDArray[np.bool_]:
        """Find the rays (n, 3) that hit anything on their way, (n,) bool; to single precision.

        Each ray goes ``reach`` times its direction's length, in model coordinates.
        """
        unit = (origins - self._center) / self._radius
        return self._engine.blocked(
            unit.astype(np.float32), (directions / self._radius).astype(np.float32), reach
        )

    def _rays(
        self, origin: FloatArray, directions: FloatArray, start: FloatArray | None = None
    ) -> tuple[SingleArray, SingleArray]:
        """Origins and directions (n, 3) of rays for the engine, in units of the mesh's radius."""
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
        """Distances of `first_hits`, in double precision."""
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
