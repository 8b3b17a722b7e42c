"""Result of a batch of fits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.errors import CadalignError
from cadalign.estimation.problems import Problems, Solutions
from cadalign.estimation.result import FitResult
from cadalign.geometry.alignment import Alignment
from cadalign.solvers.constants import POSE_SIZE

if TYPE_CHECKING:
    import pandas as pd


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

    def __repr__(self) -> str:
        return f"BatchResult({len(self)} problems, {len(self.errors)} without solution)"

    def to_dataframe(self) -> pd.DataFrame:
        """One row for each problem, as a pandas DataFrame.

        Columns: ``solved``, ``rms`` [px], ``keypoints``, ``inliers``, ``rotation_x`` to
        ``rotation_z`` (rotation vector [degrees]), ``translation_x`` to ``_z``, ``scale_x`` to
        ``_z``, ``focal_length`` [px], and ``error``, the reason where there is no solution.

        Examples
        --------
        >>> from cadalign import Camera, fit_batch
        >>> corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
        >>> camera = Camera(640, 480, 900, 900, 319.5, 239.5)
        >>> seen = camera.project(corners + [0.1, 0.2, 5.0])
        >>> frame = fit_batch([corners, corners], [seen, seen], camera).to_dataframe()
        >>> frame[["solved", "keypoints"]].to_numpy().tolist()
        [[True, 8], [True, 8]]
        """
        import pandas as pd
        from scipy.spatial.transform import Rotation

        solved = self.solved
        vectors = np.full((len(self), 3), np.nan)
        if solved.any():
            turns = Rotation.from_matrix(self.rotation[solved])
            vectors[solved] = turns.as_rotvec(degrees=True)
        kept = np.concatenate([[0], np.cumsum(self.inliers)])
        columns: dict[str, Any] = {
            "solved": solved,
            "rms": self.rms,
            "keypoints": np.diff(self.offsets),
            "inliers": np.diff(kept[self.offsets]),
        }
        named = {"rotation": vectors, "translation": self.translation, "scale": self.scale}
        for name, values in named.items():
            columns |= {f"{name}_{axis}": values[:, k] for k, axis in enumerate("xyz")}
        columns["focal_length"] = self.focal_length
        columns["error"] = [
            str(self.errors[b]) if b in self.errors else "" for b in range(len(self))
        ]
        return pd.DataFrame(columns)

    def alignment(self, problem: int) -> Alignment:
        """The alignment of one problem.

        Raises
        ------
        CadalignError
            The reason why the problem has none.
        """
        if problem in self.errors:
            raise self.errors[problem]
        rotation, translation, scale = self.rotation, self.translation, self.scale
        own = (array[problem].copy() for array in (rotation, translation, scale))
        return Alignment(*own, is_valid=True)

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
