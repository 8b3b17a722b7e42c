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
from cadalign.arrays import FloatArray
from cadalign.datasets.models.model_keypoints import ModelKeypoint
from cadalign.errors import CadalignError
from cadalign.estimation.align import align
from cadalign.estimation.focal import FocalPrior
from cadalign.estimation.model import Model
from cadalign.estimation.observed import model_of, views_of
from cadalign.estimation.options import FitOptions, RansacOptions
from cadalign.estimation.result import Result
from cadalign.estimation.uncertainty.misfit import PlacedRows, Rows, find_outliers
from cadalign.estimation.view import View, without_keypoints
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.io.evidence import Size
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
_NOISE_ROUNDS = 12
_NOISE_TOLERANCE = 0.02
_POSE_UNKNOWNS, _STRETCH_UNKNOWNS = 6, 2
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
    assumed_focal: tuple[str, ...] = ()
    """Photos whose focal length is neither known nor estimated, this one by an empty name."""
    estimates_focal: bool = False  # estimate the focal lengths of all photos
    focal_prior: FocalPrior | None = None  # on these
    by_mask: dict[Camera, Result] = field(default_factory=dict)
    """Estimates by the mask alone, by the camera; kept while nothing but pairs changes."""

    def model_for(self, observation: Observation) -> Model | ShapeModel:
        """The model that `cadalign fit` aligns to the observation.

        A similar one has keypoints that no pair shows, too, where they do not change the estimate.
        """
        shape = self.shape
        is_single = shape.is_estimated and not observation.others
        if shape.learned is not None or (is_single and not _shows_surface(observation)):
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
    views: tuple[View, ...]
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
        views = views_of(observation, model, sigma=sigma, with_photos=has_photos)
        own = any(view.sigma is not None for view in observation.views)
        noise = "given"
        is_shaped, is_marked = known.shape.is_estimated, any(len(v.keypoint_ids) for v in views)
        if not is_shaped and sigma is None and is_marked:
            has_prior = options.get("stretch_sigma") is not None
            if has_prior and (observation.is_plain or not own):
                noise = "settled"
            elif not has_prior and observation.is_plain:
                noise = "scaled"
        focal = known.estimates_focal, known.focal_prior
        return cls(model, views, observation.size, noise, *focal, observation.init, known.by_mask)

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
        if is_similar and not any(len(view.keypoint_ids) for view in self.views):
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
            problem = problem.at_focal([view.camera for view in self.views])
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

    def at_focal(self, cameras: Sequence[Camera]) -> LiveProblem:
        """The problem with the focal lengths of these cameras known."""
        views = zip(self.views, cameras, strict=True)
        known = tuple(replace(view, camera=camera) for view, camera in views)
        return replace(self, views=known, estimates_focal=False, focal_prior=None)

    def weighted(self, factor: float) -> LiveProblem:
        """The problem with each pair's standard deviation times a factor."""
        views = (replace(view, sigma=factor * cast(FloatArray, view.sigma)) for view in self.views)
        return replace(self, views=tuple(views))

    def align(self, **options: Any) -> Result:
        """Call `cadalign.align`; raises a CadalignError if that is impossible."""
        if self.estimates_focal:
            options |= {"focal": "estimate", "focal_prior": self.focal_prior}
        init = self.init
        if self.is_by_mask and len(self.views[0].keypoint_ids):
            init = self._start_by_mask()
        return align(self.model, self.views, size=self.size, init=init, **options)

    @property
    def is_by_mask(self) -> bool:
        """True if the search begins at what the mask of the only view allows."""
        if self.exact is None:
            return False
        view = self.views[0]
        few = len(self.views) == 1 and len(view.keypoint_ids) < LEAST_JOINT_PAIRS
        return few and view.mask is not None and self.init is None

    def _start_by_mask(self) -> Alignment:
        """The alignment by the mask alone that agrees best with the pairs."""
        (view,), model = self.views, self.exact
        assert model is not None
        if view.camera not in self.by_mask:
            alone = replace(without_keypoints(view), image=None)
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
        redundancy = 2 * count - self._unknowns - self.estimates_focal
        factor = math.sqrt(squares / redundancy) if redundancy > 0 else 0.0
        if self.noise == "given" or factor <= LEAST_SIGMA:
            return result, LEAST_SIGMA, {}
        if np.ndim(np.asarray(self.views[0].sigma)):
            options = {"sigma": self._sigmas(factor)}
            return self.weighted(factor).align(), factor, options
        (view,) = self.views
        estimated = replace(self, views=(replace(view, sigma=None),))
        return estimated.align(), factor, {"sigma": None}

    def contradicting(self, place: int) -> dict[int, float]:
        """Distances [px] of the pairs of a photo that contradict its others, by their rows."""
        view, model = self.views[place], self.exact
        pairs = replace(
            self,
            views=(View(view.camera, view.points_2d, ids=view.ids, sigma=view.sigma),),
            size=None,
        )
        if model is None:
            return pairs.left_out()
        points = _points_of(model, view.keypoint_ids)
        unknowns = _POSE_UNKNOWNS + _STRETCH_UNKNOWNS + self.estimates_focal
        observed = np.asarray(view.points_2d)
        return find_outliers(points, observed, pairs.fit_rows, unknowns=unknowns)

    def fit_rows(self, rows: Rows, robust: bool) -> PlacedRows:
        """Align some pairs of the only view; see `find_outliers`."""
        (view,) = self.views
        ids = tuple(view.keypoint_ids[row] for row in rows)
        points = np.asarray(view.points_2d)[rows]
        alone = replace(self, views=(View(view.camera, points, ids=ids, sigma=LEAST_SIGMA),))
        result = alone.align()
        for _ in range(_ROBUST_ROUNDS if robust else 0):
            # sigma=None iterates until nothing changes, which takes ten times as long.
            median = float(np.median(np.linalg.norm(result.residuals, axis=1)))
            sigma = max(LEAST_SIGMA, median / _ROBUST_SHARE)
            result = alone.weighted(sigma).align(loss="cauchy")
        return result.alignment, result.camera, result.fisher_covariance

    def left_out(self) -> dict[int, float]:
        """Distances [px] of the pairs that a robust search among the only view's leaves out."""
        if len(self.views[0].keypoint_ids) < _LEAST_JUDGED:
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
        sides = [max(view.camera.width, view.camera.height) for view in self.views]
        expected = _EXPECTED_NOISE * sum(sides) / len(sides)
        factor = _FIRST_NOISE * expected
        # Without masks and photos and with the focal lengths of the first round, which take long.
        bare = tuple(replace(view, mask=None, mask_sigma=None, image=None) for view in self.views)
        near = replace(self, views=bare)
        for _ in range(_NOISE_ROUNDS):
            try:
                result = near.weighted(factor).align()
            except CadalignError:
                if all(view.mask is None for view in self.views):
                    raise
                return expected  # it takes the masks
            if near.estimates_focal:
                near = near.at_focal(result.cameras)
            before = factor
            squares, count = self._residuals(result)
            redundancy = max(0, 2 * count - self._unknowns)
            factor = math.sqrt(
                (squares + _NOISE_EQUATIONS * expected**2) / (redundancy + _NOISE_EQUATIONS)
            )
            if abs(factor / before - 1) < _NOISE_TOLERANCE:
                break
        return max(LEAST_SIGMA, factor)

    def _residuals(self, result: Result) -> tuple[float, int]:
        """The sum of the squared residuals over the pairs' own sigmas, and their number."""
        squares = 0.0
        for view, given in zip(result.views, self.views, strict=True):
            if len(view.residuals):
                sigma = np.reshape(cast(FloatArray, given.sigma), (-1, 1))
                squares += float(((view.residuals / sigma) ** 2).sum())
        return squares, len(result.residuals)

    @property
    def _unknowns(self) -> int:
        is_rigid = self.views[0].cam_from_rig is not None
        return _POSE_UNKNOWNS * (1 if is_rigid else len(self.views)) + _STRETCH_UNKNOWNS

    def _sigmas(self, factor: float) -> float | list[float]:
        """The option of the fit for the pairs' standard deviations times a factor."""
        given = np.asarray(self.views[0].sigma)
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
