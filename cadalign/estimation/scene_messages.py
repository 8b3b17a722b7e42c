"""Objects of a photo, and messages of each about what they share: focal length, gravity, ground.

The shared unknowns are the logarithm of the focal length, the direction against gravity in the
camera's frame, by its coordinates along two axes across a reference, and the logarithm of the
camera's height above the ground.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.estimation.focal import FocalPrior
from cadalign.estimation.known_evidence import lowest_corner, upward
from cadalign.estimation.model import Model
from cadalign.estimation.prior import prior_of
from cadalign.estimation.result import Result
from cadalign.estimation.uncertainty.residuals import chi_square_tail
from cadalign.estimation.uncertainty.summary import Uncertainty
from cadalign.estimation.view import View
from cadalign.geometry.alignment import Alignment
from cadalign.io.evidence import Size
from cadalign.shapes.model import ShapeModel

UP = slice(1, 3)
PARTS = {"focal": slice(0, 1), "gravity": UP, "ground": slice(3, 4)}
_WORDS = {"focal": "focal length", "gravity": "direction of gravity", "ground": "ground"}
FIELDS = {"gravity": "up", "ground": "camera_height"}  # of a view, that say what is shared
_GIVEN = {"focal": "the prior on the focal length"} | {
    part: f"the `{name}` that is given" for part, name in FIELDS.items()
}
FALSE_ALARMS = 1e-4  # of objects that agree
_LOWEST = 1e-6  # height of a camera above the ground
_LEAST_INFORMATION = 1e-9  # below, nothing is said of an unknown
_WIDEST_UP = 0.5  # standard deviation of a direction that is taken as a prior [rad]
_OTHERS = "the other objects"


@dataclass(frozen=True, eq=False)
class SceneMessage:
    """Information (4, 4) and its product with the mean (4,), about a reference.

    The unknowns are the log focal length, the direction's coordinates along two axes across the
    reference's, and the log height.
    """

    information: FloatArray
    weighted: FloatArray

    def __add__(self, other: SceneMessage) -> SceneMessage:
        return SceneMessage(self.information + other.information, self.weighted + other.weighted)

    def __sub__(self, other: SceneMessage) -> SceneMessage:
        return SceneMessage(self.information - other.information, self.weighted - other.weighted)

    @property
    def moments(self) -> tuple[FloatArray, FloatArray]:
        """Mean (4,) and covariance (4, 4), infinite variances where nothing is said."""
        said = self.information.diagonal() > _LEAST_INFORMATION
        mean, covariance = np.zeros(4), np.diag(np.where(said, 0.0, np.inf))
        if said.any():
            inverse = np.linalg.pinv(self.information[np.ix_(said, said)], hermitian=True)
            covariance[np.ix_(said, said)] = inverse
            mean[said] = inverse @ self.weighted[said]
        return mean, covariance

    def positive(self, rows: Sequence[int]) -> SceneMessage:
        """The message without directions in which an object is less certain than its prior was."""
        values, axes = np.linalg.eigh(self.information[np.ix_(rows, rows)])
        kept = axes[:, values > _LEAST_INFORMATION]
        projection = np.zeros((4, 4))
        projection[np.ix_(rows, rows)] = kept @ kept.T
        return SceneMessage(projection @ self.information @ projection, projection @ self.weighted)

    def tilted(self, tilt: float) -> SceneMessage:
        """The message about gravity of one about an object's up axis."""
        noise = np.diag([0.0, tilt**2, tilt**2, 0.0])
        factor = np.linalg.inv(np.eye(4) + self.information @ noise)
        return SceneMessage(factor @ self.information, factor @ self.weighted)

    def disagreement(self, other: SceneMessage, part: slice) -> tuple[float, float]:
        """Probability that two messages about a part differ by more than they do.

        After it minus chi-squared, which orders those of which it is 0 in floats.
        """
        (mean, covariance), (other_mean, other_covariance) = self.moments, other.moments
        block = covariance[part, part] + other_covariance[part, part]
        if not np.isfinite(block).all():
            return 1.0, 0.0
        difference = mean[part] - other_mean[part]
        square = float(difference @ np.linalg.pinv(block, hermitian=True) @ difference)
        return chi_square_tail(square, len(difference)), -square


NOTHING = SceneMessage(np.zeros((4, 4)), np.zeros(4))


