"""A scene seen by a camera: rays, hits and the light that comes back along them."""

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
from cadalign.geometry.pixels import perspective
from cadalign.geometry.raycaster import FaceArray, RayCaster
from cadalign.render.drawing.canvas import LinearArray
from cadalign.render.raycast.surface import Studio
from cadalign.render.scene import Scene

_MAX_LAYERS = 8
# What is hidden to this share is left out.
_SEEN_THROUGH = 1 / 64
# How far behind a transparent hit the ray goes on, in diagonals of the model.
_LAYER_GAP = 2e-5
# Pixels left about the object.
_MARGIN = 2
_POINTS_PER_SIDE = 65
_LEAST_COSINE = 0.05  # of a cone about the object


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
        """Rows [px]."""
        return self.bottom - self.top

    @property
    def slices(self) -> tuple[slice, slice]:
        """The block's rows and columns, to index images with."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    def tiles(self, width: int, height: int) -> list[Rectangle]:
        """Cut the block into tiles of at most this size, which is at least a pixel."""
        width, height = max(1, width), max(1, height)
        return [
            Rectangle(left, top, min(left + width, self.right), min(top + height, self.bottom))
            for top in range(self.top, self.bottom, height)
            for left in range(self.left, self.right, width)
        ]

    @property
    def pixels(self) -> FloatArray:
        """Pixel centres, row by row, (n, 2)."""
        pixels = np.empty((self.height, self.width, 2))
        pixels[:, :, 0] = np.arange(self.left, self.right)
        pixels[:, :, 1] = np.arange(self.top, self.bottom)[:, None]
        return pixels.reshape(-1, 2)


class PosedScene:
    """A scene placed before a camera, seen in a block of its pixels; made by `pose_scene`."""

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
        self._alignment = cam_from_model
        self._origin, self._model_from_ray = model_rays(cam_from_model)
        first = scene.triangles[:, 0]
        side = np.einsum("mk,mk->m", self._origin - first, scene.face_normals)
        self._side = np.where(side < 0, -1.0, 1.0)
        alike, opposite = scene.coincident_faces
        self._shown = np.where(side < 0, opposite, alike).astype(np.int32)
        self._normal_matrix = cam_from_model.rotation / cam_from_model.scale
        self.normals = self._to_camera(scene.face_normals)
        """The faces' unit normals in the camera frame, (m, 3) float32, on the side that is seen."""

    def prepare_color(self) -> None:
        """Make now what `light_of_hits` needs, before several threads ask for it at once."""
        _ = self.scene.surface, self.scene.single_corner_normals
        _ = self.scene.barycentric_gradients

    def cast(
        self, rays: FloatArray, *, start: FloatArray | None = None
    ) -> tuple[FaceArray, FloatArray]:
        """Find what is seen along rays (n, 3) of the camera: triangles and depths, both (n,).

        A depth is the multiple of its ray that leads to the hit.
        """
        directions = self._directions(rays)
        face, depth = self._caster.first_hits(self._origin, directions, start=start)
        return self._as_shown(face), depth

    def _as_shown(self, face: FaceArray) -> FaceArray:
        """Triangles that were hit, (n,): of coincident ones those wound to the camera."""
        return np.where(face >= 0, self._shown[face], np.int32(-1))

    def seen_sides(self, face_id: npt.NDArray[np.int32]) -> tuple[bool, bool]:
        """Tell if any triangle in an image is seen from its front, and any from its back."""
        seen = np.zeros(len(self._side) + 1, dtype=bool)
        # Where nothing is, -1 marks the last place, which is no triangle's.
        seen[face_id.ravel()] = True
        side = self._side[seen[:-1]]
        return bool((side > 0).any()), bool((side < 0).any())

    @cached_property
    def diagonal(self) -> float:
        """The diagonal of the stretched model's bounding box [model units]."""
        return self.scene.stretched_diagonal(self._alignment)

    def blocked(
        self, points_cam: FloatArray, directions: FloatArray, *, reach: float
    ) -> npt.NDArray[np.bool_]:
        """Find the rays that hit a part of the object within a distance, (n,) bool.

        ``points_cam`` and the unit ``directions`` (n, 3) are in the camera frame, ``reach`` in
        model units.
        """
        columns = self._model_from_ray.T
        return self._caster.blocked(
            (points_cam - self._alignment.translation) @ columns, directions @ columns, reach=reach
        )

    def mean_light(
        self,
        rays: FloatArray,
        valid: npt.NDArray[np.bool_],
        studio: Studio,
        *,
        samples: int,
    ) -> LinearArray:
        """Mean colour of each ``samples`` successive rays (n, 3) of the camera, cast anew.

        Linear light, premultiplied, and opacity: (n / samples, 4) float32. Rays that are not
        ``valid`` see nothing.
        """
        face, depth = self.cast(rays)
        face[~valid] = -1
        light = self.light_of_hits(rays, face, depth, studio)
        return np.asarray(light.reshape(-1, samples, 4).mean(axis=1))

    def light_of_hits(
        self, rays: FloatArray, face: FaceArray, depth: FloatArray, studio: Studio
    ) -> LinearArray:
        """Colour seen along rays (n, 3) of the camera whose first hits are known.

        Linear light, premultiplied, and opacity: (n, 4) float32.
        """
        result = np.zeros((len(face), 4), dtype=np.float32)
        active = np.flatnonzero(face >= 0)
        if self.scene.surface.opaque:
            result[active] = self._shade(rays[active], face[active], depth[active], studio)
            return result
        rays, face, depth = rays[active], face[active], depth[active]
        for _ in range(_MAX_LAYERS):
            if not len(active):
                break
            color = self._shade(rays, face, depth, studio)
            seen = result[active]
            through = (1 - seen[:, 3]) * color[:, 3]
            seen[:, :3] += color[:, :3] * through[:, None]
            seen[:, 3] += through
            result[active] = seen
            going = np.flatnonzero(seen[:, 3] < 1 - _SEEN_THROUGH)
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
        """Light and opacity (n, 4) of hits, not premultiplied."""
        surface = self.scene.surface
        weights = self._weights(rays, face, depth)
        normal = self._smooth_normals(face, weights)
        color = surface.color(face, weights)
        view = (-rays).astype(np.float32)
        view /= np.sqrt(np.einsum("nk,nk->n", view, view))[:, None]
        up = self._alignment.rotation[:, 1]
        return np.column_stack([studio.shade(color[:, :3], normal, view, up), color[:, 3]])

    def _weights(self, rays: FloatArray, face: FaceArray, depth: FloatArray) -> LinearArray:
        """Barycentric coordinates of hits, (n, 3)."""
        points = self._directions(rays) * depth[:, None]
        points += self._origin - self.scene.triangles[face, 0]
        later = np.einsum("nck,nk->nc", self.scene.barycentric_gradients[face], points)
        weights = np.column_stack([1 - later.sum(axis=1), later])
        # The float32 caster may hit a triangle a hair outside of it.
        return np.asarray(np.clip(weights, 0, 1), dtype=np.float32)

    def _smooth_normals(self, face: FaceArray, weights: LinearArray) -> LinearArray:
        """Unit normals (n, 3) in the camera frame, blended between the corners of triangles."""
        corners = self.scene.single_corner_normals[face]
        blended = weights[:, :1] * corners[:, 0]
        blended += weights[:, 1:2] * corners[:, 1]
        blended += weights[:, 2:] * corners[:, 2]
        turned = blended @ self._normal_matrix.T.astype(np.float32)
        length = np.sqrt(np.einsum("nk,nk->n", turned, turned))
        side = self._side[face].astype(np.float32)
        return np.asarray(turned * (side / np.maximum(length, np.float32(1e-30)))[:, None])

    def _directions(self, rays: FloatArray) -> FloatArray:
        """Directions (n, 3) in the model frame of the camera's."""
        return np.asarray(rays @ self._model_from_ray.T)

    def _to_camera(self, normals: FloatArray) -> LinearArray:
        rows = normals @ self._normal_matrix.T
        rows /= np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-30)
        return (rows * self._side[:, None]).astype(np.float32)


