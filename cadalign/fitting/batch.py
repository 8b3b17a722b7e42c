"""Result of a batch of fits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.errors import CadalignError
from cadalign.fitting.problems import Problems
from cadalign.fitting.result import FitResult
from cadalign.fitting.solutions import Solutions
from cadalign.geometry.alignment import Alignment
from cadalign.solvers.constants import POSE_SIZE


@dataclass(frozen=True, eq=False)
class BatchResult:
    """Alignments of B independent problems.

    The rows of a problem without solution are NaN, ``errors`` has the reason.

    Parameters
    ----------
    rotation : (B, 3, 3) float
    translation : (B, 3) float
        [model units]
    scale : (B, 3) float
    rms : (B,) float
        Root mean square length of the inliers' residuals [px].
    covariance : (B, 8, 8) or (B, 9, 9) float or None
        See `cadalign.FitResult`.
    focal_length : (B,) float
        Horizontal focal length of the cameras [px], estimated where it was unknown.
    residuals : (n, 2) float
        Of all problems, one after the other [px].
    inliers : (n,) bool
        The keypoints that were fitted.
    offsets : (B + 1,) int
        Problem b has the rows ``offsets[b]`` to ``offsets[b + 1]`` of residuals and inliers.
    errors : mapping of int to CadalignError
        Reasons why problems have no solution, by problem.
    """

    rotation: FloatArray
    translation: FloatArray
    scale: FloatArray
    rms: FloatArray
    covariance: FloatArray | None
    focal_length: FloatArray
    residuals: FloatArray
    inliers: BoolArray
    offsets: IntArray
    errors: Mapping[int, CadalignError]

    def __len__(self) -> int:
        return len(self.rotation)

    @property
    def solved(self) -> npt.NDArray[np.bool_]:
        """Marks the problems that have a solution, (B,) bool."""
        solved = np.ones(len(self), dtype=bool)
        solved[list(self.errors)] = False
        return solved

    def alignment(self, problem: int) -> Alignment:
        """The alignment of one problem.

        Raises
        ------
        CadalignError
            The reason why the problem has none.
        """
        if problem in self.errors:
            raise self.errors[problem]
        return Alignment(self.rotation[problem], self.translation[problem], self.scale[problem])

    @classmethod
    def of_solutions(cls, problems: Problems, solutions: Solutions) -> BatchResult:
        """Arrange the solutions of a solver."""
        failed = np.zeros(len(problems), dtype=bool)
        failed[list(solutions.errors)] = True
        focals = np.broadcast_to(problems.calibrations[:, 0], len(problems))
        if solutions.focals is not None:
            focals = solutions.focals[:, 0]
        poses, residuals = solutions.poses[:, 0].copy(), solutions.residuals
        covariance = solutions.covariances
        inliers = np.repeat(~failed, problems.counts)
        if failed.any():
            poses = np.where(failed[:, None], np.nan, poses)
            residuals = np.where(inliers[:, None], residuals, np.nan)
            if covariance is not None:
                covariance = np.where(failed[:, None, None], np.nan, covariance)
        squares = np.append((residuals**2).sum(axis=1), 0.0)
        means = np.add.reduceat(squares, problems.offsets[:-1]) / np.maximum(problems.counts, 1)
        return cls(
            *_split(poses),
            rms=np.where(failed, np.nan, np.sqrt(means)),
            covariance=covariance,
            focal_length=np.where(failed, np.nan, focals),
            residuals=residuals,
            inliers=inliers,
            offsets=problems.offsets,
            errors=dict(solutions.errors),
        )

    @classmethod
    def of_fits(
        cls, problems: Problems, fits: Sequence[FitResult | CadalignError], *, focal: str
    ) -> BatchResult:
        """Arrange single results, or the errors in their place."""
        count, total = len(problems), len(problems.points_3d)
        unknowns = 9 if focal == "estimate" else 8
        poses = np.full((count, POSE_SIZE), np.nan)
        rms = np.full(count, np.nan)
        focals = np.full(count, np.nan)
        covariance = np.full((count, unknowns, unknowns), np.nan)
        residuals = np.full((total, 2), np.nan)
        inliers = np.zeros(total, dtype=bool)
        for b, fit in enumerate(fits):
            if isinstance(fit, FitResult):
                poses[b] = fit.alignment.packed
                rms[b] = fit.rms
                focals[b] = fit.camera.fx
                residuals[problems.rows(b)] = fit.residuals
                inliers[problems.rows(b)] = fit.inliers
                if fit.covariance is not None:
                    covariance[b] = fit.covariance
        return cls(
            *_split(poses),
            rms=rms,
            covariance=covariance,
            focal_length=focals,
            residuals=residuals,
            inliers=inliers,
            offsets=problems.offsets,
            errors={b: fit for b, fit in enumerate(fits) if isinstance(fit, CadalignError)},
        )

    @classmethod
    def joined(cls, parts: Sequence[BatchResult]) -> BatchResult:
        """Put the results of successive parts of a batch together."""

        def join(name: str) -> Any:
            return np.concatenate([getattr(part, name) for part in parts])

        joined = ("rotation", "translation", "scale", "rms", "focal_length", "residuals", "inliers")
        sizes = np.concatenate([np.diff(part.offsets) for part in parts])
        first_problem = np.cumsum([0, *map(len, parts)]).tolist()
        return cls(
            **{name: join(name) for name in joined},
            covariance=None if parts[0].covariance is None else join("covariance"),
            offsets=np.concatenate([[0], np.cumsum(sizes)]),
            errors={
                first + b: error
                for part, first in zip(parts, first_problem, strict=False)
                for b, error in part.errors.items()
            },
        )


def _split(poses: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Rotations, translations and scales of packed poses (B, 15)."""
    return poses[:, :9].reshape(-1, 3, 3), poses[:, 9:12], poses[:, 12:]
