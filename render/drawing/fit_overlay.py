"""Draw a fit over the photo of its observation."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.estimation.result import FitResult
from cadalign.geometry.box import Box
from cadalign.geometry.camera import Camera
from cadalign.io.images import read_image
from cadalign.io.meshes.load import load_mesh
from cadalign.io.observation import Observation
from cadalign.io.observed_image import ObservedImage
from cadalign.render.drawing.color import ByteImage
from cadalign.render.drawing.overlay import draw_overlay
from cadalign.render.frame import LIGHT_GREY, check_image_size


def draw_observation(observation: Observation, result: FitResult) -> ByteImage:
    """Draw predicted box, axes and keypoints over the photo, or over grey where there is none.

    The box is the model's; without a model it is the box of the keypoints.
    """
    camera = result.camera
    return draw_overlay(
        photo_of(observation, camera),
        camera,
        est_box=Box.from_model(_bounds(observation, result), result.alignment),
        observed=observation.points_2d,
        reprojected=camera.project_where_ahead(result.alignment.apply(result.points_3d)),
    )


def photo_of(observation: ObservedImage, camera: Camera) -> ByteImage:
    """The photo (h, w, 3), grey where there is none; refuses images that are too large."""
    check_image_size(camera)
    if observation.image is None:
        return np.full((camera.height, camera.width, 3), LIGHT_GREY, dtype=np.uint8)
    return read_image(observation.image, camera)


def _bounds(observation: Observation, result: FitResult) -> FloatArray:
    if observation.model is not None:
        return load_mesh(observation.model).bounds
    points = result.points_3d
    return np.array([points.min(axis=0), points.max(axis=0)])
