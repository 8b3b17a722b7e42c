"""Drawing of an estimate over the photo, as plain data for JSON [px]."""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from cadalign.annotate.keypoints import KeypointRegistry
from cadalign.annotate.live import LiveAlignment
from cadalign.annotate.object_shape import ObjectShape
from cadalign.annotate.wireframe import box_lines
from cadalign.arrays import FloatArray
from cadalign.geometry.projection import projected_covariances
from cadalign.render.drawing.keypoint_layer import confidence_regions


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
        "lines": _flat(lines.seen_in(live.camera, live.alignment)),
        "keypoints": [],
        "regions": [],
        "faint_regions": [],
    }
    if shape is None or live.place:
        return drawing
    in_camera = result.alignment.apply(result.points_3d)
    names = {shape.id_of(point): (point.name, number in used) for number, point in registry}
    ahead = in_camera[:, 2] > 0
    pixels = live.camera.project(in_camera[ahead])
    of_points = cast(FloatArray, result.points_cam_covariance)
    covariances = projected_covariances(in_camera[ahead], of_points[ahead], live.camera)
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
    return _flat(box_lines(live.result.bounds, live.camera, live.alignment))


def _flat(lines: FloatArray) -> list[float]:
    """Lines (k, 2, 2) as x1, y1, x2, y2, ... to a tenth of a pixel."""
    inside = lines[(np.abs(lines) < 1e6).all(axis=(1, 2))]
    return np.round(inside, 1).ravel().tolist()
