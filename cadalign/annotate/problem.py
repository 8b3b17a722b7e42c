"""Live alignment: `cadalign.align` with all marks of an object.

The standard deviation of the pairs is estimated from their residuals, so that a model that is only
similar to the object is not stretched to fit the clicks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from cadalign.annotate.observations import LIKELY_STRETCH
from cadalign.arrays import FloatArray
from cadalign.batch.observation_fit import model_of, views_of
from cadalign.errors import CadalignError, DegenerateError
from cadalign.estimation.align import align
from cadalign.estimation.model import Model
from cadalign.estimation.options import FitOptions, RansacOptions
from cadalign.estimation.result import Result
from cadalign.estimation.view import View
from cadalign.evaluation.simulation import simulate_problem
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera, projection_jacobian
from cadalign.geometry.mesh import Mesh
from cadalign.io.evidence import Size
from cadalign.io.focal import FocalPrior
from cadalign.io.observation import Observation
from cadalign.shapes.model import ShapeModel

LEAST_SIGMA = 1.0  # of clicks [px]
_ROBUST_ROUNDS = 3
_ROBUST_SHARE = 2.0  # of the median residual
# Expected noise of clicks on a similar model [longer sides of the photo], and its weight against
# the residuals, as a number of equations.
_EXPECTED_NOISE = 0.005
_NOISE_EQUATIONS = 4
_FIRST_NOISE = 4.0  # times the expected noise
_MOST_NOISE = 10.0  # times the expected noise; larger residuals are mistakes, and are shown
_NOISE_ROUNDS = 12
_NOISE_TOLERANCE = 0.02
_UNKNOWNS = 8  # of a pose and a stretch
_LEAST_JUDGED = 6  # pairs; with fewer, a learned shape has no outliers
_CONTRADICTS = 5.0  # distance of an outlier from the prediction [sigmas]; clicks have about 2 px
_FALSE_OUTLIERS = 0.01
_MOST_ROUNDS = 100  # of a forward search; each fits all inliers
# Expected noise of clicks and differences of shape [px], and its weight as a number of equations.
_CLICK, _CLICK_EQUATIONS = 2.0, 4
_UNSTRETCHED = "The model is shown unstretched: add a pair elsewhere."
_FOCAL_ASSUMED = "The focal length is assumed: add a pair elsewhere to have it estimated."

Rows = npt.NDArray[np.intp]
FitRows = Callable[[Rows, bool], Result]
"""Function that fits some rows at 1 px of noise; with a robust loss if its flag is set."""


@dataclass(frozen=True, eq=False)
class LiveEstimate:
    """An alignment of the marks; ``message`` states its additional assumption.

    ``sigma`` is the standard deviation of the pairs [px]. `cadalign fit` finds the same result with
    ``fit_options``. ``outliers`` are the distances [px] of outlying pairs, by row.
    """

    result: Result
    message: str = ""
    sigma: float = LEAST_SIGMA
    fit_options: Mapping[str, Any] = field(default_factory=dict)
    outliers: Mapping[int, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class LiveProblem:
    """Arguments of `cadalign.align`; ``estimates_noise`` if the pairs' noise is estimated."""

    model: Model | ShapeModel
    view: View
    size: Size | None = None
    estimates_noise: bool = False
    estimates_focal: bool = False
    focal_prior: FocalPrior | None = None
    init: Alignment | None = None

    @classmethod
    def make(
        cls,
        learned: ShapeModel | None,
        mesh: Mesh,
        observation: Observation,
        focal: float = 0.0,
        focal_prior: FocalPrior | None = None,
    ) -> LiveProblem:
        """Build the problem of an observation and its options.

        ``focal`` is assumed if the focal length is unknown and cannot be estimated.
        """
        options = FitOptions(stretch_sigma=observation.fit_options.get("stretch_sigma"))
        model = learned or model_of(observation, options=options, mesh=mesh)
        estimates_focal = not observation.camera.focal_known
        if estimates_focal:
            observation = replace(observation, camera=observation.camera.replace_focal(focal))
        (view,) = views_of(observation, model, with_photos="image" in observation.fit_options)
        states_noise = observation.sigma is not None and not observation.is_plain
        estimates_noise = not (learned or states_noise) and bool(len(view.keypoint_ids))
        how = estimates_noise, estimates_focal, focal_prior
        return cls(model, view, observation.size, *how, observation.init)

    def estimate(self) -> LiveEstimate:
        """Align with as few assumptions as possible; raises a CadalignError if that fails."""
        reason: CadalignError | None = None
        for attempt, message in self._attempts():
            try:
                result, sigma, options = attempt.solve()
            except DegenerateError as error:
                reason = error
                continue
            has_shape = isinstance(self.model, ShapeModel)
            judged = attempt.fix_focal(result.camera) if has_shape else attempt
            outliers = judged.outliers()
            return LiveEstimate(result, message, sigma, {} if message else options, outliers)
        assert reason is not None
        raise reason

    def _attempts(self) -> Iterator[tuple[LiveProblem, str]]:
        """Yield problems to try, and their assumptions; the last ones need the fewest marks."""
        if (
            len(self.view.keypoint_ids) or not self.estimates_focal
        ):  # a mask alone does not determine it
            yield self, ""
        problem = self.fix_focal(self.view.camera)
        if self.estimates_focal:
            yield problem, _FOCAL_ASSUMED
        if isinstance(self.model, Model):
            rigid = replace(self.model, stretch_sigma=None, stretch="none")
            yield replace(problem, model=rigid), _UNSTRETCHED

    def fix_focal(self, camera: Camera) -> LiveProblem:
        """Set a known focal length by a camera."""
        view = replace(self.view, camera=camera)
        return replace(self, view=view, estimates_focal=False, focal_prior=None)

    def scale_sigma(self, factor: float) -> LiveProblem:
        """Multiply the standard deviation of each pair by a factor."""
        sigma = factor * cast(FloatArray, self.view.sigma)
        return replace(self, view=replace(self.view, sigma=sigma))

    def align(self, **options: Any) -> Result:
        """Call `cadalign.align`; raises a CadalignError if that is impossible."""
        if self.estimates_focal:
            options |= {"focal": "estimate", "focal_prior": self.focal_prior}
        return align(self.model, self.view, size=self.size, init=self.init, **options)

    def solve(self) -> tuple[Result, float, Mapping[str, Any]]:
        """Align at the estimated noise; returns also its factor [px] and the options of a fit."""
        if not self.estimates_noise:
            return self.align(), LEAST_SIGMA, {}
        factor = self._estimate_noise()
        sigma = factor * np.asarray(self.view.sigma)
        options = {"sigma": sigma.tolist() if sigma.ndim else float(sigma)}
        return self.scale_sigma(factor).align(), factor, options

    def outliers(self) -> dict[int, float]:
        """Return the distances [px] of outlying pairs, by row."""
        view, model = self.view, self.model
        alone = View(view.camera, view.points_2d, ids=view.ids, sigma=view.sigma)
        pairs = replace(self, view=alone, size=None, init=None)
        if isinstance(model, ShapeModel):
            return pairs._robust_outliers()
        rows = {each: row for row, each in enumerate(model.ids or ())}
        points = np.asarray(model.points_3d)[[rows[each] for each in view.keypoint_ids]]
        unknowns = _UNKNOWNS + self.estimates_focal
        return find_outliers(points, np.asarray(view.points_2d), pairs._fit_rows, unknowns=unknowns)

    def _fit_rows(self, rows: Rows, robust: bool) -> Result:
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
            result = alone.scale_sigma(sigma).align(loss="cauchy")
        return result

    def _robust_outliers(self) -> dict[int, float]:
        """Return the residuals [px] of the outliers of a robust search, by row."""
        if len(self.view.keypoint_ids) < _LEAST_JUDGED:
            return {}
        try:
            robust = self.align(ransac=RansacOptions(max_reproj_error=_CONTRADICTS))
        except CadalignError:
            return {}
        lengths = np.linalg.norm(robust.residuals, axis=1)
        return {int(row): float(lengths[row]) for row in np.flatnonzero(~robust.inliers)}

    def _estimate_noise(self) -> float:
        """Estimate the factor of the pairs' standard deviations from the residuals [px].

        The factor converges from above: residuals first count as noise, and only as stretch if the
        noise does not explain them.
        """
        view = self.view
        expected = _EXPECTED_NOISE * max(view.camera.width, view.camera.height)
        factor = _FIRST_NOISE * expected
        # Without mask and photo, and with the focal length of the first round, to save time.
        near = replace(self, view=replace(view, mask=None, mask_sigma=None, image=None))
        sigma = np.reshape(cast(FloatArray, view.sigma), (-1, 1))
        for _ in range(_NOISE_ROUNDS):
            try:
                result = near.scale_sigma(factor).align()
            except CadalignError:
                if view.mask is None and view.image is None:
                    raise
                return expected  # the pairs alone do not suffice
            if near.estimates_focal:
                near = near.fix_focal(result.camera)
            before, redundancy = factor, max(0, 2 * len(result.residuals) - _UNKNOWNS)
            squares = float(((result.residuals / sigma) ** 2).sum())
            factor = math.sqrt(
                (squares + _NOISE_EQUATIONS * expected**2) / (redundancy + _NOISE_EQUATIONS)
            )
            if abs(factor / before - 1) < _NOISE_TOLERANCE:
                break
        return max(LEAST_SIGMA, factor if factor < _MOST_NOISE * expected else expected)


