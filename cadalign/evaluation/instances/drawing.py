"""The pictures of an evaluated instance: as it is, and with its true and predicted box."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import cv2
import numpy as np

from cadalign.errors import RenderError
from cadalign.evaluation.instances.instance import Instance
from cadalign.evaluation.instances.preview import write_preview
from cadalign.evaluation.instances.record import record_stem
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box
from cadalign.geometry.camera import Camera
from cadalign.geometry.conventions import resized_camera
from cadalign.io.files import write_whole
from cadalign.io.images import write_image
from cadalign.render import RaycastRenderer, draw_overlay
from cadalign.render.drawing.color import ByteImage

_THUMB_WIDTH = 320
_QUALITY, _THUMB_QUALITY = 85, 75
_EFFORT = 2  # of WebP's 6: half the time of 4, files 3 % larger


def draw_instance(
    folder: RunFolder,
    instance: Instance,
    estimate: Alignment,
    *,
    category: str,
    model_id: str,
    view: int = 0,
) -> None:
    """Render an instance; write its pictures and its mesh preview to a run's folder.

    ``overlays`` gets it with the boxes of truth and estimate and its keypoints, ``thumbs`` a small
    one with the boxes, ``pictures`` it as it is, ``sketches`` the preview of its model's mesh. Each
    file appears whole or not at all.
    """
    stem = record_stem(category, model_id, view)
    if instance.scene is None:
        raise RenderError("there is no mesh to draw", where=stem)
    frame = _renderer().render(instance.scene, instance.camera, instance.cam_from_model)
    plain = frame.composite()
    est_box = Box.from_model(instance.bounds, estimate)
    image = draw_overlay(
        plain,
        instance.camera,
        gt_box=instance.gt_box,
        est_box=est_box,
        observed=instance.points_2d,
        reprojected=instance.camera.project_where_ahead(estimate.apply(instance.points_3d)),
    )
    small, camera = _scaled(plain, instance.camera, width=_THUMB_WIDTH)
    thumb = draw_overlay(
        small, camera, gt_box=instance.gt_box, est_box=est_box, axes=False, legend=False
    )
    write_webp(folder.pictures / f"{stem}.webp", plain)
    write_webp(folder.thumbs / f"{stem}.webp", thumb, quality=_THUMB_QUALITY)
    preview = folder.previews / f"{record_stem(category, model_id)}.json"
    if view == 0 or not preview.exists():
        write_preview(preview, instance.scene.mesh)
    write_whole(folder.overlays / f"{stem}.png", lambda path: write_image(path, image))


def _scaled(image: ByteImage, camera: Camera, *, width: int) -> tuple[ByteImage, Camera]:
    """A picture of that width, and its camera."""
    height = round(camera.height * width / camera.width)
    small = np.asarray(
        cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8
    )
    return small, resized_camera(camera, width, height)


def write_webp(path: Path, image: ByteImage, *, quality: int = _QUALITY) -> None:
    """Write a picture for a page, whole or not at all."""
    from PIL import Image

    picture = Image.fromarray(image)
    write_whole(path, lambda unfinished: picture.save(unfinished, quality=quality, method=_EFFORT))


@cache
def _renderer() -> RaycastRenderer:
    return RaycastRenderer()
