"""Lines of an estimate over the photo, as plain data for JSON [px]."""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from cadalign.annotate.alignment import LiveAlignment
from cadalign.annotate.keypoint_registry import KeypointRegistry
from cadalign.annotate.object_shape import ObjectShape
from cadalign.annotate.shape_alignment import LiveShape
from cadalign.annotate.wireframe import Wireframe, box_lines
from cadalign.arrays import FloatArray
from cadalign.estimation.result import Result
from cadalign.geometry.projection import projected_covariances
from cadalign.render.drawing.keypoint_layer import confidence_regions


def drawing_of_fit(result: Result, wireframe: Wireframe) -> dict[str, Any]:
    """Box and edges of the stretched model."""
    camera, alignment = result.camera, result.alignment
    return {
        "box": _flat(box_lines(wireframe.scene.bounds, camera, alignment)),
        "lines": _flat(wireframe.seen_in(camera, alignment)),
        "keypoints": [],
        "regions": [],
        "faint_regions": [],
    }


def box_of(live: LiveAlignment | LiveShape, wireframe: Wireframe) -> list[float]:
    """The box of an estimate alone; empty without one."""
    if live.shown is None:
        return []
    if isinstance(live, LiveShape):
        assert live.camera is not None
        return _flat(box_lines(live.shown.bounds, live.camera, live.alignment))
    return _flat(box_lines(wireframe.scene.bounds, live.shown.camera, live.shown.alignment))


def drawing_of_shape(
    live: LiveShape, shape: ObjectShape | None, registry: KeypointRegistry, used: frozenset[int]
) -> dict[str, Any]:
    """Box and edges of the warped model, and all keypoints with the regions that hold them.

    Those of keypoints that the model lacks are the faint ones. There are none for the stretched
    model, of which nothing but the pairs is estimated, nor in another view than the first.
    """
    result, camera, warped = live.shown, live.camera, live.warped
    assert result is not None
    assert camera is not None
    assert warped is not None
    lines = {
        "box": _flat(box_lines(result.bounds, camera, live.alignment)),
        "lines": _flat(warped.wireframe.seen_in(camera, live.alignment)),
    }
    if shape is None or live.place:
        return {**lines, "keypoints": [], "regions": [], "faint_regions": []}
    in_camera = result.alignment.apply(result.points_3d)
    names = {shape.id_of(point): (point.name, number in used) for number, point in registry}
    keypoints = []
    ahead = in_camera[:, 2] > 0
    pixels = camera.project(in_camera[ahead])
    on_model = np.array([label in names for label in result.ids])[ahead]
    of_points = cast(FloatArray, result.points_cam_covariance)
    covariances = projected_covariances(in_camera[ahead], of_points[ahead], camera)
    for row, uv in zip(np.flatnonzero(ahead), pixels.tolist(), strict=True):
        label = result.ids[row]
        fallback = label if isinstance(label, str) else f"keypoint {label}"
        name, is_used = names.get(label, (fallback, False))  # type: ignore[call-overload]
        state = "marked" if is_used else "unmarked" if label in names else "unknown"
        keypoints.append({"uv": np.round(uv, 1).tolist(), "name": name, "state": state})
    return {
        **lines,
        "keypoints": keypoints,
        "regions": _regions(pixels[on_model], covariances[on_model]),
        "faint_regions": _regions(pixels[~on_model], covariances[~on_model]),
    }


def _regions(pixels: FloatArray, covariances: FloatArray) -> list[list[float]]:
    """Outlines of the regions that hold each point, as x1, y1, x2, y2, ..."""
    regions = confidence_regions(pixels, covariances)
    return [np.round(region, 1).ravel().tolist() for region in regions]


def _flat(lines: FloatArray) -> list[float]:
    """Lines (k, 2, 2) as x1, y1, x2, y2, ... to a tenth of a pixel."""
    inside = lines[(np.abs(lines) < 1e6).all(axis=(1, 2))]
    return np.round(inside, 1).ravel().tolist()
