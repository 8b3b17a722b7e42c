"""Triangle meshes with colours and textures, and points on their surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.errors import DataError, InputError

GREY = (0.7, 0.7, 0.7, 1.0)
_DAMAGED = "the file is cut short or damaged"

# Thresholds on keypoints relative to the mesh's diagonal, to find wrong units.
_MARGIN = 0.3  # distance by which keypoints may lie outside the mesh's box
_FAR = 1.0  # distance beyond which keypoints belong to another model
_LEAST_SHARE = 0.3  # least span of keypoints in the mesh's unit
_SMALL = 0.05  # span below which keypoints may be in a larger unit
_UNITS = {
    1000.0: "in millimetres beside a mesh in metres",
    100.0: "in centimetres beside a mesh in metres",
    25.4: "in millimetres beside a mesh in inches",
    10.0: "in millimetres beside a mesh in centimetres",
    0.01: "in metres beside a mesh in centimetres",
    0.001: "in metres beside a mesh in millimetres",
}
"""Likely units, by the size of the keypoints over the size of the mesh."""


@dataclass(frozen=True, eq=False)
class Material:
    """Appearance of a part of a surface."""

    name: str = ""
    """The material's name in its file."""
    color: tuple[float, float, float, float] = GREY
    """Red, green, blue and opacity, 0 to 1; multiplied with the texture if there is one."""
    texture: npt.NDArray[np.uint8] | None = None
    """Image (h, w, 3 or 4), first row at the top. Texture coordinates (0, 0) are its bottom
    left."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh in model coordinates.

    Raises
    ------
    DataError
        If there are no faces, an index is out of range, a vertex is not finite, or shapes don't
        match.
    """

    vertices: FloatArray
    """Positions (n, 3) [model units]."""
    faces: IntArray
    """Vertex numbers of the triangles (m, 3), in file order."""
    polygon: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """Number (m,) of each triangle's face in the file: the two triangles of a quad share one. By
    default ``0 ... m - 1``."""
    vertex_colors: FloatArray | None = None
    """Red, green, blue and opacity (n, 4), 0 to 1."""
    corner_uv: FloatArray | None = None
    """Texture coordinates of each triangle's corners (m, 3, 2)."""
    materials: tuple[Material, ...] = (Material(),)
    """Materials that ``face_material`` indexes."""
    face_material: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """Index of each triangle's material (m,); by default 0."""
    source: str = "mesh"
    """File or id that the mesh comes from, for messages."""

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices, dtype=np.float64)
        faces = np.ascontiguousarray(self.faces, dtype=np.int64)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
            what = f"vertices {vertices.shape} and faces {faces.shape} are not a triangle mesh"
            raise DataError(what, where=self.source)
        if not len(faces):
            raise DataError("the mesh has no faces", where=self.source)
        if not np.isfinite(vertices).all():
            raise DataError("the mesh has NaN or infinite vertices", where=self.source)
        if faces.min() < 0 or faces.max() >= len(vertices):
            named = faces.min() if faces.min() < 0 else faces.max()
            what = f"a face names vertex {named}, but there are {len(vertices)}"
            raise DataError(what, where=self.source, fix=_DAMAGED)
        count = len(faces)
        polygon = self.polygon if len(self.polygon) else np.arange(count)
        material = self.face_material if len(self.face_material) else np.zeros(count, dtype=int)
        own = {"vertices": vertices, "faces": faces}
        own |= {"polygon": polygon.astype(np.int64), "face_material": material.astype(np.int64)}
        for name, array, shape in (
            ("polygon", polygon, (count,)),
            ("face_material", material, (count,)),
            ("vertex_colors", self.vertex_colors, (len(vertices), 4)),
            ("corner_uv", self.corner_uv, (count, 3, 2)),
        ):
            if array is not None and array.shape != shape:
                raise DataError(f"{name} has shape {array.shape}, not {shape}", where=self.source)
        for name, value in own.items():
            object.__setattr__(self, name, value)

    @classmethod
    def from_polygons(
        cls,
        vertices: FloatArray,
        corners: IntArray,
        sizes: IntArray,
        *,
        corner_uv: FloatArray | None = None,
        polygon_material: IntArray | None = None,
        **fields: Any,
    ) -> Mesh:
        """Make a mesh from polygons; each is cut into a fan of triangles.

        Parameters
        ----------
        vertices : (n, 3) float
            Positions [model units].
        corners : (c,) int
            Vertex numbers of all polygons' corners, one polygon after the other.
        sizes : (p,) int
            Number of corners of each polygon, at least 3.
        corner_uv : (c, 2) float, optional
            Texture coordinates of the corners.
        polygon_material : (p,) int, optional
            Index of each polygon's material.
        **fields
            Further fields of the mesh.

        Raises
        ------
        DataError
            See `Mesh`; also if a polygon has fewer than 3 corners.
        """
        if len(sizes) and sizes.min() < 3:
            what = f"face {int(sizes.argmin())} has {sizes.min()} corners"
            raise DataError(what, where=fields.get("source"), fix=_DAMAGED)
        counts = sizes - 2
        polygon = np.repeat(np.arange(len(sizes)), counts)
        step = np.arange(len(polygon)) - np.repeat(np.cumsum(counts) - counts, counts)
        first = (np.cumsum(sizes) - sizes)[polygon]
        triangles = np.stack([first, first + step + 1, first + step + 2], axis=1)
        if corner_uv is not None:
            fields["corner_uv"] = corner_uv[triangles]
        if polygon_material is not None:
            fields["face_material"] = polygon_material[polygon]
        return cls(vertices, corners[triangles], polygon, **fields)

    @property
    def bounds(self) -> FloatArray:
        """Least and greatest coordinates of the vertices that faces use, (2, 3) float."""
        used = self.vertices[self.is_used]
        return np.array([used.min(axis=0), used.max(axis=0)])

    @property
    def is_used(self) -> BoolArray:
        """Mask of the vertices that faces use, (n,) bool."""
        used = np.zeros(len(self.vertices), dtype=bool)
        used[self.faces] = True
        return used

    @property
    def triangles(self) -> FloatArray:
        """Corners of all triangles, (m, 3, 3) float."""
        return np.asarray(self.vertices[self.faces])

    def stretch(self, scale: npt.ArrayLike) -> Mesh:
        """Multiply the coordinates by ``scale`` (3,); returns a new mesh."""
        return replace(self, vertices=self.vertices * np.asarray(scale, dtype=float))

    def surface_points(self, face_index: npt.ArrayLike, barycentric: npt.ArrayLike) -> FloatArray:
        """Points on the surface from face numbers and barycentric coordinates.

        Parameters
        ----------
        face_index : (k,) int
            Face numbers in the file. For a polygon its first triangle is used.
        barycentric : (k, 3) float
            Weights of the face's corners in file order; they are normalised to sum to 1.

        Returns
        -------
        (k, 3) float

        Raises
        ------
        InputError
            If a face number is not in the mesh.
        """
        index = np.atleast_1d(np.asarray(face_index, dtype=np.int64))
        weights = np.asarray(barycentric, dtype=float).reshape(len(index), 3)
        triangle = np.searchsorted(self.polygon, index)
        known = (triangle < len(self.faces)) & (index >= 0)
        known[known] = self.polygon[triangle[known]] == index[known]
        if not known.all():
            has = f"which has faces 0 to {self.polygon[-1]}"
            what = f"face {index[~known][0]} is not in {self.source}, {has}"
            raise InputError(what, where="face_index")
        weights = weights / weights.sum(axis=1, keepdims=True)
        return np.asarray(np.einsum("kc,kcd->kd", weights, self.triangles[triangle]))

    def closest(self, points: npt.ArrayLike) -> tuple[IntArray, FloatArray]:
        """Triangle and barycentric coordinates of the surface point nearest to each point.

        Parameters
        ----------
        points : (k, 3) float

        Returns
        -------
        (k,) int, (k, 3) float
            Arguments for `surface_points` of a mesh of triangles.
        """
        import trimesh

        functions: Any = trimesh  # which has no types
        body = trimesh.Trimesh(self.vertices, self.faces, process=False)
        places, _, faces = functions.proximity.closest_point_naive(body, points)
        weights = functions.triangles.points_to_barycentric(self.triangles[faces], places).clip(0)
        return faces, weights / weights.sum(axis=1, keepdims=True)

    def __repr__(self) -> str:
        materials = f", {len(self.materials)} materials" if len(self.materials) > 1 else ""
        size = f"{len(self.vertices)} vertices, {len(self.faces)} faces"
        return f"Mesh({self.source!r}, {size}{materials})"


