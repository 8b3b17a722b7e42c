"""Renderer by ray casting: exact geometry and antialiased, shaded colour; needs no display."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.raycaster import FaceArray, RayCaster
from cadalign.render.canvas import ByteImage, LinearArray, bytes_from_linear
from cadalign.render.posed_scene import PosedScene, Rectangle, draw_in_threads, pose_scene
from cadalign.render.scene import Frame, Geometry, Scene, check_image_size
from cadalign.render.surface import Studio

# Small enough for the processor's caches, large enough for NumPy's overhead not to show.
_RAYS_AT_ONCE = 1 << 15
# Pixels that differ from a neighbour by more than this in a channel (of 255) are antialiased.
_VISIBLE_STEP = 6
_MAX_SAMPLES = 256


class RaycastRenderer:
    """Renderer with embree on the CPU; works everywhere.

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
            Its lens distortion is rendered too.
        cam_from_model : Alignment
            Pose and stretch of the mesh. Parts behind the camera are not drawn.
        samples : int
            Rays per pixel where neighbouring colours differ; 1 turns antialiasing off.

        Returns
        -------
        Frame
            Pixels are empty where no object is, and where the lens model cannot be inverted.

        Raises
        ------
        RenderError
            If the image is too large.
        InputError
            If ``samples`` is not from 1 to 256.
        """
        if not 1 <= samples <= _MAX_SAMPLES:
            raise InputError(f"{samples} is not from 1 to {_MAX_SAMPLES}", where="samples")
        check_image_size(camera)
        color: ByteImage = np.zeros((camera.height, camera.width, 4), dtype=np.uint8)
        posed = pose_scene(scene, camera, cam_from_model, caster=self._caster(scene))
        if posed is None:
            geometry = geometry_of(camera, posed)
        else:
            geometry = self._paint(color, posed, samples)
            darken_corners(color, geometry, posed, self.studio)
        return Frame(geometry.depth, geometry.face_id, geometry.normal, color)

    def _caster(self, scene: Scene) -> RayCaster:
        return scene.caster

    def _paint(self, color: ByteImage, posed: PosedScene, samples: int) -> Geometry:
        """Write the colour without ambient occlusion, (h, w, 4); returns the geometry."""

        def shade(
            posed: PosedScene, band: Rectangle, rays: FloatArray, face: FaceArray, depth: FloatArray
        ) -> None:
            light = posed.shade_hits(rays, face, depth, self.studio)
            color[band.slices] = _encode(light).reshape(band.height, band.width, 4)

        # Computed now, since several threads use them.
        _ = posed.scene.surface, posed.scene.corner_normals
        geometry = geometry_of(posed.camera, posed, shade)
        if samples > 1:
            self._antialias(color, posed, samples)
        return geometry

    def _antialias(self, color: ByteImage, posed: PosedScene, samples: int) -> None:
        """Cast more rays through pixels that differ from their neighbours."""
        rows, columns = np.nonzero(_find_contrast(color[posed.block.slices]))
        pixels = np.column_stack([columns + posed.block.left, rows + posed.block.top])
        offsets = _subpixel_offsets(samples)
        step = max(1, _RAYS_AT_ONCE // samples)

        def draw(part: IntArray) -> None:
            hits = posed.cast_pixels((part[:, None] + offsets).reshape(-1, 2))
            light = posed.shade_hits(*hits, self.studio).reshape(-1, samples, 4)
            color[part[:, 1], part[:, 0]] = _encode(light.mean(axis=1))

        begins = range(0, len(pixels), step)
        draw_in_threads(draw, [pixels[begin : begin + step] for begin in begins])


class Open3DRenderer(RaycastRenderer):
    """`RaycastRenderer` with the ray caster of Open3D."""

    name = "open3d"

    def _caster(self, scene: Scene) -> RayCaster:
        return scene.open3d_caster


def cast_geometry(scene: Scene, camera: Camera, cam_from_model: Alignment) -> Geometry:
    """Render depth, triangle indices and normals without colour, one ray per pixel centre.

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


_Shade = Callable[[PosedScene, Rectangle, FloatArray, FaceArray, FloatArray], None]


