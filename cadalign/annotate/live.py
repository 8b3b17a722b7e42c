"""Live alignment: the estimate from what is marked, drawn and told."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np

from cadalign.annotate.lines import Wireframe, box_lines
from cadalign.annotate.models import KeypointRegistry, ObjectShape
from cadalign.annotate.problem import (
    LEAST_JOINT_PAIRS,
    LEAST_PAIRS,
    LEAST_SIGMA,
    Known,
    LiveProblem,
)
from cadalign.arrays import BoolArray, FloatArray
from cadalign.datasets.models.model_keypoints import ModelKeypoint
from cadalign.errors import DegenerateError
from cadalign.estimation.result import Result
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.io.evidence import LENGTHS
from cadalign.io.observation import Observation
from cadalign.render.drawing.layers import confidence_regions

_LABELS = {
    "mask": "mask",
    "depth": "depth",
    "up": "gravity",
    "camera_height": "camera height",
    "cam_from_rig": "known camera poses",
}
_UNCERTAIN = 1.0  # relative standard deviation beyond which a number is not shown
_LEFT_OPEN = 0.8  # share of a prior's standard deviation beyond which the pairs say nothing
_UNCERTAIN_DEG = 60.0
_UNDETERMINED = "not determined", "these pairs leave it open"


@dataclass(frozen=True, eq=False)
class LiveAlignment:
    """Alignment of what is marked so far, with what the page shows of it."""

    result: Result | None = None
    message: str = ""  # reason for a missing result, or an assumption that was made
    problem: LiveProblem | None = None  # what the result was computed from
    sigma: float = LEAST_SIGMA  # standard deviation of the pairs [px], larger if the residuals are
    fit_options: Mapping[str, Any] = field(default_factory=dict)
    """With which, and the priors, `cadalign fit` finds the result."""

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
    also_used: tuple[str, ...] = ()  # evidence beyond the pairs

    @classmethod
    def of(cls, known: Known, observation: Observation) -> LiveAlignment:
        """Align, with as few assumptions as the marks need; raises a CadalignError without."""
        problem = LiveProblem.of(known, observation)
        reason: DegenerateError | None = None
        for attempt, assumed in problem.attempts():
            try:
                result, sigma, options = attempt.solve()
            except DegenerateError as error:
                reason = error
                continue
            if (stored := observation.fit_options.get("sigma")) is not None:
                sigma, options = stored, {"sigma": stored}
            text = assumed.format(reason="" if reason is None else reason.what) or attempt.unsaved
            return cls(result, text, attempt, sigma, options)
        assert reason is not None
        raise reason

    @property
    def provisional(self) -> bool:
        """True if the marks alone did not suffice, so that nothing is saved."""
        return self.result is not None and bool(self.message)

    @property
    def camera(self) -> Camera:
        """The photo's camera."""
        assert self.result is not None
        return self.result.camera

    @property
    def alignment(self) -> Alignment:
        """The alignment in the photo's camera."""
        assert self.result is not None
        return self.result.alignment


def live_alignment(
    estimate: LiveAlignment,
    known: Known,
    wireframe: Wireframe,
    observation: Observation,
    points: Sequence[ModelKeypoint],
    uv: FloatArray,
) -> LiveAlignment:
    """An estimate as the page shows it.

    ``points`` and ``uv`` (n, 2) [px] are the model points and photo points of all complete pairs;
    the estimate was computed from the observation, and the wireframe is the model's.
    """
    result, problem, shape = estimate.result, estimate.problem, known.shape
    assert result is not None
    assert problem is not None
    counts = shape.known(points)
    free = np.array([point.xyz for point in points], dtype=float).reshape(-1, 3)[~counts]
    lines, carried = _warped(wireframe, result, known, free)
    residuals = np.empty((len(points), 2))
    residuals[counts] = result.residuals
    residuals[~counts] = result.camera.project(result.alignment.apply(carried)) - uv[~counts]
    rows = np.flatnonzero(counts)
    judged = problem if problem.exact else problem.at_focal(result.camera)
    prior = observation.fit_options.get("stretch_sigma") or np.inf
    return replace(
        estimate,
        fit_options={} if estimate.message else estimate.fit_options,
        counts=counts,
        residuals=residuals,
        outliers={int(rows[row]): off for row, off in judged.contradicting().items()},
        wireframe=lines,
        prior_lengths=(
            shape.length_sigmas(problem.model)
            if shape.is_estimated
            else np.array([0.0, prior, prior])
        ),
        also_used=evidence_labels(observation),
    )