def join(pieces: Sequence[Mesh], source: str) -> Mesh:
    """Concatenate meshes, for example those of a file."""
    starts = np.cumsum([0, *(len(piece.vertices) for piece in pieces)])
    materials = list(dict.fromkeys(each for piece in pieces for each in piece.materials))
    number = {each: k for k, each in enumerate(materials)}
    colored = any(piece.vertex_colors is not None for piece in pieces)
    textured = any(piece.corner_uv is not None for piece in pieces)
    uv = [
        np.zeros((len(piece.faces), 3, 2)) if piece.corner_uv is None else piece.corner_uv
        for piece in pieces
    ]
    return Mesh(
        vertices=np.concatenate([piece.vertices for piece in pieces]),
        faces=np.concatenate([k + piece.faces for k, piece in zip(starts, pieces, strict=False)]),
        vertex_colors=np.concatenate([*map(spread_colors, pieces)]) if colored else None,
        corner_uv=np.concatenate(uv) if textured else None,
        materials=tuple(materials),
        face_material=np.concatenate(
            [np.array([number[m] for m in each.materials])[each.face_material] for each in pieces]
        ),
        source=source,
    )


def spread_colors(mesh: Mesh, palette: FloatArray | None = None) -> FloatArray:
    """Vertex colours (n, 4) of a mesh.

    A mesh without vertex colours gets those of its materials, or of a palette (k, 4) with a colour
    for each material.
    """
    if mesh.vertex_colors is not None:
        return mesh.vertex_colors
    if palette is None:
        palette = np.array([material.color for material in mesh.materials])
    colors = np.ones((len(mesh.vertices), 4))
    colors[mesh.faces] = palette[mesh.face_material][:, None]
    return colors


