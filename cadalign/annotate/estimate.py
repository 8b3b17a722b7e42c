"""Estimate behind the live alignment: what the marks leave open is assumed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from cadalign.annotate.lines import Wireframe
from cadalign.annotate.problem import LEAST_SIGMA, LIKELY_STRETCH, Known, LiveProblem
from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import CadalignError, DegenerateError
from cadalign.estimation.focal import FocalPrior
from cadalign.estimation.model import Model
from cadalign.estimation.result import Result
from cadalign.estimation.scene import focal_prior_by_others
from cadalign.estimation.scene_messages import SceneObject
from cadalign.estimation.view import View
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.io.observation import Observation


@dataclass(frozen=True, eq=False)
class LiveAlignment:
    """Alignment of what is marked so far, from all photos of an object, as one of them shows it."""

    result: Result | None = None  # the estimate from all photos, as it is shown and saved
    message: str = ""  # reason for a missing result, or an assumption that was made
    problem: LiveProblem | None = None  # what the result was computed from
    sigma: float = LEAST_SIGMA  # standard deviation of the pairs [px], larger if the residuals are
    fit_options: Mapping[str, Any] = field(default_factory=dict)
    """With which, and the priors, `cadalign fit` finds the result of this object alone."""
    others_focal: FocalPrior | None = None
    """Prior on the focal length that other objects of the photo and the object's own prior say."""
    contradictions: tuple[str, ...] = ()  # of objects of the photo about its focal length

    place: int = 0  # the photo's number among the views; what follows is of this photo
    counts: BoolArray = field(default_factory=lambda: np.empty(0, dtype=bool))
    """(n,), the complete pairs whose keypoints the shape knows."""
    residuals: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    """(n, 2), projected minus placed points of all complete pairs [px]."""
    outliers: Mapping[int, float] = field(default_factory=dict)
    """Distances [px] of the pairs that contradict the others, by their rows."""
    wireframe: Wireframe | None = None
    """Lines of the model, warped to an own shape, in its frame before the stretch."""
    prior_lengths: FloatArray = field(default_factory=lambda: np.zeros(3))
    """(3,), standard deviations of the logarithms of the lengths before any pair."""
    also_used: tuple[str, ...] = ()  # evidence beyond the photo's pairs

    @classmethod
    def of(cls, known: Known, observation: Observation) -> LiveAlignment:
        """Align, with as few assumptions as the marks need; raises a CadalignError without."""
        problem = LiveProblem.of(known, observation)
        reason: DegenerateError | None = None
        for attempt, assumed in problem.attempts():
            try:
                result, sigma, options = attempt.solve()
            except DegenerateError as error:
                reason = error
                continue
            if (stored := observation.fit_options.get("sigma")) is not None:
                sigma, options = stored, {"sigma": stored}
            text = assumed.format(reason="" if reason is None else reason.what) or attempt.unsaved
            return cls(result, text, attempt, sigma, options)
        assert reason is not None
        raise reason

    @property
    def provisional(self) -> bool:
        """True if the marks alone did not suffice, so that nothing is saved."""
        return self.result is not None and bool(self.message)

    @property
    def camera(self) -> Camera:
        """The photo's camera."""
        assert self.result is not None
        return self.result.cameras[self.place]

    @property
    def alignment(self) -> Alignment:
        """The alignment in the photo's camera."""
        assert self.result is not None
        return self.result.poses[self.place]

    @property
    def tells_focal(self) -> bool:
        """True if one focal length of all photos was estimated, with nothing assumed."""
        result, problem = self.result, self.problem
        if result is None or problem is None or not problem.estimates_focal or self.message:
            return False
        one = all(camera == result.camera for camera in result.cameras)
        return one and result.covariance is not None

    def beside(self, name: str, others: Mapping[str, LiveAlignment]) -> LiveAlignment:
        """The estimate with what others of the photo, by their names, say of the focal length.

        Options of the fit stay those of the object alone, which its file holds.
        """
        if not (others and self.tells_focal):
            return self
        own = self.problem
        assert own is not None
        known = [
            (SceneObject(each.problem.model, each.problem.views[0], name=label), each.problem, each)
            for label, each in {name: self, **others}.items()
            if each.problem is not None
        ]
        prior, contradictions = focal_prior_by_others(
            [scene for scene, _, _ in known],
            [each.result for _, _, each in known if each.result is not None],
            [problem.focal_prior for _, problem, _ in known],
        )
        told = replace(self, contradictions=contradictions)
        if prior is own.focal_prior:
            return told
        problem = replace(own, focal_prior=prior)
        try:
            result, sigma, _ = problem.solve()
        except CadalignError:
            return told
        return replace(told, problem=problem, result=result, sigma=sigma, others_focal=prior)


def warm_up(points_3d: FloatArray, points_2d: FloatArray, camera: Camera, *, joint: bool) -> None:
    """Compile or load what alignments call, by aligning points (n, 3) with (n, 2) [px]."""
    view, prior = View(camera, points_2d, sigma=1.0), FocalPrior(camera.fx, 0.4)
    exact = Model(points_3d=points_3d, stretch_sigma=LIKELY_STRETCH)
    for estimates_focal in (False, True):
        problem = LiveProblem(exact, (view,), None, "settled", estimates_focal, prior)
        problem.solve()
        problem.contradicting(0)
    if joint:
        similar = Model(points_3d=points_3d, shape_sigma=0.01)
        for estimates_focal in (False, True):
            problem = LiveProblem(similar, (view,), None, "given", estimates_focal, None)
            problem.solve()
            problem.left_out()
