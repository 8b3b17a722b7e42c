"""The result of a fit."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.estimation.focal import FocalPrior, focal_doubt
from cadalign.estimation.options import FitOptions
from cadalign.estimation.symmetry import equal_text, held_axes, without_free_turns
from cadalign.estimation.uncertainty.weakness import Uncertainty, uncertainty_of, warnings_of
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.symmetry import Symmetry
from cadalign.geometry.symmetry_group import group_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from cadalign.estimation.uncertainty.misfit import Misfit
    from cadalign.export import ExportOptions
    from cadalign.geometry.mesh import Mesh


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
        The model's keypoints, as given; with a symmetry, turned by the one that leads to this
        alignment.
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
    symmetry : Symmetry, optional
        The model's, as given: of all equal alignments this is the canonical one.
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
    symmetry: Symmetry | None = None

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
        from cadalign.estimation.uncertainty.posterior import (
            posterior_covariance,  # loads the compiler
        )

        return posterior_covariance(self, self.options)

    @property
    def std(self) -> Uncertainty | None:
        """Standard deviations from `posterior_covariance`; None for methods that have none.

        Without that of rotations about an axis of the model's symmetry.
        """
        covariance = self.posterior_covariance
        if covariance is None:
            return None
        if self.symmetry is not None:
            held = held_axes(self.stretched_axes)
            best = group_of(self.symmetry).canonical(self.alignment, held=held)
            covariance = without_free_turns(covariance, best)
        return uncertainty_of(covariance, self.known_axis)

    @cached_property
    def misfit(self) -> Misfit | None:
        """Result of a chi-square test of residuals that the given sigma does not explain.

        None if they pass (of right data, 99.5 % or more do), for an estimated sigma, for methods
        that are not statistical, and for results without ``options``.
        """
        if self.covariance is None or self.options is None:
            return None
        from cadalign.estimation.uncertainty.misfit import find_misfit

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
        from cadalign.estimation.uncertainty.misfit import unverified_stretch

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
        equal = equal_text(self.alignment, self.symmetry, held=held_axes(self.stretched_axes))
        if equal:
            lines.append(f"  symmetry     {equal}")
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

    def __repr__(self) -> str:
        scale = ", ".join(f"{value:.3g}" for value in self.alignment.scale)
        count = f"{int(self.inliers.sum())}/{len(self.inliers)}"
        return (
            f"FitResult({self.method!r}, keypoints={count}, rms={self.rms:.3g} px, "
            f"scale=({scale}), warnings={len(self.warnings)})"
        )

    def _repr_html_(self) -> str:
        from cadalign.estimation.drawing import fit_html

        return fit_html(self)

    def plot(
        self,
        image: npt.ArrayLike | str | os.PathLike[str] | None = None,
        mesh: Mesh | None = None,
        *,
        axes: Axes | None = None,
    ) -> Axes:
        """Draw photo, model, box, and keypoints with their residuals on matplotlib axes.

        Parameters
        ----------
        image : (h, w, 3) uint8 or path, optional
            The photo; grey by default.
        mesh : Mesh, optional
            The model's, drawn shaded with its outline. Without it the box is the keypoints'.
        axes : matplotlib.axes.Axes, optional
            The axes to draw on; those of a new figure by default.

        Returns
        -------
        matplotlib.axes.Axes
            In pixels: x right, y down.

        Raises
        ------
        InputError
            If the photo is not of the camera's size.

        Examples
        --------
        >>> from matplotlib.figure import Figure
        >>> from cadalign import fit
        >>> camera = Camera(640, 480, 900, 900, 319.5, 239.5)
        >>> corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
        >>> result = fit(corners, camera.project(corners + [0.1, 0.2, 5.0]), camera)
        >>> axes = result.plot(axes=Figure().add_subplot())
        >>> [float(y) for y in axes.get_ylim()]
        [479.5, -0.5]
        """
        from cadalign.estimation.drawing import plot_fit

        return plot_fit(self, image, mesh, axes=axes)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the result as JSON, as `cadalign fit` does.

        Raises
        ------
        DataError
            If the file cannot be written.
        """
        from cadalign.io.files import write_json

        write_json(Path(path), self.to_dict())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> FitResult:
        """Read what `save` or `cadalign fit` wrote.

        Raises
        ------
        DataError
            If the file cannot be read, or a field is missing or invalid; the message names both.
        """
        from cadalign.io.documents import in_file, read_json

        data = read_json(Path(path))
        with in_file(Path(path)):
            return cls.from_dict(data)

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
            "symmetry": None if self.symmetry is None else self.symmetry.to_dict(),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> FitResult:
        """Read what `to_dict` wrote.

        Raises
        ------
        InputError
            If a field is missing or invalid.
        """
        from cadalign.estimation.document import read_result  # takes the validation library with it

        return read_result(data)

    def export(
        self,
        path: str | os.PathLike[str],
        *,
        format: str | None = None,
        options: ExportOptions | None = None,
        **of_the_object: Any,
    ) -> Path:
        """Write the aligned object for another tool; see `cadalign.export.export_object`.

        Parameters
        ----------
        path : path-like
            Its ending tells the format: ``.glb``, ``.usdz``, ``.obj``, ``.ply``, BOP's ``.csv``.
        format, options
            As for `cadalign.export.export_object`.
        **of_the_object
            ``mesh``, ``image``, ``world_from_cam``, ``name`` and ``metres`` of
            `cadalign.estimation.exporting.object_of_fit`.

        Examples
        --------
        >>> result.export("chair.glb", mesh=mesh, image="chair.jpg")  # doctest: +SKIP
        """
        from cadalign.estimation.exporting import object_of_fit
        from cadalign.export import export_object

        exported = object_of_fit(self, **of_the_object)
        return export_object(path, exported, format=format, options=options)

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
