"""Parts of a result: warnings, views, alternatives, evidence, the posterior, fitted keypoints.

Rows of a covariance: rotation vector in the camera frame [rad], translation, logarithms of the
lengths along x, y, z and, if estimated, of the focal length.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.estimation.options import FitOptions, RansacOptions, pixel_information
from cadalign.geometry.alignment import Alignment, Uncertainty, extent, uncertainty_of
from cadalign.geometry.camera import Camera
from cadalign.geometry.rotations import by_rotation
from cadalign.geometry.symmetry import Symmetry

Kind = (
    Literal["mistake", "outlier", "misfit", "noise", "chance", "untested", "outside-image"]
    | Literal["camera", "stretch", "contradiction", "unit", "mask", "photo", "left-out", "focal"]
    | Literal["alternative"]
)


@dataclass(frozen=True, repr=False)
class EstimateWarning:
    """A warning about an estimate.

    ``str`` and ``repr`` show only its text.

    Parameters
    ----------
    kind : str
        What is doubtful:

        - "mistake": a common mistake in the data, such as a mirrored model, explains them better;
        - "outlier": keypoints do not fit the others;
        - "misfit": residuals are larger than the stated noise explains, and not because of a few
          outliers;
        - "noise": the estimated noise is as large as the keypoints' spread;
        - "chance": random keypoints would agree as well;
        - "untested": there are no redundant equations to test the estimate;
        - "outside-image": keypoints lie outside the image;
        - "camera": the keypoints contradict the focal length, or the camera is implausible;
        - "stretch": the keypoints contradict the limit on the stretch, or it is implausible;
        - "contradiction": a piece of evidence contradicts the rest;
        - "unit": depths or distances have another unit, or keypoints are not in pixels;
        - "mask", "photo": the mask or photo is left out, or agrees only in part;
        - "left-out": a view is left out, or a keypoint that was not found or given twice;
        - "focal": the estimated focal length contradicts its prior;
        - "alternative": another pose is likely too.
    text : str
        A sentence for the user.
    view : int, optional
        Index of the view that it concerns; None for all views.
    keypoints : tuple of int
        Rows, within the view, of the keypoints that it concerns; empty if it concerns all.

    Examples
    --------
    >>> warning = EstimateWarning("left-out", "views[1] is left out", view=1)
    >>> print(warning)
    views[1] is left out
    """

    kind: Kind
    text: str
    view: int | None = None
    keypoints: tuple[int, ...] = ()

    def __str__(self) -> str:
        return self.text

    def __repr__(self) -> str:
        return repr(self.text)


Warnings = tuple[EstimateWarning, ...]

MISFIT_KINDS: frozenset[Kind] = frozenset({"misfit", "outlier", "stretch", "camera", "mistake"})
"""Kinds about keypoints that do not fit."""


T = TypeVar("T")

_NO_RESIDUAL = 1e-6  # of a length that the estimate fits exactly [sigma]
LEAST_LIKELIHOOD = 1e-3
"""Relative likelihood above which another minimum is reported as an alternative."""
_FIELDS = {
    "keypoints": "points_2d",
    "photo": "image",
    "gravity": "up",
    "camera height": "camera_height",
    "rig": "cam_from_rig",
}


@dataclass(frozen=True, eq=False)
class Alternative:
    """Another estimate that explains the evidence almost as well as the best one.

    Parameters
    ----------
    alignment : Alignment
        In the first view's camera.
    relative_likelihood : float
        Likelihood relative to the best estimate; 1 for an equally good one.
    camera : Camera
        Its camera: the best estimate's, unless the focal length was estimated.
    points_3d : (m, 3) float
        Its keypoints in the model's frame.
    own_bounds : (2, 3) float, optional
        Its bounds in the model's frame; None for the keypoints' bounds.
    """

    alignment: Alignment
    relative_likelihood: float
    camera: Camera
    points_3d: FloatArray
    own_bounds: FloatArray | None = field(default=None, repr=False)

    @property
    def bounds(self) -> FloatArray:
        """Its bounds (2, 3) in the model's frame."""
        return extent(self.points_3d) if self.own_bounds is None else self.own_bounds


