"""What a renderer gives back, and what every renderer can do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.errors import InputError, RenderError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.render.drawing.color import ByteImage, bytes_from_linear, linear_from_bytes
from cadalign.render.scene import Scene

LIGHT_GREY = (228, 230, 233)
MAX_SIDE = 16384
MAX_PIXELS = 100_000_000


@dataclass(frozen=True, eq=False)
class Geometry:
    """What is seen through the centre of each pixel: exact, not antialiased.

    Parameters
    ----------
    depth : (h, w) float
        The camera's z [model units]; 0 where nothing is.
    face_id : (h, w) int32
        The number of the mesh's triangle; -1 where nothing is.
    normal : (h, w, 3) float32
        The triangle's unit normal in the camera frame, on the side that is seen; 0 where nothing
        is.
    """

    depth: FloatArray
    face_id: npt.NDArray[np.int32]
    normal: npt.NDArray[np.float32]

    @property
    def mask(self) -> npt.NDArray[np.bool_]:
        """Where the object is, (h, w) bool."""
        return np.asarray(self.face_id >= 0)


@dataclass(frozen=True, eq=False)
class Frame(Geometry):
    """A rendered image with its geometry.

    Parameters
    ----------
    depth, face_id, normal
        See `Geometry`; `mask` is there too.
    color : (h, w, 4) uint8
        sRGB and opacity, not premultiplied: at silhouettes the colour is the object's and the
        opacity its share of the pixel.
    """

    color: ByteImage

    def composite(self, background: npt.ArrayLike = LIGHT_GREY) -> ByteImage:
        """Put the object in front of a colour or a photo, blending in linear light.

        Parameters
        ----------
        background : (3,) or (h, w, 3) uint8
            sRGB.

        Returns
        -------
        (h, w, 3) uint8

        Raises
        ------
        InputError
            If the background is neither a colour nor an image of the frame's size.
        """
        behind = np.asarray(background)
        shape = (*self.color.shape[:2], 3)
        if behind.shape not in ((3,), shape):
            raise InputError(
                f"shape {behind.shape} is neither (3,) nor {shape}", where="background"
            )
        if (
            behind.dtype.kind not in "ui"
            or behind.min(initial=0) < 0
            or behind.max(initial=0) > 255
        ):
            raise InputError("not whole numbers from 0 to 255", where="background")
        result: ByteImage = np.empty(shape, dtype=np.uint8)
        result[:] = behind
        opacity = self.color[:, :, 3]
        result[opacity == 255] = self.color[:, :, :3][opacity == 255]
        mixed = (opacity > 0) & (opacity < 255)
        share = opacity[mixed, None] / np.float32(255)
        front = linear_from_bytes(self.color[:, :, :3][mixed])
        light = front * share + linear_from_bytes(result[mixed]) * (1 - share)
        result[mixed] = bytes_from_linear(np.asarray(light, dtype=np.float32))
        return result


class Renderer(Protocol):
    """Draws a scene as a camera sees it."""

    @property
    def name(self) -> str:
        """What the renderer is called on the command line."""

    def render(
        self, scene: Scene, camera: Camera, cam_from_model: Alignment, *, samples: int = 8
    ) -> Frame:
        """Draw one frame; see `RaycastRenderer.render`."""


def check_image_size(camera: Camera) -> None:
    """Refuse images too large to be drawn.

    Raises
    ------
    RenderError
        If a side is longer than 16,384 px or the image has more than 100 million pixels.
    """
    if max(camera.width, camera.height) > MAX_SIDE or camera.width * camera.height > MAX_PIXELS:
        raise RenderError(
            f"{camera.width} x {camera.height} px is too large to be drawn; the limits are "
            f"{MAX_SIDE} px a side and {MAX_PIXELS // 1_000_000} megapixels",
            where="camera",
            fix="scale the camera down",
        )
