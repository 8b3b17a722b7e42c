"""Poses and stretches of a model whose silhouette resembles a mask's, without any start.

Seen from afar, a stretched model under any pose is an affine image of the model, and silhouettes
along one direction of the model differ by an affine map of the plane: whitened by their second
moments, by a turn. So silhouettes along directions all around are rendered once for a model,
compared with the mask's at all turns, and each that resembles it gives an affine camera. Near
objects look larger where they are nearer, by an amount that a stretch changes little: silhouettes
are rendered from about as far as the mask's size says, for there are few classes of distances.
What an occluder or the image's border leaves of a silhouette has moments of its own: so each one is
kept whole and cut by straight lines.
From ``M = R[:2] S / Z``, for the rows of ``M S^-1`` are orthogonal and of one length, the stretch
follows by two linear equations in the inverse squares of its scales.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cache, lru_cache
from typing import NamedTuple, TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.estimation.contours.contour import Image, sampled
from cadalign.estimation.contours.surface import RigidSurface, rigid_surface
from cadalign.estimation.facing import turned_alignment
from cadalign.geometry.alignment import Alignment, model_rays
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.raycaster import RayCaster
from cadalign.geometry.rotations import angle_between
from cadalign.geometry.symmetry import Symmetry
from cadalign.geometry.symmetry_group import group_of

_DIRECTIONS = 400  # over half of the sphere, 7 degrees apart
_AFAR = 60.0  # distance of an eye whose rays are almost parallel, relative to half a box's diagonal
_EYES = (5.0, 12.0, _AFAR)  # distances from which silhouettes are rendered
_CELLS = 80  # of a silhouette's or a mask's image
_TURNS = 64
_RINGS = 24
_OUTERMOST = 3.0  # [standard deviations], of the rings
_LEAST_CELLS = 4
_CELL_VARIANCE = 1e-3  # that every silhouette has at least
_CUT_EVERY = 2  # directions, of which the silhouettes are cut
_CUT_SHARES = (0.15, 0.3)  # of the area that lies beyond a line
_CUT_ANGLES = 12
_OUTLINE_CELLS = 60
_OUTLINE_EVERY = 2  # directions
_LINES = 16  # directions of what hides a part
_HIDDEN_POWER = 0.1  # of the share that is left: to hide more is less likely
_LEAST_HIDDEN = 0.03  # of the area, that a line hides
_LINE_MARGIN = 4.0  # [cells], on the object's side of a line, whose directions are few
_LEAST_OF_BEST = 0.97  # overlap of another turn, relative to the best one of the same direction
_MOST_AFFINE = 200  # cameras of which the silhouettes are rendered
_MOST_AFFINE_CUT = 600  # where the mask may lack a part, which leaves more possible
_WIDER = 3  # times as many cameras, where other evidence leaves few of them
_ITERATIONS = 8
_PRIOR = 0.05  # weight of the logarithms of scales
_MOST_LOG = 1.3
_MARGIN = 1.5  # of the image in which silhouettes are compared, relative to the mask's
_DISTINCT_DEG = 10.0
_DISTINCT_STRETCH = 0.2

T = TypeVar("T")
Possible = Callable[[FloatArray, FloatArray], BoolArray]
"""Tells which rotations (n, 3, 3) in the camera and scales (n, 3) other evidence leaves."""


class Resembling(NamedTuple):
    """An alignment whose silhouette, or the part of it that a line leaves, resembles a mask.

    The ``overlap`` is their intersection over union. Rays with ``line @ ray > 0`` are near the
    line (3,) or beyond it; it is zero where none is needed.
    """

    overlap: float
    alignment: Alignment
    line: FloatArray


class Whitened(NamedTuple):
    """Silhouettes by their first and second moments, N of them.

    ``mean`` (N, 2) and ``spread`` (N, 2, 2), the square root of the covariance, and ``rings``
    (N, `_RINGS`, `_TURNS`): the share in 255ths that is covered at these radii and angles, after
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


def whitened(image: Image, corner: FloatArray, cell: float) -> Whitened:
    """One silhouette (h, w), whose cell (0, 0) lies at ``corner``."""
    return _sampled(image, *_uncut(_cells(image)), corner, cell)


def overlaps(views: Whitened, query: Whitened, *, mirrored: bool = True) -> FloatArray:
    """Intersections over unions (k, N, turns) of silhouettes and one that is turned.

    The query's mirror image comes second: an affine image is that from the other side.
    """
    rings = query.rings[0].astype(np.float32) / 255
    count, turns = rings.shape
    weights = np.repeat(_radii(count), turns)
    around = (np.arange(turns)[:, None] + np.arange(turns)) % turns
    images = [rings, np.roll(rings[:, ::-1], 1, axis=1)][: 1 + mirrored]
    turned = [each[:, around].transpose(0, 2, 1).reshape(-1, turns) for each in images]
    weighted = np.hstack(turned) * weights[:, None].astype(np.float32)
    flat = views.rings.reshape(len(views.rings), -1).astype(np.float32) / 255
    common = (flat @ weighted).reshape(len(flat), -1, turns).transpose(1, 0, 2)
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


