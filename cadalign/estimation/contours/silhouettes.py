"""Silhouettes of models and masks, whitened by their second moments, and how much they overlap.

Seen from afar, a stretched model under any pose is an affine image of the model, and silhouettes
along one direction of the model differ by an affine map of the plane: whitened by their second
moments, by a turn. So silhouettes along directions all around are rendered once for a model, and
compared with a mask's at all turns. Near objects look larger where they are nearer, by an amount
that a stretch changes little: silhouettes are rendered from about as far as the mask's size says,
for there are few classes of distances. What an occluder or the image's border leaves of a
silhouette has moments of its own: so each one is kept whole and cut by straight lines.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, lru_cache
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray
from cadalign.compile import kernel
from cadalign.estimation.contours.surface import RigidSurface, rigid_surface
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.raycaster import RayCaster
from cadalign.io.images import ByteImage

Image = npt.NDArray[np.float32]


def sampled(image: Image, points: FloatArray) -> FloatArray:
    """Values (n,) of an image (h, w) at points (n, 2), bilinear; outside those of the border.

    OpenCV 4 rounds places to 1/32 px (`cv2.remap`, `cv2.warpAffine`), which moves contours by more
    than the precision that is sought.
    """
    return np.asarray(_bilinear(image[..., None], np.ascontiguousarray(points))[:, 0])


def colors_at(photo: ByteImage, points: FloatArray) -> ByteImage:
    """Colours (n, c) of a photo (h, w, c) at points (n, 2), as `sampled`."""
    return np.rint(_bilinear(photo, np.ascontiguousarray(points))).astype(np.uint8)


@kernel
def _bilinear(image: npt.NDArray[np.generic], points: FloatArray) -> FloatArray:
    height, width, channels = image.shape
    found = np.empty((len(points), channels))
    for row in range(len(points)):
        x, y = points[row, 0], points[row, 1]
        x = min(x, width - 1.0) if x > 0.0 else 0.0  # also where it is no number
        y = min(y, height - 1.0) if y > 0.0 else 0.0
        left, top = int(x), int(y)
        right, bottom = min(left + 1, width - 1), min(top + 1, height - 1)
        x -= left
        y -= top
        for k in range(channels):
            upper_left, upper_right = float(image[top, left, k]), float(image[top, right, k])
            lower_left, lower_right = float(image[bottom, left, k]), float(image[bottom, right, k])
            upper = upper_left + x * (upper_right - upper_left)
            lower = lower_left + x * (lower_right - lower_left)
            found[row, k] = upper + y * (lower - upper)
    return found


CELLS = 80
"""Rows and columns of a silhouette's or a mask's image."""
TURNS = 64
"""Turns at which silhouettes are compared."""
COMPARED = np.arange(0, CELLS, 2)
"""Rows and columns of a mask's image that are compared with what a pose covers."""

_DIRECTIONS = 400  # over half of the sphere, 7 degrees apart
_AFAR = 60.0  # distance of an eye whose rays are almost parallel, relative to half a box's diagonal
_EYES = (5.0, 12.0, _AFAR)  # distances from which silhouettes are rendered
_RINGS = 24
_OUTERMOST = 3.0  # [standard deviations], of the rings
_LEAST_CELLS = 4
_CELL_VARIANCE = 1e-3  # that every silhouette has at least
_CUT_EVERY = 2  # directions, of which the silhouettes are cut
_CUT_SHARES = (0.15, 0.3)  # of the area that lies beyond a line
_CUT_ANGLES = 12
_MARGIN = 1.5  # of the image in which silhouettes are compared, relative to the mask's


class Whitened(NamedTuple):
    """Silhouettes by their first and second moments, N of them.

    ``mean`` (N, 2) and ``spread`` (N, 2, 2), the square root of the covariance, and ``rings``
    (N, `_RINGS`, `TURNS`): the share in 255ths that is covered at these radii and angles, after
    both are removed.
    """

    mean: FloatArray
    spread: FloatArray
    rings: npt.NDArray[np.uint8]


class Atlas(NamedTuple):
    """A model's silhouettes; of each one the ``base`` (N, 2, 3), the axes of its image."""

    caster: RayCaster
    corners: FloatArray
    bases: FloatArray
    views: Whitened


