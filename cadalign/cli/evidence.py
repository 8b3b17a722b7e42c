"""Options of evidence beyond keypoints, and of the camera, that `fit` and `observe` share."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from cadalign.cli.options import named_as_flags
from cadalign.errors import InputError
from cadalign.geometry.camera import Camera
from cadalign.io.documents import convert
from cadalign.io.observation import Observation
from cadalign.io.observation_file import SizeFields, read_size


@dataclass(frozen=True, kw_only=True)
class CameraOptions:
    """The calibrated camera."""

    camera: Path | None = None
    """File of the calibrated camera: a matrix K as text, .npy or JSON, or JSON in COLMAP's form:
    model, width, height, params."""
    pixel_origin: Literal["center", "corner"] | None = None
    """Place of pixel (0, 0) for the camera's principal point: the centre of the top-left pixel
    (OpenCV) or the corner of the image (COLMAP); by default center for a matrix, and corner for
    COLMAP's form."""

    def read_camera(self, size: tuple[int, int] | None) -> Camera | None:
        """The camera of --camera; ``size`` is the photo's, for a file of a matrix alone."""
        if self.camera is not None:
            from cadalign.io.camera_file import read_camera

            return read_camera(self.camera, size=size, pixel_origin=self.pixel_origin)
        if self.pixel_origin is not None:
            raise InputError("given without --camera", where="--pixel-origin", fix="give both")
        return None


@dataclass(frozen=True, kw_only=True)
class EvidenceOptions:
    """Evidence beyond keypoints."""

    mask: Path | None = None
    """Mask of the object, a grey PNG of the photo's size."""
    mask_sigma: float | None = None
    """Standard deviation of the mask's contour [px]; estimated by default."""
    depth: Path | None = None
    """Depth image that is registered to the photo, a PNG of 16 bits; 0 where unknown."""
    depth_scale: float | None = None
    """Units per count of the depth image; 0.001 by default, millimetres to metres."""
    depth_sigma: float | None = None
    """Relative standard deviation of the depths; 0.01 by default."""
    up: tuple[float, float, float] | None = None
    """Upward direction in the camera's frame, whose y points down: 0 -1 0 for a level camera."""
    up_sigma_deg: float | None = None
    """Standard deviation of this direction [degrees]; 1 by default."""
    camera_height: float | None = None
    """Height of the camera above the plane that the object stands on."""
    size: Annotated[dict[str, float] | None, tyro.conf.arg(metavar="NAME LENGTH ...")] = None
    """Known lengths of the object: width, height, length (along the model's x, y, z) and sigma,
    their relative standard deviation, as in --size height 0.91 sigma 0.005."""

    def add_to(self, observation: Observation) -> Observation:
        """An observation with the evidence of the options, which takes the place of its own."""
        given: dict[str, Any] = {
            "mask": _absolute(self.mask),
            "mask_sigma": self.mask_sigma,
            "depth": _absolute(self.depth),
            "depth_scale": self.depth_scale,
            "depth_sigma": self.depth_sigma,
            "up": None if self.up is None else np.array(self.up),
            "up_sigma_deg": self.up_sigma_deg,
            "camera_height": self.camera_height,
        }
        known = {name: value for name, value in given.items() if value is not None}
        if known:
            with named_as_flags(self):
                observation = replace(observation, evidence=replace(observation.evidence, **known))
        if self.size is None:
            return observation
        size = read_size(convert(self.size, SizeFields, where="--size"))
        return replace(observation, size=size)


def _absolute(path: Path | None) -> Path | None:
    return None if path is None else path.resolve()
