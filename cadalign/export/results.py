"""Results of estimates as text, as pictures on axes and as aligned objects."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import InputError
from cadalign.export.aligned_object import AlignedObject, ExportView
from cadalign.geometry.alignment import (
    BOX_EDGES,
    NOT_DETERMINED,
    NOT_DETERMINED_ROTATION_DEG,
    Alignment,
    Box,
    deviation_text,
    distance_deviation,
    why_open,
)
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.pixels import rescaled_pixels
from cadalign.io.images import ByteImage, read_photo

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Photo = Path | str | ByteImage | None
_LONGEST_SIDE = 480  # of the grid of rays through a drawn model
_MODEL_COLOR = (0.94, 0.2, 0.2)
_MODEL_OPACITY = 0.45
_BOX_COLOR = "#f03232"
_GREY = 0.9
_LINE_POINTS = 17  # lens distortion bends the edges of a box


def result_text(result: Any) -> str:
    """Keypoints, rotation, translation, stretch, focal length, what is uncertain, warnings."""
    count, of = int(result.inliers.sum()), len(result.inliers)
    some = f"{count}" if count == of else f"{count} of {of}"
    views = "" if len(result.views) == 1 else f" in {len(result.views)} views"
    std, pose = result.std, result.alignment
    angle = np.degrees(np.arccos(np.clip((np.trace(pose.rotation) - 1) / 2, -1, 1)))
    rotation = f"{angle:.4g} deg from the camera's axes"
    translation = f"({', '.join(f'{value:.4g}' for value in pose.translation)})"
    stretch = [f"{value:.4g}" for value in result.stretch]
    known_to = ""
    if std is not None:
        is_known = std.rotation_deg <= NOT_DETERMINED_ROTATION_DEG
        rotation += f", +- {std.rotation_deg:.2g} deg" if is_known else ", not determined"
        is_known = distance_deviation(pose, result.covariance) <= NOT_DETERMINED
        deviations = ", ".join(f"{value:.2g}" for value in std.translation)
        translation += f" +- ({deviations})" if is_known else " (not determined)"
        stretch = [f"{text}{deviation_text(std.scale[k])}" for k, text in enumerate(stretch)]
        known_to = deviation_text(std.focal)
    lines = [
        f"{result.method}: {some} keypoints{views}, rms {result.rms:.3g} px",
        f"  rotation     {rotation}",
        f"  translation  {translation}",
        f"  stretch      ({', '.join(stretch)})",
    ]
    if result.focal == "estimate":
        prior = "" if result.focal_prior is None else f" (prior: {result.focal_prior})"
        lines.append(f"  focal length {result.camera.fx:.4g} px{known_to}{prior}")
    lines.extend(
        f"  also likely  ({other.relative_likelihood:.2g} x): scale "
        f"({', '.join(f'{value:.4g}' for value in other.alignment.scale)})"
        for other in result.alternatives
    )
    if result.uncertain:
        # The reason follows from the keypoints where all of them are seen, and are the evidence.
        is_plain = len(result.evidence) < 2 and len(result.points_3d) == len(result.inliers)
        exact = result.points_3d[result.inliers] if is_plain else result.points_3d[:0]
        names = [name + why_open(name, exact, pose) for name in result.uncertain]
        lines.append(f"  uncertain    {', '.join(names)}")
    if len(result.evidence) > 1:
        lines.extend(f"  evidence     {each}" for each in result.evidence)
    lines.extend(f"  warning      {text}" for text in result.warnings)
    return "\n".join(lines)


def plot_result(
    result: Any,
    image: npt.ArrayLike | str | os.PathLike[str] | None = None,
    mesh: Mesh | None = None,
    *,
    view: int = 0,
    axes: Axes | None = None,
) -> Axes:
    """Draw a result over the photo of one view; see `cadalign.Result.plot`."""
    if not 0 <= view < len(result.views):
        what = f"{view} is not one of the {len(result.views)} views"
        raise InputError(what, where="view", fix="views count from 0")
    seen = result.views[view]
    if isinstance(image, str | os.PathLike):
        image = read_photo(Path(image))
    axes = _photo_axes(seen.camera.width, seen.camera.height, image, axes)
    known = result.known_mesh(mesh)
    if known is not None:
        _plot_mesh(axes, seen.camera, seen.alignment, known)
    bounds = result.bounds if known is None or result.own_bounds is not None else known.bounds
    _plot_box(axes, seen.camera, Box.from_model(bounds, seen.alignment))
    residuals = np.where(np.isfinite(seen.residuals), seen.residuals, np.nan)
    _plot_keypoints(axes, seen.points_2d, residuals, seen.inliers)
    return axes


def _photo_axes(width: int, height: int, image: npt.ArrayLike | None, axes: Axes | None) -> Axes:
    """Axes with a photo (h, w[, 3]), or grey, in its pixels; new ones where none are given."""
    if axes is None:
        from matplotlib import pyplot

        axes = pyplot.subplots(figsize=(8, 8 * height / width))[1]
    pixels = np.full((1, 1, 3), _GREY) if image is None else np.asarray(image)
    if image is not None and pixels.shape[:2] != (height, width):
        raise InputError(
            f"shape {pixels.shape}, but the camera has {width} x {height} pixels",
            where="image",
            fix="give the photo of this camera",
        )
    axes.imshow(
        pixels,
        cmap="gray",
        extent=(-0.5, width - 0.5, height - 0.5, -0.5),
        interpolation="antialiased",
    )
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    axes.set_axis_off()
    return axes


def _plot_mesh(axes: Axes, camera: Camera, alignment: Alignment, mesh: Mesh) -> None:
    shade = _shade(camera, alignment, mesh)
    seen = np.isfinite(shade)
    if not seen.any():
        return
    color = np.zeros((*shade.shape, 4))
    color[..., :3] = np.array(_MODEL_COLOR) * np.where(seen, shade, 0.0)[..., None]
    color[..., 3] = _MODEL_OPACITY * seen
    right, bottom = camera.width - 0.5, camera.height - 0.5
    axes.imshow(color, extent=(-0.5, right, bottom, -0.5))
    if not seen.all() and min(shade.shape) > 1:
        place: Any = {"extent": (-0.5, right, -0.5, bottom), "origin": "lower"}  # rows from above
        axes.contour(seen, levels=[0.5], colors=[_MODEL_COLOR], linewidths=1.2, **place)


def _plot_box(axes: Axes, camera: Camera, box: Box) -> None:
    corners = box.corners
    share = np.linspace(0, 1, _LINE_POINTS)[:, None]
    for first, second in BOX_EDGES:
        points = corners[first] + share * (corners[second] - corners[first])
        pixels = camera.project_where_ahead(points)
        pixels[~np.isfinite(pixels)] = np.nan
        axes.plot(*pixels.T, color=_BOX_COLOR, linewidth=1.2, alpha=0.9)


def _plot_keypoints(
    axes: Axes, observed: FloatArray, residuals: FloatArray, inliers: BoolArray
) -> None:
    predicted = observed + residuals
    ends = np.stack([observed, predicted], axis=1).T  # (2, 2, n)
    for chosen, color in ((~inliers, "#999999"), (inliers, "#ffd21f")):
        axes.plot(*ends[..., chosen], color=color, linewidth=1)
        axes.plot(*predicted[chosen].T, "x", color=color, markersize=6, markeredgewidth=1.5)
    for chosen, color in ((inliers, "white"), (~inliers, "#999999")):
        x, y = observed[chosen].T
        axes.plot(x, y, "o", color="black", markerfacecolor="none", markersize=10)
        axes.plot(x, y, "o", color=color, markerfacecolor="none", markersize=8)


def _shade(camera: Camera, alignment: Alignment, mesh: Mesh) -> FloatArray:
    """Brightness (h, w) of a mesh lit from the camera on a coarse grid; NaN beside it."""
    from cadalign.geometry.raycaster import RayCaster

    step = max(1.0, max(camera.width, camera.height) / _LONGEST_SIDE)
    width, height = (max(round(side / step), 1) for side in (camera.width, camera.height))
    across = rescaled_pixels(np.arange(width, dtype=float), camera.width / width)
    down = rescaled_pixels(np.arange(height, dtype=float), camera.height / height)
    pixels = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    rays, valid = camera.rays_where_valid(pixels)
    # depth * ray = R (scale * x) + t, in the model's own coordinates
    directions = rays @ alignment.rotation / alignment.scale
    origin = -(alignment.translation @ alignment.rotation) / alignment.scale
    caster = RayCaster(mesh)
    faces, distance = caster.first_hits(origin, directions)
    hit = (faces >= 0) & valid & (distance > 0)
    normals = caster.normals(faces[hit])
    lengths = np.linalg.norm(normals / alignment.scale, axis=1) * np.linalg.norm(rays[hit], axis=1)
    towards = np.abs(np.einsum("nk,nk->n", normals, directions[hit]))  # equal in both frames
    shade = np.full(len(rays), np.nan)
    shade[hit] = 0.25 + 0.75 * towards / (lengths + 1e-300)
    return shade.reshape(height, width)


def object_of(
    result: Any,
    *,
    mesh: Mesh | str | os.PathLike[str] | None = None,
    image: Photo = None,
    images: Sequence[Photo] = (),
    world_from_cam: FloatArray | None = None,
    name: str = "model",
    metres: float = 1.0,
) -> AlignedObject:
    """The object of a result.

    Parameters
    ----------
    result : cadalign.Result
    mesh : Mesh or path, optional
        The model's as given; it is warped where the result knows its model, see `Result.mesh`.
    image : path or (h, w, 3) uint8, optional
        The photo of the only view.
    images : sequence
        The photos of several views, in the place of ``image``.
    world_from_cam, name, metres
        As for `AlignedObject`.

    Raises
    ------
    InputError
        If there are more or fewer images than the result has views.
    """
    photos: list[Photo] = list(images) or [image] + [None] * (len(result.views) - 1)
    if len(photos) != len(result.views):
        what = f"{len(photos)}, but the result has {len(result.views)} views"
        raise InputError(what, where="images", fix="give one or None for each")
    views = []
    for view, photo in zip(result.views, photos, strict=True):
        # Without keypoints behind the camera, and those without ids.
        ahead = np.flatnonzero(np.isfinite(view.residuals).all(axis=1))[: len(view.ids)]
        ids = tuple(view.ids[row] for row in ahead.tolist())
        views.append(ExportView(view.camera, view.alignment, photo, view.points_2d[ahead], ids))
    return AlignedObject(
        tuple(views),
        result.points_3d,
        result.ids,
        result.known_mesh(mesh),
        result.rig_from_model,
        world_from_cam,
        name,
        metres,
    )
