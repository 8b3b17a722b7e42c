"""Results as the aligned objects that `cadalign.export` writes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.export.aligned_object import AlignedObject, ExportView
from cadalign.geometry.mesh import Mesh
from cadalign.io.images import ByteImage

if TYPE_CHECKING:
    from cadalign.estimation.align_result import AlignResult
    from cadalign.estimation.result import FitResult
    from cadalign.estimation.view import View


def object_of_fit(
    result: FitResult,
    *,
    mesh: Mesh | None = None,
    image: Path | str | ByteImage | None = None,
    world_from_cam: FloatArray | None = None,
    name: str = "model",
    metres: float = 1.0,
) -> AlignedObject:
    """The object of a fit; parameters as for `AlignedObject`, ``mesh`` is the model's as given."""
    ids = tuple(range(len(result.points_3d)))
    ahead = result.camera.project_where_ahead(result.alignment.apply(result.points_3d))
    with np.errstate(invalid="ignore"):
        observed = ahead - result.residuals
    kept = np.flatnonzero(np.isfinite(observed).all(axis=1))
    view = ExportView(result.camera, result.alignment, image, observed[kept], tuple(kept.tolist()))
    return AlignedObject(
        (view,),
        result.points_3d,
        ids,
        mesh,
        world_from_cam=world_from_cam,
        name=name,
        metres=metres,
    )


def object_of_align(
    result: AlignResult,
    views: View | Sequence[View],
    *,
    mesh: Mesh | None = None,
    images: Sequence[Path | str | ByteImage | None] = (),
    world_from_cam: FloatArray | None = None,
    name: str = "model",
    metres: float = 1.0,
) -> AlignedObject:
    """The object of an alignment to views.

    Parameters
    ----------
    result : AlignResult
    views : View or sequence of View
        Those of the alignment.
    mesh : Mesh, optional
        As given; it is warped here where the result knows its model, see `AlignResult.mesh`.
    images : sequence
        The photos of the views, as paths or (h, w, 3) uint8.
    world_from_cam, name, metres
        As for `AlignedObject`.

    Raises
    ------
    InputError
        If there are more or fewer views or images than the result has.
    """
    listed = [views] if not isinstance(views, Sequence) else list(views)
    photos = list(images) or [None] * len(result.poses)
    for label, count in (("views", len(listed)), ("images", len(photos))):
        if count != len(result.poses):
            what = f"{count}, but the result has {len(result.poses)} views"
            raise InputError(what, where=label, fix="give those of the alignment")
    shown = tuple(
        ExportView(
            view.camera, pose, photo, np.asarray(view.points_2d).reshape(-1, 2), view.keypoint_ids
        )
        for view, pose, photo in zip(listed, result.poses, photos, strict=True)
    )
    return AlignedObject(
        shown,
        result.points_3d,
        result.ids,
        _warped(result, mesh),
        result.rig_from_model,
        world_from_cam,
        name,
        metres,
    )


def _warped(result: AlignResult, mesh: Mesh | None) -> Mesh | None:
    own = getattr(result.model, "mesh", None)
    return mesh if result.model is None or (mesh is None and own is None) else result.mesh(mesh)
