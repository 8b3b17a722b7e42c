"""The result of a fit."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.fitting.focal.prior import FocalPrior, focal_doubt
from cadalign.fitting.options import FitOptions
from cadalign.fitting.uncertainty import Uncertainty, uncertainty_of, warnings_of
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera

if TYPE_CHECKING:
    from cadalign.fitting.misfit import Misfit


@dataclass(frozen=True)
class Alternative:
    """Another alignment that the keypoints cannot tell from the best one.

    Parameters
    ----------
    alignment : Alignment
    relative_likelihood : float
        Its likelihood over that of the best alignment, 1 for an equally good one.
    camera : Camera
        The camera that goes with it; the best alignment's, unless the focal length was estimated.
    """

    alignment: Alignment
    relative_likelihood: float
    camera: Camera


@dataclass(frozen=True)
class FitStats:
    """Effort of a fit.

    Parameters
    ----------
    iterations : int
        Refinement steps over all starts; samples, where inliers were searched for.
    hypotheses : int
        Alignments from which a refinement could start.
    seconds : float
    inlier_ratio : float, optional
        Share of the keypoints that were kept, where they were searched for.
    score : float, optional
        Of the robust search: sum of squared errors, each at most the threshold's square [px^2].
    """

    iterations: int
    hypotheses: int
    seconds: float
    inlier_ratio: float | None = None
    score: float | None = None


@dataclass(frozen=True, eq=False)
class FitResult:
    """An alignment with its residuals and its uncertainty.

    Parameters
    ----------
    alignment : Alignment
        Pose and stretch.
    points_3d : (n, 3) float
        The model's keypoints, as given.
    residuals : (n, 2) float
        Projected minus observed keypoint [px]; infinite, and null in JSON, for one that was
        rejected and lies behind the camera.
    inliers : (n,) bool
        The keypoints that the alignment was fitted to.
    method : str
        The method that found it.
    camera : Camera
        The camera it was fitted with; with the estimated focal length, where that was unknown.
    sigma : float, optional
        Standard deviation of the keypoints [px], given or estimated; None where each keypoint has
        its own.
    covariance : (8, 8) or (9, 9) float, optional
        Of the rotation vector in the camera frame [rad], the translation [model units], the
        logarithms of the two unknown scales, in the order of the axes, and, where it was
        estimated, the logarithm of the focal length; zero for what was held fixed. The inverse of
        the Fisher information at the optimum, which is the Cramer-Rao bound there: with few
        keypoints errors are larger, see `posterior_covariance`. None for the methods that are not
        statistical.
    known_axis : {"x", "y", "z"}
        The model's axis whose scale was taken as 1.
    stretched_axes : str
        The axes whose scale was estimated.
    focal : {"known", "estimate"}
        The camera's focal length was taken as right, or estimated.
    focal_prior : FocalPrior, optional
        Prior on the estimated focal length.
    alternatives : tuple of Alternative
        Other alignments that explain the keypoints as well: with 4 points all other exact
        solutions, otherwise minima whose likelihood is at least 1/1000 of the best one's.
    stats : FitStats
    options : FitOptions, optional
        Those of the fit; None in files of earlier versions.
    """

    alignment: Alignment
    points_3d: FloatArray
    residuals: FloatArray
    inliers: npt.NDArray[np.bool_]
    method: str
    camera: Camera
    sigma: float | None
    covariance: FloatArray | None
    known_axis: str
    stretched_axes: str
    focal: str
    focal_prior: FocalPrior | None
    alternatives: tuple[Alternative, ...] = ()
    stats: FitStats = FitStats(0, 0, 0.0)
    options: FitOptions | None = None

    @property
    def rms(self) -> float:
        """Root mean square length of the inliers' residuals [px]."""
        kept = self.residuals[self.inliers]
        return float(np.sqrt((kept * kept).sum() / max(len(kept), 1)))

    @cached_property
    def posterior_covariance(self) -> FloatArray | None:
        """Covariance of the errors, calibrated for few keypoints, in the form of `covariance`.

        The second moments of the posterior about the alignment, from some thousand draws (always
        the same), scaled such that the 95 % ellipsoid holds what the likelihood ratio does not
        reject at 5 %. Where sigma was estimated, it is widened for the few degrees of freedom of
        that estimate. It does not reach to the ``alternatives``. Beyond 100 keypoints it is
        ``covariance`` but for that widening; for results without ``options`` it is ``covariance``.
        """
        if self.covariance is None or self.options is None:
            return self.covariance
        from cadalign.fitting.posterior import posterior_covariance  # loads the compiler

        return posterior_covariance(self, self.options)

    @property
    def std(self) -> Uncertainty | None:
        """Standard deviations from `posterior_covariance`; None for methods that have none."""
        if self.posterior_covariance is None:
            return None
        return uncertainty_of(self.posterior_covariance, self.known_axis)

    @cached_property
    def misfit(self) -> Misfit | None:
        """Result of a chi-square test of residuals that the given sigma does not explain.

        None if they pass (of right data, 99.5 % or more do), for an estimated sigma, for methods
        that are not statistical, and for results without ``options``.
        """
        if self.covariance is None or self.options is None:
            return None
        from cadalign.fitting.misfit import find_misfit

        return find_misfit(self, self.options)

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about a misfit, and about what the keypoints do not determine."""
        std = self.std
        if std is None:
            return ()
        kept = self.points_3d[self.inliers]
        unknowns = 6 + len(self.stretched_axes) + (self.focal == "estimate")
        return self._contradictions() + warnings_of(
            kept,
            self.alignment,
            std,
            redundancy=2 * len(kept) - unknowns,
            doubt=focal_doubt(self.camera, self.focal_prior) if self.focal == "estimate" else None,
        )

    def _contradictions(self) -> tuple[str, ...]:
        """Warnings about a misfit, or about a constraint that cannot be tested."""
        if self.misfit is not None:
            return (str(self.misfit),)
        if self.options is None:
            return ()
        from cadalign.fitting.misfit import unverified_stretch

        doubt = unverified_stretch(self, self.options)
        return () if doubt is None else (doubt,)

    def __str__(self) -> str:
        count = int(self.inliers.sum())
        of = "" if count == len(self.inliers) else f" of {len(self.inliers)}"
        lines = [f"{self.method}: {count}{of} keypoints, rms {self.rms:.3g} px"]
        std = self.std
        angle = np.degrees(np.arccos(np.clip((np.trace(self.alignment.rotation) - 1) / 2, -1, 1)))
        translation = ", ".join(f"{value:.4g}" for value in self.alignment.translation)
        scale = [f"{value:.4g}" for value in self.alignment.scale]
        if std is None:
            lines.append(f"  rotation     {angle:.4g} deg from the camera's axes")
            lines.append(f"  translation  ({translation})")
        else:
            shift = ", ".join(f"{value:.2g}" for value in std.translation)
            lines.append(
                f"  rotation     {angle:.4g} deg from the camera's axes, "
                f"+- {std.rotation_deg:.2g} deg"
            )
            lines.append(f"  translation  ({translation}) +- ({shift})")
            scale = [
                text if deviation == 0 else f"{text} +- {100 * deviation:.2g} %"
                for text, deviation in zip(scale, std.scale, strict=True)
            ]
        lines.append(f"  scale        ({', '.join(scale)})")
        if self.focal == "estimate":
            known_to = "" if std is None else f" +- {100 * std.focal:.2g} %"
            lines.append(f"  focal length {self.camera.fx:.4g} px{known_to}")
        lines.extend(
            f"  also likely  ({other.relative_likelihood:.2g} x): scale "
            f"({', '.join(f'{value:.4g}' for value in other.alignment.scale)})"
            for other in self.alternatives
        )
        lines.extend(f"  warning      {text}" for text in self.warnings)
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Write the result as plain lists and numbers, for JSON."""
        std = self.std
        return {
            "method": self.method,
            "camera": self.camera.to_dict(),
            "alignment": self.alignment.to_dict(),
            "rms": self.rms,
            "points_3d": self.points_3d.tolist(),
            "residuals": [
                row if math.isfinite(row[0] + row[1]) else None for row in self.residuals.tolist()
            ],
            "inliers": self.inliers.tolist(),
            "sigma": self.sigma,
            "covariance": None if self.covariance is None else self.covariance.tolist(),
            "std": None if std is None else asdict(std),
            "options": None if self.options is None else _plain_options(self.options),
            "misfit": None if self.misfit is None else self.misfit.to_dict(),
            "known_axis": self.known_axis,
            "stretched_axes": self.stretched_axes,
            "focal": self.focal,
            "focal_prior": None if self.focal_prior is None else asdict(self.focal_prior),
            "alternatives": [
                {
                    "alignment": other.alignment.to_dict(),
                    "relative_likelihood": other.relative_likelihood,
                    "camera": other.camera.to_dict(),
                }
                for other in self.alternatives
            ],
            "warnings": list(self.warnings),
            "stats": asdict(self.stats),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> FitResult:
        """Read what `to_dict` wrote.

        Raises
        ------
        InputError
            If a field is missing or invalid.
        """
        from cadalign.fitting.document import read_result  # takes the validation library with it

        return read_result(data)

    def to_json(self) -> str:
        """The result as JSON text; see `to_dict`."""
        return json.dumps(self.to_dict())

    @classmethod
    def from_json(cls, text: str) -> FitResult:
        """Read what `to_json` wrote.

        Raises
        ------
        InputError
            If it is not JSON, or a field is missing or invalid.
        """
        try:
            data = json.loads(text)
        except (ValueError, RecursionError) as error:
            what = f"not valid JSON: {str(error)[:200]}"
            raise InputError(what, where="fit result") from None
        return cls.from_dict(data)


def _plain_options(options: FitOptions) -> dict[str, Any]:
    """Options as plain lists and numbers."""
    sigma = options.sigma
    plain = sigma if sigma is None else np.asarray(sigma, dtype=float).tolist()
    return {**asdict(replace(options, sigma=None)), "sigma": plain}
