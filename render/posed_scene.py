"""A scene in front of a camera: ray casting and shading."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.geometry.alignment import Alignment, model_rays
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import barycentric_of
from cadalign.geometry.pixels import perspective
from cadalign.geometry.raycaster import FaceArray, RayCaster
from cadalign.render.canvas import LinearArray
from cadalign.render.scene import Scene
from cadalign.render.surface import Studio

_MAX_LAYERS = 8
# A ray stops once less than this share of the light comes through.
_LEAST_TRANSMITTANCE = 1 / 64
# A ray goes on this far behind a transparent hit, in diagonals of the model.
_LAYER_GAP = 2e-5
# Pixels around the object.
_MARGIN = 2
_POINTS_PER_SIDE = 65


@dataclass(frozen=True)
class Rectangle:
    """A block of pixels: columns ``left`` to ``right - 1``, rows ``top`` to ``bottom - 1``."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def width(self) -> int:
        """Number of columns."""
        return self.right - self.left

    @property
    def height(self) -> int:
        """Number of rows."""
        return self.bottom - self.top

    @property
    def slices(self) -> tuple[slice, slice]:
        """Row and column slices for indexing images."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    def bands(self, rows: int) -> list[Rectangle]:
        """Cut the block into bands of at most ``rows`` rows, at least one."""
        step = max(1, rows)
        return [
            Rectangle(self.left, top, self.right, min(top + step, self.bottom))
            for top in range(self.top, self.bottom, step)
        ]

    @property
    def pixels(self) -> FloatArray:
        """Pixel centres, row by row, (n, 2)."""
        columns = np.arange(self.left, self.right, dtype=float)
        rows = np.arange(self.top, self.bottom, dtype=float)
        return np.stack(np.meshgrid(columns, rows), axis=2).reshape(-1, 2)


class PosedScene:
    """A scene in front of a camera, and the block of pixels that shows it; see `pose_scene`."""

    def __init__(
        self,
        scene: Scene,
        camera: Camera,
        cam_from_model: Alignment,
        block: Rectangle,
        caster: RayCaster,
    ) -> None:
        self.scene = scene
        self.camera = camera
        self.block = block
        self._caster = caster
        self.alignment = cam_from_model
        self._origin, self._model_from_ray = model_rays(cam_from_model)
        first = scene.triangles[:, 0]
        side = np.einsum("mk,mk->m", self._origin - first, scene.face_normals)
        self._side = np.where(side < 0, -1.0, 1.0)
        alike, opposite = scene.coincident_faces
        self._shown = np.where(side < 0, opposite, alike).astype(np.int32)
        self._normal_matrix = cam_from_model.rotation / cam_from_model.scale
        normals = scene.face_normals @ self._normal_matrix.T
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        self.normals: LinearArray = (normals * self._side[:, None]).astype(np.float32)
        """Unit face normals in the camera frame, (m, 3) float32, towards the camera."""

    def cast_pixels(self, pixels: FloatArray) -> tuple[FloatArray, FaceArray, FloatArray]:
        """Rays (n, 3) of pixels (n, 2), and the triangles and depths of their hits; see `cast`."""
        rays, valid = self.camera.rays_where_valid(pixels)
        face, depth = self.cast(rays)
        face[~valid] = -1
        return rays, face, depth

    def cast(
        self, rays: FloatArray, *, start: FloatArray | None = None
    ) -> tuple[FaceArray, FloatArray]:
        """Cast camera rays (n, 3); returns the triangles and depths of the hits, both (n,).

        Depth times ray is the point of the hit. The triangle is -1 without a hit.
        """
        directions = self._directions(rays)
        face, depth = self._caster.first_hits(self._origin, directions, start=start)
        # Show the coincident triangle that is wound towards the camera.
        return np.where(face >= 0, self._shown[face], np.int32(-1)), depth

    @cached_property
    def diagonal(self) -> float:
        """Diagonal of the stretched model's bounding box [model units]."""
        return self.scene.stretched_diagonal(self.alignment)

    def occlusion_mask(
        self, points_cam: FloatArray, directions: FloatArray, *, reach: float
    ) -> npt.NDArray[np.bool_]:
        """Mark rays that hit the object within a distance, (n,) bool.

        Starts ``points_cam`` and unit ``directions`` (n, 3) are in the camera frame, ``reach`` in
        model units.
        """
        columns = self._model_from_ray.T
        return self._caster.occlusion_mask(
            (points_cam - self.alignment.translation) @ columns, directions @ columns, reach=reach
        )

    def shade_hits(
        self, rays: FloatArray, face: FaceArray, depth: FloatArray, studio: Studio
    ) -> LinearArray:
        """Shade camera rays (n, 3) from their first hits, through transparent surfaces.

        Returns linear light, premultiplied, and opacity, (n, 4) float32.
        """
        result = np.zeros((len(face), 4), dtype=np.float32)
        active = np.flatnonzero(face >= 0)
        rays, face, depth = rays[active], face[active], depth[active]
        for _ in range(_MAX_LAYERS):
            color = self._shade(rays, face, depth, studio)
            seen = result[active]
            through = (1 - seen[:, 3]) * color[:, 3]
            seen[:, :3] += color[:, :3] * through[:, None]
            seen[:, 3] += through
            result[active] = seen
            going = np.flatnonzero(seen[:, 3] < 1 - _LEAST_TRANSMITTANCE)
            if not len(going):
                break
            rays, depth = rays[going], depth[going]
            along = self._directions(rays)
            speed = np.sqrt(np.einsum("nk,nk->n", along, along))
            face, depth = self.cast(rays, start=depth + _LAYER_GAP * self.scene.diagonal / speed)
            hit = np.flatnonzero(face >= 0)
            active, rays, face, depth = active[going[hit]], rays[hit], face[hit], depth[hit]
        return result

    def _shade(
        self, rays: FloatArray, face: FaceArray, depth: FloatArray, studio: Studio
    ) -> LinearArray:
        """Linear light and opacity of hits, not premultiplied, (n, 4)."""
        surface = self.scene.surface
        weights = self._weights(rays, face, depth)
        normal = self._smooth_normals(face, weights)
        color = surface.color(face, weights)
        view = (-rays).astype(np.float32)
        view /= np.sqrt(np.einsum("nk,nk->n", view, view))[:, None]
        up = self.alignment.rotation[:, 1]
        return np.column_stack([studio.shade(color[:, :3], normal, view, up), color[:, 3]])

    def _weights(self, rays: FloatArray, face: FaceArray, depth: FloatArray) -> LinearArray:
        """Barycentric coordinates of hits, (n, 3)."""
        points = self._origin + self._directions(rays) * depth[:, None]
        weights = barycentric_of(self.scene.triangles[face], points)
        # The float32 ray caster may hit slightly outside the triangle.
        return np.asarray(np.clip(np.nan_to_num(weights), 0, 1), dtype=np.float32)

    def _smooth_normals(self, face: FaceArray, weights: LinearArray) -> LinearArray:
        """Unit normals (n, 3) in the camera frame, interpolated between the triangles' corners."""
        blended = np.einsum("nc,nck->nk", weights, self.scene.corner_normals[face])
        turned = blended @ self._normal_matrix.T.astype(np.float32)
        length = np.sqrt(np.einsum("nk,nk->n", turned, turned))
        side = self._side[face].astype(np.float32)
        return np.asarray(turned * (side / np.maximum(length, np.float32(1e-30)))[:, None])

    def _directions(self, rays: FloatArray) -> FloatArray:
        """Convert camera rays (n, 3) to directions in the model frame."""
        return np.asarray(rays @ self._model_from_ray.T)


