"""Ambient occlusion: the share of the sky that is open to each seen point of the surface."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.render.drawing.canvas import ByteImage
from cadalign.render.raycast.posed import PosedScene, in_threads
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
# Points of the unit sphere, evenly spread, (16, 8, 3): each neighbour takes every 16th, so that
# each has some of all heights.
_NUMBER = np.arange(_RAYS * _TILE * _TILE) + 0.5
_HEIGHT = 1 - 2 * _NUMBER / len(_NUMBER)
_TURN = np.exp(1j * _NUMBER * np.pi * (3 - np.sqrt(5))) * np.sqrt(1 - _HEIGHT**2)
_SPHERE = np.column_stack([_TURN.real, _TURN.imag, _HEIGHT]).reshape(_RAYS, -1, 3).swapaxes(0, 1)
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
    block = posed.block
    covered = int(geometry.mask[block.slices].sum())
    step = max(1, int(np.ceil(np.sqrt(covered / _MAX_POINTS))))
    rows = np.arange(block.top + step // 2, block.bottom, step)
    columns = np.arange(block.left + step // 2, block.right, step)
    grid = np.ix_(rows, columns)
    hit = geometry.face_id[grid] >= 0
    depth = geometry.depth[grid].astype(np.float32)
    normal = geometry.normal[grid]
    inside = np.argwhere(hit)
    if not len(inside):
        return None
    pixels = np.column_stack([columns[inside[:, 1]], rows[inside[:, 0]]]).astype(float)
    rays, _ = posed.camera.rays_where_valid(pixels)
    points = rays * depth[hit][:, None]
    points += _LIFT * posed.diagonal * normal[hit]
    sky = np.zeros(hit.shape, dtype=np.float32)
    tile = (inside[:, 0] % _TILE) * _TILE + inside[:, 1] % _TILE

    def look(part: slice) -> None:
        directions = _sky_directions(normal[hit][part], tile[part]).reshape(-1, 3)
        blocked = posed.blocked(np.repeat(points[part], _RAYS, axis=0), directions, reach=reach)
        rows_of, columns_of = inside[part].T
        sky[rows_of, columns_of] = 1 - blocked.reshape(-1, _RAYS).mean(axis=1)

    begins = range(0, len(inside), _POINTS_AT_ONCE)
    in_threads(look, [slice(begin, begin + _POINTS_AT_ONCE) for begin in begins])
    smooth, alike = _share_with_neighbours(sky, hit, depth, normal, posed.diagonal)
    # A groove or a bevel narrower than the grid is hit here and there: its dashes would show.
    filled = _filled(smooth, hit & (alike >= _FEW_ALIKE))
    size = block.width, block.height
    return np.asarray(cv2.resize(filled, size, interpolation=cv2.INTER_LINEAR), np.float32)


def _sky_directions(normal: SingleImage, tile: npt.NDArray[np.int64]) -> FloatArray:
    """Unit directions (n, 8, 3) about normals (n, 3), dense where light falls straight."""
    # A point of the unit sphere about the normal's tip is that dense: cosine-weighted.
    towards = normal[:, None] + _SPHERE[tile]
    return np.asarray(towards / np.linalg.norm(towards, axis=2, keepdims=True))


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
    mean = np.where(hit, total / np.maximum(weight, 1), 1)
    return np.asarray(mean, dtype=np.float32), np.asarray(weight)


def _filled(sky: SingleImage, known: npt.NDArray[np.bool_]) -> SingleImage:
    """Spread known values to the places beside them, in place of what is there."""
    filled = np.where(known, sky, 0).astype(np.float32)
    weight = known.astype(np.float32)
    # Twice: the border of the object too takes the value beside it, or a bright rim would be left.
    for _ in range(2):
        total = cv2.boxFilter(filled, -1, (3, 3), normalize=False)
        count = cv2.boxFilter(weight, -1, (3, 3), normalize=False)
        empty = weight == 0
        filled = np.where(empty, total / np.maximum(count, 1), filled)
        weight = np.where(empty, count > 0, weight).astype(np.float32)
    return np.where(weight > 0, filled, sky)