def geometry_of(camera: Camera, posed: PosedScene | None, shade: _Shade | None = None) -> Geometry:
    """Render depth, triangle indices and normals; empty without a posed scene.

    ``shade`` draws the colour: it takes the scene, a band of its block, and the rays, triangles and
    depths of the band's pixels.
    """
    whole = (camera.height, camera.width)
    face_id = np.full(whole, -1, dtype=np.int32)
    geometry = Geometry(np.zeros(whole), face_id, np.zeros((*whole, 3), dtype=np.float32))
    if posed is None:
        return geometry

    def draw(band: Rectangle) -> None:
        rays, face, depth = posed.cast_pixels(band.pixels)
        hit = np.flatnonzero(face >= 0)
        shape = (band.height, band.width)
        geometry.face_id[band.slices] = face.reshape(shape)
        geometry.depth[band.slices] = np.where(face >= 0, depth, 0.0).reshape(shape)
        normal = np.zeros((len(face), 3), dtype=np.float32)
        normal[hit] = posed.normals[face[hit]]
        geometry.normal[band.slices] = normal.reshape(*shape, 3)
        if shade is not None:
            shade(posed, band, rays, face, depth)

    draw_in_threads(draw, posed.block.bands(_RAYS_AT_ONCE // posed.block.width))
    return geometry


def _find_contrast(color: ByteImage) -> BoolArray:
    """Mark pixels that visibly differ from one of its 8 neighbours, (h, w) bool."""
    around = np.ones((3, 3), dtype=np.uint8)
    span = cv2.subtract(cv2.dilate(color, around), cv2.erode(color, around))
    return np.asarray(span.reshape(color.shape).max(axis=2) > _VISIBLE_STEP)


def _subpixel_offsets(count: int) -> FloatArray:
    """Evenly spread points of a pixel, (count, 2) from -0.5 to 0.5, with the mean 0.

    The R2 sequence: M. Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018.
    """
    plastic = 1.324717957244746
    steps = np.arange(1, count + 1)[:, None] * (1 / plastic, 1 / plastic**2)
    offsets = (steps + 0.5) % 1.0
    return np.asarray(np.clip(offsets - offsets.mean(axis=0), -0.5, 0.5))


def _encode(light: LinearArray) -> ByteImage:
    """Convert premultiplied linear light (n, 4) to sRGB bytes, not premultiplied."""
    opacity = light[:, 3:]
    straight = np.asarray(light[:, :3] / np.maximum(opacity, 1e-6), dtype=np.float32)
    result: ByteImage = np.empty(light.shape, dtype=np.uint8)
    result[:, :3] = bytes_from_linear(straight)
    result[:, 3:] = (np.clip(opacity, 0, 1) * 255 + 0.5).astype(np.uint8)
    return result


# Ambient occlusion --------------------------------------------------------------------------------

# Rays per point. The points of a 4 x 4 tile have different rays, and their results are averaged.
_RAYS = 8
_TILE = 4
# Above this many pixels, only every second, third, ... row and column is sampled.
_MAX_POINTS = 12_000
# Distance of the rays' starts from the surface, in diagonals.
_LIFT = 2e-3
_POINTS_AT_ONCE = 1 << 12
# Evenly spread points of the unit sphere, (16, 8, 3). Each point of a tile takes every 16th, so
# that it has points of all heights.
_NUMBER = np.arange(_RAYS * _TILE * _TILE) + 0.5
_HEIGHT = 1 - 2 * _NUMBER / len(_NUMBER)
_TURN = np.exp(1j * _NUMBER * np.pi * (3 - np.sqrt(5))) * np.sqrt(1 - _HEIGHT**2)
_SPHERE = np.column_stack([_TURN.real, _TURN.imag, _HEIGHT]).reshape(_RAYS, -1, 3).swapaxes(0, 1)
# sRGB values are about the 2.2th root of light.
_ENCODING = 1 / 2.2


def darken_corners(color: ByteImage, geometry: Geometry, posed: PosedScene, studio: Studio) -> None:
    """Apply ambient occlusion to the colours, in place."""
    if studio.occlusion <= 0:
        return
    openness = _openness(geometry, posed, studio.occlusion_reach * posed.diagonal)
    if openness is None:
        return
    factor = (1 - studio.occlusion * (1 - openness)) ** np.float32(_ENCODING)
    part = color[posed.block.slices]
    part[:, :, :3] = (part[:, :, :3] * factor[:, :, None] + 0.5).astype(np.uint8)


def _openness(geometry: Geometry, posed: PosedScene, reach: float) -> LinearArray | None:
    """Visible share of the sky at the block's pixels, (h, w) float32; None without hits."""
    block = posed.block
    covered = int(geometry.mask[block.slices].sum())
    step = max(1, int(np.ceil(np.sqrt(covered / _MAX_POINTS))))
    rows = np.arange(block.top + step // 2, block.bottom, step)
    columns = np.arange(block.left + step // 2, block.right, step)
    grid = np.ix_(rows, columns)
    hit = geometry.face_id[grid] >= 0
    depth = geometry.depth[grid].astype(np.float32)
    normal = geometry.normal[grid]
    inside = np.argwhere(hit)
    if not len(inside):
        return None
    pixels = np.column_stack([columns[inside[:, 1]], rows[inside[:, 0]]]).astype(float)
    rays, _ = posed.camera.rays_where_valid(pixels)
    points = rays * depth[hit][:, None]
    points += _LIFT * posed.diagonal * normal[hit]
    sky = np.zeros(hit.shape, dtype=np.float32)
    tile = (inside[:, 0] % _TILE) * _TILE + inside[:, 1] % _TILE

    def look(part: slice) -> None:
        directions = _sky_directions(normal[hit][part], tile[part]).reshape(-1, 3)
        blocked = posed.occlusion_mask(
            np.repeat(points[part], _RAYS, axis=0), directions, reach=reach
        )
        rows_of, columns_of = inside[part].T
        sky[rows_of, columns_of] = 1 - blocked.reshape(-1, _RAYS).mean(axis=1)

    begins = range(0, len(inside), _POINTS_AT_ONCE)
    draw_in_threads(look, [slice(begin, begin + _POINTS_AT_ONCE) for begin in begins])
    # The mean over a tile; beside the object it continues the border, which would else be bright.
    total, count = (
        cv2.boxFilter(each, -1, (_TILE, _TILE), normalize=False, borderType=cv2.BORDER_CONSTANT)
        for each in (sky, hit.astype(np.float32))
    )
    smooth = np.where(count > 0, total / np.maximum(count, 1), np.float32(1))
    size = block.width, block.height
    return np.asarray(cv2.resize(smooth, size, interpolation=cv2.INTER_LINEAR), np.float32)


def _sky_directions(normal: LinearArray, tile: npt.NDArray[np.int64]) -> FloatArray:
    """Cosine-weighted unit directions (n, 8, 3) around normals (n, 3)."""
    # Points of the unit sphere around the normal's tip are cosine-weighted directions.
    towards = normal[:, None] + _SPHERE[tile]
    return np.asarray(towards / np.linalg.norm(towards, axis=2, keepdims=True))
