"""Reading and writing photos, and drawing a fit over the photo of its observation."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from cadalign.box import Box
from cadalign.camera import Camera
from cadalign.datasets import load_mesh
from cadalign.errors import DataError
from cadalign.observation import Observation
from cadalign.photo import read_photo
from cadalign.render import draw_overlay
from cadalign.render.color import ByteImage
from cadalign.render.frame import LIGHT_GREY
from cadalign.result import FitResult
from cadalign.validation import FloatArray


def read_image(path: Path, camera: Camera) -> ByteImage:
    """Read a photo as RGB (h, w, 3) uint8, turned upright where EXIF says how it was held.

    Raises
    ------
    DataError
        If it is missing, is not an image, or has another size than the camera.
    """
    pixels = read_photo(path)
    height, width = pixels.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise DataError(
            f"the image is {width} x {height}, the camera {camera.width} x {camera.height}",
            where=str(path),
            fix="give the camera of this image",
        )
    return pixels


def write_image(path: Path, image: ByteImage) -> None:
    """Write an RGB image (h, w, 3) uint8 as PNG.

    Raises
    ------
    DataError
        If the file cannot be written.
    """
    encoded, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    try:
        if not encoded:
            raise OSError("the picture could not be encoded")
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise DataError(f"cannot be written ({error})", where=str(path)) from None


def draw_observation(observation: Observation, result: FitResult) -> ByteImage:
    """Draw predicted box, axes and keypoints over the photo, or over grey where there is none.

    The box is the model's; without a model it is the box of the keypoints.
    """
    camera = result.camera
    if observation.image is None:
        image = np.full((camera.height, camera.width, 3), LIGHT_GREY, dtype=np.uint8)
    else:
        image = read_image(observation.image, camera)
    return draw_overlay(
        image,
        camera,
        est_box=Box.from_model(_bounds(observation), result.alignment),
        observed=observation.points_2d,
        reprojected=camera.project(result.alignment.apply(observation.points_3d)),
    )


def _bounds(observation: Observation) -> FloatArray:
    if observation.model is not None:
        return load_mesh(observation.model).bounds
    points = observation.points_3d
    return np.array([points.min(axis=0), points.max(axis=0)])