def overlaps(views: Whitened, query: Whitened) -> FloatArray:
    """Intersections over unions (N, turns) of silhouettes and one that is turned."""
    rings = query.rings[0].astype(np.float32) / 255
    count, turns = rings.shape
    weights = np.repeat(_radii(count), turns)
    around = (np.arange(turns)[:, None] + np.arange(turns)) % turns
    turned = rings[:, around].transpose(0, 2, 1).reshape(-1, turns)
    weighted = turned * weights[:, None].astype(np.float32)
    flat = views.rings.reshape(len(views.rings), -1).astype(np.float32) / 255
    common = flat @ weighted
    areas = flat @ weights.astype(np.float32)
    return np.asarray(common / (areas[:, None] + weighted[:, 0].sum() - common), dtype=np.float64)


def _radii(count: int) -> FloatArray:
    return np.asarray(_OUTERMOST * (np.arange(count) + 0.5) / count)


@lru_cache(maxsize=32)
def atlas_of(mesh: Mesh, eye: float, *, is_cut: bool = False) -> Atlas:
    """The silhouettes of a mesh, whole or the parts that lines leave, rendered once.

    The ``eye`` is so far from the middle of the box, relative to half of its diagonal.
    """
    surface, around = rigid_surface(mesh), _half_sphere(_DIRECTIONS)
    directions = np.concatenate([around, -around])
    if is_cut:
        return _atlas(surface, directions[::_CUT_EVERY], eye, _cuts)
    return _atlas(surface, directions, eye, _uncut)


def _atlas(
    surface: RigidSurface,
    directions: FloatArray,
    eye: float,
    parts_of: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
) -> Atlas:
    """Silhouettes along directions, and the parts of each by their moments and lines."""
    caster, corners = surface.caster, surface.corners
    middle = corners.mean(axis=0)
    far = eye * float(np.linalg.norm(corners - middle, axis=1).max())
    bases, views = [], []
    for direction in directions:
        base = np.linalg.svd(direction[None])[2][1:]
        base[1] *= np.sign(np.cross(*base) @ direction)  # the image as it is seen, not mirrored
        across = (corners - middle) @ base.T
        across *= far / (far + (corners - middle) @ direction)[:, None]
        low, high = across.min(axis=0), across.max(axis=0)
        cell = float((high - low).max()) / CELLS or 1.0
        columns, rows = np.minimum((high - low) // cell + 2, CELLS + 1).astype(int)
        x, y = low[:, None] + cell * np.arange(CELLS + 1)
        grid = np.stack(np.meshgrid(x[:columns], y[:rows]), axis=-1).reshape(-1, 2)
        rays = (grid / far) @ base + direction
        covered = caster.covered(middle - far * direction, rays)
        image = covered.reshape(rows, columns).astype(np.float32)
        points = _cells(image)
        if len(points) < _LEAST_CELLS:
            continue
        moments, lines = parts_of(points)
        views.append(_sampled(image, moments, lines, low + base @ middle, cell))
        bases.append(np.broadcast_to(base, (len(moments), 2, 3)))
    every = [np.concatenate(column) for column in zip(*views, strict=True)]
    return Atlas(caster, corners, np.concatenate(bases), Whitened(*every))


def eye_of(mesh: Mesh, query: Whitened) -> float:
    """One of `_EYES` from which a box of the mesh's size looks as large as a silhouette."""
    sides = np.ptp(mesh.bounds, axis=0)
    area = float((sides * np.roll(sides, 1)).sum()) / 2  # a quarter of the surface (Cauchy)
    angle = 4 * np.pi * float(np.linalg.det(query.spread[0]))  # of a disc of this variance
    far = np.sqrt(area / angle) / (float(np.linalg.norm(sides)) / 2)
    return min(_EYES, key=lambda eye: abs(np.log(eye / far)))


@cache
def around(count: int) -> FloatArray:
    """Unit vectors (count, 2) in equal steps, all around."""
    angles = 2 * np.pi * np.arange(count) / count
    return np.column_stack([np.cos(angles), np.sin(angles)])


def _half_sphere(count: int) -> FloatArray:
    """Directions (count, 3) spread evenly: a Fibonacci lattice."""
    k = np.arange(count) + 0.5
    z = 1 - k / count
    angle = np.pi * (1 + 5**0.5) * k
    radius = np.sqrt(1 - z**2)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])


def _cells(image: Image) -> FloatArray:
    rows, columns = np.nonzero(image > 0.5)
    return np.column_stack([columns, rows]).astype(float)


def _terms(points: FloatArray) -> FloatArray:
    """1, x, y, x², xy, y² of points (n, 2), as (6, n)."""
    x, y = points.T
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y])


