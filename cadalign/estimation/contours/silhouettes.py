"""Poses and stretches of a model whose silhouette resembles a mask's, without any start.

Seen from afar, a stretched model under any pose is an affine image of the model, and silhouettes
along one direction of the model differ by an affine map of the plane: whitened by their second
moments, by a turn or a reflection. So silhouettes along directions all around are rendered once for
a model, compared with the mask's at all turns, and each that resembles it gives an affine camera.
Where a part of the object may be hidden or outside of the image, those that lines cut off are, too.
Of ``M = R[:2] S / Z``, for the rows of ``M S^-1`` are orthogonal and of one length, the stretch
follows by two linear equations in the inverse squares of its scales.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import cv2
import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.estimation.contours.atlas import (
    Atlas,
    Whitened,
    atlas_of,
    coarse,
    cut_atlas_of,
    overlaps,
    turn_of,
    whitened,
)
from cadalign.estimation.contours.contour import Image
from cadalign.geometry.alignment import Alignment, model_rays
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh

_CELLS = 80  # of a mask's image
_LINE_ANGLES = 16  # of what hides a part
_HIDDEN_POWER = 0.1  # of the share that is left: to hide more is less likely
_LEAST_OF_BEST = 0.97  # overlap of another turn, relative to the best one of the same direction
_MOST_AFFINE = 200  # cameras of which the silhouettes are rendered
_ITERATIONS = 8
_PRIOR = 0.05  # weight of the logarithms of scales
_MOST_LOG = 1.3
_MARGIN = 1.5  # of the image in which silhouettes are compared, relative to the mask's
_DISTINCT_DEG = 10.0
_DISTINCT_STRETCH = 0.2


class Resembling(NamedTuple):
    """An alignment, and the intersection over union of its silhouette, or a part, and the mask."""

    alignment: Alignment
    iou: float


def resembling_poses(
    mesh: Mesh,
    mask: FloatArray | BoolArray,
    camera: Camera,
    *,
    free: BoolArray,
    count: int,
    is_cut: bool = False,
) -> list[Resembling]:
    """Distinct alignments whose silhouettes resemble a mask (h, w), the best first.

    ``free`` (3,) marks the scales that are unknown; ``is_cut`` says that the mask may lack all that
    lies beyond a line.
    """
    atlas, view = cut_atlas_of(mesh) if is_cut else atlas_of(mesh), _facing(mask, camera)
    query = whitened(view.image, view.corner, view.cell)
    poses = [_pose_of(*each, atlas, free) for each in _affine_cameras(atlas, query)]
    found = [Resembling(pose, _overlap(atlas, view, pose, is_cut=is_cut)) for pose in poses]
    found.sort(key=lambda each: -each.iou)
    kept: list[Resembling] = []
    for each in found:
        if len(kept) < count and all(differ(each.alignment, other.alignment) for other in kept):
            kept.append(each)
    return [
        each._replace(alignment=_turned(each.alignment, view.camera_from_facing)) for each in kept
    ]


def outline_of_mask(mask: FloatArray | BoolArray, camera: Camera) -> Whitened:
    """A mask (h, w) in the form of the outlines of `cadalign.estimation.contours.atlas`."""
    view = _facing(mask, camera)
    return coarse(whitened(view.image, view.corner, view.cell))


class _Facing(NamedTuple):
    """A mask as a camera sees it that looks at its middle.

    Cells of ``image`` (n, n) lie on the plane at depth 1, from ``corner`` (2,) on; those that
    ``is_seen`` (n * n,) marks lie in the photo.
    """

    image: Image
    is_seen: BoolArray
    corner: FloatArray
    cell: float
    camera_from_facing: FloatArray

    @property
    def rays(self) -> FloatArray:
        """Rays (n * n, 3) through the cells."""
        places = self.cell * np.arange(len(self.image))
        x, y = np.meshgrid(self.corner[0] + places, self.corner[1] + places)
        return np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)


def _facing(mask: FloatArray | BoolArray, camera: Camera) -> _Facing:
    inside: BoolArray = np.asarray(mask, dtype=np.float64) >= 0.5
    rows, columns = np.nonzero(inside)
    some = slice(None, None, max(1, len(rows) // 20_000))
    rays, valid = camera.normalize_where_valid(np.column_stack([columns, rows])[some].astype(float))
    seen = np.column_stack([rays[valid], np.ones(int(valid.sum()))])
    axis = seen.mean(axis=0)
    axis /= np.linalg.norm(axis)
    right = np.cross([0.0, 1.0, 0.0], axis)
    right /= np.linalg.norm(right)
    turn = np.column_stack([right, np.cross(axis, right), axis])
    turned = seen @ turn
    flat = turned[:, :2] / turned[:, 2:]
    low, high = flat.min(axis=0), flat.max(axis=0)
    middle, width = (low + high) / 2, _MARGIN * float((high - low).max())
    cell = width / (_CELLS - 1)
    everywhere = np.ones(_CELLS * _CELLS, dtype=bool)
    blank = np.zeros((_CELLS, _CELLS), np.float32)
    empty = _Facing(blank, everywhere, middle - width / 2, cell, turn)
    in_camera = empty.rays @ turn.T
    pixels = camera.project(np.where(in_camera[:, 2:] > 1e-6, in_camera, [0, 0, 1]))
    single = np.clip(pixels, -1e6, 1e6).astype(np.float32).reshape(_CELLS, _CELLS, 2)
    # Averages over a cell, where it holds several pixels.
    blur = max(cell * camera.fx / 3, 0.3)
    soft = cv2.GaussianBlur(inside.astype(np.float32), (0, 0), blur)
    image = cv2.remap(
        soft,
        np.ascontiguousarray(single[..., 0]),
        np.ascontiguousarray(single[..., 1]),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
    )
    return empty._replace(
        image=np.asarray(image, dtype=np.float32), is_seen=camera.contains(pixels)
    )


def _affine_cameras(atlas: Atlas, query: Whitened) -> list[tuple[FloatArray, FloatArray]]:
    """Maps ``M x + b`` of the model to the query's plane, those of the best overlaps."""
    overlap = overlaps(atlas.views, query)
    # A whitened silhouette may fit at several turns.
    is_peak = (overlap >= np.roll(overlap, 1, 2)) & (overlap >= np.roll(overlap, -1, 2))
    is_peak &= overlap > _LEAST_OF_BEST * overlap.max(axis=2, keepdims=True)
    peaks = np.nonzero(is_peak)
    best = np.argsort(-overlap[peaks])[:_MOST_AFFINE]
    found = []
    for flip, row, turn in zip(*(each[best].tolist() for each in peaks), strict=True):
        turned = turn_of(turn, mirrored=bool(flip))
        plane = query.spread[0] @ turned @ np.linalg.inv(atlas.views.spread[row])
        found.append((plane @ atlas.bases[row], query.mean[0] - plane @ atlas.views.mean[row]))
    return found


