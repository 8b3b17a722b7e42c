"""Ambient occlusion: the share of the sky that is open to each seen point of the surface."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.render.drawing.canvas import ByteImage
from cadalign.render.raycast.posed import PosedScene, Rectangle, in_threads
from cadalign.render.raycast.surface import Studio
from cadalign.render.scene import Geometry

SingleImage = npt.NDArray[np.float32]

# Rays of a point; each of 4 x 4 neighbours has its own, and shares what they find.
_RAYS = 8
_TILE = 4
# Above this many pixels of the object every second, third, ... row and column is enough.
_MAX_POINTS = 12_000
# How far off the surface rays start, in diagonals.
_LIFT = 2e-3
_SAME_SIDE = 0.85
_FEW_ALIKE = 6
_POINTS_AT_ONCE = 1 << 12
# Encoded values are about the 2.2th root of light.
_ENCODING = 1 / 2.2


def darken_corners(color: ByteImage, geometry: Geometry, posed: PosedScene, studio: Studio) -> None:
    """Darken, in place, corners and places under other parts of the object."""
    if studio.occlusion <= 0:
        return
    openness = _openness(geometry, posed, studio.occlusion_reach * posed.diagonal)
    if openness is None:
        return
    factor = (1 - studio.occlusion * (1 - openness)) ** np.float32(_ENCODING)
    part = color[posed.block.slices]
    part[:, :, :3] = (part[:, :, :3] * factor[:, :, None] + 0.5).astype(np.uint8)


def _openness(geometry: Geometry, posed: PosedScene, reach: float) -> SingleImage | None:
    """Share of the sky that the block's pixels see, (h, w) float32; None without pixels."""
    block, camera = posed.block, posed.camera
    covered = int(geometry.mask[block.slices].sum())
    if not covered:
        return None
    step = max(1, int(np.ceil(np.sqrt(covered / _MAX_POINTS))))
    rows = np.arange(block.top + step // 2, max(block.bottom, block.top + step // 2 + 1), step)
    columns = np.arange(block.left + step // 2, max(block.right, block.left + step // 2 + 1), step)
    rows, columns = rows[rows < camera.height], columns[columns < camera.width]
    grid = np.ix_(rows, columns)
    hit = geometry.face_id[grid] >= 0
    depth = geometry.depth[grid].astype(np.float32)
    normal = geometry.normal[grid]
    inside = np.argwhere(hit)
    if not len(inside):
        return None
    pixels = np.column_stack([columns[inside[:, 1]], rows[inside[:, 0]]]).astype(float)
    rays, _ = camera.rays_where_valid(pixels)
    points = rays * depth[hit][:, None]
    points += _LIFT * posed.diagonal * normal[hit]
    sky = np.zeros(hit.shape, dtype=np.float32)
    tile = (inside[:, 0] % _TILE) * _TILE + inside[:, 1] % _TILE

    def look(part: slice) -> None:
        directions = _around(normal[hit][part], _sky_directions()[tile[part]])
        blocked = posed.blocked(np.repeat(points[part], _RAYS, axis=0), directions, reach=reach)
        rows_of, columns_of = inside[part].T
        sky[rows_of, columns_of] = 1 - blocked.reshape(-1, _RAYS).mean(axis=1)

    begins = range(0, len(inside), _POINTS_AT_ONCE)
    in_threads(look, [slice(begin, begin + _POINTS_AT_ONCE) for begin in begins])
    smooth, alike = _share_with_neighbours(sky, hit, depth, normal, posed.diagonal)
    # A groove or a bevel narrower than the grid is hit here and there: its dashes would show.
    filled = _filled(smooth, hit & (alike >= _FEW_ALIKE))
    coarse = np.where(np.isnan(filled), np.where(hit, smooth, 1), filled).astype(np.float32)
    return coarse if step == 1 else _enlarge(coarse, block, step)


@cache
def _sky_directions() -> SingleImage:
    """Directions about +z, dense where light falls straight; (16, 8, 3) float32."""
    count = _RAYS * _TILE * _TILE
    # Evenly spread over the disc below and lifted to the hemisphere: cosine-weighted.
    number = np.arange(count) + 0.5
    radius = np.sqrt(number / count)
    angle = number * np.pi * (3 - np.sqrt(5))
    up = np.sqrt(1 - radius**2)
    spread = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), up])
    # Each neighbour takes every 16th, so that each has some of all heights.
    return spread.reshape(_RAYS, _TILE * _TILE, 3).transpose(1, 0, 2).astype(np.float32)


