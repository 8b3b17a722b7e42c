"""Tests of what a fit was told, scales and camera, against its inliers at their stated noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import CadalignError
from cadalign.estimation.options import FitOptions
from cadalign.estimation.problems import pack_one
from cadalign.estimation.solve import fitted_fields, solve_one
from cadalign.estimation.uncertainty.distributions import chi_square_tail
from cadalign.estimation.uncertainty.posterior import FittedKeypoints, Likelihood
from cadalign.estimation.uncertainty.prediction import projection_jacobian
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.conventions import resized_camera

_FALSE_ALARMS = 0.004
_FALSE_STRETCH_ALARMS = 0.002
_FALSE_CAMERA_ALARMS = 0.002
_SCALES = 2  # unknown ones, of an alignment without constraints
_WORTH_A_SEARCH = 4.0  # linearised decrease of the sum
_SIZES = (0.25, 0.5, 2.0, 4.0)  # of images, over that of their camera
Rows = npt.NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Tested:
    """A result's inliers, with their noise and the sum of their losses."""

    points_3d: FloatArray
    points_2d: FloatArray
    covariances: FloatArray
    rows: IntArray
    alignment: Alignment
    camera: Camera
    options: FitOptions
    chi_square: float

    @classmethod
    def of(cls, result: FittedKeypoints) -> Tested:
        rows = np.flatnonzero(result.inliers)
        points_3d, residuals = result.points_3d[rows], result.residuals[rows]
        projected = result.camera.project(result.alignment.apply(points_3d))
        likelihood = Likelihood.of(result)
        covariances = np.linalg.inv(likelihood.information)
        return cls(
            points_3d,
            projected - residuals,
            np.broadcast_to(covariances, (len(rows), 2, 2)),
            rows,
            result.alignment,
            result.camera,
            result.options,
            float(likelihood.losses(residuals).sum()),
        )

    @property
    def redundancy(self) -> int:
        """Equations, of the priors too, minus unknowns.

        A scale that the keypoints leave to the bounding prior has its equation there.
        """
        priors = int(self.options.focal_prior is not None)
        width = self.options.scale_prior.width
        if width == 0:
            priors += len(self.options.stretched_axes)
        else:
            priors += int((np.abs(np.log(self.alignment.scale)) > width).sum())
        return 2 * len(self.rows) - self.options.unknowns + priors

    @property
    def passes(self) -> bool:
        """True if the noise explains the sum."""
        redundancy = self.redundancy
        return redundancy <= 0 or chi_square_tail(self.chi_square, redundancy) >= _FALSE_ALARMS

    def decrease_by_focal(self) -> float:
        """Decrease of the sum by a focal length of its own, to first order."""
        derivatives = projection_jacobian(self.points_3d, self.camera, self.alignment)
        free = [*self.options.estimated_unknowns, 9]
        whitening = np.linalg.inv(np.linalg.cholesky(self.covariances))
        rows = (whitening @ derivatives[:, :, free]).reshape(2 * len(self.rows), -1)
        projected = self.camera.project(self.alignment.apply(self.points_3d))
        errors = (whitening @ (projected - self.points_2d)[:, :, None]).ravel()
        others, _ = np.linalg.qr(rows[:, :-1])
        alone = rows[:, -1] - others @ (others.T @ rows[:, -1])
        length = float(alone @ alone)
        return float(alone @ errors) ** 2 / length if length > 0 else 0.0

    def fit(
        self,
        rows: Rows | slice = slice(None),
        *,
        camera: Camera | None = None,
        **changes: Any,
    ) -> FittedKeypoints:
        """Fit some of the keypoints anew, with changed options or camera."""
        options = replace(self.options, sigma=self.covariances[rows], **changes)
        chosen = self.camera if camera is None else camera
        problems = pack_one(self.points_3d[rows], self.points_2d[rows], chosen)
        with np.errstate(all="ignore"):
            solutions = solve_one(problems, options)
        return FittedKeypoints(**fitted_fields(problems, solutions, options))


def contradicting_scale(tested: Tested) -> tuple[float, float, float] | None:
    """The scales without the constraints on them, if these contradict the keypoints."""
    options = tested.options
    if len(options.stretched_axes) == _SCALES and options.scale_prior_sigma is None:
        return None
    try:
        free = tested.fit(stretch=None, scale_prior_sigma=None)
        decrease = tested.chi_square - Tested.of(free).chi_square
    except CadalignError:  # the keypoints do not determine the scales, so nothing contradicts
        return None
    if chi_square_tail(decrease, _SCALES) >= _FALSE_STRETCH_ALARMS:
        return None
    x, y, z = free.alignment.scale.tolist()
    return x, y, z


def contradicting_camera(tested: Tested) -> Camera | None:
    """The camera that the keypoints fit instead of the given one, if they contradict it.

    Tried are a focal length of their own and images of another size than the camera's, unless the
    keypoints fit and the derivative by the focal length promises nothing.
    """
    if tested.options.focal == "estimate" or tested.redundancy < 1:
        return None
    if tested.passes and tested.decrease_by_focal() < _WORTH_A_SEARCH:
        return None
    width, height = tested.camera.width, tested.camera.height
    found = [_tried(tested, focal="estimate")]
    for factor in _SIZES:
        sizes = max(1, round(width * factor)), max(1, round(height * factor))
        found.append(_tried(tested, camera=resized_camera(tested.camera, *sizes)))
    fits = [each for each in found if each is not None and each.passes]
    if not fits:
        return None
    best = min(fits, key=lambda each: each.chi_square)
    decrease = tested.chi_square - best.chi_square
    return best.camera if chi_square_tail(decrease, 1) < _FALSE_CAMERA_ALARMS else None


def _tried(tested: Tested, **changes: Any) -> Tested | None:
    try:
        return Tested.of(tested.fit(**changes))
    except CadalignError:
        return None
