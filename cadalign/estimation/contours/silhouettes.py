"""Find poses and stretches of a model from a mask alone, without a start.

From afar, the image of a stretched model is affine. Silhouettes from one direction therefore differ
by an affine map of the plane; after whitening by their second moments, by a rotation. The model's
silhouettes from all directions are rendered once, and compared with the mask's at all rotations.
Perspective depends little on the stretch: silhouettes are rendered from a few distances, and the
mask's size selects one.

Each similar silhouette gives an affine camera ``M = R[:2] S / Z``. The rows of ``M S^-1`` are
orthogonal and of equal length, which gives two linear equations in the inverse squares of the
scales.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple, cast

import cv2
import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import InputError
from cadalign.estimation.contours.contour import Image, interpolate
from cadalign.estimation.contours.outline import rigid_surface
from cadalign.estimation.model import Model
from cadalign.estimation.problem import Inits, Problem
from cadalign.geometry.alignment import Alignment, bounds_corners, model_rays
from cadalign.geometry.camera import Camera, rotate_alignment
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.raycaster import RayCaster
from cadalign.geometry.rotations import angles_between
from cadalign.geometry.symmetry import Symmetry
from cadalign.io.focal import prior_of_camera

_CELLS = 80  # rows and columns of a silhouette's image
_TURNS = 64  # rotations at which silhouettes are compared
_DIRECTIONS = 800  # all around, 7 degrees apart
_AFAR = 60.0  # distance with almost parallel rays, relative to half the box's diagonal
_EYES = (5.0, 12.0, _AFAR)  # distances from which silhouettes are rendered
_RINGS = 24
_ANGLES = 2 * np.pi * np.arange(_TURNS) / _TURNS
_AROUND = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])
_RADII = 3.0 * (np.arange(_RINGS) + 0.5) / _RINGS  # [standard deviations]
_LEAST_CELLS = 4
_CELL_VARIANCE = 1e-3  # least variance of a silhouette
_MARGIN = 1.5  # size of the compared image, relative to the mask
_LEAST_OF_BEST = 0.97  # overlap at another rotation, relative to the best of the same direction
_MOST_AFFINE = 200  # affine cameras that are tested
_ITERATIONS = 8
_PRIOR = 0.05  # weight of the logarithms of scales
_MOST_LOG = 1.3
_DISTINCT_DEG = 10.0
_DISTINCT_STRETCH = 0.2
_MOST_SIMILAR = 12  # starts from a mask alone
_LARGEST_FOCAL_SIGMA = 0.25  # relative: the search uses the mean focal length of the prior


class WhitenedSilhouettes(NamedTuple):
    """N silhouettes, whitened by their first and second moments.

    ``mean`` (N, 2); ``spread`` (N, 2, 2), the square root of the covariance; and ``rings`` (N,
    `_RINGS`, `_TURNS`), the whitened coverage on polar rings, in 255ths.
    """

    mean: FloatArray
    spread: FloatArray
    rings: npt.NDArray[np.uint8]


class Atlas(NamedTuple):
    """A model's silhouettes, and the axes ``bases`` (N, 2, 3) of their images."""

    caster: RayCaster
    corners: FloatArray
    bases: FloatArray
    views: WhitenedSilhouettes


def starts_of_mask(problem: Problem) -> list[Inits]:
    """Distinct alignments with silhouettes similar to a single mask, the best first.

    Raises InputError without a prior on the focal length.
    """
    (view,), camera, model = problem.views, problem.lenses.cameras[0], cast(Model, problem.model)
    known = prior_of_camera(problem.lenses.prior, camera)
    if problem.lenses.count and (known is None or known.relative_sigma > _LARGEST_FOCAL_SIGMA):
        raise InputError(
            "a mask alone does not determine the focal length",
            where=f"views[{view.number}].camera",
            fix="give a calibrated camera, a focal_prior whose relative_sigma is at most "
            f"{_LARGEST_FOCAL_SIGMA}, or keypoints",
        )
    mask = CentredMask.from_mask(cast(FloatArray, view.mask_image), camera)
    mesh, free = cast(Mesh, model.mesh), np.asarray(problem.prior.scales.free > 0)
    atlas = atlas_of(mesh, _eye_of(mesh, mask.outline))
    poses = _poses_of(*_affine_cameras(atlas, mask.outline), atlas, free)
    poses.sort(key=lambda pose: -mask.overlap(atlas.caster, pose))
    kept = select_distinct(poses, _MOST_SIMILAR, model.symmetry)
    in_camera = [rotate_alignment(pose, mask.camera_from_facing) for pose in kept]
    return [[rotate_alignment(pose, problem.turns[0])] for pose in in_camera]