def missing_text(counts: BoolArray, shape: ObjectShape, *, is_plain: bool) -> str:
    """Say how many more pairs the first alignment needs; empty if none.

    ``counts`` (n,) are the complete pairs that count, ``is_plain`` says that nothing else is used.
    """
    missing = (LEAST_PAIRS if is_plain else LEAST_JOINT_PAIRS) - int(counts.sum())
    if missing <= 0:
        return ""
    text = f"{missing} more pair{'s' if missing > 1 else ''} to the first alignment"
    if not counts.all() and shape.learned is not None:
        text += f": keypoints that {shape.learned.category} has, marked by rings on the model"
    return text


def _warped(
    wireframe: Wireframe,
    result: Result,
    known: Known,
    free: FloatArray,
) -> tuple[Wireframe, FloatArray]:
    """The model warped such that its known keypoints come to the estimated ones, with points."""
    if not known.shape.is_estimated:
        return wireframe, free
    rows = [row for row, label in enumerate(result.ids) if label in known.anchors]
    source = np.array([known.anchors[result.ids[row]].xyz for row in rows]).reshape(-1, 3)
    return wireframe.warped(source, result.points_3d[rows], result.bounds, carried=free)


def drawing_of(
    live: LiveAlignment, shape: ObjectShape, registry: KeypointRegistry, used: frozenset[int]
) -> dict[str, Any]:
    """Box and edges of the model and, for an own shape, its keypoints with regions that hold them.

    Regions of keypoints that the model lacks are the faint ones.
    """
    result, lines = live.result, live.wireframe
    assert result is not None
    assert lines is not None
    drawing: dict[str, Any] = {
        "box": flat(box_lines(result.bounds, live.camera, live.alignment)),
        "lines": flat(lines.seen_in(live.camera, live.alignment)),
        "keypoints": [],
        "regions": [],
        "faint_regions": [],
    }
    if not shape.is_estimated:
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


def flat(lines: FloatArray) -> list[float]:
    """Lines (k, 2, 2) as x1, y1, x2, y2, ... to a tenth of a pixel."""
    inside = lines[(np.abs(lines) < 1e6).all(axis=(1, 2))]
    return np.round(inside, 1).ravel().tolist()


def evidence_labels(observation: Observation) -> tuple[str, ...]:
    """Name what an observation holds beyond keypoints, for the page."""
    given = set(observation.evidence.given)
    if observation.depths is not None:
        given.add("depth")
    labels = [label for name, label in _LABELS.items() if name in given]
    if observation.fit_options.get("image") and not observation.evidence.mask:
        labels.append("photo")
    size = observation.size
    if size is not None:
        known = [name for name in LENGTHS if getattr(size, name) is not None]
        labels.append(f"known {' and '.join(known)}")
    return tuple(labels)


@dataclass(frozen=True)
class Fact:
    """One row of the result: label, value, and a remark on the value."""

    label: str
    value: str
    note: str


def facts_of(live: LiveAlignment, shape: ObjectShape) -> tuple[Fact, ...]:
    """Stretch or lengths, pose and residuals, with standard deviations."""
    result = live.result
    if result is None:
        return ()
    in_lengths = shape.is_estimated or "x" in result.stretched_axes
    axes = "xyz" if in_lengths else result.stretched_axes
    facts = [_extent(live, axis, shape, in_lengths=in_lengths) for axis in axes]
    if result.std is not None:
        facts.append(_rotation(result.std.rotation_deg))
    facts += [_distance(live, shape), _focal(live)]
    if 2 * live.counts.sum() > 6 + len(result.stretched_axes):
        off = f"points off by {short(live.sigma)} px" if live.sigma > 1 else "clicks of 1 px"
        note = f"rms; the standard deviations above are for {off}"
        facts.append(Fact("Pairs agree to", f"{short(result.rms)} px", note))
    return tuple(facts)


