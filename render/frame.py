"""Results of a renderer, and the interface of all renderers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.errors import RenderError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.render.drawing.color import ByteImage, composite
from cadalign.render.scene import Scene

LIGHT_GREY = (228, 230, 233)
MAX_SIDE = 16384
MAX_PIXELS = 100_000_000


@dataclass(frozen=True, eq=False)
class Geometry:
    """The hit of the ray through the centre of each pixel: exact, not antialiased."""

    depth: FloatArray
    """(h, w), the camera's z, of a wide lens the distance from it [model units]; 0 for nothing."""
    face_id: npt.NDArray[np.int32]
    """(h, w) int32, the number of the mesh's triangle; -1 where nothing is."""
    normal: npt.NDArray[np.float32]
    """(h, w, 3) float32, the triangle's unit normal in the camera frame, on the side that is seen;
    0 where nothing is."""

    @property
    def mask(self) -> npt.NDArray[np.bool_]:
        """Pixels of the object, (h, w) bool."""
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
        return composite(self.color, background)


class Renderer(Protocol):
    """Draws a scene as a camera sees it."""

    @property
    def name(self) -> str:
        """The renderer's name on the command line."""

    def render(
        self, scene: Scene, camera: Camera, cam_from_model: Alignment, *, samples: int = 8
    ) -> Frame:
        """Draw one frame; see `RaycastRenderer.render`."""

    def drawn_by(self, scene: Scene, *, samples: int) -> str:
        """Name of the renderer that draws a scene's frames: another where this one cannot."""


def check_image_size(camera: Camera) -> None:
    """Refuse images too large to be drawn."""
    if max(camera.width, camera.height) > MAX_SIDE or camera.width * camera.height > MAX_PIXELS:
        raise RenderError(
            f"{camera.width} x {camera.height} px is too large to be drawn; the limits are "
            f"{MAX_SIDE} px a side and {MAX_PIXELS // 1_000_000} megapixels",
            where="camera",
            fix="scale the camera down",
        )
