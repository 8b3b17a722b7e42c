"""Next-best evidence: what to add to one view's keypoints, by its predicted effect."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.fitting.joint.deviations import pose_and_lengths
from cadalign.fitting.joint.model import Model
from cadalign.fitting.joint.pack import evidence_of
from cadalign.fitting.joint.prior import prior_of
from cadalign.fitting.joint.size import Size
from cadalign.fitting.joint.view import View
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.solvers.constants import LINEAR
from cadalign.solvers.joint.covariance import joint_covariance
from cadalign.solvers.joint.evidence import State

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
    """

    kind: str
    detail: Hashable
    rotation_deg: float
    position: float
    stretch: tuple[float, float, float]

    @property
    def worst(self) -> float:
        """The largest deviation: rotation in radians, position, stretch."""
        return max(float(np.radians(self.rotation_deg)), self.position, *self.stretch)


def rank_evidence(
    model: Model,
    view: View,
    alignment: Alignment,
    *,
    candidates: Sequence[Hashable] = (),
    mask: npt.ArrayLike | None = None,
) -> tuple[Advice, ...]:
    """Rank what could be added to the keypoints of a view, the most useful first.

    Compared is the largest deviation that is left, linearised at the alignment. A further view is
    one of the same keypoints from 25 deg aside, the motion unknown. Lengths are the object's width
    and the less certain of its height and length, measured to 1 %.

    Parameters
    ----------
    model : Model
        Exact or stretched.
    view : View
        The keypoints that there are.
    alignment : Alignment
        The estimate from them.
    candidates : sequence of int or str
        Ids of keypoints that could be marked, as precisely as the others on average.
    mask : (h, w) bool, optional
        The mask that is predicted for the alignment, where one could be drawn; the model then needs
        its mesh. Its contour counts with a deviation of 1.5 px.

    Returns
    -------
    tuple of Advice

    Raises
    ------
    InputError
        If the model is not exact, or lacks a keypoint or the mesh.

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
    found = [
        _advice("keypoint", name, model, [_with_keypoint(model, view, alignment, name)], alignment)
        for name in candidates
    ]
    found.append(_advice("view", "", model, [view, _turned(model, view, alignment)], alignment))
    found.extend(_lengths(model, view, alignment))
    if mask is not None:
        from cadalign.fitting.contours.bound import contour_bound  # with OpenCV and embree

        masked = replace(view, mask=mask, mask_sigma=_MASK_SIGMA)
        found.append(_summary("mask", "", contour_bound(model, masked, alignment), alignment))
    return tuple(sorted(found, key=lambda each: each.worst))


def _lengths(model: Model, view: View, alignment: Alignment) -> Iterator[Advice]:
    """The width, and of the two other lengths the one whose knowledge leaves less open."""
    bounds = np.asarray(model.bounds)
    lengths = np.ptp(bounds, axis=0) * alignment.scale
    pairs = [
        _advice(
            "lengths",
            f"width and {name}",
            model,
            [view],
            alignment,
            Size(width=lengths[0], sigma=LENGTH_SIGMA, **{name: lengths[axis]}),
        )
        for axis, name in enumerate(_LENGTHS)
        if axis and lengths[0] > 0 and lengths[axis] > 0
    ]
    yield from sorted(pairs, key=lambda each: each.worst)[:1]


def _with_keypoint(model: Model, view: View, alignment: Alignment, name: Hashable) -> View:
    (place,) = _predicted(model, view, alignment, (name,))
    points = np.vstack([cast(FloatArray, view.points_2d), place])
    given = np.asarray(view.sigma, dtype=np.float64)
    sigma = given if given.ndim == 3 else np.broadcast_to(given, len(points) - 1)
    sigma = np.concatenate([sigma, sigma.mean(axis=0, keepdims=True)])
    return View(view.camera, points, ids=(*view.keypoint_ids, name), sigma=sigma)


def _turned(model: Model, view: View, alignment: Alignment) -> View:
    """The same keypoints in a camera that went around the object."""
    moved = _moved(model, alignment)
    points = _predicted(model, view, moved, view.keypoint_ids)
    return View(view.camera, points, ids=view.keypoint_ids, sigma=view.sigma)


def _moved(model: Model, alignment: Alignment) -> Alignment:
    centre = alignment.apply(np.asarray(model.bounds).mean(axis=0)[None])[0]
    turn = rotation_from_vector(np.array([0.0, np.radians(TURN_DEG), 0.0]))
    shift = centre + turn @ (alignment.translation - centre)
    return Alignment(turn @ alignment.rotation, shift, alignment.scale)


def _predicted(
    model: Model, view: View, alignment: Alignment, names: Sequence[Hashable]
) -> FloatArray:
    rows = prior_of(model).rows_of(tuple(names), "candidates")
    return view.camera.project(alignment.apply(np.asarray(model.points_3d)[rows]))


def _advice(
    kind: str,
    detail: Hashable,
    model: Model,
    views: Sequence[View],
    alignment: Alignment,
    size: Size | None = None,
) -> Advice:
    """The effect of evidence that agrees with the alignment."""
    evidence = evidence_of(prior_of(model), views, size, loss=LINEAR, loss_scale=1.0)
    places = [alignment, _moved(model, alignment)][: len(views)]
    state = State(
        np.array([np.append(each.rotation.ravel(), each.translation) for each in places]),
        np.log(alignment.scale),
        np.zeros(len(evidence.shape.modes)),
        np.zeros_like(evidence.shape.mean),
    )
    unknowns = joint_covariance(evidence, state).unknowns
    return _summary(kind, detail, pose_and_lengths(evidence, state, unknowns), alignment)


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
