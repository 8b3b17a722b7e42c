"""`align_scene`: several objects of one photo, which share its camera and the ground.

Each object is aligned by `cadalign.align`. What its evidence says of the shared unknowns (focal
length, direction of gravity, height of the camera above the ground) is its message: the Gaussian of
its posterior, the prior that it was given divided out. The others' messages and what the user knows
are its prior in the next round, as in expectation propagation (Minka, 2001): at the fixed point the
objects agree, and each is as certain as all evidence together makes it, up to the correlations
between the shared unknowns within a prior, which are left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from cadalign.arrays import FloatArray, as_positive
from cadalign.errors import CadalignError, DegenerateError, InputError, quote, require_kind
from cadalign.estimation.align import align
from cadalign.estimation.evidence_kinds import upward
from cadalign.estimation.focal import USUAL, FocalPrior, PriorOption, prior_of_camera
from cadalign.estimation.options import FitOptions, RansacOptions
from cadalign.estimation.prior import prior_of
from cadalign.estimation.result import Result
from cadalign.estimation.results import Results
from cadalign.estimation.scene_messages import (
    PARTS,
    UP,
    Member,
    SceneMessage,
    SceneObject,
    SharedUnknowns,
    as_prior,
)
from cadalign.estimation.uncertainty.residuals import chi_square_tail
from cadalign.estimation.uncertainty.summary import Uncertainty
from cadalign.geometry.camera import Camera

SHARED = tuple(PARTS)
_WORDS = {"focal": "focal length", "gravity": "direction of gravity", "ground": "ground"}
_ROUNDS = 8
_SETTLED = 0.02  # change of the shared unknowns that ends the rounds, in standard deviations
_FALSE_ALARMS = 1e-4  # of objects that agree


@dataclass(frozen=True, eq=False)
class AlignedScene:
    """Objects of a photo, aligned together.

    Parameters
    ----------
    results : Results
        A `Result` for each object, or the error in its place.
    camera : Camera
        The photo's camera, with the focal length of all objects together.
    focal_std : float
        Its relative standard deviation; 0 where it was known.
    up : (3,) float or None
        The direction against gravity in the camera's frame, where it is shared.
    up_std_deg : float
        Its standard deviation, about the axis about which it is larger [degrees].
    camera_height : float or None
        Height of the camera above the ground, where that is shared and some object's size is known.
    camera_height_std : float
        Its relative standard deviation.
    warnings : tuple of str
        Objects that contradict the others, and were left alone.
    """

    results: Results
    camera: Camera
    focal_std: float = 0.0
    up: FloatArray | None = None
    up_std_deg: float = 0.0
    camera_height: float | None = None
    camera_height_std: float = 0.0
    warnings: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Shared unknowns and warnings in the form of JSON, without the objects' results."""
        plain = {name: value for name, value in vars(self).items() if name != "results"}
        up = None if self.up is None else self.up.tolist()
        return plain | {"camera": self.camera.to_dict(), "up": up, "warnings": list(self.warnings)}

    def __str__(self) -> str:
        """Shared unknowns and warnings as text; ``results`` have a text of each object."""
        lines = [f"scene of {len(self.results)} objects"]
        if self.focal_std:
            share = f"+- {100 * self.focal_std:.2g} %"
            lines.append(f"  focal length {self.camera.fx:.4g} px {share}")
        if self.up is not None:
            direction = ", ".join(f"{value:.3f}" for value in self.up)
            lines.append(f"  up           ({direction}) +- {self.up_std_deg:.2g} deg")
        if self.camera_height is not None:
            share = f"+- {100 * self.camera_height_std:.2g} %"
            lines.append(f"  camera       {self.camera_height:.4g} above the ground {share}")
        lines.extend(f"  warning      {text}" for text in self.warnings)
        return "\n".join(lines)