@lru_cache(maxsize=32)
def atlas_of(mesh: Mesh, eye: float) -> Atlas:
    """Silhouettes of a mesh from distance ``eye``, relative to half the box's diagonal."""
    caster, corners = rigid_surface(mesh).caster, bounds_corners(*mesh.bounds)
    middle = corners.mean(axis=0)
    far = eye * float(np.linalg.norm(corners - middle, axis=1).max())
    bases, views = [], []
    for direction in _directions():
        base = np.linalg.svd(direction[None])[2][1:]
        base[1] *= np.sign(np.cross(*base) @ direction)  # the image as it is seen, not mirrored
        across = (corners - middle) @ base.T
        across *= far / (far + (corners - middle) @ direction)[:, None]
        low, high = across.min(axis=0), across.max(axis=0)
        cell = float((high - low).max()) / _CELLS or 1.0
        columns, rows = np.minimum((high - low) // cell + 2, _CELLS + 1).astype(int)
        x, y = low[:, None] + cell * np.arange(_CELLS + 1)
        grid = np.stack(np.meshgrid(x[:columns], y[:rows]), axis=-1).reshape(-1, 2)
        covered = caster.hit_mask(middle - far * direction, (grid / far) @ base + direction)
        if covered.sum() >= _LEAST_CELLS:
            image = covered.reshape(rows, columns).astype(np.float32)
            views.append(_whiten(image, low + base @ middle, cell))
            bases.append(base)
    every = [np.concatenate(column) for column in zip(*views, strict=True)]
    return Atlas(caster, corners, np.array(bases), WhitenedSilhouettes(*every))


def _directions() -> FloatArray:
    """Evenly spread directions (n, 3): half a Fibonacci lattice, and the opposite directions."""
    k = np.arange(_DIRECTIONS // 2) + 0.5
    z = 1 - 2 * k / _DIRECTIONS
    angle = np.pi * (1 + 5**0.5) * k
    radius = np.sqrt(1 - z**2)
    half = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])
    return np.concatenate([half, -half])


def _eye_of(mesh: Mesh, query: WhitenedSilhouettes) -> float:
    """One of `_EYES` from which the mesh's box looks about as large as a silhouette."""
    sides = np.ptp(mesh.bounds, axis=0)
    area = float((sides * np.roll(sides, 1)).sum()) / 2  # a quarter of the surface (Cauchy)
    angle = 4 * np.pi * float(np.linalg.det(query.spread[0]))  # of a disc of this variance
    far = np.sqrt(area / angle) / (float(np.linalg.norm(sides)) / 2)
    return min(_EYES, key=lambda eye: abs(np.log(eye / far)))


def _whiten(image: Image, corner: FloatArray, cell: float) -> WhitenedSilhouettes:
    """Whiten the silhouette in an image with its first cell at ``corner`` (2,)."""
    points = np.argwhere(image > 0.5)[:, ::-1].astype(float)
    mean = points.mean(axis=0)
    covariance = np.cov(points.T, bias=True) + _CELL_VARIANCE * np.eye(2)
    variances, axes = np.linalg.eigh(covariance)
    spread = (axes * np.sqrt(variances)) @ axes.T
    rays = (_RADII[:, None, None] * _AROUND).reshape(-1, 2)
    covered = interpolate(np.pad(image, 1), mean + rays @ spread + 1)
    rings = np.rint(255 * covered).astype(np.uint8).reshape(1, _RINGS, _TURNS)
    return WhitenedSilhouettes((corner + cell * mean)[None], cell * spread[None], rings)