def _pose_of(matrix: FloatArray, shift: FloatArray, atlas: Atlas, free: BoolArray) -> Alignment:
    """The alignment of an affine camera ``matrix`` (2, 3)."""
    scale = _stretch_of(matrix, free)
    rows = matrix / scale
    lengths = np.linalg.norm(rows, axis=1)
    size = float(np.sqrt(lengths.prod()))
    left, _, right = np.linalg.svd(rows)
    first = left @ right[:2]
    rotation = np.vstack([first, np.cross(first[0], first[1])])
    middle = atlas.corners.mean(axis=0)
    seen = np.append(matrix @ middle + shift, 1.0) / size
    return Alignment(rotation, seen - rotation @ (scale * middle), scale)


def _stretch_of(matrix: FloatArray, free: BoolArray) -> FloatArray:
    """Scales (3,) that make the rows of ``matrix / scale`` orthogonal and of one length.

    Least squares by Gauss and Newton, with a weak prior on the logarithms: some views leave a
    stretch open.
    """
    first, second = matrix
    products, differences = first * second, (first**2 - second**2) / 2
    logs, count = np.zeros(3), int(free.sum())
    for _ in range(_ITERATIONS if count else 0):
        inverse = np.exp(-2 * logs)
        size = float(((first**2 + second**2) * inverse).sum()) / 2
        equations = np.stack([products, differences])[:, free] * inverse[free] / size
        values = np.array([products @ inverse, differences @ inverse]) / size
        rows = np.vstack([-2 * equations, _PRIOR * np.eye(count)])
        residuals = np.concatenate([values, _PRIOR * logs[free]])
        step = np.linalg.lstsq(rows, -residuals, rcond=None)[0]
        logs[free] = np.clip(logs[free] + np.clip(step, -0.5, 0.5), -_MOST_LOG, _MOST_LOG)
    return np.asarray(np.exp(logs))


@cache
def _line_bins() -> IntArray:
    """Numbers (`_LINE_ANGLES`, n * n) of the cells' places along directions, all around."""
    angles = 2 * np.pi * np.arange(_LINE_ANGLES) / _LINE_ANGLES
    places = np.arange(_CELLS) - (_CELLS - 1) / 2
    x, y = np.meshgrid(places, places)
    along = np.cos(angles)[:, None] * x.ravel() + np.sin(angles)[:, None] * y.ravel()
    return np.asarray(np.rint(along + _CELLS), dtype=np.int64)


def _overlap(atlas: Atlas, view: _Facing, pose: Alignment, *, is_cut: bool) -> float:
    """Intersection over union of a pose's silhouette and the mask.

    If it ``is_cut``, of what the best line leaves of the silhouette, less where it leaves less.
    """
    origin, model_from_ray = model_rays(pose)
    seen = atlas.caster.covered(origin, view.rays @ model_from_ray.T) & view.is_seen
    mask = view.image.ravel()
    both, total = mask[seen], float(mask.sum())
    if not is_cut:
        return float(both.sum()) / (total + len(both) - float(both.sum()))
    best = 0.0
    for bins in _line_bins()[:, seen]:
        count = np.cumsum(np.bincount(bins, minlength=1))
        common = np.cumsum(np.bincount(bins, weights=both, minlength=1))
        share = count / max(float(count[-1]), 1.0)
        best = max(best, float((common / (total + count - common) * share**_HIDDEN_POWER).max()))
    return best


def differ(one: Alignment, other: Alignment) -> bool:
    """True if rotations or scales are too far apart for one start to lead to both."""
    cosine = (np.trace(one.rotation.T @ other.rotation) - 1) / 2
    turn = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    stretch = np.abs(np.log(one.scale / other.scale)).max()
    return bool(turn > _DISTINCT_DEG or stretch > _DISTINCT_STRETCH)


def _turned(pose: Alignment, turn: FloatArray) -> Alignment:
    return Alignment(turn @ pose.rotation, turn @ pose.translation, pose.scale)
