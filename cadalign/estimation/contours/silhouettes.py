"""Poses and stretches of a model whose silhouette resembles a mask's, without any start.

Seen from afar, a stretched model under any pose is an affine image of the model, and silhouettes
along one direction of the model differ by an affine map of the plane: whitened by their second
moments, by a turn or a reflection. So silhouettes along directions all around are rendered once for
a model, compared with the mask's at all turns, and each that resembles it gives an affine camera.
Of ``M = R[:2] S / Z``, for the rows of ``M S^-1`` are orthogonal and of one length, the stretch
follows by two linear equations in the inverse squares of its scales.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray
from cadalign.estimation.contours.contour import Image, sampled
from cadalign.estimation.contours.surface import caster_of, corners_of
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.projection import model_rays
from cadalign.geometry.raycaster import RayCaster

_DIRECTIONS = 400  # over half of the sphere, 7 degrees apart
_CELLS = 80  # of a silhouette's image
_TURNS = 64
_RINGS = 24
_OUTERMOST = 3.0  # [standard deviations], of the rings
_LEAST_OF_BEST = 0.97  # overlap of another turn, relative to the best one of the same direction
_MOST_AFFINE = 200  # cameras of which the silhouettes are rendered
_ITERATIONS = 8
_PRIOR = 0.05  # weight of the logarithms of scales
_MOST_LOG = 1.3
_MARGIN = 1.5  # of the image in which silhouettes are compared, relative to the mask's
_DISTINCT_DEG = 10.0
_DISTINCT_STRETCH = 0.2


class Whitened(NamedTuple):
    """A silhouette by its first and second moments.

    ``mean`` (2,) and ``spread`` (2, 2), the square root of the covariance, and ``rings``
    (`_RINGS`, `_TURNS`): the share that is covered at these radii and angles, after both are
    removed.
    """

    mean: FloatArray
    spread: FloatArray
    rings: FloatArray


def _whitened(image: Image, corner: FloatArray, cell: float) -> Whitened:
    """The silhouette (h, w), whose cell (0, 0) lies at ``corner``."""
    rows, columns = np.nonzero(image > 0.5)
    points = np.column_stack([columns, rows]).astype(float)
    mean = points.mean(axis=0)
    values, vectors = np.linalg.eigh(np.cov(points.T) + 1e-3 * np.eye(2))
    spread = (vectors * np.sqrt(values)) @ vectors.T
    angles = 2 * np.pi * np.arange(_TURNS) / _TURNS
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    places = mean + (_radii()[:, None, None] * circle) @ spread
    padded = np.asarray(np.pad(image, 1), dtype=np.float32)
    rings = sampled(padded, places.reshape(-1, 2) + 1).reshape(_RINGS, _TURNS)
    return Whitened(corner + cell * mean, cell * spread, rings)


def _radii() -> FloatArray:
    return np.asarray(_OUTERMOST * (np.arange(_RINGS) + 0.5) / _RINGS)


class Atlas(NamedTuple):
    """A model's silhouettes along directions, ``base`` (2, 3) the axes of each one's image."""

    caster: RayCaster
    corners: FloatArray
    bases: FloatArray
    views: list[Whitened]
    spectra: npt.NDArray[np.complex128]
    areas: FloatArray


@lru_cache(maxsize=16)
def atlas_of(mesh: Mesh) -> Atlas:
    """The silhouettes of a mesh, rendered once."""
    caster, corners = caster_of(mesh), corners_of(mesh)
    middle = corners.mean(axis=0)
    reach = float(np.linalg.norm(corners - middle, axis=1).max())
    bases, views = [], []
    for direction in _half_sphere(_DIRECTIONS):
        base = np.linalg.svd(direction[None])[2][1:]
        across = (corners - middle) @ base.T
        low, high = across.min(axis=0), across.max(axis=0)
        cell = float((high - low).max()) / _CELLS or 1.0
        places = low[:, None] + cell * np.arange(_CELLS + 1)
        grid = np.stack(np.meshgrid(places[0], places[1]), axis=-1).reshape(-1, 2)
        # Rays from afar: their origin is one point, so that they are almost parallel.
        eye = middle - 60 * reach * direction
        rays = (grid / (60 * reach)) @ base + direction
        image = caster.covered(eye, rays).reshape(_CELLS + 1, _CELLS + 1).astype(np.float32)
        if image.sum() < 4:
            continue
        whitened = _whitened(image, low, cell)
        bases.append(base)
        views.append(whitened._replace(mean=whitened.mean + base @ middle))
    rings = np.array([view.rings for view in views])
    areas = (rings * _radii()[:, None]).sum(axis=(1, 2))
    return Atlas(caster, corners, np.array(bases), views, np.fft.rfft(rings, axis=2), areas)


def _half_sphere(count: int) -> FloatArray:
    """Directions (count, 3) spread evenly: a Fibonacci lattice."""
    k = np.arange(count) + 0.5
    z = 1 - k / count
    angle = np.pi * (1 + 5**0.5) * k
    radius = np.sqrt(1 - z**2)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])


class Resembling(NamedTuple):
    """An alignment, and the intersection over union of its silhouette and the mask."""

    alignment: Alignment
    iou: float


def resembling_poses(
    mesh: Mesh, mask: FloatArray | BoolArray, camera: Camera, *, free: BoolArray, count: int
) -> list[Resembling]:
    """Distinct alignments whose silhouettes resemble a mask (h, w), the best first.

    ``free`` (3,) marks the scales that are unknown.
    """
    atlas, view = atlas_of(mesh), _facing(mask, camera)
    query = _whitened(view.image, view.corner, view.cell)
    poses = [_pose_of(*each, atlas, free) for each in _affine_cameras(atlas, query)]
    found = [Resembling(pose, _overlap(atlas, view, pose)) for pose in poses]
    found.sort(key=lambda each: -each.iou)
    kept: list[Resembling] = []
    for each in found:
        if len(kept) < count and all(differ(each.alignment, other.alignment) for other in kept):
            kept.append(each)
    return [
        each._replace(alignment=_turned(each.alignment, view.camera_from_facing)) for each in kept
    ]


class _Facing(NamedTuple):
    """A mask as a camera sees it that looks at its middle.

    Cells of ``image`` (n, n) lie on the plane at depth 1, from ``corner`` (2,) on.
    """

    image: Image
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
    empty = _Facing(np.zeros((_CELLS, _CELLS), np.float32), middle - width / 2, cell, turn)
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
    return empty._replace(image=np.asarray(image, dtype=np.float32))


def _affine_cameras(atlas: Atlas, query: Whitened) -> list[tuple[FloatArray, FloatArray]]:
    """Maps ``M x + b`` of the model to the query's plane, those of the best overlaps."""
    weights = _radii()[:, None]
    area = float((query.rings * weights).sum())
    candidates = []
    mirrored = np.roll(query.rings[:, ::-1], 1, axis=1)
    for flip, rings in ((1.0, query.rings), (-1.0, mirrored)):
        spectrum = np.fft.rfft(weights * rings, axis=1)
        common = np.fft.irfft((spectrum * atlas.spectra.conj()).sum(axis=1), _TURNS, axis=1)
        overlap = common / (atlas.areas[:, None] + area - common)
        # A whitened silhouette may fit at several turns.
        is_peak = (overlap >= np.roll(overlap, 1, 1)) & (overlap >= np.roll(overlap, -1, 1))
        is_peak &= overlap > _LEAST_OF_BEST * overlap.max(axis=1, keepdims=True)
        for row, turn in zip(*np.nonzero(is_peak), strict=True):
            candidates.append((float(overlap[row, turn]), int(row), int(turn), flip))
    candidates.sort(reverse=True)
    found = []
    for _, row, turn, flip in candidates[:_MOST_AFFINE]:
        angle = 2 * np.pi * turn / _TURNS
        cosine, sine = np.cos(angle), np.sin(angle)
        turned = np.diag([1.0, flip]) @ np.array([[cosine, -sine], [sine, cosine]])
        view = atlas.views[row]
        plane = query.spread @ turned @ np.linalg.inv(view.spread)
        found.append((plane @ atlas.bases[row], query.mean - plane @ view.mean))
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


def _overlap(atlas: Atlas, view: _Facing, pose: Alignment) -> float:
    """Intersection over union of a pose's silhouette and the mask."""
    origin, model_from_ray = model_rays(pose)
    seen = atlas.caster.covered(origin, view.rays @ model_from_ray.T).reshape(view.image.shape)
    common = float(view.image[seen].sum())
    return common / (float(view.image.sum()) + float(seen.sum()) - common)


def differ(one: Alignment, other: Alignment) -> bool:
    """True if rotations or scales are too far apart for one start to lead to both."""
    cosine = (np.trace(one.rotation.T @ other.rotation) - 1) / 2
    turn = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    stretch = np.abs(np.log(one.scale / other.scale)).max()
    return bool(turn > _DISTINCT_DEG or stretch > _DISTINCT_STRETCH)


def _turned(pose: Alignment, turn: FloatArray) -> Alignment:
    return Alignment(turn @ pose.rotation, turn @ pose.translation, pose.scale)
