"""Matplotlib pictures of an alignment: photo, model, box and keypoints on axes in pixels."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import BOX_EDGES, Box
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.notebook.axes import photo_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_LONGEST_SIDE = 480  # of the grid of rays through a drawn model
_MODEL_COLOR = (0.94, 0.2, 0.2)
_MODEL_OPACITY = 0.45
_BOX_COLOR = "#f03232"
_LINE_POINTS = 17  # lens distortion bends the edges of a box


def plot_photo(
    camera: Camera, image: npt.ArrayLike | None = None, *, axes: Axes | None = None
) -> Axes:
    """Draw a photo (h, w[, 3]), or grey where there is none; returns axes in its pixels.

    Raises
    ------
    InputError
        If the photo is not of the camera's size.
    """
    return photo_axes(camera.width, camera.height, image, axes=axes)


def plot_mesh(axes: Axes, camera: Camera, alignment: Alignment, mesh: Mesh) -> None:
    """Draw a mesh over the photo, shaded and translucent, with its outline."""
    shade = _shade(camera, alignment, mesh)
    seen = np.isfinite(shade)
    if not seen.any():
        return
    color = np.zeros((*shade.shape, 4))
    color[..., :3] = np.array(_MODEL_COLOR) * np.where(seen, shade, 0.0)[..., None]
    color[..., 3] = _MODEL_OPACITY * seen
    axes.imshow(color, extent=_extent(camera))
    height, width = shade.shape
    columns = (np.arange(width) + 0.5) * camera.width / width - 0.5
    rows = (np.arange(height) + 0.5) * camera.height / height - 0.5
    if not seen.all() and min(shade.shape) > 1:
        axes.contour(columns, rows, seen, levels=[0.5], colors=[_MODEL_COLOR], linewidths=1.2)


def plot_box(axes: Axes, camera: Camera, box: Box) -> None:
    """Draw the edges of a box in the camera frame."""
    corners = box.corners
    share = np.linspace(0, 1, _LINE_POINTS)[:, None]
    for first, second in BOX_EDGES:
        points = corners[first] + share * (corners[second] - corners[first])
        pixels = camera.project_where_ahead(points)
        pixels[~np.isfinite(pixels)] = np.nan
        axes.plot(*pixels.T, color=_BOX_COLOR, linewidth=1.2, alpha=0.9)


def plot_keypoints(
    axes: Axes, observed: FloatArray, residuals: FloatArray, inliers: BoolArray
) -> None:
    """Draw observed keypoints (n, 2) as rings, reprojected ones as crosses, residuals as lines.

    Keypoints that are no inliers (n,) are grey.
    """
    predicted = observed + residuals
    for start, end, kept in zip(observed, predicted, inliers, strict=True):
        if np.isfinite(end).all():
            color = "#ffd21f" if kept else "#999999"
            axes.plot(*np.stack([start, end]).T, color=color, linewidth=1)
            axes.plot(*end, "x", color=color, markersize=6, markeredgewidth=1.5)
    for chosen, color in ((inliers, "white"), (~inliers, "#999999")):
        x, y = observed[chosen].T
        axes.plot(x, y, "o", color="black", markerfacecolor="none", markersize=10)
        axes.plot(x, y, "o", color=color, markerfacecolor="none", markersize=8)


def _extent(camera: Camera) -> tuple[float, float, float, float]:
    return (-0.5, camera.width - 0.5, camera.height - 0.5, -0.5)


def _shade(camera: Camera, alignment: Alignment, mesh: Mesh) -> FloatArray:
    """Brightness (h, w) of a mesh lit from the camera on a coarse grid; NaN beside it."""
    from cadalign.geometry.raycaster import EmbreeEngine, RayCaster, face_normals

    step = max(1.0, max(camera.width, camera.height) / _LONGEST_SIDE)
    width, height = round(camera.width / step), round(camera.height / step)
    width, height = max(width, 1), max(height, 1)
    across = (np.arange(width) + 0.5) * camera.width / width - 0.5
    down = (np.arange(height) + 0.5) * camera.height / height - 0.5
    pixels = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    rays, valid = camera.rays_where_valid(pixels)
    # depth * ray = R (scale * x) + t, in the model's own coordinates
    directions = rays @ alignment.rotation / alignment.scale
    origin = -(alignment.translation @ alignment.rotation) / alignment.scale
    caster = RayCaster(mesh, face_normals(mesh.triangles), engine=EmbreeEngine)
    faces, distance = caster.first_hits(origin, directions)
    hit = (faces >= 0) & valid & (distance > 0)
    normals = (caster.normals(faces[hit]) / alignment.scale) @ alignment.rotation.T
    towards = np.abs(np.einsum("nk,nk->n", normals, rays[hit]))
    towards /= np.linalg.norm(normals, axis=1) * np.linalg.norm(rays[hit], axis=1) + 1e-300
    shade = np.full(len(rays), np.nan)
    shade[hit] = 0.25 + 0.75 * towards
    return shade.reshape(height, width)
