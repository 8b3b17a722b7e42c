"""Scenes and frames."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import RenderError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh, face_normals
from cadalign.geometry.raycaster import Open3DEngine, RayCaster
from cadalign.render.canvas import ByteImage, composite
from cadalign.render.surface import SurfaceColors, coincident_faces, corner_normals


class Scene:
    """A mesh prepared for rendering; each derived quantity is computed once, on first use.

    A pose or stretch needs no preparation: rays are cast in the model frame, where the camera ray
    through the normalised coordinates (u, v) is the line

        x = -L^-1 t + depth * L^-1 (u, v, 1),    L = rotation @ diag(scale).

    Parameters
    ----------
    mesh : Mesh
        The mesh in model coordinates.

    Examples
    --------
    >>> import numpy as np
    >>> from cadalign import Mesh
    >>> Scene(Mesh([[0, 0, 0], [3, 0, 0], [0, 4, 0]], [[0, 1, 2]])).diagonal
    5.0
    """

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh

    def __reduce__(self) -> tuple[object, ...]:
        # The ray caster cannot be pickled; worker processes build their own.
        return Scene, (self.mesh,)

    @cached_property
    def bounds(self) -> FloatArray:
        """Lowest and highest model coordinates, (2, 3) float."""
        return self.mesh.bounds

    @property
    def diagonal(self) -> float:
        """Diagonal of the bounding box [model units]."""
        return float(np.linalg.norm(self.bounds[1] - self.bounds[0]))

    def stretched_diagonal(self, alignment: Alignment) -> float:
        """Diagonal of the stretched model's bounding box [model units]."""
        return float(np.linalg.norm((self.bounds[1] - self.bounds[0]) * alignment.scale))

    @cached_property
    def caster(self) -> RayCaster:
        """The ray caster."""
        return RayCaster(self.mesh, self.face_normals)

    @cached_property
    def open3d_caster(self) -> RayCaster:
        """The ray caster of Open3D, which must be installed."""
        return RayCaster(self.mesh, self.face_normals, engine=Open3DEngine)

    @cached_property
    def used_vertices(self) -> FloatArray:
        """Vertices that faces use, (n, 3) float."""
        return np.asarray(self.mesh.vertices[self.mesh.is_used])

    @cached_property
    def triangles(self) -> FloatArray:
        """Corners of the triangles, (m, 3, 3) float."""
        return self.mesh.triangles

    @cached_property
    def face_normals(self) -> FloatArray:
        """Unit normals of the triangles, (m, 3) float; zero without area."""
        return face_normals(self.triangles)

    @cached_property
    def corner_normals(self) -> npt.NDArray[np.float32]:
        """Smooth normals at the triangles' corners, (m, 3, 3) float32, on the side of the face."""
        normals = corner_normals(self.mesh.vertices, self.mesh.faces, self.face_normals)
        return normals.astype(np.float32)

    @cached_property
    def coincident_faces(self) -> tuple[IntArray, IntArray]:
        """The coincident triangles to show, from either side; see `coincident_faces`."""
        return coincident_faces(self.mesh.vertices, self.mesh.faces)

    @cached_property
    def surface(self) -> SurfaceColors:
        """Colours of the mesh."""
        return SurfaceColors(self.mesh)


LIGHT_GREY = (228, 230, 233)
MAX_SIDE = 16384
MAX_PIXELS = 100_000_000


@dataclass(frozen=True, eq=False)
class Geometry:
    """The surface at each pixel's centre: exact, not antialiased."""

    depth: FloatArray
    """(h, w) float [model units], z in the camera frame, or the distance for a wide lens; 0 where
    empty."""
    face_id: npt.NDArray[np.int32]
    """(h, w) int32, index of the mesh's triangle; -1 where empty."""
    normal: npt.NDArray[np.float32]
    """(h, w, 3) float32, unit normal of the triangle in the camera frame, towards the camera; 0
    where empty."""

    @property
    def mask(self) -> npt.NDArray[np.bool_]:
        """Pixels of the object, (h, w) bool."""
        return np.asarray(self.face_id >= 0)


@dataclass(frozen=True, eq=False)
class Frame(Geometry):
    """A rendered image with its geometry.

    Parameters
    ----------
    depth, face_id, normal
        See `Geometry`, which has the `mask` too.
    color : (h, w, 4) uint8
        sRGB and opacity, not premultiplied. At silhouettes the colour is the object's, and the
        opacity the share of the pixel that it covers.
    """

    color: ByteImage

    def composite(self, background: npt.ArrayLike = LIGHT_GREY) -> ByteImage:
        """Put the object in front of a colour or a photo, blending in linear light.

        Parameters
        ----------
        background : (3,) or (h, w, 3) uint8
            sRGB.

        Returns
        -------
        (h, w, 3) uint8

        Raises
        ------
        InputError
            If the background is neither a colour nor an image of the frame's size.
        """
        return composite(self.color, background)


def check_image_size(camera: Camera) -> None:
    """Raise RenderError if an image is too large to be rendered."""
    if max(camera.width, camera.height) > MAX_SIDE or camera.width * camera.height > MAX_PIXELS:
        raise RenderError(
            f"{camera.width} x {camera.height} px is too large to be drawn; the limits are "
            f"{MAX_SIDE} px a side and {MAX_PIXELS // 1_000_000} megapixels",
            where="camera",
            fix="scale the camera down",
        )
