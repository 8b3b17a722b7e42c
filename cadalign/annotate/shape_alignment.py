"""Live alignment by `cadalign.align`: an object's own shape, or evidence beyond keypoints."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from cadalign.annotate.alignment import LEAST_SIGMA, ExpectedNoise
from cadalign.annotate.further import FurtherEvidence
from cadalign.annotate.object_shape import ObjectShape
from cadalign.annotate.photos import without_focal
from cadalign.annotate.wireframe import Wireframe
from cadalign.arrays import BoolArray, FloatArray
from cadalign.datasets.models.model_keypoints import ModelKeypoint
from cadalign.errors import CadalignError, DegenerateError
from cadalign.estimation.align import align
from cadalign.estimation.focal import FocalPrior
from cadalign.estimation.model import Model
from cadalign.estimation.observed import model_of, views_of
from cadalign.estimation.options import FitOptions, RansacOptions
from cadalign.estimation.result import Result
from cadalign.estimation.view import View
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.io.evidence import Size
from cadalign.io.observation import Observation
from cadalign.shapes.model import ShapeModel

LEAST_SHAPE_PAIRS = 3
_LEAST_JUDGED = 6  # pairs from which on one can contradict the others
_NOISE_ROUNDS = 4
_UNKNOWNS = 9  # of pose and lengths
_NOISE_TOLERANCE = 0.1
_CONTRADICTS = 5.0  # distance from the others' prediction [sigmas]; hands click to about 2 px


@dataclass(frozen=True, eq=False)
class WarpedModel:
    """The model, warped to the estimated shape, in its frame before the stretch.

    ``carried`` (k, 3) are points of the model that the estimate does not know.
    """

    wireframe: Wireframe
    carried: FloatArray


@dataclass(frozen=True, eq=False)
class LiveShape:
    """Alignment and shape from the pairs placed so far, and from evidence beyond them.

    It is provisional if the focal length was assumed. ``counts`` (n,) are the complete pairs whose
    keypoints the shape knows; the others' residuals are those of points that the warp carries. The
    photo is the view of number ``place``.
    """

    shown: Result | None
    message: str = ""
    provisional: bool = False
    camera: Camera | None = None
    counts: BoolArray = field(default_factory=lambda: np.empty(0, dtype=bool))
    residuals: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    outliers: Mapping[int, float] = field(default_factory=dict)
    warped: WarpedModel | None = None
    prior_lengths: FloatArray = field(default_factory=lambda: np.zeros(3))
    sigma: float = LEAST_SIGMA
    place: int = 0
    also_used: tuple[str, ...] = ()
    fit_options: Mapping[str, Any] = field(default_factory=dict)
    """Options with which, and the priors, `cadalign fit` finds the same."""

    @property
    def alignment(self) -> Alignment:
        """The alignment in the photo's camera."""
        assert self.shown is not None
        return self.shown.poses[self.place]


def warm_up_joint(points_3d: FloatArray, points_2d: FloatArray, camera: Camera) -> None:
    """Compile or load what `align_shape` calls, by aligning points (n, 3) with (n, 2) [px]."""
    view, model = View(camera, points_2d), Model(points_3d=points_3d, shape_sigma=0.01)
    for ransac in (None, RansacOptions()):
        align(model, view, ransac=ransac)
    align(model, view, focal="estimate")


