"""Conversion of results: to text, table rows, plots and aligned objects."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from cadalign.errors import InputError
from cadalign.export.aligned_object import AlignedObject, ExportView
from cadalign.geometry.alignment import (
    BOX_FACES,
    NOT_DETERMINED,
    NOT_DETERMINED_ROTATION_DEG,
    bounds_corners,
    deviation_text,
    distance_deviation,
    why_open,
)
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.rotations import quat_wxyz_from_rotation
from cadalign.io.files import as_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def result_text(result: Any) -> str:
    """Summary of a result: pose, stretch, focal length, uncertain quantities, warnings."""
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
        # Keypoints give a reason only if all are observed, and there is no other evidence.
        is_plain = len(result.evidence) < 2 and len(result.points_3d) == len(result.inliers)
        exact = result.points_3d[result.inliers] if is_plain else result.points_3d[:0]
        names = [name + why_open(name, exact, pose) for name in result.uncertain]
        lines.append(f"  uncertain    {', '.join(names)}")
    if [each.kind for each in result.evidence] != ["keypoints"]:
        lines.extend(f"  evidence     {each}" for each in result.evidence)
    lines.extend(f"  warning      {text}" for text in result.warnings)
    return "\n".join(lines)


RESULT_COLUMNS: tuple[tuple[str, type], ...] = (
    *(("status", str), ("reason", str), ("method", str)),
    *(("views", int), ("keypoints", int), ("inliers", int)),
    *((f"q{axis}", float) for axis in "wxyz"),
    *((f"t{axis}", float) for axis in "xyz"),
    *((f"scale_{axis}", float) for axis in "xyz"),
    *(("focal_length", float), ("sigma", float), ("rotation_std_deg", float)),
    *((f"t{axis}_std", float) for axis in "xyz"),
    *((f"scale_{axis}_std", float) for axis in "xyz"),
    *(("focal_length_std", float), ("rms_px", float), ("cost", float)),
    *(("alternatives", int), ("uncertain", str)),
    *(("warning_count", int), ("warning_kinds", str), ("warnings", str)),
)
"""Names and types of the columns of a result in tables."""


def failed_row(reason: str) -> dict[str, Any]:
    """Table row of a failed problem."""
    texts = ("method", "uncertain", "warning_kinds", "warnings")
    return {"status": "failed", "reason": reason, **dict.fromkeys(texts, "")}


def row_of(result: Any) -> dict[str, Any]:
    """Table row of a `cadalign.Result`, with the keys of `RESULT_COLUMNS`."""
    pose, std, warnings = result.alignment, result.std, result.warnings
    sigma: Any = result.sigma
    if sigma is None and result.options is not None:
        sigma = result.options.sigma
    inliers = result.inliers
    row: dict[str, Any] = {
        "status": "ok",
        "reason": "",
        "method": result.method,
        "views": len(result.views),
        "keypoints": len(inliers),
        "inliers": int(inliers.sum()),
        "focal_length": result.camera.fx,
        "sigma": None if sigma is None or np.ndim(sigma) else float(sigma),
        "rms_px": result.rms,
        "cost": result.cost,
        "alternatives": len(result.alternatives),
        "uncertain": "; ".join(result.uncertain),
        "warning_count": len(warnings),
        "warning_kinds": "; ".join(each.kind for each in warnings),
        "warnings": "; ".join(each.text for each in warnings),
    }
    by_axis: dict[str, Any] = {"t{}": pose.translation, "scale_{}": pose.scale}
    if std is not None:
        by_axis |= {"t{}_std": std.translation, "scale_{}_std": std.scale}
        row |= {"rotation_std_deg": std.rotation_deg, "focal_length_std": std.focal}
    for name, values in by_axis.items():
        row |= {name.format(axis): float(each) for axis, each in zip("xyz", values, strict=True)}
    quaternion = quat_wxyz_from_rotation(pose.rotation).tolist()
    row |= {f"q{axis}": value for axis, value in zip("wxyz", quaternion, strict=True)}
    return row


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
    from cadalign.render.overlay import (  # takes time to import
        draw_result,
        drawable_mesh,
        photo_of,
    )

    camera, known = result.views[view].camera, drawable_mesh(result, mesh)
    photo = photo_of(os.fspath(image) if isinstance(image, os.PathLike) else image, camera)
    bounds = None if known is None or result.own_bounds is not None else known.bounds
    picture = draw_result(photo, result, mesh=known, bounds=bounds, number=view)
    if axes is None:
        from matplotlib import pyplot

        axes = pyplot.subplots(figsize=(8, 8 * camera.height / camera.width))[1]
    axes.imshow(picture)
    axes.set_axis_off()
    return axes


def object_of(
    result: Any,
    *,
    mesh: Mesh | str | os.PathLike[str] | None = None,
    photos: Sequence[str | os.PathLike[str] | None] = (),
    name: str = "model",
) -> AlignedObject:
    """Convert a result to an `AlignedObject`, for `export_object`.

    Parameters
    ----------
    result : cadalign.Result
    mesh : Mesh or path, optional
        Mesh of the model; by default the result's. It is warped to an estimated shape, see
        `Result.mesh`. A learned shape without meshes has its box.
    photos : sequence of path or None
        The photos of the views; by default none.
    name : str
        Name of the model.

    Raises
    ------
    InputError
        If the number of photos is not the number of views, or no mesh is known.
    """
    paths = [None if each is None else as_path(each, "photos") for each in photos]
    paths = paths or [None] * len(result.views)
    if len(paths) != len(result.views):
        what = f"{len(paths)}, but the result has {len(result.views)} views"
        raise InputError(what, where="photos", fix="give one or None for each")
    from cadalign.render.overlay import drawable_mesh  # takes time to import
    from cadalign.shapes.model import ShapeModel

    known = drawable_mesh(result, mesh)
    if known is None and isinstance(result.model, ShapeModel) and not result.model.training:
        known = Mesh(bounds_corners(*result.bounds), np.array(BOX_FACES))
    if known is None:
        what = "there is no mesh of the model to write"
        raise InputError(what, where="mesh", fix="give one, or an observation with a `model`")
    views = zip(result.views, paths, strict=True)
    return AlignedObject(
        tuple(ExportView(view.camera, view.alignment, photo) for view, photo in views), known, name
    )