def alternatives_of(
    points: FloatArray,
    poses: Sequence[Alignment],
    cameras: Sequence[Camera],
    costs: Sequence[float],
) -> tuple[Alternative, ...]:
    """Alternatives with points (n, 3) among all minima but the first, where likely enough."""
    ratios = [math.exp(min(0.0, costs[0] - cost) / 2) for cost in costs]
    return tuple(
        Alternative(pose, ratio, camera, points)
        for pose, ratio, camera in list(zip(poses, ratios, cameras, strict=True))[1:]
        if ratio >= LEAST_LIKELIHOOD and np.isfinite(pose.vector).all()
    )


@dataclass(frozen=True)
class FitStats:
    """Effort of an estimate.

    Parameters
    ----------
    iterations : int
        Number of refinement steps over all starts; with ``ransac``, of samples.
    hypotheses : int
        Number of alignments that a refinement could start from.
    seconds : float
    """

    iterations: int
    hypotheses: int
    seconds: float


NO_STATS = FitStats(0, 0, 0.0)


@dataclass(frozen=True, eq=False)
class FittedKeypoints:
    """Keypoints of an exact model in one view, with their alignment; fields as in `Result`."""

    points_3d: FloatArray  # (n, 3), only the keypoints that the view shows
    residuals: FloatArray
    inliers: BoolArray
    alignment: Alignment
    camera: Camera
    options: FitOptions
    sigma: float | None = None
    fisher_covariance: FloatArray | None = None
    symmetry: Symmetry | None = None
    method: str = "optimal"
    cost: float | None = None
    alternatives: tuple[Alternative, ...] = ()
    stats: FitStats = NO_STATS
    ransac: RansacOptions | None = None
    doubt: Callable[[FloatArray, BoolArray], EstimateWarning | None] | None = None  # of inliers
    repeats: tuple[tuple[int, int], ...] = ()  # (row left out, row that it repeats)

    @property
    def is_counted(self) -> BoolArray:
        """Rows (n,) that are not left out."""
        counted = np.ones(len(self.points_3d), dtype=bool)
        counted[[row for row, _ in self.repeats]] = False
        return counted

    @property
    def observed(self) -> FloatArray:
        """The given keypoints (n, 2) [px]; NaN behind the camera."""
        projected = self.camera.project_where_ahead(self.alignment.apply(self.points_3d))
        with np.errstate(invalid="ignore"):  # infinite residuals
            return np.asarray(projected - self.residuals)

    @property
    def redundancy(self) -> int:
        """Number of equations, including priors, minus the number of unknowns."""
        equations = 2 * int(self.inliers.sum()) + self.options.prior_equations(self.alignment.scale)
        return equations - self.options.unknowns

    @property
    def chosen_sigma(self) -> Any:
        return self.sigma if self.options.sigma is None else self.options.sigma


Diagnosis = Callable[[FittedKeypoints], EstimateWarning | None]
"""A function that names the cause of a misfit; see `cadalign.estimation.diagnose.diagnose_fit`."""


@dataclass(frozen=True)
class EvidenceSummary:
    """Agreement of one piece of evidence with a joint estimate."""

    kind: str
    """Name of the kind: "keypoints", "mask", "photo", "depth", "gravity", "size", "camera height",
    "rig"."""
    view: int | None
    """Number of the view; None for the object's size."""
    count: int
    """Number of measurements: keypoints, contour pixels, depths, directions, lengths."""
    rms_sigmas: float
    """Root mean square residual, in standard deviations of the measurements."""
    rms: float
    """Root mean square residual in ``unit``."""
    unit: str
    """One of "px", "deg", "" (the unit of lengths). A camera's motion has no residual."""
    share: float | None = None
    """Share of the model's outline that was found in a photo; 0 if the photo was left out."""

    @property
    def name(self) -> str:
        """The argument with this evidence.

        Examples
        --------
        >>> EvidenceSummary("gravity", 1, 1, 0.5, 0.5, "deg").name
        'views[1].up'
        """
        field = _FIELDS.get(self.kind, self.kind)
        return self.kind if self.view is None else f"views[{self.view}].{field}"

    def __str__(self) -> str:
        if self.share == 0:
            return f"{self.name}: left out"
        if not self.unit and self.rms_sigmas < _NO_RESIDUAL:
            return f"{self.name}: sets the unit of lengths"
        unit = f" {self.unit}" if self.unit else ""
        return f"{self.name}: rms {self.rms:.3g}{unit}, {self.rms_sigmas:.2g} sigma"