@dataclass(frozen=True, eq=False)
class Known:
    """Prior knowledge of the object, before any pair and beside them.

    Parameters
    ----------
    shape : ObjectShape, optional
        The object's own shape; None for the stretched model.
    further : FurtherEvidence
    scale_prior_sigma : float, optional
        Prior on the stretch.
    anchors : mapping
        The model's keypoints that the shape knows, by their ids there.
    assumed_focal : tuple of str
        Photos whose focal length is neither known nor estimated, this one by an empty name.
    estimates_focal : bool
        Estimate the focal lengths of all views.
    focal_prior : FocalPrior, optional
        On these.
    """

    shape: ObjectShape | None
    further: FurtherEvidence
    scale_prior_sigma: float | None
    anchors: Mapping[Any, ModelKeypoint]
    assumed_focal: tuple[str, ...] = ()
    estimates_focal: bool = False
    focal_prior: FocalPrior | None = None

    def model_for(self, observation: Observation, mesh: Mesh) -> Model | ShapeModel:
        """The model that `cadalign fit` aligns to the observation."""
        shape = self.shape
        if shape is not None and (shape.learned is not None or not observation.others):
            return shape.model_with(self.anchors.values(), mesh)
        prior = self.scale_prior_sigma
        sigma = None if shape is None else shape.sigma
        options = FitOptions(scale_prior_sigma=prior)
        return model_of(observation, options=options, shape_sigma=sigma, mesh=mesh)

    def has_open_sigma(self, observation: Observation) -> bool:
        """True if the residuals say how far the keypoints lie from the stretched model's.

        With an own shape it says so; without a prior, residuals would be fitted away by a stretch.
        """
        own = any(view.sigma is not None for view in observation.views)
        return self.shape is None and self.scale_prior_sigma is not None and not own

    def counts(self, points: Sequence[ModelKeypoint]) -> BoolArray:
        """The points (n,) whose pairs count."""
        shape = self.shape
        return np.array([shape is None or shape.knows(point) for point in points], dtype=bool)

    def prior_lengths(self, model: Model | ShapeModel) -> FloatArray:
        """Standard deviations (3,) of the logarithms of the box's lengths before any pair."""
        if self.shape is not None:
            return self.shape.length_sigmas(model)
        prior = self.scale_prior_sigma or np.inf
        return np.array([0.0, prior, prior])


@dataclass(frozen=True, eq=False)
class JointEstimate:
    """An alignment from all photos of an object, and what it was computed from.

    ``sigma`` is the deviation [px] that the estimate took for all keypoints, None for their own;
    ``assumes_focal`` is True where the evidence did not suffice to estimate focal lengths.
    """

    model: Model | ShapeModel
    views: tuple[View, ...]
    result: Result
    sigma: float | None
    assumes_focal: bool = False

    @classmethod
    def of(cls, known: Known, mesh: Mesh, observation: Observation) -> JointEstimate:
        """Align as `cadalign fit` does; raises a CadalignError if that is impossible.

        With too little evidence for focal lengths, at those of the observation's cameras.
        """
        model = known.model_for(observation, mesh)
        views = views_of(observation, model, sigma=known.further.sigma)
        if known.estimates_focal:
            unknown = tuple(replace(view, camera=without_focal(view.camera)) for view in views)
            lens = {"focal": "estimate", "focal_prior": known.focal_prior}
            try:
                return cls._of(known, observation, model, unknown, lens)
            except DegenerateError:
                estimate = cls._of(known, observation, model, views, {})
                return replace(estimate, assumes_focal=True)
        return cls._of(known, observation, model, views, {})

    @classmethod
    def _of(
        cls,
        known: Known,
        observation: Observation,
        model: Model | ShapeModel,
        views: tuple[View, ...],
        lens: Mapping[str, Any],
    ) -> JointEstimate:
        """Align views, ``lens`` being the options of `align` for focal lengths."""
        size, sigma, used = observation.size, known.further.sigma, views
        if sigma is None and known.has_open_sigma(observation):
            sigma = _explaining_sigma(model, views, size, lens)
            used = tuple(replace(view, sigma=sigma) for view in views)
        return cls(model, views, align(model, used, size=size, **lens), sigma)


def _explaining_sigma(
    model: Model | ShapeModel,
    views: Sequence[View],
    size: Size | None,
    lens: Mapping[str, Any],
) -> float:
    """The deviation of keypoints [px] that explains what a model which is only similar leaves.

    The fixed point of its estimate, from the expected one. Without masks, which take longer than
    all the rest, and with focal lengths as the first round finds them, ``lens`` being the options
    of `align` for them.
    """
    noise = ExpectedNoise.of(*(view.camera for view in views))
    sigma = noise.sigma
    views = [replace(view, mask=None, mask_sigma=None) for view in views]
    for _ in range(_NOISE_ROUNDS):
        used = [replace(view, sigma=sigma) for view in views]
        try:
            result = align(model, used, size=size, **lens)
        except CadalignError:  # it takes the masks
            break
        if lens:
            pairs = zip(views, result.cameras, strict=True)
            views, lens = [replace(view, camera=camera) for view, camera in pairs], {}
        residuals = result.residuals
        redundancy = max(0, residuals.size - _UNKNOWNS)
        before = sigma
        sigma = noise.with_residuals(float((residuals**2).sum()), redundancy=redundancy)
        if abs(sigma / before - 1) < _NOISE_TOLERANCE:
            break
    return max(LEAST_SIGMA, sigma)