def align_scene(
    objects: Sequence[SceneObject],
    *,
    share: Collection[str] = ("focal",),
    tilt_sigma_deg: float = 1.0,
    focal_prior: PriorOption = FitOptions.focal_prior,
    loss: str = FitOptions.loss,
    loss_scale: float = FitOptions.loss_scale,
    ransac: RansacOptions | None = None,
) -> AlignedScene:
    """Align several objects of one photo, which share its camera and the ground.

    Parameters
    ----------
    objects : sequence of SceneObject
        One model and one view each, the views of one camera. A camera `Camera.without_focal` has
        its focal length estimated.
    share : collection of {"focal", "gravity", "ground"}
        What the objects have in common: the focal length, where it is unknown; the direction of
        gravity, as objects standing upright have it; and the ground that they stand on with their
        lowest faces, which includes gravity. The height of the camera above the ground is known by
        `View.camera_height`, or by the objects whose ``size`` is known; it determines the size of
        the others.
    tilt_sigma_deg : float
        Standard deviation of an object's up axis about gravity [degrees].
    focal_prior, loss, loss_scale, ransac
        As for `cadalign.align`.

    Returns
    -------
    AlignedScene
        An object that contradicts the others in what they share is aligned alone, and named in the
        warnings.

    Raises
    ------
    InputError
        If an argument is invalid, the cameras differ, or a model has no up axis and ``share`` needs
        one.
    DegenerateError
        If no object can be aligned.

    Examples
    --------
    Two boxes in a photo of unknown focal length:

    >>> from cadalign import Alignment, Camera, Model, SceneObject, View
    >>> corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    >>> camera = Camera(640, 480, 600, 600, 319.5, 239.5)
    >>> places = [[0.6, 0.3, 4.0], [-0.8, 0.4, 5.0]]
    >>> turn = np.array([[-0.8, 0.0, 0.6], [0.0, -1.0, 0.0], [0.6, 0.0, 0.8]])
    >>> poses = [Alignment(turn, place, [1.0, 1.2, 0.9]) for place in places]
    >>> unknown = Camera.without_focal(640, 480)
    >>> seen = [View(unknown, camera.project(pose.apply(corners))) for pose in poses]
    >>> scene = align_scene([SceneObject(Model(points_3d=corners), view) for view in seen])
    >>> bool(abs(scene.camera.fx / 600 - 1) < 2 * scene.focal_std)
    True
    """
    camera, wanted = _checked(objects, share)
    tilt = math.radians(as_positive(tilt_sigma_deg, name="tilt_sigma_deg"))
    known = _known(objects, prior_of_camera(focal_prior, camera))
    if "gravity" in wanted:
        for each in objects:
            upward("share", prior_of(each.model))

    def aligned(given: SceneObject, had: SharedUnknowns) -> Result:
        prior: PriorOption = USUAL
        if not camera.focal_known:
            prior = had.focal_prior if "focal" in wanted else focal_prior
        return align(
            given.model,
            had.seen_by(given.view, wanted),
            size=given.size,
            init=given.init,
            loss=loss,
            loss_scale=loss_scale,
            ransac=ransac,
            focal="known" if camera.focal_known else "estimate",
            focal_prior=prior,
        )

    found: list[Result | CadalignError] = []
    members = []
    first = known.tilted(tilt)
    for number, each in enumerate(objects):
        try:
            result = aligned(each, first)
        except CadalignError as error:
            found.append(error)
            continue
        found.append(result)
        members.append(Member(number, each, wanted, first, result))
    if not members:
        raise DegenerateError(f"no object can be aligned: {found[0]}", where="objects")
    members, warnings = _agreeing(members, known, tilt)
    shared = _fused(members, _reference(members), known, tilt)
    if wanted and len(members) > 1:
        shared, members = _settled(members, shared, known, tilt, aligned)
    for member in members:
        found[member.number] = member.result
    scene = AlignedScene(Results.of(found), camera, warnings=tuple(warnings))
    if "focal" in wanted:
        focal_std = shared.std("focal")
        scene = replace(scene, camera=camera.with_focal(shared.focal), focal_std=focal_std)
    if "gravity" in wanted:
        up_std = float(np.degrees(shared.std("gravity")))
        scene = replace(scene, up=shared.up, up_std_deg=up_std)
    if "ground" in wanted and np.isfinite(shared.covariance[3, 3]):
        height_std = shared.std("ground")
        scene = replace(scene, camera_height=shared.height, camera_height_std=height_std)
    return scene


