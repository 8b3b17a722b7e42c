"""The overlay of an evaluated instance: its picture with true and predicted box."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

from cadalign.alignment import Alignment
from cadalign.box import Box
from cadalign.errors import RenderError
from cadalign.evaluation.instance import Instance
from cadalign.picture import write_image
from cadalign.render import RaycastRenderer, draw_overlay


def draw_instance(path: Path, instance: Instance, estimate: Alignment) -> None:
    """Render an instance, draw truth and estimate over it, and write that to a PNG file.

    The file appears whole or not at all.

    Raises
    ------
    RenderError
        If the instance has no mesh to draw.
    DataError
        If the file cannot be written.
    """
    if instance.scene is None:
        raise RenderError("there is no mesh to draw", where=path.stem)
    frame = _renderer().render(instance.scene, instance.camera, instance.cam_from_model)
    image = draw_overlay(
        frame.composite(),
        instance.camera,
        gt_box=Box.from_model(instance.bounds, instance.gt),
        est_box=Box.from_model(instance.bounds, estimate),
        observed=instance.points_2d,
        reprojected=instance.camera.project(estimate.apply(instance.points_3d)),
    )
    unfinished = path.with_name(f".{path.stem}.{os.getpid()}.png")
    write_image(unfinished, image)
    os.replace(unfinished, path)


@cache
def _renderer() -> RaycastRenderer:
    return RaycastRenderer()