def pose_scene(
    scene: Scene, camera: Camera, cam_from_model: Alignment, *, caster: RayCaster | None = None
) -> PosedScene | None:
    """Place a scene before a camera; None if it is unseen. The caster is by default its own."""
    block = _object_rectangle(scene, camera, cam_from_model)
    if block is None:
        return None
    return PosedScene(scene, camera, cam_from_model, block, caster or scene.caster)


def _object_rectangle(scene: Scene, camera: Camera, cam_from_model: Alignment) -> Rectangle | None:
    """The block of pixels that holds all of the object and a margin; None if it is unseen."""
    points = scene.used_vertices @ cam_from_model.linear.T + cam_from_model.translation
    whole = Rectangle(0, 0, camera.width, camera.height)
    if camera.is_wide:
        outline = _cone_about(points)
    else:
        if points[:, 2].max() <= 0:
            return None
        if points[:, 2].min() <= 0:
            return whole
        normalized = perspective(points)
        if not np.isfinite(normalized).all():
            return whole
        outline = _outline(normalized.min(axis=0), normalized.max(axis=0))
    if not len(outline) or not within_lens_field(camera, outline).all():
        return whole
    pixels = camera.pixels_of_rays(outline)
    size = (camera.width, camera.height)
    # Clip before converting to whole numbers, which far-off pixels would overflow.
    first = np.clip(np.floor(pixels.min(axis=0)) - _MARGIN, 0, size).astype(int)
    last = np.clip(np.ceil(pixels.max(axis=0)) + _MARGIN + 1, 0, size).astype(int)
    if (first >= last).any():
        return None
    return Rectangle(int(first[0]), int(first[1]), int(last[0]), int(last[1]))


