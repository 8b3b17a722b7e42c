"""The problem behind the live alignment: `cadalign.align` with all that is marked of an object.

The standard deviation of the pairs is the one that explains their residuals, so that a model which
is only similar is not stretched to fit clicks.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np

from cadalign.annotate.models import ObjectShape
from cadalign.annotate.outliers import PlacedRows, Rows, find_outliers
from cadalign.arrays import FloatArray
from cadalign.batch.observed import model_of, views_of
from cadalign.datasets.models.model_keypoints import ModelKeypoint
from cadalign.errors import CadalignError
from cadalign.estimation.align import align
from cadalign.estimation.model import Model
from cadalign.estimation.options import FitOptions, RansacOptions
from cadalign.estimation.result import Result
from cadalign.estimation.view import View
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.io.evidence import Size
from cadalign.io.focal import FocalPrior
from cadalign.io.observation import Observation
from cadalign.shapes.model import ShapeModel

LEAST_SIGMA = 1.0  # of clicks [px]
LEAST_PAIRS, LEAST_JOINT_PAIRS = 4, 3
"""Pairs of an alignment without evidence beside them, and with it."""
LIKELY_STRETCH = 0.25
"""Standard deviation of the logarithm of each scale about 1, until another one is chosen."""
_ROBUST_ROUNDS = 3
_ROBUST_SHARE = 2.0  # of the median residual
# Of clicks on natural points of a model that is not quite the object [longer sides of the photo],
# and the weight of that expectation against residuals, as that of so many equations.
_EXPECTED_NOISE = 0.005
_NOISE_EQUATIONS = 4
_FIRST_NOISE = 4.0  # over the expected one
_MOST_NOISE = 10.0  # the same; what needs more is a mistake, which the residuals then show
_NOISE_ROUNDS = 12
_NOISE_TOLERANCE = 0.02
_UNKNOWNS = 8  # of a pose and a stretch
_LEAST_JUDGED = 6  # pairs from which on one can contradict the others
_CONTRADICTS = 5.0  # distance from the others' prediction [sigmas]; hands click to about 2 px
_FOCAL_ASSUMED = "The focal length is assumed: add a pair elsewhere to have it estimated."


@dataclass(frozen=True, eq=False)
class Known:
    """Knowledge of an object beside its observation."""

    shape: ObjectShape
    mesh: Mesh  # the model's
    anchors: Mapping[Any, ModelKeypoint] = field(default_factory=dict)
    """The model's keypoints that the shape knows, by their ids there."""
    estimates_focal: bool = False
    focal_prior: FocalPrior | None = None  # on an estimated focal length
    by_mask: dict[Camera, Result] = field(default_factory=dict)
    """Estimates by the mask alone, by the camera; kept while nothing but pairs changes."""

    def model_for(self, observation: Observation) -> Model | ShapeModel:
        """The model that `cadalign fit` aligns to the observation.

        A similar one has keypoints that no pair shows, too, where they do not change the estimate.
        """
        shape = self.shape
        is_similar = shape.sigma is not None
        if shape.learned is not None or (is_similar and not _shows_surface(observation)):
            points = self.anchors.values()
            return shape.model_with(points, self.mesh, up_axis=observation.up_axis)
        options = FitOptions(stretch_sigma=observation.fit_options.get("stretch_sigma"))
        return model_of(observation, options=options, shape_sigma=shape.sigma, mesh=self.mesh)