def pose_scene(
    scene: Scene, camera: Camera, cam_from_model: Alignment, *, caster: RayCaster | None = None
) -> PosedScene | None:
    """Place a scene in front of a camera; None if no pixel shows it.

    ``caster`` is the scene's by default.
    """
    block = _object_rectangle(scene, camera, cam_from_model)
    if block is None:
        return None
    return PosedScene(scene, camera, cam_from_model, block, caster or scene.caster)


def _object_rectangle(scene: Scene, camera: Camera, cam_from_model: Alignment) -> Rectangle | None:
    """Block of pixels around the object, with a margin; None if no pixel shows it."""
    points = scene.used_vertices @ cam_from_model.linear.T + cam_from_model.translation
    whole = Rectangle(0, 0, camera.width, camera.height)
    if camera.is_wide:
        return whole
    if points[:, 2].max() <= 0:
        return None
    if points[:, 2].min() <= 0:
        return whole
    normalized = perspective(points)
    outline = _outline(normalized.min(axis=0), normalized.max(axis=0))
    if not np.isfinite(outline).all() or not within_lens_field(camera, outline).all():
        return whole
    pixels = camera.pixels_of_rays(outline)
    size = (camera.width, camera.height)
    # Clip before converting to integers, which distant pixels would overflow.
    first = np.clip(np.floor(pixels.min(axis=0)) - _MARGIN, 0, size).astype(int)
    last = np.clip(np.ceil(pixels.max(axis=0)) + _MARGIN + 1, 0, size).astype(int)
    if (first >= last).any():
        return None
    return Rectangle(int(first[0]), int(first[1]), int(last[0]), int(last[1]))


def _outline(low: FloatArray, high: FloatArray) -> FloatArray:
    """Rays (n, 3) along the border of a rectangle in normalised coordinates."""
    share = np.linspace(0, 1, _POINTS_PER_SIDE)[:, None]
    corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
    following = np.roll(corners, -1, axis=0)
    lines = [a + share * (b - a) for a, b in zip(corners, following, strict=True)]
    return np.column_stack([np.concatenate(lines), np.ones(4 * _POINTS_PER_SIDE)])


_STEPS = 24


def within_lens_field(camera: Camera, points_cam: FloatArray) -> npt.NDArray[np.bool_]:
    """Mark points (n, 3) that are in front of the camera with a valid lens model, (n,) bool.

    A distortion polynomial decreases beyond some radius, and maps distant directions back into the
    image. A point is valid if the distorted radius grows all the way from the centre to it.
    """
    seen = camera.sees(points_cam)
    if camera.is_wide or not camera.distortion:
        return seen
    normalized = perspective(np.where(seen[:, None], points_cam, 1.0))
    share = np.linspace(0, 1, _STEPS + 1)
    path = (normalized[:, None, :] * share[:, None]).reshape(-1, 2)
    pixels = camera.pixels_from_normalized(path).reshape(len(normalized), _STEPS + 1, 2)
    step = np.diff((pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy), axis=1)
    growth = np.einsum("nsk,nk->ns", step, normalized)
    return np.asarray(seen & (growth >= 0).all(axis=1))


_MAX_THREADS = 8

_Part = TypeVar("_Part")


def draw_in_threads(draw: Callable[[_Part], None], parts: Sequence[_Part]) -> None:
    """Draw parts of a frame in threads; embree and NumPy release the interpreter lock."""
    if len(parts) == 1:
        draw(parts[0])
        return
    with ThreadPoolExecutor(min(os.cpu_count() or 1, _MAX_THREADS)) as pool:
        # Reading the results raises the errors of the threads.
        list(pool.map(draw, parts))