def outline_of(mesh: Mesh) -> Whitened:
    """The silhouettes of a mesh from afar along fewer directions, to be compared with many others'.

    Those from the other side are mirror images.
    """
    directions = _half_sphere(_DIRECTIONS)[::_OUTLINE_EVERY]
    return _atlas(RigidSurface(mesh), directions, _AFAR, _uncut, cells=_OUTLINE_CELLS).views


def _atlas(
    surface: RigidSurface,
    directions: FloatArray,
    eye: float,
    parts_of: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
    *,
    cells: int = _CELLS,
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
        cell = float((high - low).max()) / cells or 1.0
        places = low[:, None] + cell * np.arange(cells + 1)
        grid = np.stack(np.meshgrid(places[0], places[1]), axis=-1).reshape(-1, 2)
        rays = (grid / far) @ base + direction
        covered = caster.covered(middle - far * direction, rays)
        image = covered.reshape(cells + 1, cells + 1).astype(np.float32)
        points = _cells(image)
        if len(points) < _LEAST_CELLS:
            continue
        moments, lines = parts_of(points)
        views.append(_sampled(image, moments, lines, low + base @ middle, cell))
        bases.append(np.broadcast_to(base, (len(moments), 2, 3)))
    rows = [np.concatenate(column) for column in zip(*views, strict=True)]
    return Atlas(caster, corners, np.concatenate(bases), Whitened(*rows))


def _eye_of(mesh: Mesh, query: Whitened) -> float:
    """One of `_EYES` from which a box of the mesh's size looks as large as a silhouette."""
    sides = np.ptp(mesh.bounds, axis=0)
    area = float((sides * np.roll(sides, 1)).sum()) / 2  # a quarter of the surface (Cauchy)
    angle = 4 * np.pi * float(np.linalg.det(query.spread[0]))  # of a disc of this variance
    far = np.sqrt(area / angle) / (float(np.linalg.norm(sides)) / 2)
    return min(_EYES, key=lambda eye: abs(np.log(eye / far)))


@cache
def _around(count: int) -> FloatArray:
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
    normals = _around(_CUT_ANGLES) @ np.linalg.inv(root)
    terms = _terms(points)
    last = [max(int((1 - share) * len(points)) - 1, 2) for share in _CUT_SHARES]
    moments: list[FloatArray] = []
    lines: list[list[float]] = []
    for normal in normals:
        along = points @ normal
        order = np.argsort(along)
        moments.append(np.cumsum(terms[:, order], axis=1)[:, last].T)
        lines.extend([*normal, along[order[k]]] for k in last)
    return np.concatenate(moments), np.array(lines)


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
    spread = (axes * np.sqrt(np.maximum(variances, _CELL_VARIANCE))[:, None]) @ axes.mT
    rays = (_radii(_RINGS)[:, None, None] * _around(_TURNS)).reshape(-1, 2)
    places = mean[:, None] + rays @ spread
    padded = np.asarray(np.pad(image, 1), dtype=np.float32)
    covered = sampled(padded, places.reshape(-1, 2) + 1).reshape(len(mean), -1)
    kept = (places @ lines[:, :2, None])[..., 0] <= lines[:, 2:]
    rings = np.rint(255 * covered * kept).astype(np.uint8).reshape(-1, _RINGS, _TURNS)
    return Whitened(corner + cell * mean, cell * spread, rings)


def resembling_poses(
    mesh: Mesh,
    mask: FloatArray | BoolArray,
    camera: Camera,
    *,
    free: BoolArray,
    count: int,
    is_cut: bool = False,
    every: int = 1,
    symmetry: Symmetry | None = None,
    possible: Possible | None = None,
) -> list[Resembling]:
    """Distinct alignments whose silhouettes resemble a mask (h, w), the best first.

    ``free`` (3,) marks the scales that are unknown; ``is_cut`` says that the mask may lack all that
    lies beyond a line. One row and column in ``every`` are compared. Of alignments that are equal
    under the ``symmetry`` one is kept. Those that are not ``possible`` are left out.
    """
    view = _facing(mask, camera)
    query, compared = whitened(view.image, view.corner, view.cell), view.compared(every)
    atlas = atlas_of(mesh, _eye_of(mesh, query), is_cut=is_cut)
    most = _MOST_AFFINE_CUT if is_cut else _MOST_AFFINE
    cameras = _affine_cameras(atlas, query, most if possible is None else _WIDER * most)
    rotations, places, scales = _poses_of(*cameras, atlas, free)
    is_left = np.ones(len(scales), dtype=bool)
    if possible is not None:
        is_left = possible(view.camera_from_facing @ rotations, scales)
    left = (each[is_left][:most] for each in (rotations, places, scales))
    poses = [Alignment(*each) for each in zip(*left, strict=True)]
    found = [_resemblance(atlas, compared, pose, is_cut=is_cut) for pose in poses]
    found.sort(key=lambda each: -each.overlap)
    kept = distinct(((each.alignment, each) for each in found), count, symmetry)
    return [view.in_camera(each) for each in kept]


def outline_of_mask(mask: FloatArray | BoolArray, camera: Camera) -> Whitened:
    """The silhouette of a mask (h, w), to be compared with those of `outline_of`."""
    view = _facing(mask, camera)
    return whitened(view.image, view.corner, view.cell)


class _Facing(NamedTuple):
    """A mask as a camera sees it that looks at its middle.

    Cells of ``image`` (n, n) lie on the plane at depth 1, from ``corner`` (2,) on, with ``rays``
    (n * n, 3) through them; those that ``is_seen`` (n * n,) marks lie in the photo.
    """

    image: Image
    is_seen: BoolArray
    rays: FloatArray
    corner: FloatArray
    cell: float
    camera_from_facing: FloatArray

    def compared(self, every: int) -> _Cells:
        """The cells of so many rows and columns that stand for all."""
        grid = np.arange(_CELLS**2).reshape(_CELLS, _CELLS)
        some = grid[::every, ::every].ravel()
        middle = self.corner + self.cell * (_CELLS - 1) / 2
        mask = self.image.ravel()[some].astype(float)
        return _Cells(mask, self.rays[some], self.is_seen[some], every, middle, self.cell)

    def in_camera(self, found: Resembling) -> Resembling:
        """The same in the photo's camera."""
        turn = self.camera_from_facing
        pose = turned_alignment(found.alignment, turn)
        return Resembling(found.overlap, pose, turn @ found.line)


class _Cells(NamedTuple):
    """Cells (m,) of `_Facing`, their rays (m, 3) and if they are seen (m,); every so many."""

    mask: FloatArray
    rays: FloatArray
    is_seen: BoolArray
    every: int
    middle: FloatArray
    cell: float


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
    cell, corner = width / (_CELLS - 1), middle - width / 2
    places = cell * np.arange(_CELLS)
    x, y = np.meshgrid(corner[0] + places, corner[1] + places)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    in_camera = rays @ turn.T
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
    seen_cells = np.asarray(image, dtype=np.float32)
    return _Facing(seen_cells, camera.contains(pixels), rays, corner, cell, turn)


def _affine_cameras(atlas: Atlas, query: Whitened, most: int) -> tuple[FloatArray, FloatArray]:
    """Maps ``M x + b`` of the model to the query's plane, those of the ``most`` best overlaps.

    Matrices (n, 2, 3) and shifts (n, 2).
    """
    (overlap,) = overlaps(atlas.views, query, mirrored=False)
    # A whitened silhouette may fit at several turns.
    is_peak = (overlap >= np.roll(overlap, 1, 1)) & (overlap >= np.roll(overlap, -1, 1))
    is_peak &= overlap > _LEAST_OF_BEST * overlap.max(axis=1, keepdims=True)
    peaks = np.nonzero(is_peak)
    best = np.argsort(-overlap[peaks])[:most]
    row, number = (each[best] for each in peaks)
    cosine, sine = _around(_TURNS)[number].T
    turns = np.stack([cosine, -sine, sine, cosine], axis=1).reshape(-1, 2, 2)
    planes = query.spread[0] @ turns @ np.linalg.inv(atlas.views.spread[row])
    shifts = query.mean[0] - (planes @ atlas.views.mean[row][:, :, None])[:, :, 0]
    return planes @ atlas.bases[row], shifts


def _poses_of(
    matrices: FloatArray, shifts: FloatArray, atlas: Atlas, free: BoolArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Rotations, translations and scales of affine cameras.

    These are ``matrices`` (n, 2, 3) and ``shifts`` (n, 2).
    """
    scales = _stretches_of(matrices, free)
    rows = matrices / scales[:, None]
    sizes = np.sqrt(np.linalg.norm(rows, axis=2).prod(axis=1))
    left, _, right = np.linalg.svd(rows, full_matrices=False)
    first = left @ right
    rotations = np.concatenate([first, np.cross(first[:, 0], first[:, 1])[:, None]], axis=1)
    middle = atlas.corners.mean(axis=0)
    seen = np.column_stack([matrices @ middle + shifts, np.ones(len(matrices))]) / sizes[:, None]
    places = seen - (rotations @ (scales * middle)[:, :, None])[:, :, 0]
    return rotations, places, scales


def _stretches_of(matrices: FloatArray, free: BoolArray) -> FloatArray:
    """Scales (n, 3) that make the rows of ``matrix / scale`` orthogonal and of one length.

    Least squares by Gauss and Newton, with a weak prior on the logarithms: some views leave a
    stretch open.
    """
    first, second = matrices[:, 0], matrices[:, 1]
    terms = np.stack([first * second, (first**2 - second**2) / 2], axis=1)
    squares = (first**2 + second**2) / 2
    logs, count = np.zeros((len(matrices), 3)), int(free.sum())
    for _ in range(_ITERATIONS if count else 0):
        inverse = np.exp(-2 * logs)
        relative = terms * (inverse / (squares * inverse).sum(axis=1, keepdims=True))[:, None]
        slopes = -2 * relative[:, :, free]
        normal = slopes.mT @ slopes + _PRIOR**2 * np.eye(count)
        gradient = (slopes.mT @ relative.sum(axis=2)[:, :, None])[:, :, 0]
        gradient += _PRIOR**2 * logs[:, free]
        step = np.linalg.solve(normal, -gradient[:, :, None])[:, :, 0]
        moved = logs[:, free] + np.clip(step, -0.5, 0.5)
        logs[:, free] = np.clip(moved, -_MOST_LOG, _MOST_LOG)
    return np.asarray(np.exp(logs))


@cache
def _line_bins(every: int) -> IntArray:
    """Numbers (`_LINES`, m) of the cells' places along directions, all around."""
    places = np.arange(0, _CELLS, every) - (_CELLS - 1) / 2
    x, y = np.meshgrid(places, places)
    cosine, sine = _around(_LINES).T[:, :, None]
    along = cosine * x.ravel() + sine * y.ravel()
    return np.asarray(np.rint(along + _CELLS), dtype=np.int64)


def _resemblance(atlas: Atlas, view: _Cells, pose: Alignment, *, is_cut: bool) -> Resembling:
    """Compare a pose's silhouette with the mask.

    If it ``is_cut``, what the best line leaves of the silhouette, less where it leaves less.
    """
    origin, model_from_ray = model_rays(pose)
    mask = view.mask
    seen = atlas.caster.covered(origin, view.rays @ model_from_ray.T) & view.is_seen
    both, total = mask[seen], float(mask.sum())
    if not is_cut:
        overlap = float(both.sum()) / (total + len(both) - float(both.sum()))
        return Resembling(overlap, pose, np.zeros(3))
    best, line = 0.0, np.zeros(3)
    for normal, bins in zip(_around(_LINES), _line_bins(view.every)[:, seen], strict=True):
        count = np.cumsum(np.bincount(bins, minlength=1))
        common = np.cumsum(np.bincount(bins, weights=both, minlength=1))
        share = count / max(float(count[-1]), 1.0)
        overlaps = common / (total + count - common) * share**_HIDDEN_POWER
        last = int(overlaps.argmax())
        if overlaps[last] > best:
            best, is_hidden = float(overlaps[last]), share[last] < 1 - _LEAST_HIDDEN
            farthest = (last - _CELLS - _LINE_MARGIN) * view.cell + normal @ view.middle
            line = is_hidden * np.array([*normal, -farthest])
    return Resembling(best, pose, line)


def distinct(
    found: Iterable[tuple[Alignment, T]], count: int, symmetry: Symmetry | None
) -> list[T]:
    """The first ones, so many at most, whose alignments are too far apart for a common minimum.

    Of alignments that are equal under the symmetry the canonical ones are compared.
    """
    group = None if symmetry is None else group_of(symmetry)
    poses: list[Alignment] = []
    kept: list[T] = []
    for given, each in found:
        pose = given
        if group is not None:
            pose = group.canonical(given, tolerance=_DISTINCT_STRETCH).alignment
        if all(_differ(pose, other) for other in poses):
            poses.append(pose)
            kept.append(each)
        if len(kept) == count:
            break
    return kept


def _differ(one: Alignment, other: Alignment) -> bool:
    """True if rotations or scales are too far apart for one start to lead to both."""
    turn = angle_between(one.rotation, other.rotation)
    stretch = np.abs(np.log(one.scale / other.scale)).max()
    return bool(turn > _DISTINCT_DEG or stretch > _DISTINCT_STRETCH)
