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
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cadalign.arrays import FloatArray, as_positive
from cadalign.errors import CadalignError, DegenerateError, InputError, quote, require_kind
from cadalign.estimation.align import align
from cadalign.estimation.focal import FocalPrior, PriorOption, prior_of_camera
from cadalign.estimation.known_evidence import upward
from cadalign.estimation.options import FitOptions, RansacOptions
from cadalign.estimation.prior import prior_of
from cadalign.estimation.result import Result
from cadalign.estimation.results import Results
from cadalign.estimation.scene_messages import (
    FALSE_ALARMS,
    FIELDS,
    PARTS,
    Member,
    SceneObject,
    SharedUnknowns,
    agreeing,
    as_prior,
    but_for,
    known_by,
    left_out,
    reference_of,
)
from cadalign.estimation.view import View
from cadalign.geometry.camera import Camera

SHARED = tuple(PARTS)
_ROUNDS = 8
_SETTLED = 0.02  # change of the shared unknowns that ends the rounds, in standard deviations


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
        Objects that contradict the others and were left alone, and what tells nothing.
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
    focal: str | None = None,
    focal_prior: PriorOption = FitOptions.focal_prior,
    loss: str = FitOptions.loss,
    loss_scale: float = FitOptions.loss_scale,
    ransac: RansacOptions | None = None,
) -> AlignedScene:
    """Align several objects of one photo, which share its camera and the ground.

    Parameters
    ----------
    objects : sequence of SceneObject
        One model and one view each, the views of one camera. Where gravity or the ground is shared,
        ``up`` or ``camera_height`` of the first view that has it counts for all.
    share : collection of {"focal", "gravity", "ground"}
        What the objects have in common: the focal length, where it is unknown; the direction of
        gravity, as objects standing upright have it; and the ground that they stand on with their
        lowest faces, which includes gravity. The height of the camera above the ground is known by
        `View.camera_height`, or by the objects whose ``size`` is known; it determines the size of
        the others.
    tilt_sigma_deg : float
        Standard deviation of an object's up axis about gravity [degrees].
    focal : {"known", "estimate"}, optional
        As for `cadalign.align`; by default known, if the camera has one.
    focal_prior, loss, loss_scale, ransac
        As for `cadalign.align`; what is shared needs ``refine``.

    Returns
    -------
    AlignedScene
        An object that contradicts the others in what they share is aligned alone, and what is given
        but contradicts them all is left out; the warnings name both. An object that cannot be
        aligned alone, as by a mask where the focal length is unknown, is aligned with what the
        others tell, and tells them nothing.

    Raises
    ------
    InputError
        If an argument is invalid, the cameras or what views say of gravity and the ground differ,
        or a model has no up axis and ``share`` needs one.
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
    camera = _checked(objects)
    focal = focal or ("known" if camera.focal_known else "estimate")
    options = FitOptions(loss=loss, loss_scale=loss_scale, focal=focal, focal_prior=focal_prior)
    if ransac is not None:
        require_kind(ransac, RansacOptions, "ransac")
    wanted = _wanted(share, focal=focal, ransac=ransac)
    tilt = math.radians(as_positive(tilt_sigma_deg, name="tilt_sigma_deg"))
    known = known_by([each.view for each in objects], prior_of_camera(focal_prior, camera))
    first = known.tilted(tilt)
    _check_views(objects, first, wanted, tilt)
    if "gravity" in wanted:
        for each in objects:
            upward("share", prior_of(each.model))

    def aligned(given: SceneObject, had: SharedUnknowns) -> Result:
        own = replace(options, focal_prior=had.focal_prior) if "focal" in wanted else options
        view = had.seen_by(given.view, wanted)
        return align(
            given.model, view, size=given.size, init=given.init, ransac=ransac, **own.of_views
        )

    found: list[Result | CadalignError] = []
    members, warnings = [], []
    for number, each in enumerate(objects):
        try:
            result = aligned(each, first)
        except CadalignError as error:
            found.append(error)
            continue
        found.append(result)
        member = Member(number, each, wanted, first, result)
        if result.covariance is not None:
            members.append(member)
        elif wanted:
            warnings.append(f"{member.name} has no covariance to share by, and is aligned alone")
    _require_one(found)
    if not members or not wanted:
        return AlignedScene(Results.of(found), camera, warnings=tuple(warnings))
    members, agreed, contradictions = agreeing(members, known, tilt)
    if agreed is not known:  # which has misled the objects
        wrong: dict[str, Any] = {
            name: None for part, name in FIELDS.items() if np.isinf(agreed.std(part))
        }
        scene = align_scene(
            [replace(each, view=replace(each.view, **wrong)) for each in objects],
            share=share,
            tilt_sigma_deg=tilt_sigma_deg,
            focal=focal,
            focal_prior=None if np.isinf(agreed.std("focal")) else focal_prior,
            loss=loss,
            loss_scale=loss_scale,
            ransac=ransac,
        )
        return replace(scene, warnings=(*left_out(known, agreed), *scene.warnings))
    shared = _fused(members, reference_of(members), known, tilt)
    if len(members) > 1:
        shared, members = _settled(members, shared, known, tilt, aligned)
    for member in members:
        found[member.number] = member.result
    for number, each in enumerate(objects):
        # A mask does not tell the focal length, and points on one line no rotation but for gravity;
        # keypoints that fail without the focal length fail with it.
        can_gain = "gravity" in wanted or each.view.mask is not None
        if isinstance(found[number], CadalignError) and can_gain:
            with suppress(CadalignError):
                found[number] = aligned(each, shared.tilted(tilt))
    scene = AlignedScene(Results.of(found), camera, warnings=(*warnings, *contradictions))
    if "focal" in wanted:
        focal_std = shared.std("focal")
        scene = replace(scene, camera=camera.with_focal(shared.focal), focal_std=focal_std)
    if "gravity" in wanted:
        up_std = float(np.degrees(shared.std("gravity")))
        scene = replace(scene, up=shared.up, up_std_deg=up_std)
    if "ground" in wanted:
        height_std = shared.std("ground")
        if np.isfinite(height_std):
            return replace(scene, camera_height=shared.height, camera_height_std=height_std)
        nothing = "the ground tells nothing: give the size of an object, or the camera's height"
        return replace(scene, warnings=(*scene.warnings, nothing))
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
        Member(number, each, ("focal",), known_by([], prior), result)
        for number, (each, result, prior) in given
    ]
    own = members[0]
    members, known, contradictions = agreeing(members, own.had, 0.0)
    prior = priors[0]
    if own in members and len(members) > 1:
        reference = reference_of(members)
        said = [each.message(reference, 0.0) for each in members]
        others = but_for([*said, as_prior(known, reference)], members.index(own))
        prior = reference.moved(*others.moments).focal_prior
    return prior, (*left_out(own.had, known), *contradictions)


def _checked(objects: Sequence[SceneObject]) -> Camera:
    """The camera of valid objects."""
    if not isinstance(objects, Sequence) or not len(objects):
        fix = "give a list of cadalign.SceneObject"
        raise InputError("expected at least one object", where="objects", fix=fix)
    for number, one in enumerate(objects):
        require_kind(one, SceneObject, f"objects[{number}]")
        fix = "give the object's one view of the photo"
        require_kind(one.view, View, f"objects[{number}].view", fix=fix)
        if one.view.camera != objects[0].view.camera:
            what = "the camera differs from the first object's"
            fix = "give objects of one photo, with its camera"
            raise InputError(what, where=f"objects[{number}].view.camera", fix=fix)
    return objects[0].view.camera


def _wanted(share: Collection[str], *, focal: str, ransac: RansacOptions | None) -> tuple[str, ...]:
    """The unknowns that the objects share, in order."""
    is_known = isinstance(share, Collection) and not isinstance(share, str)
    if not is_known or not all(isinstance(each, str) and each in SHARED for each in share):
        fix = f"give some of {', '.join(SHARED)}"
        raise InputError(f"{quote(share)} is not what objects share", where="share", fix=fix)
    wanted = set(share)
    if "ground" in wanted:  # which includes gravity
        wanted.add("gravity")
    if focal == "known":
        wanted.discard("focal")
    if wanted and ransac is not None and not ransac.refine:
        what = "a hypothesis has no covariance, by which objects share what is unknown"
        raise InputError(what, where="refine", fix="leave it True, or share nothing")
    return tuple(part for part in SHARED if part in wanted)


def _check_views(
    objects: Sequence[SceneObject], known: SharedUnknowns, wanted: Collection[str], tilt: float
) -> None:
    """Refuse views that contradict what is known by the first of them."""
    said = as_prior(known, known)
    for number, each in enumerate(objects):
        own = as_prior(known_by([each.view]).tilted(tilt), known)
        for part, name in FIELDS.items():
            if part in wanted and own.disagreement(said, PARTS[part])[0] < FALSE_ALARMS:
                what = f"contradicts the {name} of an object before, which the photo shares"
                fix = "give the one that is right"
                raise InputError(what, where=f"objects[{number}].view.{name}", fix=fix)


def _require_one(found: Sequence[Result | CadalignError]) -> None:
    """Refuse objects of which none was aligned; wrong arguments stay such."""
    if all(isinstance(each, CadalignError) for each in found):
        is_refused = all(isinstance(each, InputError) for each in found)
        kind = InputError if is_refused else DegenerateError
        raise kind(f"no object can be aligned: {found[0]}", where="objects")


def _fused(
    members: Sequence[Member], reference: SharedUnknowns, known: SharedUnknowns, tilt: float
) -> SharedUnknowns:
    """The shared unknowns by all objects and what the user knows."""
    messages = [each.message(reference, tilt) for each in members]
    return reference.moved(*sum(messages, as_prior(known, reference)).moments)


def _settled(
    members: list[Member],
    shared: SharedUnknowns,
    known: SharedUnknowns,
    tilt: float,
    aligned: Callable[[SceneObject, SharedUnknowns], Result],
) -> tuple[SharedUnknowns, list[Member]]:
    """The shared unknowns, and the objects aligned with each other as their priors."""
    for _ in range(_ROUNDS):
        said = [*(each.message(shared, tilt) for each in members), as_prior(known, shared)]
        moved = []
        for number, member in enumerate(members):
            had = shared.moved(*but_for(said, number).moments).tilted(tilt)
            try:
                result = aligned(member.given, had)
            except CadalignError:  # as it was
                moved.append(member)
            else:
                is_told = result.covariance is not None
                moved.append(replace(member, had=had, result=result) if is_told else member)
        members = moved
        last, shared = shared, _fused(members, shared, known, tilt)
        change = last.deviations(shared.focal, shared.up, shared.height)
        variances = shared.covariance.diagonal()
        is_said = np.isfinite(variances) & (variances > 0)
        if (change[is_said] ** 2 <= _SETTLED**2 * variances[is_said]).all():
            break
    return shared, members