@dataclass(frozen=True, eq=False)
class SharedUnknowns:
    """Values of the shared unknowns: the reference of messages, and the prior of an object.

    ``covariance`` (4, 4) is that of their deviations; infinite where nothing is known. ``source``
    is that of the focal length.
    """

    focal: float
    up: FloatArray
    height: float
    covariance: FloatArray
    source: str = _OTHERS

    @property
    def across(self) -> FloatArray:
        """Two axes (2, 3) across the direction."""
        _, _, axes = np.linalg.svd(self.up[None])
        return np.asarray(axes[1:])

    def deviations(self, focal: float, up: FloatArray, height: float) -> FloatArray:
        """Deviations (4,) of values from these."""
        sine, cosine = self.across @ up, float(self.up @ up)
        length = float(np.linalg.norm(sine))
        toward = sine / length if length else np.array([1.0, 0.0])  # the opposite is on every side
        turned = math.atan2(length, cosine) * toward
        return np.array([math.log(focal / self.focal), *turned, math.log(height / self.height)])

    def moved(self, mean: FloatArray, covariance: FloatArray) -> SharedUnknowns:
        """The values at deviations from these, with their covariance."""
        turn = self.across.T @ mean[UP]
        angle = float(np.linalg.norm(turn))
        up = math.cos(angle) * self.up + np.sinc(angle / math.pi) * turn
        focal, height = self.focal * math.exp(mean[0]), self.height * math.exp(mean[3])
        return SharedUnknowns(focal, up / np.linalg.norm(up), height, covariance)

    def tilted(self, tilt: float) -> SharedUnknowns:
        """The values for the up axis of one object, which deviates from gravity's."""
        return replace(self, covariance=self.covariance + np.diag([0, tilt**2, tilt**2, 0]))

    @property
    def focal_prior(self) -> FocalPrior | None:
        """The prior on the focal length, where one is known."""
        variance = self.covariance[0, 0]
        sigma = math.sqrt(variance)
        return FocalPrior(self.focal, sigma, self.source) if variance < np.inf else None

    def without(self, part: str) -> SharedUnknowns:
        """The values with nothing known of a part."""
        covariance, rows = self.covariance.copy(), PARTS[part]
        covariance[rows, rows] = np.diag(np.full(rows.stop - rows.start, np.inf))
        return replace(self, covariance=covariance)

    def seen_by(self, view: View, wanted: Collection[str]) -> View:
        """A view with what is known of gravity and ground."""
        if "gravity" in wanted and self.std("gravity") < _WIDEST_UP:
            turned = self.across.T @ self.covariance[UP, UP] @ self.across
            view = replace(view, up=self.up, up_sigma_deg=np.degrees(np.degrees(turned)))
        if "ground" in wanted and np.isfinite(self.covariance[3, 3]):
            sigma = math.sqrt(self.covariance[3, 3])
            view = replace(view, camera_height=self.height, camera_height_sigma=sigma)
        return view

    def std(self, part: str) -> float:
        """The largest standard deviation of a part."""
        block = self.covariance[PARTS[part], PARTS[part]]
        if not np.isfinite(block).all():
            return math.inf
        return float(np.sqrt(max(np.linalg.eigvalsh(block)[-1], 0.0)))


def known_by(views: Sequence[View], focal: FocalPrior | None = None) -> SharedUnknowns:
    """Knowledge of the user about the shared unknowns, by the first view that has it."""
    covariance = np.diag(np.full(4, np.inf))
    up, height = np.array([0.0, -1.0, 0.0]), 1.0
    given = [view for view in views if view.up is not None]
    if given:
        up, sigma = cast(FloatArray, given[0].up), np.asarray(given[0].up_sigma_deg, dtype=float)
        across = SharedUnknowns(1.0, up, 1.0, covariance).across
        turned = np.radians(np.radians(sigma if sigma.ndim else sigma**2 * np.eye(3)))
        covariance[UP, UP] = across @ turned @ across.T
    heights = [view for view in views if view.camera_height is not None]
    if heights:
        height = cast(float, heights[0].camera_height)
        covariance[3, 3] = cast(float, heights[0].camera_height_sigma) ** 2
    if focal is not None:
        covariance[0, 0] = focal.relative_sigma**2
    if focal is None:
        return SharedUnknowns(1.0, up, height, covariance)
    return SharedUnknowns(focal.focal, up, height, covariance, focal.source)


def as_prior(
    values: SharedUnknowns, reference: SharedUnknowns, rows: Sequence[int] = range(4)
) -> SceneMessage:
    """The message of separate priors on focal length, direction and height, on some rows."""
    information = np.zeros((4, 4))
    for part in PARTS.values():
        block = values.covariance[part, part]
        if np.isfinite(block).all() and block.any():
            information[part, part] = np.linalg.inv(block)
    chosen = np.isin(np.arange(4), list(rows))
    mean = reference.deviations(values.focal, values.up, values.height)
    said = np.where(np.outer(chosen, chosen), information, 0.0)
    return SceneMessage(said, said @ mean)