def keypoint_summary(
    number: int, residuals: FloatArray, inliers: BoolArray, sigma: Any
) -> EvidenceSummary:
    """Summary of a view's inliers (n,) with residuals (n, 2) [px] and ``sigma``."""
    kept, unit = residuals[inliers], 1.0 if sigma is None else sigma
    count = max(len(kept), 1)
    rms = math.sqrt((kept * kept).sum() / count)
    if np.ndim(unit) == 0:
        # The smallest positive float is a valid sigma.
        in_sigmas = min(rms / math.sqrt(2.0) / float(unit), sys.float_info.max)
    else:
        information = pixel_information(unit, len(residuals))[inliers]
        squares = np.einsum("ni,nij,nj->", kept, information, kept)
        in_sigmas = float(np.sqrt(squares / (2 * count)))
    return EvidenceSummary("keypoints", number, len(kept), in_sigmas, rms, "px")


def join_or(clauses: Sequence[str]) -> str:
    """Join names or clauses by commas and "or"."""
    *some, last = clauses
    return f"{', '.join(some)} or {last}" if some else last


def create_unchecked(kind: type[T], fields: dict[str, Any]) -> T:
    """Create a frozen dataclass without its slow constructor and checks."""
    made = object.__new__(kind)
    made.__dict__.update(fields)
    return made


@dataclass(frozen=True, eq=False)
class Posterior:
    """Uncertainty of an estimate, and warnings about it; see `cadalign.Result`."""

    covariance: FloatArray | None = None
    fisher_covariance: FloatArray | None = None
    points_covariance: FloatArray | None = None
    points_cam_covariance: FloatArray | None = None
    degrees_of_freedom: float | None = None
    redundancy: int = 0
    warnings: Warnings = ()
    evidence: tuple[EvidenceSummary, ...] = ()
    score: float | None = None
    """-2 log probability up to a constant, without the shape; None for exact models."""


class OutlineNotes(NamedTuple):
    """Evidence and warnings from masks and photos."""

    evidence: tuple[EvidenceSummary, ...] = ()
    warnings: Warnings = ()


NO_NOTES = OutlineNotes()


def points_covariances(
    points: FloatArray, alignment: Alignment, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Covariances (m, 3, 3) of stretched points in the model's frame and in the camera's."""
    covariance, stretched = covariance[:9, :9], points * alignment.scale
    by_logs = stretched[:, :, None] * np.eye(3)
    of_points = by_logs @ covariance[6:, 6:] @ by_logs.swapaxes(1, 2)
    seen_by_logs = alignment.rotation * stretched[:, None]
    shifts = np.broadcast_to(np.eye(3), seen_by_logs.shape)
    by_turns = by_rotation(stretched @ alignment.rotation.T)
    rows = np.concatenate([by_turns, shifts, seen_by_logs], axis=2)
    return of_points, rows @ covariance @ rows.swapaxes(1, 2)


@dataclass(frozen=True, eq=False)
class ViewResult:
    """Estimate of one view.

    Parameters
    ----------
    camera : Camera
        The camera, with the estimated focal length if it was unknown.
    alignment : Alignment
        Pose in that camera, and scale.
    ids : sequence of int or str
        Ids of its keypoints.
    points_2d : (n, 2) float
        Observed keypoints [px].
    residuals : (n, 2) float
        Projected minus observed keypoints [px]; infinite (null in JSON) for outliers behind the
        camera.
    inliers : (n,) bool
        Keypoints that the estimate uses.
    posterior : Posterior
        Uncertainty in this camera's frame.
    """

    camera: Camera
    alignment: Alignment
    ids: Sequence[Hashable]
    points_2d: FloatArray
    residuals: FloatArray
    inliers: BoolArray
    posterior: Posterior = field(repr=False)

    @property
    def covariance(self) -> FloatArray | None:
        """Covariance in this camera's frame; see `cadalign.Result.covariance`."""
        return self.posterior.covariance

    @property
    def std(self) -> Uncertainty | None:
        """Standard deviations from ``covariance``; None for methods that have none."""
        return None if self.covariance is None else uncertainty_of(self.covariance)

    @property
    def rms(self) -> float:
        """Root mean square length of the inliers' residuals [px]."""
        return rms_of(self.residuals, self.inliers)


def rms_of(residuals: FloatArray, inliers: BoolArray) -> float:
    """Root mean square length of the residuals (n, 2) of inliers (n,)."""
    kept = residuals[inliers]
    return math.sqrt((kept * kept).sum() / max(len(kept), 1))