class CentredMask(NamedTuple):
    """A mask in a camera that looks at its centre.

    ``outline`` is its whitened silhouette. Cells on the plane at depth 1 have values ``inside``
    (m,), ``rays`` (m, 3), and are inside the photo where ``is_seen`` (m,).
    """

    outline: WhitenedSilhouettes
    inside: FloatArray
    rays: FloatArray
    is_seen: BoolArray
    camera_from_facing: FloatArray

    @classmethod
    def from_mask(cls, mask: FloatArray | BoolArray, camera: Camera) -> CentredMask:
        inside: BoolArray = np.asarray(mask, dtype=np.float64) >= 0.5
        pixels = np.argwhere(inside)[:, ::-1].astype(float)
        found, valid = camera.rays_where_valid(pixels[:: max(1, len(pixels) // 20_000)])
        seen = found[valid]
        axis = seen.mean(axis=0)
        axis /= np.linalg.norm(axis)
        right = np.cross([0.0, 1.0, 0.0], axis)
        right /= np.linalg.norm(right)
        turn = np.column_stack([right, np.cross(axis, right), axis])
        turned = seen @ turn
        flat = turned[:, :2] / turned[:, 2:]
        low, high = flat.min(axis=0), flat.max(axis=0)
        middle, width = (low + high) / 2, _MARGIN * float((high - low).max())
        cell, corner = width / (_CELLS - 1), middle - width / 2
        places = cell * np.arange(_CELLS)
        x, y = np.meshgrid(corner[0] + places, corner[1] + places)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
        in_camera = rays @ turn.T
        is_ahead = camera.is_wide | (in_camera[:, 2:] > 1e-6)
        pixels = camera.project(np.where(is_ahead, in_camera, [0, 0, 1]))
        # Averages over a cell of several pixels.
        blur = max(cell * camera.fx / 3, 0.3)
        soft = cv2.GaussianBlur(inside.astype(np.float32), (0, 0), blur)
        image = interpolate(np.pad(soft, 1), pixels + 1).reshape(_CELLS, _CELLS).astype(np.float32)
        some = np.arange(_CELLS**2).reshape(_CELLS, _CELLS)[::2, ::2].ravel()
        compared = image.ravel()[some].astype(float), rays[some], camera.contains(pixels)[some]
        return cls(_whiten(image, corner, cell), *compared, turn)

    def overlap(self, caster: RayCaster, pose: Alignment) -> float:
        """Intersection over union of the mask and the silhouette at a pose in this view."""
        origin, model_from_ray = model_rays(pose)
        seen = caster.hit_mask(origin, self.rays @ model_from_ray.T) & self.is_seen
        common = float(self.inside[seen].sum())
        return common / (float(self.inside.sum()) + int(seen.sum()) - common)


def _overlaps(views: WhitenedSilhouettes, query: WhitenedSilhouettes) -> FloatArray:
    """Intersections over unions (N, turns) of silhouettes and a turned query."""
    rings = query.rings[0].astype(np.float32) / 255
    weights = np.repeat(_RADII, _TURNS).astype(np.float32)
    turns = (np.arange(_TURNS)[:, None] + np.arange(_TURNS)) % _TURNS
    weighted = rings[:, turns].transpose(0, 2, 1).reshape(-1, _TURNS) * weights[:, None]
    flat = views.rings.reshape(len(views.rings), -1).astype(np.float32) / 255
    common = flat @ weighted
    areas = flat @ weights
    return np.asarray(common / (areas[:, None] + weighted[:, 0].sum() - common), dtype=np.float64)


def _affine_cameras(atlas: Atlas, query: WhitenedSilhouettes) -> tuple[FloatArray, FloatArray]:
    """Affine cameras ``M x + b`` (n, 2, 3), (n, 2) with the best overlaps."""
    overlap = _overlaps(atlas.views, query)
    # A whitened silhouette may fit at several rotations.
    is_peak = (overlap >= np.roll(overlap, 1, 1)) & (overlap >= np.roll(overlap, -1, 1))
    is_peak &= overlap > _LEAST_OF_BEST * overlap.max(axis=1, keepdims=True)
    peaks = np.nonzero(is_peak)
    best = np.argsort(-overlap[peaks])[:_MOST_AFFINE]
    row, number = (each[best] for each in peaks)
    cosine, sine = _AROUND[number].T
    turns = np.stack([cosine, -sine, sine, cosine], axis=1).reshape(-1, 2, 2)
    planes = query.spread[0] @ turns @ np.linalg.inv(atlas.views.spread[row])
    shifts = query.mean[0] - (planes @ atlas.views.mean[row][:, :, None])[:, :, 0]
    return planes @ atlas.bases[row], shifts


def _poses_of(
    matrices: FloatArray, shifts: FloatArray, atlas: Atlas, free: BoolArray
) -> list[Alignment]:
    """Alignments of affine cameras: ``matrices`` (n, 2, 3) and ``shifts`` (n, 2)."""
    scales = _stretches_of(matrices, free)
    rows = matrices / scales[:, None]
    sizes = np.sqrt(np.linalg.norm(rows, axis=2).prod(axis=1))
    left, _, right = np.linalg.svd(rows, full_matrices=False)
    first = left @ right
    rotations = np.concatenate([first, np.cross(first[:, 0], first[:, 1])[:, None]], axis=1)
    middle = atlas.corners.mean(axis=0)
    seen = np.column_stack([matrices @ middle + shifts, np.ones(len(matrices))]) / sizes[:, None]
    places = seen - (rotations @ (scales * middle)[:, :, None])[:, :, 0]
    return [Alignment(*each) for each in zip(rotations, places, scales, strict=True)]


def _stretches_of(matrices: FloatArray, free: BoolArray) -> FloatArray:
    """Scales (n, 3) that make the rows of ``matrix / scale`` orthogonal and of equal length.

    Least squares, with a weak prior on the logarithms for undetermined stretches.
    """
    first, second = matrices[:, 0], matrices[:, 1]
    terms = np.stack([first * second, (first**2 - second**2) / 2], axis=1)
    squares = (first**2 + second**2) / 2
    logs, count = np.zeros((len(matrices), 3)), int(free.sum())
    for _ in range(_ITERATIONS if count else 0):
        inverse = np.exp(-2 * logs)
        relative = terms * (inverse / (squares * inverse).sum(axis=1, keepdims=True))[:, None]
        slopes = -2 * relative[:, :, free]
        transposed = slopes.swapaxes(1, 2)
        normal = transposed @ slopes + _PRIOR**2 * np.eye(count)
        gradient = (transposed @ relative.sum(axis=2)[:, :, None])[:, :, 0]
        gradient += _PRIOR**2 * logs[:, free]
        step = np.linalg.solve(normal, -gradient[:, :, None])[:, :, 0]
        moved = logs[:, free] + np.clip(step, -0.5, 0.5)
        logs[:, free] = np.clip(moved, -_MOST_LOG, _MOST_LOG)
    return np.asarray(np.exp(logs))


def select_distinct(
    found: list[Alignment], count: int, symmetry: Symmetry | None
) -> list[Alignment]:
    """The first ``count`` alignments that differ, up to symmetry."""
    poses: list[Alignment] = []
    kept: list[Alignment] = []
    for each in found:
        pose = each
        if symmetry is not None:
            pose = symmetry.canonical(each, tolerance=_DISTINCT_STRETCH).alignment
        if all(_differ(pose, other) for other in poses):
            poses.append(pose)
            kept.append(each)
        if len(kept) == count:
            break
    return kept


def _differ(one: Alignment, other: Alignment) -> bool:
    turn = angles_between(one.rotation, other.rotation)
    stretch = np.abs(np.log(one.scale / other.scale)).max()
    return bool(turn > _DISTINCT_DEG or stretch > _DISTINCT_STRETCH)
