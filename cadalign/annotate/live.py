"""Live alignment: the estimate from all photos of an object, as one of them shows it, drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, cast

import numpy as np

from cadalign.annotate.estimate import (
    LEAST_JOINT_PAIRS,
    LEAST_PAIRS,
    LEAST_SIGMA,
    Known,
    LiveEstimate,
)
from cadalign.annotate.evidence import evidence_labels
from cadalign.annotate.model import Wireframe, box_lines
from cadalign.annotate.models import KeypointRegistry
from cadalign.annotate.object_shape import ObjectShape
from cadalign.arrays import BoolArray, FloatArray
from cadalign.datasets.models.model_keypoints import ModelKeypoint
from cadalign.estimation.focal import FocalPrior
from cadalign.estimation.model import Model
from cadalign.estimation.result import Result
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.io.observation import Observation
from cadalign.render.drawing.keypoint_layer import confidence_regions
from cadalign.shapes.model import ShapeModel


@dataclass(frozen=True, eq=False)
class LiveAlignment:
    """Alignment of what is marked so far, as one photo of the object shows it."""

    result: Result | None = None  # the estimate from all photos, as it is shown and saved
    message: str = ""  # reason for a missing result, or an assumption that was made
    provisional: bool = False  # True if the marks alone did not suffice, so that nothing is saved
    place: int = 0  # the photo's number among the views
    sigma: float = LEAST_SIGMA  # standard deviation of the pairs [px], larger if the residuals are
    fit_options: Mapping[str, Any] = field(default_factory=dict)
    """With which, and the priors, `cadalign fit` finds the result of this object alone."""
    others_focal: FocalPrior | None = None
    """Prior on the focal length that other objects of the photo and the object's own prior say."""
    contradictions: tuple[str, ...] = ()  # of objects of the photo about its focal length
    counts: BoolArray = field(default_factory=lambda: np.empty(0, dtype=bool))
    """(n,), the complete pairs whose keypoints the shape knows."""
    residuals: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    """(n, 2), projected minus placed points of all complete pairs [px]."""
    outliers: Mapping[int, float] = field(default_factory=dict)
    """Distances [px] of the pairs that contradict the others, by their rows."""
    wireframe: Wireframe | None = None
    """Lines of the model, warped to an own shape, in its frame before the stretch."""
    prior_lengths: FloatArray = field(default_factory=lambda: np.zeros(3))
    """(3,), standard deviations of the logarithms of the lengths before any pair."""
    also_used: tuple[str, ...] = ()  # evidence beyond the photo's pairs

    @property
    def camera(self) -> Camera:
        """The photo's camera."""
        assert self.result is not None
        return self.result.cameras[self.place]

    @property
    def alignment(self) -> Alignment:
        """The alignment in the photo's camera."""
        assert self.result is not None
        return self.result.poses[self.place]


def live_alignment(
    estimate: LiveEstimate,
    known: Known,
    wireframe: Wireframe,
    observation: Observation,
    place: int,
    points: Sequence[ModelKeypoint],
    uv: FloatArray,
) -> LiveAlignment:
    """An estimate as the photo of a number shows it.

    ``points`` and ``uv`` (n, 2) [px] are the model points and photo points of all complete pairs of
    the photo; the estimate was computed from the observation, and the wireframe is the model's.
    """
    result, problem, shape = estimate.result, estimate.problem, known.shape
    counts = known_points(shape, points)
    free = np.array([point.xyz for point in points], dtype=float).reshape(-1, 3)[~counts]
    lines, carried = _warped(wireframe, result, problem.model, known, free)
    camera = result.cameras[place]
    residuals = np.empty((len(points), 2))
    residuals[counts] = result.views[place].residuals
    residuals[~counts] = camera.project(result.poses[place].apply(carried)) - uv[~counts]
    rows = np.flatnonzero(counts)
    if not problem.exact:
        problem = problem.at_focal(result.cameras)
    outliers = {int(rows[row]): off for row, off in problem.contradicting(place).items()}
    message = _assumed_text(known.assumed_focal, camera) or estimate.assumed
    prior = known.stretch or np.inf
    lengths = np.array([0.0, prior, prior])
    return LiveAlignment(
        result,
        message,
        provisional=bool(message),
        place=place,
        sigma=estimate.sigma,
        fit_options={} if message else estimate.fit_options,
        others_focal=estimate.others_focal,
        contradictions=estimate.contradictions,
        counts=counts,
        residuals=residuals,
        outliers=outliers,
        wireframe=lines,
        prior_lengths=lengths if shape is None else shape.length_sigmas(problem.model),
        also_used=evidence_labels(observation),
    )


class Candidate(NamedTuple):
    """An alignment that a mask alone allows, with its likelihood over the best one's."""

    alignment: Alignment
    likelihood: float