@dataclass(frozen=True, eq=False)
class LiveProblem:
    """Arguments of `cadalign.align`, and how the pairs' standard deviation is found.

    ``noise`` is "given", "settled" for one that explains the residuals beside a prior on the
    stretch, and "scaled" for one that is estimated from them alone.
    """

    model: Model | ShapeModel
    view: View
    size: Size | None
    noise: str
    estimates_focal: bool
    focal_prior: FocalPrior | None
    init: Alignment | None = None
    by_mask: dict[Camera, Result] = field(default_factory=dict)

    @classmethod
    def of(cls, known: Known, observation: Observation) -> LiveProblem:
        """The problem of an observation, with the options of a fit that it holds."""
        options, model = observation.fit_options, known.model_for(observation)
        sigma, has_photos = options.get("sigma"), bool(options.get("image"))
        (view,) = views_of(observation, model, sigma=sigma, with_photos=has_photos)
        noise = "given"
        if not known.shape.is_estimated and sigma is None and len(view.keypoint_ids):
            has_prior = options.get("stretch_sigma") is not None
            if has_prior and (observation.is_plain or observation.sigma is None):
                noise = "settled"
            elif not has_prior and observation.is_plain:
                noise = "scaled"
        focal = known.estimates_focal, known.focal_prior
        return cls(model, view, observation.size, noise, *focal, observation.init, known.by_mask)

    @property
    def exact(self) -> Model | None:
        """The model, if nothing but its stretch is estimated."""
        model = self.model
        return model if isinstance(model, Model) and model.shape_sigma is None else None

    @property
    def unsaved(self) -> str:
        """Says that it is shown and not saved, since `cadalign fit` would not find it; else empty.

        That does not know a similar model's other keypoints.
        """
        is_similar = self.exact is None and isinstance(self.model, Model)
        if is_similar and not len(self.view.keypoint_ids):
            return "It is saved from the first pair on."
        return ""

    def attempts(self) -> Iterator[tuple[LiveProblem, str]]:
        """Problems to try, the first as it is, down to what is left where marks do not suffice.

        Each comes with what it assumes, where ``{reason}`` stands for why the ones before fail.
        """
        problem = self
        if not (self.is_by_mask and self.estimates_focal):  # which a mask alone leaves open
            yield problem, ""
        if self.estimates_focal:
            problem = problem.at_focal(self.view.camera)
            yield problem, _FOCAL_ASSUMED
        if self.exact is None:
            return
        if self.exact.stretch_sigma is None:
            model = replace(self.exact, stretch_sigma=LIKELY_STRETCH)
            yield (
                replace(problem, model=model),
                "The stretch shown is assumed: {reason}. Add a pair elsewhere.",
            )
        rigid = replace(self.exact, stretch_sigma=None, stretch="none")
        yield replace(problem, model=rigid), "The model is shown unstretched: add a pair elsewhere."

    def at_focal(self, camera: Camera) -> LiveProblem:
        """The problem with the focal length of this camera known."""
        view = replace(self.view, camera=camera)
        return replace(self, view=view, estimates_focal=False, focal_prior=None)

    def weighted(self, factor: float) -> LiveProblem:
        """The problem with each pair's standard deviation times a factor."""
        sigma = factor * cast(FloatArray, self.view.sigma)
        return replace(self, view=replace(self.view, sigma=sigma))

    def align(self, **options: Any) -> Result:
        """Call `cadalign.align`; raises a CadalignError if that is impossible."""
        if self.estimates_focal:
            options |= {"focal": "estimate", "focal_prior": self.focal_prior}
        init = self.init
        if self.is_by_mask and len(self.view.keypoint_ids):
            init = self._start_by_mask()
        return align(self.model, self.view, size=self.size, init=init, **options)

    @property
    def is_by_mask(self) -> bool:
        """True if the search of an exact model begins at what the mask allows."""
        few = len(self.view.keypoint_ids) < LEAST_JOINT_PAIRS
        return self.exact is not None and few and self.view.mask is not None and self.init is None

    def _start_by_mask(self) -> Alignment:
        """The alignment by the mask alone that agrees best with the pairs."""
        view, model = self.view, self.exact
        assert model is not None
        if view.camera not in self.by_mask:
            alone = replace(view, points_2d=(), ids=None, sigma=1.0, scores=None, image=None)
            self.by_mask[view.camera] = align(model, alone, size=self.size)
        result, points = self.by_mask[view.camera], _points_of(model, view.keypoint_ids)

        def gap(alignment: Alignment) -> float:
            pixels = view.camera.project(alignment.apply(points))
            return float(np.linalg.norm(pixels - np.asarray(view.points_2d)))

        found = (result.alignment, *(each.alignment for each in result.alternatives))
        return min(found, key=gap)

    def solve(self) -> tuple[Result, float, Mapping[str, Any]]:
        """Align at the noise that is due; with its factor [px] and the options of the fit."""
        if self.noise == "settled":
            factor = self._explaining_noise()
            return self.weighted(factor).align(), factor, {"sigma": self._sigmas(factor)}
        result = self.align()
        squares, count = self._residuals(result)
        redundancy = 2 * count - _UNKNOWNS - self.estimates_focal
        factor = math.sqrt(squares / redundancy) if redundancy > 0 else 0.0
        if self.noise == "given" or factor <= LEAST_SIGMA:
            return result, LEAST_SIGMA, {}
        if np.ndim(np.asarray(self.view.sigma)):
            options = {"sigma": self._sigmas(factor)}
            return self.weighted(factor).align(), factor, options
        estimated = replace(self, view=replace(self.view, sigma=None))
        return estimated.align(), factor, {"sigma": None}

    def contradicting(self) -> dict[int, float]:
        """Distances [px] of the pairs that contradict the others, by their rows."""
        view, model = self.view, self.exact
        alone = View(view.camera, view.points_2d, ids=view.ids, sigma=view.sigma)
        pairs = replace(self, view=alone, size=None)
        if model is None:
            return pairs.left_out()
        points = _points_of(model, view.keypoint_ids)
        unknowns = _UNKNOWNS + self.estimates_focal
        observed = np.asarray(view.points_2d)
        return find_outliers(points, observed, pairs.fit_rows, unknowns=unknowns)

    def fit_rows(self, rows: Rows, robust: bool) -> PlacedRows:
        """Align some pairs; see `find_outliers`."""
        view = self.view
        ids = tuple(view.keypoint_ids[row] for row in rows)
        points = np.asarray(view.points_2d)[rows]
        alone = replace(self, view=View(view.camera, points, ids=ids, sigma=LEAST_SIGMA))
        result = alone.align()
        for _ in range(_ROBUST_ROUNDS if robust else 0):
            # sigma=None iterates until nothing changes, which takes ten times as long.
            median = float(np.median(np.linalg.norm(result.residuals, axis=1)))
            sigma = max(LEAST_SIGMA, median / _ROBUST_SHARE)
            result = alone.weighted(sigma).align(loss="cauchy")
        return result.alignment, result.camera, result.fisher_covariance

    def left_out(self) -> dict[int, float]:
        """Distances [px] of the pairs that a robust search leaves out."""
        if len(self.view.keypoint_ids) < _LEAST_JUDGED:
            return {}
        try:
            robust = self.align(ransac=RansacOptions(max_reproj_error=_CONTRADICTS))
        except CadalignError:
            return {}
        lengths = np.linalg.norm(robust.residuals, axis=1)
        return {int(row): float(lengths[row]) for row in np.flatnonzero(~robust.inliers)}

    def _explaining_noise(self) -> float:
        """The factor of the pairs' standard deviations that explains the residuals [px].

        It is the fixed point of its estimate, reached from above, so that residuals first count as
        noise, and as a stretch only where the noise does not explain them.
        """
        expected = _EXPECTED_NOISE * max(self.view.camera.width, self.view.camera.height)
        factor = _FIRST_NOISE * expected
        # Without mask and photo and with the focal length of the first round, which take long.
        near = replace(self, view=replace(self.view, mask=None, mask_sigma=None, image=None))
        for _ in range(_NOISE_ROUNDS):
            try:
                result = near.weighted(factor).align()
            except CadalignError:
                if self.view.mask is None:
                    raise
                return expected  # it takes the mask
            if near.estimates_focal:
                near = near.at_focal(result.camera)
            before = factor
            squares, count = self._residuals(result)
            redundancy = max(0, 2 * count - _UNKNOWNS)
            factor = math.sqrt(
                (squares + _NOISE_EQUATIONS * expected**2) / (redundancy + _NOISE_EQUATIONS)
            )
            if abs(factor / before - 1) < _NOISE_TOLERANCE:
                break
        return max(LEAST_SIGMA, factor if factor < _MOST_NOISE * expected else expected)

    def _residuals(self, result: Result) -> tuple[float, int]:
        """The sum of the squared residuals over the pairs' own sigmas, and their number."""
        residuals = result.residuals
        if not len(residuals):
            return 0.0, 0
        sigma = np.reshape(cast(FloatArray, self.view.sigma), (-1, 1))
        return float(((residuals / sigma) ** 2).sum()), len(residuals)

    def _sigmas(self, factor: float) -> float | list[float]:
        """The option of the fit for the pairs' standard deviations times a factor."""
        given = np.asarray(self.view.sigma)
        return (factor * given).tolist() if given.ndim else factor