def focal_prior_by_others(
    objects: Sequence[SceneObject], results: Sequence[Result], priors: Sequence[FocalPrior | None]
) -> tuple[FocalPrior | None, tuple[str, ...]]:
    """Prior on the focal length of the first object by the others of its photo, beside its own.

    As in the first round of `align_scene`: of each other object's estimate its own prior is divided
    out, so that nothing counts twice.

    Parameters
    ----------
    objects : sequence of SceneObject
        The object, and the others.
    results : sequence of Result
        Each aligned alone, its focal length estimated.
    priors : sequence of FocalPrior or None
        With which each was aligned.

    Returns
    -------
    prior : FocalPrior or None
        The object's own one where it agrees with no other object.
    warnings : tuple of str
        Objects that contradict the others.

    Examples
    --------
    >>> from cadalign import Alignment, Camera, Model, SceneObject, View
    >>> corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    >>> turn = np.array([[-0.8, 0.0, 0.6], [0.0, -1.0, 0.0], [0.6, 0.0, 0.8]])
    >>> box = Alignment(turn, [0.6, 0.3, 4.0], [1.0, 1.2, 0.9]).apply(corners)
    >>> pixels = Camera(640, 480, 600, 600, 319.5, 239.5).project(box)
    >>> seen = SceneObject(Model(points_3d=corners), View(Camera.without_focal(640, 480), pixels))
    >>> usual = FocalPrior.of_usual_lenses(640, 480)
    >>> alone = align(seen.model, seen.view, focal="estimate", focal_prior=usual)
    >>> prior, warnings = focal_prior_by_others([seen, seen], [alone, alone], [usual, usual])
    >>> prior.relative_sigma < usual.relative_sigma
    True
    """
    given = enumerate(zip(objects, results, priors, strict=True))
    members = [
        Member(number, each, ("focal",), _known([], prior), result)
        for number, (each, result, prior) in given
    ]
    own = members[0]
    members, warnings = _agreeing(members, own.had, 0.0)
    prior = priors[0]
    if own in members and len(members) > 1:
        reference = _reference(members)
        messages = [each.message(reference, 0.0) for each in members]
        others = _but_for(messages, members.index(own), as_prior(own.had, reference))
        prior = reference.moved(*others.moments).focal_prior
    return prior, tuple(warnings)


def _checked(
    objects: Sequence[SceneObject], share: Collection[str]
) -> tuple[Camera, tuple[str, ...]]:
    """The camera of valid objects, and the unknowns that they share, in order."""
    if not isinstance(objects, Sequence) or not len(objects):
        fix = "give a list of cadalign.SceneObject"
        raise InputError("expected at least one object", where="objects", fix=fix)
    for number, one in enumerate(objects):
        require_kind(one, SceneObject, f"objects[{number}]")
        if one.view.camera != objects[0].view.camera:
            what = "the camera differs from the first object's"
            fix = "give objects of one photo, with its camera"
            raise InputError(what, where=f"objects[{number}].view.camera", fix=fix)
    if isinstance(share, str) or not set(share) <= set(SHARED):
        fix = f"give some of {', '.join(SHARED)}"
        raise InputError(f"{quote(share)} is not what objects share", where="share", fix=fix)
    camera, wanted = objects[0].view.camera, set(share)
    if "ground" in wanted:  # which includes gravity
        wanted.add("gravity")
    if camera.focal_known:
        wanted.discard("focal")
    return camera, tuple(part for part in SHARED if part in wanted)


def _known(objects: Sequence[SceneObject], focal: FocalPrior | None) -> SharedUnknowns:
    """Knowledge of the user about the shared unknowns, by the first view that has it."""
    covariance = np.diag(np.full(4, np.inf))
    up, height = np.array([0.0, -1.0, 0.0]), 1.0
    given = [each.view for each in objects if each.view.up is not None]
    if given:
        up, sigma = cast(FloatArray, given[0].up), np.asarray(given[0].up_sigma_deg, dtype=float)
        across = SharedUnknowns(1.0, up, 1.0, covariance).across
        turned = np.radians(np.radians(sigma if sigma.ndim else sigma**2 * np.eye(3)))
        covariance[UP, UP] = across @ turned @ across.T
    heights = [each.view for each in objects if each.view.camera_height is not None]
    if heights:
        height = cast(float, heights[0].camera_height)
        covariance[3, 3] = cast(float, heights[0].camera_height_sigma) ** 2
    if focal is not None:
        covariance[0, 0] = focal.relative_sigma**2
    return SharedUnknowns(1.0 if focal is None else focal.focal, up, height, covariance)


