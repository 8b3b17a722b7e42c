"""Drawing by ray casting: exact geometry and antialiased, shaded colour; needs no display."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.errors import InputError, RenderError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.raycaster import FaceArray, RayCaster
from cadalign.render.drawing.canvas import ByteImage, LinearArray, bytes_from_linear
from cadalign.render.raycast.occlusion import darken_corners
from cadalign.render.raycast.posed import PosedScene, Rectangle, in_threads, pose_scene
from cadalign.render.raycast.surface import Studio
from cadalign.render.scene import Frame, Geometry, Scene, check_image_size

# Small enough for the processor's caches, large enough for NumPy's overhead not to show.
_RAYS_AT_ONCE = 1 << 15
# Neighbouring pixels that differ by more than this in a channel (of 255) are sampled again.
_VISIBLE_STEP = 6
_MAX_SAMPLES = 256


class RaycastRenderer:
    """Draws with embree on the processor; the renderer that works everywhere.

    Parameters
    ----------
    studio : Studio, optional
        The lights.

    Examples
    --------
    >>> import numpy as np
    >>> from cadalign import Alignment, Camera, Mesh
    >>> from cadalign.render import RaycastRenderer, Scene
    >>> scene = Scene(Mesh([[-1, -1, 0], [1, -1, 0], [0, 2, 0]], [[0, 1, 2]]))
    >>> camera = Camera.from_fov(65, 49, fov_x=60.0)
    >>> frame = RaycastRenderer().render(scene, camera, Alignment(np.eye(3), [0, 0, 4], [1, 1, 1]))
    >>> float(frame.depth[24, 32]), int(frame.face_id[24, 32]), bool(frame.mask[0, 0])
    (4.0, 0, False)
    """

    name = "raycast"

    def __init__(self, *, studio: Studio | None = None) -> None:
        self.studio = studio or Studio()

    def render(
        self, scene: Scene, camera: Camera, cam_from_model: Alignment, *, samples: int = 8
    ) -> Frame:
        """Draw a scene.

        Parameters
        ----------
        scene : Scene
            The prepared mesh.
        camera : Camera
            The camera; its lens distortion is drawn too.
        cam_from_model : Alignment
            Where the mesh is and how it is stretched. What lies behind the camera is not seen.
        samples : int
            Rays per pixel where the colour changes from one pixel to the next; 1 turns
            antialiasing off.

        Returns
        -------
        Frame
            All of it empty if the object is not in the image; pixels are empty where the lens
            model cannot be inverted.

        Raises
        ------
        RenderError
            If the image is too large.
        InputError
            If ``samples`` is not from 1 to 256.
        """
        check_samples(samples)
        check_image_size(camera)
        color: ByteImage = np.zeros((camera.height, camera.width, 4), dtype=np.uint8)
        posed = pose_scene(scene, camera, cam_from_model, caster=self._caster(scene))

        def shade(
            posed: PosedScene, band: Rectangle, rays: FloatArray, face: FaceArray, depth: FloatArray
        ) -> None:
            light = posed.light_of_hits(rays, face, depth, self.studio)
            color[band.slices] = _encode(light).reshape(band.height, band.width, 4)

        # Made now, before several threads ask for them at once.
        _ = scene.surface, scene.corner_normals
        geometry = geometry_of(camera, posed, shade)
        if posed is not None:
            if samples > 1:
                self._antialias(color, posed, samples)
            darken_corners(color, geometry, posed, self.studio)
        return Frame(geometry.depth, geometry.face_id, geometry.normal, color)

    def _caster(self, scene: Scene) -> RayCaster:
        return scene.caster

    def _antialias(self, color: ByteImage, posed: PosedScene, samples: int) -> None:
        """Cast more rays through pixels that differ from their neighbours."""
        rows, columns = np.nonzero(_unlike_neighbours(color[posed.block.slices]))
        pixels = np.column_stack([columns + posed.block.left, rows + posed.block.top])
        offsets = _subpixel_offsets(samples)
        step = max(1, _RAYS_AT_ONCE // samples)

        def draw(part: IntArray) -> None:
            hits = posed.hits((part[:, None] + offsets).reshape(-1, 2))
            light = posed.light_of_hits(*hits, self.studio).reshape(-1, samples, 4)
            color[part[:, 1], part[:, 0]] = _encode(light.mean(axis=1))

        in_threads(draw, [pixels[begin : begin + step] for begin in range(0, len(pixels), step)])


class Open3DRenderer(RaycastRenderer):
    """Draws as `RaycastRenderer` does; Open3D finds the hits."""

    name = "open3d"

    def __init__(self, *, studio: Studio | None) -> None:
        try:
            import open3d  # noqa: F401
        except (ImportError, OSError) as error:  # OSError: a library of the system is missing
            raise RenderError(
                f"Open3D cannot be imported ({error})",
                where="open3d",
                fix="run `cadalign doctor` to see what is missing, or use the ray-cast renderer",
            ) from None
        super().__init__(studio=studio)

    def _caster(self, scene: Scene) -> RayCaster:
        return scene.open3d_caster


def cast_geometry(scene: Scene, camera: Camera, cam_from_model: Alignment) -> Geometry:
    """Depth, triangle numbers and normals without colour: one ray through each pixel's centre.

    Returns
    -------
    Geometry
        Empty at pixels where the lens model cannot be inverted.

    Raises
    ------
    RenderError
        If the image is too large.
    """
    check_image_size(camera)
    return geometry_of(camera, pose_scene(scene, camera, cam_from_model))


def check_samples(samples: int) -> None:
    """Refuse a number of rays per pixel that is out of range."""
    if not 1 <= samples <= _MAX_SAMPLES:
        raise InputError(f"{samples} is not from 1 to {_MAX_SAMPLES}", where="samples")


_Shade = Callable[[PosedScene, Rectangle, FloatArray, FaceArray, FloatArray], None]


def geometry_of(camera: Camera, posed: PosedScene | None, shade: _Shade | None = None) -> Geometry:
    """Hits of one ray through each pixel's centre, which ``shade`` draws; none of an unseen scene.

    ``shade`` takes the scene, a part of its block, and the rays, triangles and depths of the pixels
    there.
    """
    whole = (camera.height, camera.width)
    face_id = np.full(whole, -1, dtype=np.int32)
    geometry = Geometry(np.zeros(whole), face_id, np.zeros((*whole, 3), dtype=np.float32))
    if posed is None:
        return geometry

    def draw(band: Rectangle) -> None:
        rays, face, depth = posed.hits(band.pixels)
        hit = np.flatnonzero(face >= 0)
        shape = (band.height, band.width)
        geometry.face_id[band.slices] = face.reshape(shape)
        geometry.depth[band.slices] = np.where(face >= 0, depth, 0.0).reshape(shape)
        normal = np.zeros((len(face), 3), dtype=np.float32)
        normal[hit] = posed.normals[face[hit]]
        geometry.normal[band.slices] = normal.reshape(*shape, 3)
        if shade is not None:
            shade(posed, band, rays, face, depth)

    in_threads(draw, posed.block.bands(_RAYS_AT_ONCE // posed.block.width))
    return geometry


def _unlike_neighbours(color: ByteImage) -> BoolArray:
    """Pixels of (h, w, k) that visibly differ from one of 8 neighbours, (h, w) bool."""
    around = np.ones((3, 3), dtype=np.uint8)
    span = cv2.subtract(cv2.dilate(color, around), cv2.erode(color, around))
    return np.asarray(span.reshape(color.shape).max(axis=2) > _VISIBLE_STEP)


def _subpixel_offsets(count: int) -> FloatArray:
    """Points spread evenly over a pixel, (count, 2) from -0.5 to 0.5, their mean at the centre.

    The R2 sequence: M. Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018.
    """
    plastic = 1.324717957244746
    steps = np.arange(1, count + 1)[:, None] * (1 / plastic, 1 / plastic**2)
    offsets = (steps + 0.5) % 1.0
    return np.asarray(np.clip(offsets - offsets.mean(axis=0), -0.5, 0.5))


def _encode(light: LinearArray) -> ByteImage:
    """Turn premultiplied linear light (n, 4) into sRGB bytes with straight opacity."""
    opacity = light[:, 3:]
    straight = np.asarray(light[:, :3] / np.maximum(opacity, 1e-6), dtype=np.float32)
    result: ByteImage = np.empty(light.shape, dtype=np.uint8)
    result[:, :3] = bytes_from_linear(straight)
    result[:, 3:] = (np.clip(opacity, 0, 1) * 255 + 0.5).astype(np.uint8)
    return result
