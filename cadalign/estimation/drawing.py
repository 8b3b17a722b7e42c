"""Pictures of results: on matplotlib axes, and small ones in the tables of notebooks."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.geometry.box import Box
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.plots import plot_box, plot_keypoints, plot_mesh, plot_photo
from cadalign.io.images import read_photo
from cadalign.notebook.html import card, draw_picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from cadalign.estimation.align_result import AlignResult
    from cadalign.estimation.result import FitResult
    from cadalign.estimation.uncertainty.weakness import Uncertainty

Photo = npt.ArrayLike | str | os.PathLike[str]


def plot_fit(
    result: FitResult,
    image: Photo | None = None,
    mesh: Mesh | None = None,
    *,
    axes: Axes | None = None,
) -> Axes:
    """Draw a fit over its photo; see `FitResult.plot`."""
    camera, alignment = result.camera, result.alignment
    axes = plot_photo(camera, _pixels(image), axes=axes)
    if mesh is not None:
        plot_mesh(axes, camera, alignment, mesh)
    bounds = _extent(result.points_3d) if mesh is None else mesh.bounds
    plot_box(axes, camera, Box.from_model(bounds, alignment))
    predicted = camera.project_where_ahead(alignment.apply(result.points_3d))
    residuals = np.where(np.isfinite(predicted), result.residuals, np.nan)
    plot_keypoints(axes, predicted - residuals, residuals, result.inliers)
    return axes


def plot_alignment(
    result: AlignResult,
    image: Photo | None = None,
    mesh: Mesh | None = None,
    *,
    view: int = 0,
    axes: Axes | None = None,
) -> Axes:
    """Draw an alignment over the photo of one view; see `AlignResult.plot`."""
    if not 0 <= view < len(result.poses):
        what = f"{view} is not one of the {len(result.poses)} views"
        raise InputError(what, where="view", fix="views count from 0")
    if not result.cameras:
        what = "the result has no cameras: it was written by an earlier version"
        raise InputError(what, where="plot", fix="align again")
    camera, pose = result.cameras[view], result.poses[view]
    axes = plot_photo(camera, _pixels(image), axes=axes)
    known = (
        mesh if mesh is not None or result.model is None else getattr(result.model, "mesh", None)
    )
    if known is not None:
        plot_mesh(axes, camera, pose, known if result.model is None else result.mesh(known))
    plot_box(axes, camera, Box.from_model(result.bounds, pose))
    residuals, inliers = result.residuals[view], result.inliers[view]
    plot_keypoints(axes, result.observed[view], residuals, inliers)
    return axes


def fit_html(result: FitResult) -> str:
    """HTML of a fit for notebooks."""
    count = f"{int(result.inliers.sum())} of {len(result.inliers)}"
    rows = [("keypoints", count), ("residuals (rms)", f"{result.rms:.3g} px")]
    rows += _pose_rows(result.alignment.translation, result.alignment.scale, result.std)
    if result.focal == "estimate":
        rows.append(("focal length", f"{result.camera.fx:.4g} px"))
    aspect = result.camera.height / result.camera.width
    picture = draw_picture(lambda axes: plot_fit(result, axes=axes), aspect=aspect)
    return card(f"FitResult ({result.method})", rows, picture=picture, note=_note(result.warnings))


def alignment_html(result: AlignResult) -> str:
    """HTML of an alignment for notebooks."""
    seen = sum(int(inliers.sum()) for inliers in result.inliers)
    rows = [
        ("keypoints", f"{seen} in {len(result.poses)} view{'s' * (len(result.poses) > 1)}"),
        ("residuals (rms)", f"{result.rms:.3g} px"),
        *_pose_rows(result.alignment.translation, result.stretch, result.std),
    ]
    picture = None
    if result.cameras:
        aspect = result.cameras[0].height / result.cameras[0].width
        picture = draw_picture(lambda axes: plot_alignment(result, axes=axes), aspect=aspect)
    return card("AlignResult", rows, picture=picture, note=_note(result.warnings))


def _pose_rows(
    translation: FloatArray, scale: FloatArray, std: Uncertainty | None
) -> list[tuple[str, str]]:
    """Rows of position, stretch and, where known, their standard deviations."""
    shift = ", ".join(f"{value:.4g}" for value in translation)
    if std is None:
        scales = [f"{axis} {value:.4g}" for axis, value in zip("xyz", scale, strict=True)]
        return [("translation", shift), ("stretch", ", ".join(scales))]
    scales = [
        f"{axis} {value:.4g}" + (f" ± {100 * deviation:.2g} %" if deviation else "")
        for axis, value, deviation in zip("xyz", scale, std.scale, strict=True)
    ]
    known_to = ", ".join(f"{value:.2g}" for value in std.translation)
    return [
        ("rotation", f"± {std.rotation_deg:.2g}°"),
        ("translation", f"({shift}) ± ({known_to})"),
        ("stretch", ", ".join(scales)),
    ]


def _note(warnings: tuple[str, ...]) -> str:
    return "" if not warnings else "Warning: " + "; ".join(warnings)


def _pixels(image: Photo | None) -> npt.ArrayLike | None:
    if isinstance(image, str | os.PathLike):
        return read_photo(Path(image))
    return image


def _extent(points: FloatArray) -> FloatArray:
    return np.array([points.min(axis=0), points.max(axis=0)])
