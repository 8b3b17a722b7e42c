"""A fitted observation as text, JSON and pictures."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cadalign.errors import InputError
from cadalign.io.documents import written_path

if TYPE_CHECKING:
    from cadalign.estimation.result import Result
    from cadalign.estimation.view import View
    from cadalign.io.observation import Observation
    from cadalign.render.drawing.canvas import ByteImage


def fit_text(result: Result, sources: Mapping[str, Path], out: Path) -> str:
    """The result as JSON for a folder, which the files that it states are relative to."""
    stated = {
        name: written_path(path.absolute(), folder=out.absolute()) for name, path in sources.items()
    }
    return json.dumps(result.to_dict() | stated, indent=2) + "\n"


def drawn(
    observation: Observation,
    result: Result,
    views: Sequence[View] | None,
    *,
    picture: bool,
    overlay: bool,
) -> tuple[list[ByteImage], list[ByteImage]]:
    """Pictures of all views, and the model over their photos; each photo is read once.

    ``views`` are those that were aligned, None for a stretched model and keypoints alone, whose
    mesh is drawn as a box. Raises InputError for overlays without a mesh, DataError if a photo or
    the model cannot be read.
    """
    if not picture and not overlay:
        return [], []
    from cadalign.render.drawing.model_overlay import draw_result, mesh_of, photo_of

    seen = list(zip(observation.views, result.views, strict=True))
    photos = [photo_of(image.image, view.camera) for image, view in seen]
    mesh = mesh_of(observation, result)
    masks: list[Any] = [None] if views is None else [view.mask_image for view in views]
    shown = mesh if views is not None else None
    bounds = mesh.bounds if views is None and mesh is not None else None
    pictures = [
        draw_result(photo, result, mesh=shown, bounds=bounds, mask=mask, number=number)
        for number, (photo, mask) in enumerate(zip(photos, masks, strict=True))
        if picture
    ]
    if not overlay:
        return pictures, []
    if mesh is None:
        raise InputError("no mesh of the object is known", where="--overlay")
    from cadalign.render import Scene, overlay_model

    scene = Scene(mesh)
    return pictures, [
        overlay_model(photo, view.camera, scene, view.alignment)
        for photo, (_, view) in zip(photos, seen, strict=True)
    ]


def write_pictures(path: Path, pictures: Sequence[ByteImage]) -> list[Path]:
    """Write the first picture to a path, further ones to NAME_1 and so on; returns their paths."""
    if not pictures:
        return []
    from cadalign.io.images import write_image

    further = (path.with_stem(f"{path.stem}_{row}") for row in range(1, len(pictures)))
    paths = [path, *further]
    for each, picture in zip(paths, pictures, strict=True):
        write_image(each, picture)
    return paths