def notes_of(live: LiveAlignment, shape: ObjectShape) -> tuple[str, ...]:
    """Assumptions, pairs that do not count, alternative alignments and warnings."""
    result = live.result
    if result is None:
        return ()
    notes = [live.message] if live.message else []
    carried = int((~live.counts).sum())
    if carried and shape.learned is not None:
        notes.append(
            f"{carried} pair{'s do' if carried > 1 else ' does'} not count: the shape of "
            f"{shape.learned.category} has no such keypoint. Shown is where the warped model puts "
            "it."
        )
    others = len(result.alternatives)
    if others and len(live.counts):  # those of a mask alone are shown
        how = "nearly as well" if shape.is_estimated else "as well"
        notes.append(
            f"{others} other alignment{'s explain' if others > 1 else ' explains'} these pairs "
            f"{how}: one more pair tells them apart"
        )
    return (*notes, *(each.text.replace("+-", "± ") for each in result.warnings))


def _extent(live: LiveAlignment, axis: str, shape: ObjectShape, *, in_lengths: bool) -> Fact:
    """Length of the object along an axis, or its stretch."""
    result, row = live.result, "xyz".index(axis)
    assert result is not None
    stretch, relative = float(result.stretch[row]), 0.0
    if result.std is not None:
        relative = result.std.scale[row]
    label, value, unit = f"Stretch along {axis}", stretch, ""
    if in_lengths:
        label, unit = f"Length along {axis}", _unit(shape)
        value = float(np.ptp(result.bounds, axis=0)[row] * result.alignment.scale[row])
    if not value > 0 or relative > _UNCERTAIN:
        return Fact(label, *_UNDETERMINED)
    average = shape.average
    if relative == 0:
        return Fact(label, f"{value:.3g}{unit}", f"{average}'s, taken as known")
    text = f"{value:.3g} ± {short(value * relative)}{unit}"
    prior = float(live.prior_lengths[row])
    if prior and relative > _LEFT_OPEN * prior:
        if in_lengths:
            return Fact(label, text, f"the pairs leave it open: {average}'s and its spread")
        note = f"the pairs leave it open: about 1 by the prior of ± {100 * prior:.0f} %"
        return Fact(label, "not determined", note)
    percent = 100 * (stretch - 1)
    if abs(percent) < 100 * relative:
        return Fact(label, text, f"{average}'s length lies within the standard deviation")
    if abs(percent) < 0.5:
        return Fact(label, text, f"as long as {average}")
    than = "longer" if percent > 0 else "shorter"
    return Fact(label, text, f"{abs(percent):.0f} % {than} than {average}")


def _rotation(sigma: float) -> Fact:
    if sigma > _UNCERTAIN_DEG:
        return Fact("Rotation", *_UNDETERMINED)
    return Fact("Rotation", f"known to ± {short(sigma)}°", "")


def _distance(live: LiveAlignment, shape: ObjectShape) -> Fact:
    assert live.result is not None
    translation, covariance = live.result.alignment.translation, live.result.covariance
    distance = float(np.linalg.norm(translation))
    learned = shape.learned
    units = {"m": "", "diagonal": "diagonals of the object's box"}
    note = "model units" if learned is None else units.get(learned.unit, learned.unit)
    if covariance is None or not distance > 0:
        return Fact("Distance", f"{distance:.3g} {note}", "")
    along = translation / distance
    sigma = math.sqrt(max(float(along @ covariance[3:6, 3:6] @ along), 0.0))
    if sigma > _UNCERTAIN * distance:
        return Fact("Distance", *_UNDETERMINED)
    return Fact("Distance", f"{distance:.3g} ± {short(sigma)}{_unit(shape)}", note)


def _focal(live: LiveAlignment) -> Fact:
    result, focal = live.result, live.camera.fx
    assert result is not None
    if result.std is None or result.focal == "known":
        note = "assumed" if "focal length" in live.message else "taken as known"
        return Fact("Focal length", f"{focal:.0f} px", note)
    relative = result.std.focal
    if relative > _UNCERTAIN:
        return Fact("Focal length", *_UNDETERMINED)
    return Fact("Focal length", f"{focal:.0f} ± {short(focal * relative)} px", "estimated")


def _unit(shape: ObjectShape) -> str:
    """Unit of lengths, after a number; empty for the model's own."""
    return " m" if shape.learned is not None and shape.learned.unit == "m" else ""


def short(value: float) -> str:
    """Two digits, without an exponent."""
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"
