"""Next-best evidence: what to add to the views of an object, by its predicted effect."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.errors import InputError, quote
from cadalign.fitting.joint.known_scene import KnownScene, scene_of
from cadalign.fitting.joint.model import Model
from cadalign.fitting.joint.result import AlignResult
from cadalign.fitting.joint.size import Size
from cadalign.fitting.joint.view import View
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.rotations import nearest_rotation, rotation_from_vector
from cadalign.shapes.model import ShapeModel

TURN_DEG = 25.0  # of another view about the object
_MASK_SIGMA = 1.5  # of a contour as segmentation gives it [px]
LENGTH_SIGMA = 0.01
_LENGTHS = ("width", "height", "length")


@dataclass(frozen=True)
class Advice:
    """One piece of evidence that could be added, and its predicted effect.

    Parameters
    ----------
    kind : {"keypoint", "mask", "view", "lengths"}
    detail : int or str
        Id of the keypoint; names of the two lengths; empty otherwise.
    rotation_deg : float
        Standard deviation of the rotation with the piece [degrees].
    position : float
        Of the translation, over the distance.
    stretch : tuple of 3 float
        Of the lengths along x, y, z, relative.
    view : int
        Number of the view that a keypoint or a mask is added to.
    """

    kind: str
    detail: Hashable
    rotation_deg: float
    position: float
    stretch: tuple[float, float, float]
    view: int = 0

    @property
    def worst(self) -> float:
        """The largest deviation: rotation in radians, position, stretch."""
        return max(float(np.radians(self.rotation_deg)), self.position, *self.stretch)


def rank_evidence(
    model: Model | ShapeModel,
    views: View | Sequence[View],
    estimate: Alignment | AlignResult,
    *,
    candidates: Sequence[Hashable] = (),
    mask: npt.ArrayLike | None = None,
    size: Size | None = None,
) -> tuple[Advice, ...]:
    """Rank what could be added to the evidence of an object's views, the most useful first.

    Compared is the largest deviation that is left, linearised at the estimate; what is known of a
    learned or similar shape counts. A further view is one of the first view's keypoints from 25 deg
    aside, its motion known where that of the others is. Lengths are the object's width and the less
    certain of its height and length, measured to 1 %, or the one of them that is still unknown.

    Parameters
    ----------
    model : Model or ShapeModel
    views : View or sequence of View
        All that is there; of a depth image, what it tells at keypoints counts.
    estimate : Alignment or AlignResult
        The estimate from them. An alignment, in the first camera, suffices for an exact model and
        one view, or views with ``cam_from_rig``.
    candidates : sequence of int or str
        Ids of keypoints that could be marked in any view that lacks them and whose image they lie
        in, as precisely as the others on average.
    mask : (h, w) bool, optional
        The mask that is predicted for the estimate in the first view, where one could be drawn; the
        model then needs its mesh. Its contour counts with a deviation of 1.5 px.
    size : Size, optional
        The lengths that are known.

    Returns
    -------
    tuple of Advice

    Raises
    ------
    InputError
        If the model lacks a keypoint or the mesh, every view has a candidate, an alignment does not
        suffice, or there is a mask and the model is not exact.

    Examples
    --------
    >>> from cadalign import Camera
    >>> corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    >>> camera = Camera(640, 480, 900, 900, 319.5, 239.5)
    >>> truth = Alignment(np.diag([-1.0, -1.0, 1.0]), [0.3, 0.2, 6.0], np.ones(3))
    >>> seen = View(camera, camera.project(truth.apply(corners[:6])), ids=range(6))
    >>> first, *others = rank_evidence(Model(points_3d=corners), seen, truth, candidates=[6, 7])
    >>> first.kind, len(others)
    ('lengths', 3)
    """
    given = (views,) if isinstance(views, View) else tuple(views)
    scene = scene_of(model, given, estimate, size)
    found = [each for name in candidates for each in _keypoints(scene, name)]
    found.append(_best(_view(scene, turn) for turn in _turns(scene)))
    found.extend(_lengths(scene))
    if mask is not None and given[0].mask is None:
        first = replace(_without_scale(given[0]), mask=mask, mask_sigma=_MASK_SIGMA)
        masked = scene_of(model, (first, *given[1:]), estimate, size)
        found.append(_advice("mask", "", masked))
    return tuple(sorted(found, key=lambda each: each.worst))


def _turns(scene: KnownScene) -> tuple[float, ...]:
    """Angles of a further view; beside several views, to the side that tells more."""
    return (TURN_DEG,) if len(scene.views) == 1 else (TURN_DEG, -TURN_DEG)


def _best(advice: Iterable[Advice]) -> Advice:
    return min(advice, key=lambda each: each.worst)


def _view(scene: KnownScene, turn_deg: float) -> Advice:
    return _advice("view", "", scene.with_view(_turned(scene, turn_deg)))


def _turned(scene: KnownScene, turn_deg: float) -> tuple[View, Alignment]:
    """The first view's keypoints in a camera that went around the object."""
    view, pose = scene.views[0], scene.poses[0]
    centre = pose.apply(scene.bounds.mean(axis=0)[None])[0]
    turn = rotation_from_vector(np.array([0.0, np.radians(turn_deg), 0.0]))
    shift = centre - turn @ centre
    moved = Alignment(turn @ pose.rotation, turn @ pose.translation + shift, pose.scale)
    motion = None
    if view.cam_from_rig is not None:
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = turn, shift
        motion = step @ cast(FloatArray, view.cam_from_rig)
        motion[:3, :3] = nearest_rotation(motion[:3, :3])
    points = view.camera.project(moved.apply(scene.points_of(view.keypoint_ids)))
    ids, sigma = view.keypoint_ids, view.sigma
    return View(view.camera, points, ids=ids, sigma=sigma, cam_from_rig=motion), moved