def _cone_about(points: FloatArray) -> FloatArray:
    """Directions (n, 3) along the border of a cone that holds all points; none of half a space.

    Nor of a cone about the direction straight behind, where a wide lens sees nothing.
    """
    rays = points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-300)
    axis = rays.mean(axis=0)
    axis /= max(float(np.linalg.norm(axis)), 1e-300)
    cosine = float((rays @ axis).min())
    if cosine < _LEAST_COSINE or -axis[2] > cosine:
        return np.empty((0, 3))
    across = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.9 else [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    angles = np.linspace(0, 2 * np.pi, 4 * _POINTS_PER_SIDE)[:, None]
    ring = np.cos(angles) * across + np.sin(angles) * np.cross(axis, across)
    return np.asarray(cosine * axis + np.sqrt(1 - cosine**2) * ring)


def _outline(low: FloatArray, high: FloatArray) -> FloatArray:
    """Directions (n, 3) along the border of a rectangle of normalised ones."""
    share = np.linspace(0, 1, _POINTS_PER_SIDE)[:, None]
    corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
    following = np.roll(corners, -1, axis=0)
    lines = [a + share * (b - a) for a, b in zip(corners, following, strict=True)]
    return np.column_stack([np.concatenate(lines), np.ones(4 * _POINTS_PER_SIDE)])


_STEPS = 24


def within_lens_field(camera: Camera, points_cam: FloatArray) -> npt.NDArray[np.bool_]:
    """Find the points up to which the lens model maps outer points farther out than inner ones.

    A distortion polynomial turns back at some radius and from there on folds far-off directions
    into the image. Points beyond are not seen by the camera, wherever the model puts them.
    Returns (n,) bool for points (n, 3): the camera sees them, and the distorted radius grows all
    the way from the centre to the point.
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


def in_threads(draw: Callable[[_Part], None], parts: Sequence[_Part]) -> None:
    """Draw parts of a frame side by side; embree and NumPy let go of the interpreter lock."""
    if len(parts) == 1:
        draw(parts[0])
        return
    with ThreadPoolExecutor(min(os.cpu_count() or 1, _MAX_THREADS)) as pool:
        # Asking for the results raises what a part has raised.
        list(pool.map(draw, parts))