def _around(normal: SingleImage, directions: SingleImage) -> FloatArray:
    """Turn directions (n, r, 3) about +z to be about unit normals (n, 3); (n r, 3).

    A frame without branches: T. Duff et al., "Building an Orthonormal Basis, Revisited", JCGT 2017.
    """
    x, y, z = normal.T
    sign = np.where(z < 0, np.float32(-1), np.float32(1))
    a = -1 / (sign + z)
    b = x * y * a
    first = np.stack([1 + sign * x * x * a, sign * b, -sign * x], axis=1)
    second = np.stack([b, sign + y * y * a, -y], axis=1)
    frame = np.stack([first, second, normal], axis=1)
    return np.asarray((directions @ frame).reshape(-1, 3))


def _share_with_neighbours(
    sky: SingleImage,
    hit: npt.NDArray[np.bool_],
    depth: SingleImage,
    normal: SingleImage,
    diagonal: float,
) -> tuple[SingleImage, SingleImage]:
    """Average over the 4 x 4 neighbours on the same piece of surface, and how many those are."""
    rows, columns = hit.shape
    before, after = _TILE // 2, _TILE - _TILE // 2 - 1
    pad = ((before, after), (before, after))
    wide_sky, wide_hit = np.pad(sky, pad), np.pad(hit, pad)
    wide_depth = np.pad(depth, pad)
    wide_normal = np.pad(normal, (*pad, (0, 0)))
    total = np.zeros(hit.shape, dtype=np.float32)
    weight = np.zeros(hit.shape, dtype=np.float32)
    for down in range(_TILE):
        for right in range(_TILE):
            near = (slice(down, down + rows), slice(right, right + columns))
            alike = np.einsum("rck,rck->rc", wide_normal[near], normal) > _SAME_SIDE
            alike &= wide_hit[near]
            alike &= np.abs(wide_depth[near] - depth) < 0.03 * diagonal
            total += np.where(alike, wide_sky[near], 0)
            weight += alike
    return np.asarray(total / np.maximum(weight, 1), dtype=np.float32), np.asarray(weight)


def _filled(sky: SingleImage, known: npt.NDArray[np.bool_]) -> SingleImage:
    """Spread known values to the places beside them; NaN where none is near."""
    filled = np.where(known, sky, 0).astype(np.float32)
    weight = known.astype(np.float32)
    # Twice: the border of the object too takes the value beside it, or a bright rim would be left.
    for _ in range(2):
        total = cv2.boxFilter(filled, -1, (3, 3), normalize=False)
        count = cv2.boxFilter(weight, -1, (3, 3), normalize=False)
        empty = weight == 0
        filled = np.where(empty, total / np.maximum(count, 1), filled)
        weight = np.where(empty, count > 0, weight).astype(np.float32)
    return np.where(weight > 0, filled, np.float32(np.nan))


def _enlarge(sky: SingleImage, block: Rectangle, step: int) -> SingleImage:
    """Bring the coarse grid to the block's pixels."""
    rows = (np.arange(block.height, dtype=np.float32) - step // 2) / step
    columns = (np.arange(block.width, dtype=np.float32) - step // 2) / step
    at_x, at_y = np.meshgrid(columns, rows)
    enlarged = cv2.remap(sky, at_x, at_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(enlarged, dtype=np.float32)
