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

    from cadalign.estimation.result_data import ResultData
    from cadalign.estimation.uncertainty.summary import Uncertainty

Photo = npt.ArrayLike | str | os.PathLike[str]


def plot_result(
    result: ResultData,
    image: Photo | None = None,
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
    axes = plot_photo(seen.camera, image, axes=axes)
    known = result.known_mesh(mesh)
    if known is not None:
        plot_mesh(axes, seen.camera, seen.alignment, known)
    bounds = result.bounds if known is None or result.own_bounds is not None else known.bounds
    plot_box(axes, seen.camera, Box.from_model(bounds, seen.alignment))
    residuals = np.where(np.isfinite(seen.residuals), seen.residuals, np.nan)
    plot_keypoints(axes, seen.points_2d, residuals, seen.inliers)
    return axes


def result_html(result: ResultData) -> str:
    """HTML of a result for notebooks."""
    views = "" if len(result.views) == 1 else f" in {len(result.views)} views"
    count = f"{int(result.inliers.sum())} of {len(result.inliers)}{views}"
    rows = [("keypoints", count), ("residuals (rms)", f"{result.rms:.3g} px")]
    rows += _pose_rows(result.alignment.translation, result.stretch, result.std)
    if result.focal == "estimate":
        rows.append(("focal length", f"{result.camera.fx:.4g} px"))
    aspect = result.camera.height / result.camera.width
    note = f"Warning: {'; '.join(result.warnings)}" if result.warnings else ""
    picture = draw_picture(lambda axes: plot_result(result, axes=axes), aspect=aspect)
    return card(f"Result ({result.method})", rows, picture=picture, note=note)


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