def _shows_surface(observation: Observation) -> bool:
    """True if a mask, a depth image or the photo bears on the mesh, which every keypoint warps.

    Not without a pair, which is not saved.
    """
    evidence = observation.evidence
    if not len(observation.points_2d):
        return False
    has_photo = bool(observation.fit_options.get("image"))
    return has_photo or evidence.mask is not None or evidence.depth is not None


def _points_of(model: Model, ids: Sequence[Hashable]) -> FloatArray:
    """Keypoints (n, 3) of a model by their ids."""
    rows = {each: row for row, each in enumerate(model.ids or ())}
    return np.asarray(model.points_3d)[[rows[each] for each in ids]]


def warm_up(points_3d: FloatArray, points_2d: FloatArray, camera: Camera, *, joint: bool) -> None:
    """Compile or load what alignments call, by aligning points (n, 3) with (n, 2) [px]."""
    view, prior = View(camera, points_2d, sigma=1.0), FocalPrior(camera.fx, 0.4)
    exact = Model(points_3d=points_3d, stretch_sigma=LIKELY_STRETCH)
    for estimates_focal in (False, True):
        problem = LiveProblem(exact, view, None, "settled", estimates_focal, prior)
        problem.solve()
        problem.contradicting()
    if joint:
        similar = Model(points_3d=points_3d, shape_sigma=0.01)
        for estimates_focal in (False, True):
            problem = LiveProblem(similar, view, None, "given", estimates_focal, None)
            problem.solve()
            problem.left_out()
