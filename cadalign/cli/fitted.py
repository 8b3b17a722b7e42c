"""A fitted observation: its result as text, JSON and pictures, and their files."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from cadalign.cli.common import make_folder
from cadalign.errors import InputError
from cadalign.io.documents import written_path
from cadalign.io.files import keeping, write_text

if TYPE_CHECKING:
    from cadalign.arrays import BoolArray, FloatArray
    from cadalign.estimation.result import Result
    from cadalign.estimation.view import View
    from cadalign.io.observation import Observation
    from cadalign.render.drawing.canvas import ByteImage


@dataclass(frozen=True, eq=False)
class FittedFile:
    """Result of a fit of one file, and pictures of each view.

    ``sources`` are the files of the observation, of the learned shape and of a mask alone, which
    fit.json states; ``inputs`` those and what the observation names, which are not written over.
    ``overlays`` are those of the model that were asked for.
    """

    result: Result
    sources: dict[str, Path]
    inputs: tuple[Path, ...]
    pictures: tuple[ByteImage, ...] = ()
    overlays: tuple[ByteImage, ...] = ()

    def text(self, out: Path) -> str:
        """The result as JSON for a folder, which its sources are relative to."""
        sources = {
            name: written_path(path.absolute(), folder=out.absolute())
            for name, path in self.sources.items()
        }
        return json.dumps(self.result.to_dict() | sources, indent=2) + "\n"

    def write(self, out: Path, *, overlay: Path | None = None) -> list[Path]:
        """Write fit.json and the pictures to a folder; returns the pictures' paths.

        The ``overlays`` go to ``overlay``, those of further views beside it.
        """
        make_folder(out)
        with keeping(self.inputs):
            # First what somebody names, which may be refused.
            further = [] if overlay is None else _write_pictures(overlay, self.overlays)
            write_text(out / "fit.json", self.text(out))
            return _write_pictures(out / "overlay.png", self.pictures) + further

    def drawn(
        self,
        observation: Observation,
        *,
        views: tuple[View, ...] | None,
        picture: bool,
        overlay: bool,
    ) -> FittedFile:
        """The same with pictures of all views, and overlays; each photo is read once.

        ``views`` are those that were aligned, None for a stretched model and keypoints alone, whose
        mesh is drawn as a box. Raises InputError for overlays without a mesh, DataError if a photo
        or the model cannot be read.
        """
        if not picture and not overlay:
            return self
        from cadalign.io.meshes.files import mesh_at
        from cadalign.render.drawing.model_overlay import draw_result, mesh_of, photo_of

        result = self.result
        seen = list(zip(observation.views, result.views, strict=True))
        photos = [photo_of(image.image, view.camera) for image, view in seen]
        mesh = shown = bounds = None
        masks: list[FloatArray | BoolArray | None] = [None]
        if views is not None:
            mesh = shown = mesh_of(observation, result)
            masks = [view.mask_image for view in views]
        elif observation.model is not None:
            mesh = mesh_at(observation.model)
            bounds = mesh.bounds
        found = self
        if picture:
            of_views = enumerate(zip(photos, masks, strict=True))
            pictures = (
                draw_result(photo, result, mesh=shown, bounds=bounds, mask=mask, number=number)
                for number, (photo, mask) in of_views
            )
            found = replace(found, pictures=tuple(pictures))
        if not overlay:
            return found
        if mesh is None:
            raise InputError("no mesh of the object is known", where="--overlay")
        from cadalign.render import Scene, overlay_model

        scene = Scene(mesh)
        overlays = (
            overlay_model(photo, view.camera, scene, view.alignment)
            for photo, view in zip(photos, result.views, strict=True)
        )
        return replace(found, overlays=tuple(overlays))


def _picture_paths(path: Path, count: int) -> list[Path]:
    """A path for the first picture, NAME_1 and so on for further ones."""
    further = (path.with_name(f"{path.stem}_{row}{path.suffix}") for row in range(1, count))
    return [path, *further][:count]


def _write_pictures(path: Path, pictures: tuple[ByteImage, ...]) -> list[Path]:
    """Write the first picture to a path, further ones to NAME_1 and so on; returns their paths."""
    if not pictures:
        return []
    from cadalign.io.images import write_image

    paths = _picture_paths(path, len(pictures))
    for each, picture in zip(paths, pictures, strict=True):
        write_image(each, picture)
    return paths