def _reference(members: Sequence[Member]) -> SharedUnknowns:
    """Values of the object that is most certain of its rotation."""
    best = min(members, key=lambda each: cast(Uncertainty, each.result.std).rotation_deg)
    return best.values(SharedUnknowns(1.0, np.array([0.0, -1.0, 0.0]), 1.0, np.zeros((4, 4))))


def _fused(
    members: Sequence[Member], reference: SharedUnknowns, known: SharedUnknowns, tilt: float
) -> SharedUnknowns:
    """The shared unknowns by all objects and what the user knows."""
    messages = [each.message(reference, tilt) for each in members]
    return reference.moved(*sum(messages, as_prior(known, reference)).moments)


def _agreeing(
    members: list[Member], known: SharedUnknowns, tilt: float
) -> tuple[list[Member], list[str]]:
    """The objects that agree in what they share; the others are named, the worst first."""
    warnings = []
    while len(members) > 1:
        reference = _reference(members)
        messages = [each.message(reference, tilt) for each in members]
        prior = as_prior(known, reference)
        worst: tuple[float, int, str] = (1.0, 0, "")
        for number, member in enumerate(members):
            others = _but_for(messages, number, prior)
            for part in member.shared:
                tail = _tail(messages[number], others, PARTS[part])
                worst = min(worst, (tail, number, part))
        tail, number, part = worst
        if tail > _FALSE_ALARMS / len(members):
            break
        warnings.append(
            f"{members[number].name} contradicts the {_WORDS[part]} of the other objects, and is "
            "aligned alone: check its model, its keypoints, and whether it stands in this photo"
        )
        members = members[:number] + members[number + 1 :]
    return members, warnings


def _but_for(messages: Sequence[SceneMessage], number: int, prior: SceneMessage) -> SceneMessage:
    """The prior of an object: what the others say, and what the user knows."""
    return sum((each for k, each in enumerate(messages) if k != number), prior)


def _tail(own: SceneMessage, others: SceneMessage, part: slice) -> float:
    """Probability that two messages about a part differ by more than they do."""
    (mean, covariance), (other_mean, other_covariance) = own.moments, others.moments
    block = covariance[part, part] + other_covariance[part, part]
    if not np.isfinite(block).all():
        return 1.0
    difference = mean[part] - other_mean[part]
    square = float(difference @ np.linalg.pinv(block, hermitian=True) @ difference)
    return chi_square_tail(square, len(difference))


def _settled(
    members: list[Member],
    shared: SharedUnknowns,
    known: SharedUnknowns,
    tilt: float,
    aligned: Callable[[SceneObject, SharedUnknowns], Result],
) -> tuple[SharedUnknowns, list[Member]]:
    """The shared unknowns, and the objects aligned with each other as their priors."""
    for _ in range(_ROUNDS):
        prior = as_prior(known, shared)
        messages = [each.message(shared, tilt) for each in members]
        moved = []
        for number, member in enumerate(members):
            others = _but_for(messages, number, prior)
            had = shared.moved(*others.moments).tilted(tilt)
            try:
                result = aligned(member.given, had)
            except CadalignError:  # as it was
                moved.append(member)
            else:
                moved.append(replace(member, had=had, result=result))
        members = moved
        last, shared = shared, _fused(members, shared, known, tilt)
        change = last.deviations(shared.focal, shared.up, shared.height)
        variances = shared.covariance.diagonal()
        is_said = np.isfinite(variances) & (variances > 0)
        if (change[is_said] ** 2 <= _SETTLED**2 * variances[is_said]).all():
            break
    return shared, members