def _lengths(scene: KnownScene) -> Iterator[Advice]:
    """The unknown one of the width and another length, or both, that leaves the least open."""
    lengths = np.ptp(scene.bounds, axis=0) * scene.poses[0].scale
    known = np.full(3, np.nan) if scene.size is None else scene.size.lengths
    sigma = np.where(np.isfinite(known), _relative(scene.size), LENGTH_SIGMA)
    rows = [(0, 1), (0, 2)] if np.isnan(known[0]) else [(1,), (2,)]
    found = []
    for axes in rows:
        new = [axis for axis in axes if np.isnan(known[axis])]
        if not new or not (lengths[new] > 0).all():
            continue
        all_of_them = known.copy()
        all_of_them[new] = lengths[new]
        told = dict(zip(_LENGTHS, all_of_them.tolist(), strict=True))
        size = Size(**{name: value for name, value in told.items() if value == value}, sigma=sigma)
        detail = " and ".join(_LENGTHS[axis] for axis in new)
        found.append(_advice("lengths", detail, replace(scene, size=size)))
    if found:
        yield _best(found)


def _relative(size: Size | None) -> FloatArray:
    """Relative deviations (3,) of known lengths."""
    given = LENGTH_SIGMA if size is None else size.sigma
    return np.broadcast_to(np.asarray(given, dtype=np.float64), (3,))


def _keypoints(scene: KnownScene, name: Hashable) -> Iterator[Advice]:
    """A keypoint in every view that lacks it and can show it."""
    lacking = [n for n, view in enumerate(scene.views) if name not in view.keypoint_ids]
    if not lacking:
        fix = "give those that a view lacks"
        raise InputError(f"every view has the keypoint {quote(name)}", where="candidates", fix=fix)
    for number in lacking:
        place = scene.project((name,), number, "candidates")
        camera = scene.views[number].camera
        if len(scene.views) == 1 or camera.contains(place).all():
            views = list(scene.views)
            views[number] = _with_keypoint(views[number], name, place)
            marked = _advice("keypoint", name, replace(scene, views=tuple(views)))
            yield replace(marked, view=number)


def _with_keypoint(view: View, name: Hashable, place: FloatArray) -> View:
    count = len(view.keypoint_ids)
    depth = view.depth
    if depth is not None and view.depth_image is None:
        depth = np.append(cast(FloatArray, depth), np.nan)
    return replace(
        _without_scale(view),
        points_2d=np.vstack([cast(FloatArray, view.points_2d), place]),
        ids=(*view.keypoint_ids, name),
        sigma=_with_mean(view.sigma, count, is_one=np.ndim(view.sigma) == 0),
        confidences=None,
        depth=depth,
        depth_sigma=_with_mean(view.depth_sigma, count, is_one=np.ndim(view.depth_sigma) == 0),
    )


def _with_mean(sigma: npt.ArrayLike, count: int, *, is_one: bool) -> npt.ArrayLike:
    """Deviations of ``count`` values, and their mean for one more."""
    given = np.asarray(sigma, dtype=np.float64)
    if is_one or not count:
        return given if is_one else 1.0
    return np.concatenate([given, given.mean(axis=0, keepdims=True)])


def _without_scale(view: View) -> View:
    """The view as it is after its depths were read: they are not to be scaled again."""
    return replace(view, depth_scale=None)


def _advice(kind: str, detail: Hashable, scene: KnownScene) -> Advice:
    """The effect of evidence that agrees with the estimate."""
    return _summary(kind, detail, scene.covariance(), scene.poses[0])


def _summary(kind: str, detail: Hashable, covariance: FloatArray, alignment: Alignment) -> Advice:
    """Deviations up to scale, which is known or not according to the evidence."""
    distance = float(np.linalg.norm(alignment.translation))
    # Translation over the distance, and lengths, relative to the length along x.
    terms = np.zeros((9, 9))
    terms[:3, :3] = np.eye(3)
    terms[3:6, 3:6] = np.eye(3) / distance
    terms[3:6, 6] = -alignment.translation / distance
    terms[6:, 6:] = np.eye(3)
    terms[6:, 6] -= 1.0
    deviations = np.sqrt(np.maximum((terms @ covariance @ terms.T).diagonal(), 0.0))
    x, y, z = deviations[6:].tolist()
    return Advice(
        kind,
        detail,
        float(np.degrees(np.linalg.norm(deviations[:3]))),
        float(np.linalg.norm(deviations[3:6])),
        (x, y, z),
    )