def _uncut(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    return _terms(points).sum(axis=1)[None], np.array([[0.0, 0.0, np.inf]])


def _cuts(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Moments (N, 6) of what lines leave, and the lines (N, 3): kept is ``n x <= c``.

    Their directions are spread evenly after whitening.
    """
    root = np.linalg.cholesky(np.cov(points.T) + _CELL_VARIANCE * np.eye(2))
    normals = around(_CUT_ANGLES) @ np.linalg.inv(root)
    last = [max(int((1 - share) * len(points)) - 1, 2) for share in _CUT_SHARES]
    along = normals @ points.T
    limits = np.partition(along, last, axis=1)[:, last]
    kept = (along[:, None] <= limits[:, :, None]).reshape(-1, len(points))
    lines = np.column_stack([np.repeat(normals, len(last), axis=0), limits.ravel()])
    return kept @ _terms(points).T, lines


def _sampled(
    image: Image, moments: FloatArray, lines: FloatArray, corner: FloatArray, cell: float
) -> Whitened:
    """Moments (N, 6) of the parts of an image that lines (N, 3) leave."""
    count = moments[:, 0]
    mean = moments[:, 1:3] / count[:, None]
    xx, xy, yy = (moments[:, 3:] / count[:, None]).T
    square = np.stack([xx, xy, xy, yy], axis=1).reshape(-1, 2, 2)
    square -= mean[:, :, None] * mean[:, None, :]
    variances, axes = np.linalg.eigh(square + _CELL_VARIANCE * np.eye(2))
    spread = (axes * np.sqrt(np.maximum(variances, _CELL_VARIANCE))[:, None]) @ axes.swapaxes(1, 2)
    rays = (_radii(_RINGS)[:, None, None] * around(TURNS)).reshape(-1, 2)
    places = mean[:, None] + rays @ spread
    padded = np.asarray(np.pad(image, 1), dtype=np.float32)
    covered = sampled(padded, places.reshape(-1, 2) + 1).reshape(len(mean), -1)
    kept = (places @ lines[:, :2, None])[..., 0] <= lines[:, 2:]
    rings = np.rint(255 * covered * kept).astype(np.uint8).reshape(-1, _RINGS, TURNS)
    return Whitened(corner + cell * mean, cell * spread, rings)


class FacedMask(NamedTuple):
    """A mask as a camera sees it that looks at its middle.

    The ``outline`` is its silhouette. Cells of its image lie on the plane at depth 1, a ``cell``
    apart, about the ``middle`` (2,). Those of `COMPARED` have values ``inside`` (m,), ``rays``
    (m, 3) through them, and lie in the photo where ``is_seen`` (m,).
    """

    outline: Whitened
    inside: FloatArray
    rays: FloatArray
    is_seen: BoolArray
    middle: FloatArray
    cell: float
    camera_from_facing: FloatArray

    @classmethod
    def of(cls, mask: FloatArray | BoolArray, camera: Camera) -> FacedMask:
        """The mask (h, w) of a camera."""
        inside: BoolArray = np.asarray(mask, dtype=np.float64) >= 0.5
        rows, columns = np.nonzero(inside)
        every = max(1, len(rows) // 20_000)
        pixels = np.column_stack([columns, rows])[::every].astype(float)
        found, valid = camera.rays_where_valid(pixels)
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
        cell, corner = width / (CELLS - 1), middle - width / 2
        places = cell * np.arange(CELLS)
        x, y = np.meshgrid(corner[0] + places, corner[1] + places)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
        in_camera = rays @ turn.T
        is_ahead = camera.is_wide | (in_camera[:, 2:] > 1e-6)
        pixels = camera.project(np.where(is_ahead, in_camera, [0, 0, 1]))
        # Averages over a cell, where it holds several pixels.
        blur = max(cell * camera.fx / 3, 0.3)
        soft = cv2.GaussianBlur(inside.astype(np.float32), (0, 0), blur)
        image = sampled(np.pad(soft, 1), pixels + 1).reshape(CELLS, CELLS).astype(np.float32)
        outline = _sampled(image, *_uncut(_cells(image)), corner, cell)
        some = (CELLS * COMPARED[:, None] + COMPARED).ravel()
        compared = image.ravel()[some].astype(float), rays[some], camera.contains(pixels)[some]
        return cls(outline, *compared, corner + cell * (CELLS - 1) / 2, cell, turn)