def barycentric_of(triangles: FloatArray, points: FloatArray) -> FloatArray:
    """Barycentric coordinates (n, 3) of points (n, 3) in triangles (n, 3, 3).

    They are not finite for triangles without area.
    """
    edges, offsets = triangles[:, 1:] - triangles[:, :1], points - triangles[:, 0]
    a, b = np.einsum("nik,nk->in", edges, offsets)
    (aa, ab), (_, bb) = np.einsum("nik,njk->ijn", edges, edges)
    with np.errstate(divide="ignore", invalid="ignore"):
        later = np.stack([bb * a - ab * b, aa * b - ab * a]) / (aa * bb - ab * ab)
    return np.column_stack([1 - later.sum(axis=0), *later])


def face_normals(triangles: FloatArray) -> FloatArray:
    """Unit normals of triangles (m, 3, 3), (m, 3) float; zero for triangles without area."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(normals / np.where(length > 0, length, 1.0))


def check_near(points_3d: FloatArray, bounds: FloatArray, *, where: str) -> None:
    """Refuse keypoints that lie far from their mesh; the message names a likely unit mistake.

    Parameters
    ----------
    points_3d : (k, 3) float
        Keypoints of the model [model units].
    bounds : (2, 3) float
        Least and greatest coordinates of its mesh [model units].
    where : str
        Name of the keypoints, for the message.

    Raises
    ------
    InputError
        If the keypoints fit the mesh only in another unit, or a keypoint lies more than a diagonal
        away from the mesh's box.
    """
    diagonal = float(np.linalg.norm(bounds[1] - bounds[0]))
    if not len(points_3d) or not diagonal > 0:
        return
    span = float(np.linalg.norm(np.ptp(points_3d, axis=0)))
    outside = _distances_from_box(points_3d, bounds)
    if outside.max() > _MARGIN * diagonal or span < _SMALL * diagonal:
        fitting = [
            factor
            for factor in _UNITS
            if span >= _LEAST_SHARE * factor * diagonal
            and _distances_from_box(points_3d / factor, bounds).max() <= _MARGIN * diagonal
        ]
        if fitting and span > 0:
            factor = min(fitting, key=lambda each: abs(np.log(span / (each * diagonal))))
            raise InputError(
                f"the keypoints span {span:.3g} model units, the mesh {diagonal:.3g}: they fit "
                f"if divided by {factor:g}, as keypoints {_UNITS[factor]} do",
                where=where,
                fix=f"give both in one unit: multiply the keypoints by {1 / factor:g}",
            )
    if outside.max() > _FAR * diagonal:
        row = int(outside.argmax())
        what = f"keypoint {row} lies {outside[row] / diagonal:.3g} mesh diagonals from the mesh"
        fix = "give the keypoints and the mesh of one model, in the same coordinates"
        raise InputError(what, where=where, fix=fix)


def _distances_from_box(points: FloatArray, bounds: FloatArray) -> FloatArray:
    """Distances (k,) of points (k, 3) from a box, 0 inside."""
    beyond = np.maximum(bounds[0] - points, points - bounds[1]).clip(0)
    return np.asarray(np.linalg.norm(beyond, axis=1))
