"""Poses and stretches of a model whose silhouette resembles a mask's, without any start.

Each silhouette of the model that resembles the mask's at some turn (`silhouettes.py`) gives an
affine camera ``M = R[:2] S / Z``. The rows of ``M S^-1`` are orthogonal and of one length, so that
the stretch follows by two linear equations in the inverse squares of its scales.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import NamedTuple, TypeVar

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.estimation.contours.silhouettes import (
    CELLS,
    COMPARED,
    TURNS,
    Atlas,
    FacedMask,
    Whitened,
    around,
    atlas_of,
    eye_of,
    overlaps,
)
from cadalign.geometry.alignment import Alignment, model_rays
from cadalign.geometry.camera import Camera, turned_alignment
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.rotations import angle_between
from cadalign.geometry.symmetry import Symmetry
from cadalign.geometry.symmetry_group import group_of

_LINES = 16  # directions of what hides a part
_HIDDEN_POWER = 0.1  # of the share that is left: to hide more is less likely
_LEAST_HIDDEN = 0.03  # of the area, that a line hides
_LINE_MARGIN = 4.0  # [cells], on the object's side of a line, whose directions are few
_LEAST_OF_BEST = 0.97  # overlap of another turn, relative to the best one of the same direction
_MOST_AFFINE = 200  # cameras of which the silhouettes are rendered
_MOST_AFFINE_CUT = 600  # where the mask may lack a part, which leaves more possible
_ITERATIONS = 8
_PRIOR = 0.05  # weight of the logarithms of scales
_MOST_LOG = 1.3
_DISTINCT_DEG = 10.0
_DISTINCT_STRETCH = 0.2

T = TypeVar("T")


class Resembling(NamedTuple):
    """An alignment whose silhouette, or the part of it that a line leaves, resembles a mask.

    The ``overlap`` is their intersection over union. Rays with ``line @ ray > 0`` are near the
    line (3,) or beyond it; it is zero where none is needed.
    """

    overlap: float
    alignment: Alignment
    line: FloatArray


def resembling_poses(
    mesh: Mesh,
    mask: FloatArray | BoolArray,
    camera: Camera,
    *,
    free: BoolArray,
    count: int,
    is_cut: bool = False,
    symmetry: Symmetry | None = None,
) -> list[Resembling]:
    """Distinct alignments whose silhouettes resemble a mask (h, w), the best first.

    ``free`` (3,) marks the scales that are unknown; ``is_cut`` says that the mask may lack all that
    lies beyond a line. Of alignments that are equal under the ``symmetry`` one is kept.
    """
    view = FacedMask.of(mask, camera)
    atlas = atlas_of(mesh, eye_of(mesh, view.outline), is_cut=is_cut)
    cameras = _affine_cameras(atlas, view.outline, _MOST_AFFINE_CUT if is_cut else _MOST_AFFINE)
    poses = [Alignment(*each) for each in zip(*_poses_of(*cameras, atlas, free), strict=True)]
    found = [_resemblance(atlas, view, pose, is_cut=is_cut) for pose in poses]
    found.sort(key=lambda each: -each.overlap)
    kept = distinct(((each.alignment, each) for each in found), count, symmetry)
    turn = view.camera_from_facing
    return [
        Resembling(each.overlap, turned_alignment(each.alignment, turn), turn @ each.line)
        for each in kept
    ]


def _affine_cameras(atlas: Atlas, query: Whitened, most: int) -> tuple[FloatArray, FloatArray]:
    """Maps ``M x + b`` of the model to the query's plane, those of the ``most`` best overlaps.

    Matrices (n, 2, 3) and shifts (n, 2).
    """
    overlap = overlaps(atlas.views, query)
    # A whitened silhouette may fit at several turns.
    is_peak = (overlap >= np.roll(overlap, 1, 1)) & (overlap >= np.roll(overlap, -1, 1))
    is_peak &= overlap > _LEAST_OF_BEST * overlap.max(axis=1, keepdims=True)
    peaks = np.nonzero(is_peak)
    best = np.argsort(-overlap[peaks])[:most]
    row, number = (each[best] for each in peaks)
    cosine, sine = around(TURNS)[number].T
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
        transposed = slopes.swapaxes(1, 2)
        normal = transposed @ slopes + _PRIOR**2 * np.eye(count)
        gradient = (transposed @ relative.sum(axis=2)[:, :, None])[:, :, 0]
        gradient += _PRIOR**2 * logs[:, free]
        step = np.linalg.solve(normal, -gradient[:, :, None])[:, :, 0]
        moved = logs[:, free] + np.clip(step, -0.5, 0.5)
        logs[:, free] = np.clip(moved, -_MOST_LOG, _MOST_LOG)
    return np.asarray(np.exp(logs))


@cache
def _line_bins() -> IntArray:
    """Numbers (`_LINES`, m) of the cells' places along directions, all around."""
    places = COMPARED - (CELLS - 1) / 2
    x, y = np.meshgrid(places, places)
    cosine, sine = around(_LINES).T[:, :, None]
    along = cosine * x.ravel() + sine * y.ravel()
    return np.asarray(np.rint(along + CELLS), dtype=np.int64)


def _resemblance(atlas: Atlas, view: FacedMask, pose: Alignment, *, is_cut: bool) -> Resembling:
    """Compare a pose's silhouette with the mask.

    If it ``is_cut``, what the best line leaves of the silhouette, less where it leaves less.
    """
    origin, model_from_ray = model_rays(pose)
    mask = view.inside
    seen = atlas.caster.covered(origin, view.rays @ model_from_ray.T) & view.is_seen
    both, total = mask[seen], float(mask.sum())
    if not is_cut:
        overlap = float(both.sum()) / (total + len(both) - float(both.sum()))
        return Resembling(overlap, pose, np.zeros(3))
    best, line = 0.0, np.zeros(3)
    for normal, bins in zip(around(_LINES), _line_bins()[:, seen], strict=True):
        count = np.cumsum(np.bincount(bins, minlength=1))
        common = np.cumsum(np.bincount(bins, weights=both, minlength=1))
        share = count / max(float(count[-1]), 1.0)
        overlaps = common / (total + count - common) * share**_HIDDEN_POWER
        last = int(overlaps.argmax())
        if overlaps[last] > best:
            best, is_hidden = float(overlaps[last]), share[last] < 1 - _LEAST_HIDDEN
            farthest = (last - CELLS - _LINE_MARGIN) * view.cell + normal @ view.middle
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
