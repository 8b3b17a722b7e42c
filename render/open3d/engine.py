"""Open3D's `RaycastingScene` as a ray engine; imported only where it is asked for."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import open3d

from cadalign.geometry.raycaster import FaceArray, SingleArray

_NO_HIT = np.uint32(open3d.t.geometry.RaycastingScene.INVALID_ID)


class Open3DEngine:
    """Embree by way of Open3D, which casts with all cores by itself; see `EmbreeEngine`."""

    def __init__(self, vertices: SingleArray, faces: FaceArray) -> None:
        self._scene = open3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            open3d.core.Tensor(np.ascontiguousarray(vertices)),
            open3d.core.Tensor(np.ascontiguousarray(faces.astype(np.uint32))),
        )
        # The hierarchy is built on the first query; let no two threads make that one at once.
        self.first_faces(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))

    def first_faces(self, origins: SingleArray, directions: SingleArray) -> FaceArray:
        """See `RayEngine`."""
        found = self._scene.cast_rays(_rays(origins, directions))["primitive_ids"].numpy()
        return np.asarray(np.where(found == _NO_HIT, -1, found.astype(np.int32)), dtype=np.int32)

    def blocked(
        self, origins: SingleArray, directions: SingleArray, reach: float
    ) -> npt.NDArray[np.bool_]:
        """See `RayEngine`."""
        found = self._scene.test_occlusions(_rays(origins, directions), tnear=0.0, tfar=reach)
        return np.asarray(found.numpy(), dtype=bool)


def _rays(origins: SingleArray, directions: SingleArray) -> open3d.core.Tensor:
    return open3d.core.Tensor(np.concatenate([origins, directions], axis=1))
