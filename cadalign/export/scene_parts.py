"""Photos as rectangles in a scene for viewers, and the model's place in it.

glTF's cameras have their principal point in the image's centre and no lens distortion. So the photo
becomes a textured rectangle at the place where the camera sees it, and the camera's field of view
is the least one about the principal point that holds all of it: the image of that camera is the
photo with a margin at one side. A distorted photo is resampled to a pinhole camera's.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.export.aligned_object import AlignedObject, Frame
from cadalign.geometry.camera import Camera
from cadalign.geometry.conventions import OPENGL_AXES, OPENGL_FLIP
from cadalign.geometry.mesh import Mesh
from cadalign.io.images import ByteImage

_BORDER = 0.5  # from the corner pixel's centre to the image's border [px]
_GROWTH = 2.0  # how much larger than the photo an undistorted one may become, each way
_AGREES = 1e-6
_RIM = 1.5  # how far the border's colours go on beyond the photo [px]
_BEHIND = 1.5  # depth of the photo over that of the object's farthest corner
_FAR_OFF = 100.0  # coordinates over the extent
_NEAR, _FAR = 1e-3, 10.0  # depths between which a viewer draws, over that of the photo


class PhotoPlane(NamedTuple):
    """The rectangle of a photo at depth 1, in the camera's axes (x right, y down)."""

    image: ByteImage | None
    """The photo (h, w, 3), without lens distortion."""
    low: FloatArray
    """Its top left corner (2,) in normalised image coordinates."""
    high: FloatArray
    """Its bottom right corner (2,)."""


def photo_plane(camera: Camera, image: ByteImage | None) -> PhotoPlane:
    """Make the rectangle of a camera's photo."""
    if camera.distortion:
        pinhole = _pinhole_of(camera)
        image = None if image is None else _undistorted(image, camera, pinhole)
        camera = pinhole
    centre, focal = np.array([camera.cx, camera.cy]), np.array([camera.fx, camera.fy])
    size = np.array([camera.width, camera.height])
    return PhotoPlane(image, (-_BORDER - centre) / focal, (size - _BORDER - centre) / focal)


class PlacedPhoto(NamedTuple):
    """A photo in a scene, behind the object."""

    plane: PhotoPlane
    """Its rectangle at depth 1."""
    depth: float
    """Depth at which it stands [m]."""
    pose: FloatArray
    """Pose (4, 4) of its camera, which has glTF's axes [m]."""

    @property
    def look(self) -> dict[str, float]:
        """The camera of glTF that holds the photo about its principal point."""
        across, down = np.maximum(np.abs(self.plane.low), np.abs(self.plane.high)).tolist()
        field = {"aspectRatio": across / down, "yfov": 2 * float(np.arctan(down))}
        return field | {"znear": _NEAR * self.depth, "zfar": _FAR * self.depth}

    @property
    def corners(self) -> FloatArray:
        """Top left, bottom left, bottom right, top right, in glTF's axes; (4, 3) float."""
        (left, top), (right, bottom) = self.plane.low, self.plane.high
        rows = [[left, top, 1], [left, bottom, 1], [right, bottom, 1], [right, top, 1]]
        return np.asarray(np.array(rows) * self.depth * OPENGL_AXES)


def placed_parts(
    exported: AlignedObject, frame: Frame
) -> tuple[Mesh, FloatArray, tuple[PlacedPhoto, ...]]:
    """Place an object's model, (4, 4) float, and its photos in a scene that is measured in metres.

    The scene has the axes of the frame; those of the first camera are turned to glTF's. A mesh far
    from its origin, whose vertices single precision would round, is moved there, and so its place.
    """
    mesh = exported.require_mesh()
    root = OPENGL_FLIP if frame == "camera" else np.eye(4)
    placing = root @ exported.frame_from_model(frame).cam_from_model
    placing[:3] *= exported.metres
    low, high = mesh.bounds
    if np.abs(mesh.bounds).max() > _FAR_OFF * np.abs(high - low).max():
        middle = (low + high) / 2
        mesh = replace(mesh, vertices=mesh.vertices - middle)
        placing[:3, 3] += placing[:3, :3] @ middle
    photos = []
    for number, view in enumerate(exported.views):
        pose = root @ exported.frame_from_cam(frame, number) @ OPENGL_FLIP
        pose[:3, 3] *= exported.metres
        depth = _photo_depth(exported, number) * exported.metres
        photos.append(PlacedPhoto(photo_plane(view.camera, view.read_image()), depth, pose))
    return mesh, placing, tuple(photos)


def _photo_depth(exported: AlignedObject, number: int) -> float:
    """Depth at which a view's photo stands, behind the object [units of the camera frame]."""
    low, high = exported.bounds
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    depths = exported.views[number].cam_from_model.apply(low + corners * (high - low))[:, 2]
    return _BEHIND * float(np.abs(depths).max())


def _pinhole_of(camera: Camera) -> Camera:
    """A camera without distortion, of the same focal length, that holds all pixels it can."""
    width, height = camera.width, camera.height
    across, down = np.arange(width + 1) - _BORDER, np.arange(height + 1) - _BORDER
    sides = [np.stack([across, np.full(width + 1, y)], axis=1) for y in (down[0], down[-1])]
    sides += [np.stack([np.full(height + 1, x), down], axis=1) for x in (across[0], across[-1])]
    normalized, valid = camera.normalize_where_valid(np.concatenate(sides))
    pixels = normalized[valid] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    whole = np.array([[-_BORDER] * 2, [width - _BORDER, height - _BORDER]])
    pixels = pixels if len(pixels) else whole
    slack = (_GROWTH - 1) * np.array([width, height])
    low = np.maximum(np.floor(pixels.min(axis=0) + _BORDER), -slack)
    high = np.minimum(np.ceil(pixels.max(axis=0) + _BORDER), [width, height] + slack)
    columns, rows = (int(n) for n in np.maximum(high - low, 1))
    cx, cy = camera.cx - float(low[0]), camera.cy - float(low[1])
    return Camera(columns, rows, camera.fx, camera.fy, cx, cy)


def _undistorted(image: ByteImage, camera: Camera, pinhole: Camera) -> ByteImage:
    """The photo as the pinhole camera would have taken it, black where it shows nothing."""
    import cv2

    columns, rows = np.meshgrid(np.arange(pinhole.width), np.arange(pinhole.height))
    targets = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float)
    normalized = pinhole.normalize(targets)
    sources = camera.pixels_from_normalized(normalized)
    # Past the fold of the lens model a far place would be given a pixel of the photo.
    inside: BoolArray = np.asarray(np.isfinite(sources).all(axis=1))
    inside[inside] = camera.contains(sources[inside], margin=-_RIM)
    back, valid = camera.normalize_where_valid(sources[inside])
    gap = np.abs(back - normalized[inside]).max(axis=1, initial=0.0)
    inside[inside] = valid & (gap < _AGREES)
    sources[~inside] = -10.0
    maps = sources.reshape(pinhole.height, pinhole.width, 2).astype(np.float32)
    # The rim has its colour, or viewers would mix black into the photo's borders.
    drawn = cv2.remap(
        image, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    drawn[~inside.reshape(drawn.shape[:2])] = 0
    return np.asarray(drawn, dtype=np.uint8)
