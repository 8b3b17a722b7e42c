"""Instance records and pictures of objects in photos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError, DataError
from cadalign.estimation.result import Result
from cadalign.estimation.result_parts import Alternative
from cadalign.evaluation.instances.aligned import Warp, box_alignment, shape_of_result
from cadalign.evaluation.instances.drawing import write_webp
from cadalign.evaluation.instances.preview import write_preview
from cadalign.evaluation.instances.record import Estimate, record_of, record_stem
from cadalign.evaluation.outcome import Outcome
from cadalign.evaluation.photos.methods import PhotoEstimate
from cadalign.evaluation.photos.sighting import Sighting
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import Row
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.conventions import resized_camera
from cadalign.io.files import write_whole
from cadalign.io.images import ByteImage, write_image
from cadalign.render.drawing.overlay import draw_overlay
from cadalign.render.raycast.renderer import cast_geometry


def sighting_record(
    sighting: Sighting,
    outcomes: Sequence[Outcome],
    estimates: Sequence[PhotoEstimate | CadalignError],
) -> Row:
    """The record of an object, in terms of the data set's model."""
    return record_of(
        camera=sighting.camera,
        gt=sighting.target.gt,
        stretch=np.ones(3),
        bounds=sighting.bounds,
        points_3d=sighting.points_3d,
        points_2d=sighting.points_2d,
        semantic_ids=np.arange(len(sighting.names)),
        outcomes=outcomes,
        estimates=[_described(each, sighting) for each in estimates],
    )


def _described(estimate: PhotoEstimate | CadalignError, sighting: Sighting) -> Estimate:
    if isinstance(estimate, CadalignError):
        return estimate
    result = estimate.result
    if result is None:
        return estimate.alignment
    return shape_of_result(
        result,
        lambda each: (_of_box(each, sighting), _warp(result, each, sighting)),
        rms=result.rms,
        sigma=sighting.sigma,
    )


def _of_box(found: Result | Alternative, sighting: Sighting) -> Alignment:
    """The alignment of the model's box with an estimated one."""
    return box_alignment(found.alignment, found.bounds, model_bounds=sighting.bounds)


def _warp(result: Result, found: Result | Alternative, sighting: Sighting) -> Warp:
    """The places of the model's keypoints on the estimated object, in the model's coordinates."""
    row_of = {str(name): row for row, name in enumerate(result.ids)}
    known = [row for row, name in enumerate(sighting.model.names) if name in row_of]
    rows = [row_of[sighting.model.names[row]] for row in known]
    places = _of_box(found, sighting).inverse(found.alignment.apply(found.points_3d[rows]))
    return Warp(sighting.model.xyz[known], places)


_MOST = 1024  # pixels of a picture's longer side
_THUMB = (320, 240)
_MARGIN = 0.2  # of a thumb, around the object
_GREY = 225  # of a photo that is not there


def draw_sighting(folder: RunFolder, sighting: Sighting, estimate: PhotoEstimate | None) -> None:
    """Write the pictures of an object in a photo, and the preview of its model, to a run's folder.

    ``overlays`` gets the photo with the boxes of truth and estimate, the estimated model and the
    keypoints, ``thumbs`` the part around the object with the boxes, ``pictures`` the photo alone,
    ``sketches`` the preview. Files appear whole or not at all.
    """
    names = sighting.target.names
    stem = record_stem(names["category"], names["model_id"])
    photo, camera = _photo(sighting)
    scale = camera.width / sighting.camera.width
    est_box = None if estimate is None else estimate.box
    boxes: dict[str, Any] = {"gt_box": sighting.target.gt_box, "est_box": est_box}
    cad = sighting.target.cad
    frame = predicted = None
    if estimate is not None:
        predicted = camera.project_where_ahead(estimate.alignment.apply(sighting.points_3d))
        if cad is not None and cad.has_mesh:
            frame = cast_geometry(cad.scene, camera, estimate.alignment)
    observed = (sighting.points_2d + 0.5) * scale - 0.5
    marks: dict[str, Any] = {"observed": observed, "reprojected": predicted}
    image = draw_overlay(photo, camera, est_frame=frame, **boxes, **marks)
    crop, near = _around(photo, camera, sighting, observed)
    thumb = draw_overlay(crop, near, axes=False, legend=False, **boxes)
    write_webp(folder.pictures / f"{stem}.webp", photo)
    write_webp(folder.thumbs / f"{stem}.webp", thumb)
    if cad is not None and cad.has_mesh:
        write_preview(folder.previews / f"{stem}.json", cad.scene.mesh)
    write_whole(folder.overlays / f"{stem}.png", lambda path: write_image(path, image))


def _photo(sighting: Sighting) -> tuple[ByteImage, Camera]:
    """The photo in a size for a page, and its camera; a grey one where there is none."""
    camera = sighting.camera
    try:
        image = sighting.target.photo.read_image()
    except DataError:
        image = np.full((camera.height, camera.width, 3), _GREY, dtype=np.uint8)
    factor = min(1.0, _MOST / max(camera.width, camera.height))
    size = max(1, round(factor * camera.width)), max(1, round(factor * camera.height))
    if image.shape[1::-1] != size:
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return image, resized_camera(camera, *size)


def _around(
    photo: ByteImage, camera: Camera, sighting: Sighting, points: FloatArray
) -> tuple[ByteImage, Camera]:
    """The part of a photo around the object, and its camera."""
    box = sighting.target.gt_box
    if box is not None and (box.corners[:, 2] > 0).all():
        points = np.concatenate([points, camera.project(box.corners)])
    limit = np.array([camera.width, camera.height], dtype=float)
    low, high = np.clip(points.min(axis=0), 0, limit), np.clip(points.max(axis=0), 0, limit)
    middle = (low + high) / 2
    across = float(((high - low) / _THUMB).max()) * (1 + 2 * _MARGIN)  # photo's pixels per pixel
    across = min(max(across, 0.1), float((limit / _THUMB).max()))
    corner = middle - across * np.array(_THUMB) / 2
    # A pixel's borders, not its centre, stay in place.
    warp = np.array([[across, 0, corner[0]], [0, across, corner[1]]])
    how = cv2.WARP_INVERSE_MAP | (cv2.INTER_AREA if across > 1 else cv2.INTER_LINEAR)
    crop = cv2.warpAffine(photo, warp, _THUMB, flags=how, borderValue=(_GREY,) * 3)
    near = replace(
        camera,
        width=_THUMB[0],
        height=_THUMB[1],
        fx=camera.fx / across,
        fy=camera.fy / across,
        cx=(camera.cx - corner[0]) / across,
        cy=(camera.cy - corner[1]) / across,
    )
    return np.asarray(crop, dtype=np.uint8), near
