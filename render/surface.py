"""Shading: colours of a mesh, smooth normals, coincident faces, and the lights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, IntArray
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.raycaster import FaceArray
from cadalign.geometry.simplify import number_rows
from cadalign.render.canvas import LinearArray, linear_from_bytes, linear_from_srgb


class SurfaceColors:
    """The colours of a mesh, in linear light.

    Vertex colours replace the materials' colours; textures are multiplied with them. Textures
    repeat outside [0, 1]; v points up from the bottom row.
    """

    def __init__(self, mesh: Mesh) -> None:
        plain = np.array([material.color for material in mesh.materials], dtype=np.float32)
        self._face_color = linear_colors(plain)[mesh.face_material]
        self._corner_color: LinearArray | None = None
        if mesh.vertex_colors is not None:
            self._corner_color = linear_colors(mesh.vertex_colors)[mesh.faces]
        self._face_material = mesh.face_material
        self._corner_uv = None if mesh.corner_uv is None else mesh.corner_uv.astype(np.float32)
        self._textures: dict[int, LinearArray] = {}
        if mesh.corner_uv is not None:
            self._textures = {
                number: _linear_texture(material.texture)
                for number, material in enumerate(mesh.materials)
                if material.texture is not None
            }

    @property
    def opaque(self) -> bool:
        """True if the whole surface is opaque."""
        color = self._face_color if self._corner_color is None else self._corner_color
        return bool((color[..., 3] >= 1).all()) and all(
            bool((texture[..., 3] >= 1).all()) for texture in self._textures.values()
        )

    def color(self, face: FaceArray, weights: LinearArray) -> LinearArray:
        """Linear colour and opacity (n, 4), not premultiplied, at points of triangles (n,).

        ``weights`` (n, 3) are the points' barycentric coordinates.
        """
        if self._corner_color is None:
            color = self._face_color[face]
        else:
            color = np.einsum("nc,nck->nk", weights, self._corner_color[face])
        if self._corner_uv is None:
            return color
        material = self._face_material[face]
        for number, texture in self._textures.items():
            chosen = np.flatnonzero(material == number)
            if len(chosen):
                uv = np.einsum("nc,nck->nk", weights[chosen], self._corner_uv[face[chosen]])
                color[chosen] *= sample_texture(texture, uv)
        return color


def linear_colors(color: npt.NDArray[Any]) -> LinearArray:
    """Decode sRGB colours with opacity (n, 4), 0 to 1, to linear light; float32."""
    linear = color.astype(np.float32)
    linear[:, :3] = linear_from_srgb(linear[:, :3])
    return linear


def sample_texture(texture: LinearArray, uv: LinearArray) -> LinearArray:
    """Sample a texture (h, w, 4) bilinearly at texture coordinates (n, 2); (n, 4) float32."""
    from scipy.ndimage import map_coordinates  # takes time to import

    height, width = texture.shape[:2]
    u, v = np.where(np.isfinite(uv), uv % 1.0, 0.0).T
    at = [(1 - v) * height - 0.5, u * width - 0.5]
    channels = [map_coordinates(texture[:, :, k], at, order=1, mode="grid-wrap") for k in range(4)]
    return np.stack(channels, axis=1)


def _linear_texture(texture: npt.NDArray[np.uint8]) -> LinearArray:
    """Convert an image (h, w, 3 or 4) to linear light with opacity, (h, w, 4)."""
    result = np.ones((*texture.shape[:2], 4), dtype=np.float32)
    result[:, :, : texture.shape[2]] = texture / np.float32(255)
    result[:, :, :3] = linear_from_bytes(texture[:, :, :3])
    return result


def coincident_faces(vertices: FloatArray, faces: IntArray) -> tuple[IntArray, IntArray]:
    """Find the first triangles with the same corners and the same, and the opposite, winding.

    Modellers such as SketchUp write every face twice, with opposite windings and the materials of
    its front and back. The triangle wound towards the viewer is the one to show. Both results are
    (m,) int; where no triangle has the opposite winding, they are the same.
    """
    corners = number_rows(vertices)[faces]
    place = number_rows(np.sort(corners, axis=1))
    a, b, c = corners.T
    # The winding is the parity of the swaps that sort the corners.
    winding = (((a > b) ^ (b > c)) ^ (a > c)).astype(np.int64)
    none = len(faces)
    first = np.full((place.max() + 1, 2), none)
    np.minimum.at(first, (place, winding), np.arange(none))
    alike = first[place, winding]
    opposite = first[place, 1 - winding]
    return alike, np.where(opposite < none, opposite, alike)


# A point where more triangles meet stays faceted: the number of pairs is quadratic.
_MAX_VALENCE = 1024
_PAIRS_AT_ONCE = 1 << 20
_SMOOTH_COSINE = np.cos(np.radians(40.0))


def corner_normals(vertices: FloatArray, faces: IntArray, face_normals: FloatArray) -> FloatArray:
    """Smooth unit normals at the faces' corners, (m, 3, 3), on the side of the face.

    The normals of adjacent faces are averaged, weighted by their angles at the corner. Faces are
    adjacent where their vertices have the same position, even if they don't share the vertex. An
    angle of more than 40 degrees between faces is an edge. A face of opposite orientation counts
    with its normal reversed, since many CAD models have faces of random orientation.
    """
    point = number_rows(vertices)[faces].ravel()
    weight = _corner_angles(vertices[faces]).ravel()
    normals = np.repeat(face_normals, 3, axis=0)
    order = np.argsort(point, kind="stable")
    valence = np.bincount(point)
    start = np.cumsum(valence) - valence
    result = normals.copy()
    for count in np.unique(valence):
        if count < 2 or count > _MAX_VALENCE:  # no face uses a point of valence 0
            continue
        first = start[valence == count]
        step = max(1, _PAIRS_AT_ONCE // int(count) ** 2)
        for begin in range(0, len(first), step):
            corners = order[first[begin : begin + step, None] + np.arange(count)]
            result[corners] = _smooth(normals[corners], weight[corners])
    return result.reshape(-1, 3, 3)


def _smooth(normals: FloatArray, weight: FloatArray) -> FloatArray:
    """Average the normals (g, c, 3) of g points, each with c corners."""
    cosine = normals @ normals.transpose(0, 2, 1)
    share = np.where(np.abs(cosine) >= _SMOOTH_COSINE, np.sign(cosine) * weight[:, None, :], 0)
    total = share @ normals
    length = np.linalg.norm(total, axis=2, keepdims=True)
    return np.where(length > 1e-9, total / np.where(length > 0, length, 1.0), normals)


def _corner_angles(triangles: FloatArray) -> FloatArray:
    """Angles at the corners of triangles (m, 3, 3), in radians, (m, 3)."""
    after = np.roll(triangles, -1, axis=1) - triangles
    before = np.roll(triangles, 1, axis=1) - triangles
    scale = np.linalg.norm(after, axis=2) * np.linalg.norm(before, axis=2)
    cosine = np.einsum("mck,mck->mc", after, before) / np.where(scale > 0, scale, 1.0)
    return np.asarray(np.arccos(np.clip(cosine, -1, 1)))


Direction = tuple[float, float, float]

# Least albedo: perfectly black parts would show no shape.
DARKEST = 0.015


@dataclass(frozen=True)
class Studio:
    """Lights: two fixed relative to the camera, and an ambient light from above.

    Parameters
    ----------
    key, fill : tuple of 3 float
        Direction towards the light in the camera frame (x right, y down, z forward).
    key_power, fill_power, sky_power, ground_power : float
        Light reflected by a white surface that faces the light, the sky or the ground.
    wrap : float
        Size of the lights, which reach around the object: 0 (a point) to 1 (a hemisphere).
    gloss, gloss_exponent : float
        Strength and sharpness of the key light's highlight.
    occlusion, occlusion_reach : float
        Ambient occlusion: share of the light lost where other parts of the object hide the whole
        sky, and their largest distance, in diagonals of the object; 0 turns it off.
    """

    key: Direction = (-0.55, -0.75, -0.75)
    fill: Direction = (0.9, -0.15, -0.6)
    key_power: float = 0.60
    fill_power: float = 0.12
    sky_power: float = 0.28
    ground_power: float = 0.08
    wrap: float = 0.25
    gloss: float = 0.08
    gloss_exponent: float = 40.0
    occlusion: float = 0.7
    occlusion_reach: float = 0.2

    def shade(
        self, albedo: LinearArray, normal: LinearArray, view: LinearArray, up: FloatArray
    ) -> LinearArray:
        """Linear light (n, 3) that surface points reflect towards the camera.

        ``albedo`` (n, 3) is linear colour. The others are unit vectors in the camera frame:
        ``normal`` (n, 3), ``view`` (n, 3) from the points to the camera, ``up`` (3,) to the sky.
        """
        key, fill = _unit(self.key), _unit(self.fill)
        towards_sky = 0.5 + 0.5 * (normal @ up.astype(np.float32))
        light = (
            np.float32(self.ground_power)
            + np.float32(self.sky_power - self.ground_power) * towards_sky
            + np.float32(self.key_power) * self._diffuse(normal @ key)
            + np.float32(self.fill_power) * self._diffuse(normal @ fill)
        )
        halfway = view + key
        halfway /= np.sqrt(np.einsum("nk,nk->n", halfway, halfway))[:, None]
        facing = np.maximum(np.einsum("nk,nk->n", normal, halfway), 0)
        shine = np.float32(self.gloss) * facing ** np.float32(self.gloss_exponent)
        lifted = np.float32(DARKEST) + np.float32(1 - DARKEST) * albedo
        return np.asarray(lifted * light[:, None] + shine[:, None], dtype=np.float32)

    def _diffuse(self, cosine: LinearArray) -> LinearArray:
        wrap = np.float32(self.wrap)
        return np.asarray(np.maximum((cosine + wrap) / (1 + wrap), 0), dtype=np.float32)


def _unit(direction: Direction) -> LinearArray:
    vector = np.array(direction, dtype=np.float32)
    return np.asarray(vector / np.linalg.norm(vector), dtype=np.float32)
