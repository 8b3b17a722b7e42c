"""Live alignment: the estimate from all photos of an object, as one of them shows it, drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np

from cadalign.annotate.estimate import LEAST_JOINT_PAIRS, LEAST_PAIRS, Known, LiveAlignment
from cadalign.annotate.evidence import evidence_labels
from cadalign.annotate.lines import Wireframe, box_lines
from cadalign.annotate.models import KeypointRegistry
from cadalign.annotate.object_shape import ObjectShape
from cadalign.arrays import BoolArray, FloatArray
from cadalign.datasets.models.model_keypoints import ModelKeypoint
from cadalign.estimation.model import Model
from cadalign.estimation.result import Result
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.io.observation import Observation
from cadalign.render.drawing.keypoint_layer import confidence_regions
from cadalign.shapes.model import ShapeModel


def live_alignment(
    estimate: LiveAlignment,
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
    assert result is not None
    assert problem is not None
    counts = known_points(shape, points)
    free = np.array([point.xyz for point in points], dtype=float).reshape(-1, 3)[~counts]
    lines, carried = _warped(wireframe, result, problem.model, known, free)
    camera = result.cameras[place]
    residuals = np.empty((len(points), 2))
    residuals[counts] = result.views[place].residuals
    residuals[~counts] = camera.project(result.poses[place].apply(carried)) - uv[~counts]
    rows = np.flatnonzero(counts)
    judged = problem if problem.exact else problem.at_focal(result.cameras)
    prior = known.stretch or np.inf
    message = _assumed_text(known.assumed_focal, camera) or estimate.message
    return replace(
        estimate,
        message=message,
        fit_options={} if message else estimate.fit_options,
        place=place,
        counts=counts,
        residuals=residuals,
        outliers={int(rows[row]): off for row, off in judged.contradicting(place).items()},
        wireframe=lines,
        prior_lengths=(
            np.array([0.0, prior, prior]) if shape is None else shape.length_sigmas(problem.model)
        ),
        also_used=evidence_labels(observation),
    )


def candidates_of(result: Result) -> list[tuple[Alignment, float]]:
    """Alignments that the evidence cannot tell apart, and their likelihoods over the first's."""
    others = ((each.alignment, each.relative_likelihood) for each in result.alternatives)
    return [(result.alignment, 1.0), *others]


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