def align_shape(
    known: Known,
    wireframe: Wireframe,
    observation: Observation | None,
    points: Sequence[ModelKeypoint],
    uv: FloatArray,
    *,
    estimated: Callable[[Observation], JointEstimate],
) -> LiveShape:
    """Align with the complete pairs, and with all evidence beside them.

    Parameters
    ----------
    known : Known
    wireframe : Wireframe
        That of the model.
    observation : Observation, optional
        The pairs that count, with the evidence beside them; None if there are none.
    points, uv
        Model points and photo points (n, 2) [px] of all complete pairs.
    estimated : callable
        The estimate from an observation, which is the same for all photos of an object.
    """
    counts = known.counts(points)
    missing = LEAST_SHAPE_PAIRS - int(counts.sum())
    further = known.further
    if observation is None or missing > 0:
        all_count = bool(counts.all())
        text = _missing(missing, known.shape, all_count=all_count)
        return LiveShape(None, f"{text} of this photo" if further.others else text)
    try:
        estimate = estimated(observation)
    except CadalignError as error:
        return LiveShape(None, f"No alignment: {error}.")
    model, result = estimate.model, estimate.result
    free = np.array([point.xyz for point in points], dtype=float).reshape(-1, 3)[~counts]
    warped = _warp(wireframe, result, model, known, free)
    camera = result.cameras[further.place]
    residuals = np.empty((len(points), 2))
    residuals[counts] = result.views[further.place].residuals
    seen = camera.project(result.poses[further.place].apply(warped.carried))
    residuals[~counts] = seen - uv[~counts]
    rows = np.flatnonzero(counts)
    too_few = ""
    if estimate.assumes_focal:
        too_few = "The focal length is assumed: add a pair elsewhere to have it estimated."
    contradicting = _contradicting(model, replace(estimate.views[further.place], camera=camera))
    return LiveShape(
        shown=result,
        message=_assumption(known.assumed_focal, camera) or too_few,
        provisional=bool(known.assumed_focal or too_few),
        camera=camera,
        counts=counts,
        residuals=residuals,
        outliers={int(rows[row]): off for row, off in contradicting.items()},
        warped=warped,
        prior_lengths=known.prior_lengths(model),
        place=further.place,
        also_used=further.labels(observation),
        sigma=estimate.sigma or LEAST_SIGMA,
        fit_options={} if estimate.sigma is None else {"sigma": estimate.sigma},
    )


def _assumption(photos: tuple[str, ...], camera: Camera) -> str:
    """Say whose focal length is assumed; empty if none is."""
    if not photos:
        return ""
    if "" in photos:
        return (
            f"The focal length is assumed, {camera.fx:.0f} px. Choose 'known' to "
            "accept or correct it; until then the alignment is not saved."
        )
    return (
        f"The focal length of {' and '.join(photos)} is assumed. Choose 'known' in that photo to "
        "accept or correct it; until then the alignment is not saved."
    )


def _missing(missing: int, shape: ObjectShape | None, *, all_count: bool) -> str:
    text = f"{missing} more pair{'s' if missing > 1 else ''} to the first alignment"
    if all_count or shape is None or shape.learned is None:
        return text
    return f"{text}: keypoints that {shape.learned.category} has, marked by rings on the model"


def _warp(
    wireframe: Wireframe,
    result: Result,
    model: Model | ShapeModel,
    known: Known,
    free: FloatArray,
) -> WarpedModel:
    """Warp the model such that its known keypoints come to the estimated ones."""
    if known.shape is None:
        return WarpedModel(wireframe, free)
    if isinstance(model, Model):
        source, target = np.asarray(model.points_3d), result.points_3d
    else:
        rows = [row for row, label in enumerate(result.ids) if label in known.anchors]
        source = np.array([known.anchors[result.ids[row]].xyz for row in rows])
        target = result.points_3d[rows]
    return WarpedModel(*wireframe.warped(source, target, result.bounds, carried=free))


def _contradicting(model: Model | ShapeModel, view: View) -> dict[int, float]:
    """Distances [px] of pairs that a robust search among them leaves out, by their rows."""
    if len(view.keypoint_ids) < _LEAST_JUDGED:
        return {}
    pairs = View(view.camera, view.points_2d, ids=view.ids, sigma=view.sigma)
    try:
        robust = align(model, pairs, ransac=RansacOptions(max_reproj_error=_CONTRADICTS))
    except CadalignError:
        return {}
    lengths = np.linalg.norm(robust.residuals, axis=1)
    return {int(row): float(lengths[row]) for row in np.flatnonzero(~robust.inliers)}