@dataclass(frozen=True, eq=False)
class SceneObject:
    """An object of a photo: its model, the photo's evidence, and what else is known.

    Parameters
    ----------
    model : Model or ShapeModel
    view : View
        View of the scene's photo; all objects' views have the same camera.
    size : Size, optional
        Known lengths of the object.
    init : Alignment, optional
        A start, as for `cadalign.align`.
    name : str, optional
        Name in messages; by default its number.
    """

    model: Model | ShapeModel
    view: View
    size: Size | None = None
    init: Alignment | None = None
    name: str = ""


@dataclass(frozen=True, eq=False)
class Member:
    """An object, what it shares, its result, and the prior that this was given."""

    number: int
    given: SceneObject
    shared: tuple[str, ...]
    had: SharedUnknowns
    result: Result

    @property
    def name(self) -> str:
        return self.given.name or f"objects[{self.number}]"

    @property
    def tells(self) -> list[int]:
        """The shared unknowns that it tells of: the height only where its size is known."""
        parts = list(self.shared)
        if "ground" in parts and self.given.size is None and self.given.view.depth is None:
            parts.remove("ground")
        return [k for part in parts for k in range(4)[PARTS[part]]]

    def values(self, reference: SharedUnknowns) -> SharedUnknowns:
        """The shared unknowns as the result has them, with their covariance."""
        pose, covariance = self.result.alignment, self.result.covariance
        assert covariance is not None
        up, height, lowest = reference.up, reference.height, np.zeros(3)
        if "gravity" in self.shared:
            model_up = upward("share", prior_of(self.given.model))
            up = pose.rotation @ model_up
            lowest = model_up * pose.scale * self.result.bounds[lowest_corner(model_up)]
        rows = np.zeros((4, len(covariance)))
        if "focal" in self.shared:
            rows[0, 9] = 1.0
        if "gravity" in self.shared:
            turn = np.array([[0, up[2], -up[1]], [-up[2], 0, up[0]], [up[1], -up[0], 0]])
            rows[UP, :3] = reference.across @ turn
        if "ground" in self.shared:
            height = max(float(-up @ pose.translation - lowest.sum()), _LOWEST)
            rows[3, :3] = -np.cross(up, pose.translation) / height
            rows[3, 3:6], rows[3, 6:9] = -up / height, -lowest / height
        return SharedUnknowns(self.result.camera.fx, up, height, rows @ covariance @ rows.T)

    def message(self, reference: SharedUnknowns, tilt: float) -> SceneMessage:
        """Message of its evidence on the shared unknowns, about a reference."""
        found, told = self.values(reference), self.tells
        block = found.covariance[np.ix_(told, told)]
        if not told or not np.isfinite(block).all():
            return NOTHING
        information = np.zeros((4, 4))
        information[np.ix_(told, told)] = np.linalg.pinv(block, hermitian=True)
        mean = reference.deviations(found.focal, found.up, found.height)
        own = SceneMessage(information, information @ mean) - as_prior(self.had, reference, told)
        return own.positive(told).tilted(tilt)


def reference_of(members: Sequence[Member]) -> SharedUnknowns:
    """Values of the object that is most certain of its rotation."""
    best = min(members, key=lambda each: cast(Uncertainty, each.result.std).rotation_deg)
    return best.values(SharedUnknowns(1.0, np.array([0.0, -1.0, 0.0]), 1.0, np.zeros((4, 4))))


def agreeing(
    given: list[Member], known: SharedUnknowns, tilt: float
) -> tuple[list[Member], SharedUnknowns, list[str]]:
    """The objects, and what of the known, that agree; other objects are named, the worst first."""
    members, warnings = given, []
    while len(members) > 1:
        reference = reference_of(members)
        said = [each.message(reference, tilt) for each in members]
        said.append(as_prior(known, reference))  # may be what is wrong, as an object may
        (tail, _), number, part = min(
            (message.disagreement(but_for(said, number), PARTS[part]), number, part)
            for number, message in enumerate(said)
            for part in members[0].shared
        )
        if tail > FALSE_ALARMS / len(members):
            break
        if number == len(members):
            return agreeing(given, known.without(part), tilt)
        others = f", or {_GIVEN[part]}" if math.isfinite(known.std(part)) else ""
        warnings.append(
            f"{members[number].name} contradicts the {_WORDS[part]} of the other objects{others}, "
            "and is aligned alone: check its model, its keypoints, and whether it stands in this "
            "photo"
        )
        members = members[:number] + members[number + 1 :]
    return members, known, warnings


def left_out(known: SharedUnknowns, agreed: SharedUnknowns) -> list[str]:
    """Warnings about what was known and contradicts the objects."""
    return [
        f"{_GIVEN[part]} contradicts the objects, and is left out: check it"
        for part in PARTS
        if math.isfinite(known.std(part)) and not math.isfinite(agreed.std(part))
    ]


def but_for(said: Sequence[SceneMessage], number: int) -> SceneMessage:
    """The messages of all but one together."""
    return sum((each for k, each in enumerate(said) if k != number), NOTHING)