def find_outliers(
    points_3d: FloatArray, points_2d: FloatArray, fit_rows: FitRows, *, unknowns: int
) -> dict[int, float]:
    """Find the keypoints that lie farther from the others' prediction than noise explains.

    A forward search (Hadi, "Identifying multiple outliers in multivariate data", 1992): it begins
    with the better half of the keypoints in a robust fit and adds all that agree, until nothing
    changes, so that several outliers do not mask each other. The noise is estimated from the
    inliers, since all keypoints of a model that is only similar to the object are some pixels off.

    Returns, by row, the distance [px] of each outlier from the fit to the inliers. With too few
    keypoints there are no outliers: a fit to the others needs at least two more equations than
    unknowns.
    """
    count, least = len(points_3d), unknowns // 2 + 1
    if count <= least:
        return {}
    start = max(least, count // 2 + 1)

    def residuals_of(result: Result) -> FloatArray:
        """Projected minus observed (n, 2) [px]; infinite behind the camera."""
        in_camera = result.alignment.apply(points_3d)
        return result.camera.project_where_ahead(in_camera) - points_2d

    def statistic(rows: Rows) -> tuple[FloatArray, float]:
        """Squared residuals (n,) per equation over their expectation, and their quantile.

        For keypoints outside the fit, the covariance of the prediction adds to the noise.
        """
        result = fit_rows(rows, False)
        residuals, covariance = residuals_of(result), result.fisher_covariance
        equations = 2 * len(rows) - unknowns + _CLICK_EQUATIONS
        total = float((residuals[rows] ** 2).sum()) + _CLICK_EQUATIONS * _CLICK**2
        expected = np.tile(np.eye(2), (count, 1, 1))
        others = np.setdiff1d(np.arange(count), rows)
        others = others[result.camera.sees(result.alignment.apply(points_3d[others]))]
        if len(others) and covariance is not None:
            jacobian = projection_jacobian(points_3d[others], result.camera, result.alignment)
            jacobian = jacobian[:, :, : len(covariance)]
            expected[others] += jacobian @ covariance @ jacobian.transpose(0, 2, 1)
        finite = np.nan_to_num(residuals, posinf=1e9)
        squares = np.einsum("na,nab,nb->n", finite, np.linalg.inv(expected), finite)
        # The quantile of an F distribution with 2 degrees of freedom has a closed form.
        quantile = equations / 2 * (math.pow(_FALSE_OUTLIERS / count, -2 / equations) - 1)
        return np.asarray(squares / 2 / (total / equations)), quantile

    def nearest(values: FloatArray) -> Rows:
        return np.sort(np.argsort(values, kind="stable")[:start])

    try:
        robust = residuals_of(fit_rows(np.arange(count), True))
        rows, known = nearest((robust**2).sum(axis=1)), set[bytes]()
        # The search may cycle instead of converging.
        while rows.tobytes() not in known and len(known) < _MOST_ROUNDS:
            known.add(rows.tobytes())
            values, quantile = statistic(rows)
            agreed = np.flatnonzero(values <= quantile)
            rows = agreed if len(agreed) >= start else nearest(values)
        outliers = np.setdiff1d(np.arange(count), rows)
        if not len(outliers):
            return {}
        lengths = np.linalg.norm(residuals_of(fit_rows(rows, False)), axis=1)
    except CadalignError:  # a subset is degenerate: no keypoint can be judged
        return {}
    return {int(row): float(lengths[row]) for row in outliers}


@cache
def warm_up(*, joint: bool) -> None:
    """Compile or load the solvers, once per process, by aligning synthetic problems."""
    problem = simulate_problem(np.random.default_rng(0), points=8, noise_px=1.0)
    view = View(problem.camera, problem.points_2d, sigma=1.0)
    prior = FocalPrior(problem.camera.fx, 0.4)
    for estimates_focal in (False, True):
        exact = Model(points_3d=problem.points_3d, stretch_sigma=LIKELY_STRETCH)
        LiveProblem(exact, view, None, True, estimates_focal, prior).estimate()
        if joint:
            similar = Model(points_3d=problem.points_3d, shape_sigma=0.01)
            LiveProblem(similar, view, None, False, estimates_focal).estimate()