def candidates_of(result: Result) -> list[Candidate]:
    """The alignments that the evidence cannot tell apart, the best first."""
    others = (Candidate(each.alignment, each.relative_likelihood) for each in result.alternatives)
    return [Candidate(result.alignment, 1.0), *others]


def known_points(shape: ObjectShape | None, points: Sequence[ModelKeypoint]) -> BoolArray:
    """The points (n,) of which pairs count."""
    return np.array([shape is None or shape.knows(point) for point in points], dtype=bool)


def missing_text(
    counts: BoolArray, shape: ObjectShape | None, *, is_plain: bool, has_others: bool
) -> str:
    """Say how many more pairs the first alignment needs; empty if none.

    ``counts`` (n,) are the complete pairs that count, ``is_plain`` says that nothing else is used.
    """
    missing = (LEAST_PAIRS if is_plain else LEAST_JOINT_PAIRS) - int(counts.sum())
    if missing <= 0:
        return ""
    text = f"{missing} more pair{'s' if missing > 1 else ''} to the first alignment"
    if not counts.all() and shape is not None and shape.learned is not None:
        text += f": keypoints that {shape.learned.category} has, marked by rings on the model"
    return f"{text} of this photo" if has_others else text


def _assumed_text(photos: tuple[str, ...], camera: Camera) -> str:
    """Say whose focal length is assumed; empty if none is."""
    if not photos:
        return ""
    fix = "accept or correct it; until then the alignment is not saved."
    if "" in photos:
        return f"The focal length is assumed, {camera.fx:.0f} px. Choose 'known' to {fix}"
    names = " and ".join(photos)
    return f"The focal length of {names} is assumed. Choose 'known' in that photo to {fix}"


def _warped(
    wireframe: Wireframe, result: Result, model: Model | ShapeModel, known: Known, free: FloatArray
) -> tuple[Wireframe, FloatArray]:
    """The model warped such that its known keypoints come to the estimated ones, with points."""
    if known.shape is None:
        return wireframe, free
    if isinstance(model, Model):
        source, target = np.asarray(model.points_3d), result.points_3d
    else:
        rows = [row for row, label in enumerate(result.ids) if label in known.anchors]
        source = np.array([known.anchors[result.ids[row]].xyz for row in rows])
        target = result.points_3d[rows]
    return wireframe.warped(source, target, result.bounds, carried=free)


def drawing_of(
    live: LiveAlignment, shape: ObjectShape | None, registry: KeypointRegistry, used: frozenset[int]
) -> dict[str, Any]:
    """Box and edges of the model and, for an own shape, its keypoints with regions that hold them.

    Regions of keypoints that the model lacks are the faint ones. There are none in another view
    than the first.
    """
    result, lines = live.result, live.wireframe
    assert result is not None
    assert lines is not None
    drawing: dict[str, Any] = {
        "box": box_of(live),
        "lines": flat(lines.seen_in(live.camera, live.alignment)),
        "keypoints": [],
        "regions": [],
        "faint_regions": [],
    }
    if shape is None or live.place:
        return drawing
    in_camera = result.alignment.apply(result.points_3d)
    names = {shape.id_of(point): (point.name, number in used) for number, point in registry}
    ahead = live.camera.sees(in_camera)
    pixels = live.camera.project(in_camera[ahead])
    of_points = cast(FloatArray, result.points_cam_covariance)
    covariances = live.camera.projected_covariances(in_camera[ahead], of_points[ahead])
    for row, uv in zip(np.flatnonzero(ahead), pixels.tolist(), strict=True):
        label = result.ids[row]
        fallback = label if isinstance(label, str) else f"keypoint {label}"
        name, is_used = names.get(label, (fallback, False))  # type: ignore[call-overload]
        state = "marked" if is_used else "unmarked" if label in names else "unknown"
        drawing["keypoints"].append({"uv": np.round(uv, 1).tolist(), "name": name, "state": state})
    on_model = np.array([label in names for label in result.ids])[ahead]
    for key, rows in (("regions", on_model), ("faint_regions", ~on_model)):
        regions = confidence_regions(pixels[rows], covariances[rows])
        drawing[key] = [np.round(region, 1).ravel().tolist() for region in regions]
    return drawing


def box_of(live: LiveAlignment) -> list[float]:
    """The box of an estimate alone, as x1, y1, x2, y2, ...; empty without an estimate."""
    if live.result is None:
        return []
    return flat(box_lines(live.result.bounds, live.camera, live.alignment))


def flat(lines: FloatArray) -> list[float]:
    """Lines (k, 2, 2) as x1, y1, x2, y2, ... to a tenth of a pixel."""
    inside = lines[(np.abs(lines) < 1e6).all(axis=(1, 2))]
    return np.round(inside, 1).ravel().tolist()
