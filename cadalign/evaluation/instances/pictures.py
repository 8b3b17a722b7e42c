"""Pictures of instances with true and estimated boxes, and mesh previews."""

from __future__ import annotations

import base64
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image

from cadalign.arrays import FloatArray
from cadalign.errors import RenderError
from cadalign.evaluation.instances.instance import Instance
from cadalign.evaluation.instances.record import record_stem
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.geometry.alignment import Alignment, Box
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.pixels import rescaled_pixels
from cadalign.geometry.simplify import cluster, mesh_edges, simplify
from cadalign.io.files import dense_json, write_text, write_whole
from cadalign.render import RaycastRenderer, draw_overlay
from cadalign.render.canvas import ByteImage

NO_PHOTO = 225
"""Grey level of missing photos."""
_MOST = 1024  # pixels of a photo's longer side
_THUMB = (320, 240)
_MARGIN = 0.2  # around the object, relative to its size
_QUALITY, _THUMB_QUALITY = 85, 75
_EFFORT = 2  # WebP's method, 0 (fast) to 6 (small)


def write_pictures(
    folder: RunFolder,
    stem: str,
    photo: ByteImage,
    camera: Camera,
    *,
    observed: FloatArray,
    gt_box: Box | None = None,
    est_box: Box | None = None,
    skeleton: npt.ArrayLike = (),
) -> None:
    """Write the pictures of an instance, named ``stem``, to a run's folder.

    The folder's ``pictures`` gets the photo. ``thumbs`` gets the part around the object and its
    keypoints ``observed`` (n, 2) [px], with the true and the estimated box, and the lines of a
    ``skeleton`` (s, 2, 3) in the camera frame.
    """
    small, near = shrink_photo(photo, camera)
    box = gt_box or est_box
    corners = np.empty((0, 2)) if box is None else near.project_where_ahead(box.corners)
    points = np.concatenate([rescaled_pixels(observed, near.width / camera.width), corners])
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        points = np.array([[0, 0], [near.width, near.height]], dtype=float)
    crop, crop_camera = crop_photo(small, near, points)
    drawn: dict[str, Any] = {"gt_box": gt_box, "est_box": est_box, "skeleton": skeleton}
    thumb = draw_overlay(crop, crop_camera, axes=False, legend=False, **drawn)
    write_webp(folder.pictures / f"{stem}.webp", small)
    write_webp(folder.thumbs / f"{stem}.webp", thumb, quality=_THUMB_QUALITY)


def draw_instance(
    folder: RunFolder,
    instance: Instance,
    estimate: Alignment,
    category: str,
    model_id: str,
    view: int = 0,
) -> None:
    """Render an instance; write its pictures and its mesh preview to a run's folder."""
    stem = record_stem(category, model_id, view)
    if instance.scene is None:
        raise RenderError("there is no mesh to draw", where=stem)
    frame = _renderer().render(instance.scene, instance.camera, instance.cam_from_model)
    write_pictures(
        folder,
        stem,
        frame.composite(),
        instance.camera,
        observed=instance.points_2d,
        gt_box=instance.gt_box,
        est_box=Box.from_model(instance.bounds, estimate),
    )
    preview = folder.previews / f"{record_stem(category, model_id)}.json"
    if view == 0 or not preview.exists():
        write_preview(preview, instance.scene.mesh)


def shrink_photo(photo: ByteImage, camera: Camera) -> tuple[ByteImage, Camera]:
    """Shrink a photo to at most 1024 pixels on its longer side; returns it and its camera."""
    factor = min(1.0, _MOST / max(camera.width, camera.height))
    size = tuple(max(1, round(factor * length)) for length in (camera.width, camera.height))
    if photo.shape[1::-1] != size:
        photo = np.asarray(cv2.resize(photo, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return photo, camera.resize(*size)


def crop_photo(photo: ByteImage, camera: Camera, points: FloatArray) -> tuple[ByteImage, Camera]:
    """Crop a photo around points (n, 2) [px] to a thumb; returns it and its camera."""
    limit = np.array([camera.width, camera.height], dtype=float)
    low, high = np.clip(points.min(axis=0), 0, limit), np.clip(points.max(axis=0), 0, limit)
    across = float(((high - low) / _THUMB).max()) * (1 + 2 * _MARGIN)  # photo's per thumb's pixel
    across = min(max(across, 0.1), float((limit / _THUMB).max()))
    left, top = (low + high) / 2 - across * np.array(_THUMB) / 2
    # Borders of pixels, not their centres, are aligned.
    warp = np.array([[across, 0, left], [0, across, top]])
    how = cv2.WARP_INVERSE_MAP | (cv2.INTER_AREA if across > 1 else cv2.INTER_LINEAR)
    crop = cv2.warpAffine(photo, warp, _THUMB, flags=how, borderValue=(NO_PHOTO,) * 3)
    near = replace(
        camera,
        width=_THUMB[0],
        height=_THUMB[1],
        fx=camera.fx / across,
        fy=camera.fy / across,
        cx=(camera.cx - left) / across,
        cy=(camera.cy - top) / across,
    )
    return np.asarray(crop, dtype=np.uint8), near


def write_webp(path: Path, image: ByteImage, *, quality: int = _QUALITY) -> None:
    """Write a picture for a page as WebP, atomically."""
    picture = Image.fromarray(image)
    write_whole(path, lambda unfinished: picture.save(unfinished, quality=quality, method=_EFFORT))


@cache
def _renderer() -> RaycastRenderer:
    return RaycastRenderer()


_MOST_PARTS = 1500  # triangles, and as many lines, in a preview
_FINEST = 1 << 15  # cells along the longest side, within the range of 16-bit coordinates
_CREASE_DEG = 30.0


def preview_of(
    mesh: Mesh, *, max_faces: int = _MOST_PARTS, max_edges: int = _MOST_PARTS
) -> dict[str, Any]:
    """Simplify a mesh by grid clustering, to a maximum number of triangles and of lines.

    Returns fields for JSON, with arrays as little-endian base64: vertex = lo + step * uint16.
    ``edges`` are pairs of vertices for a wireframe: parts too thin for triangles, creases and
    borders.
    """
    small = cluster(mesh, cells=_FINEST)
    if len(small.faces) > max_faces:
        small = simplify(mesh, max_faces=max_faces)
    edges = mesh_edges(small.vertices, small.faces, crease_angle=_CREASE_DEG)
    creases = edges.ends[edges.creased]
    length = np.linalg.norm(small.vertices[creases[:, 0]] - small.vertices[creases[:, 1]], axis=1)
    longest = creases[np.argsort(-length, kind="stable")]
    placed = small.vertices if len(small.vertices) else np.zeros((1, 3))
    low = placed.min(axis=0)
    step = np.maximum(np.ptp(placed, axis=0), 1e-12) / (2 * _FINEST - 1)
    wide = len(small.vertices) > 2 * _FINEST
    index = "<u4" if wide else "<u2"
    return {
        "lo": low.tolist(),
        "step": step.tolist(),
        "vertices": _base64(np.round((small.vertices - low) / step), "<u2"),
        "faces": _base64(small.faces, index),
        "edges": _base64(np.concatenate([small.wires, longest])[:max_edges], index),
        "wide": wide,
    }


def write_preview(path: Path, mesh: Mesh) -> None:
    """Write a preview of a mesh as JSON."""
    write_text(path, dense_json(preview_of(mesh)))


def _base64(values: npt.NDArray[Any], kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode("ascii")
