"""The result of a fitted observation file: its text, its pictures, and the files written of it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cadalign.cli.output import make_folder
from cadalign.errors import InputError

if TYPE_CHECKING:
    from cadalign.arrays import BoolArray, FloatArray
    from cadalign.estimation.result import Result
    from cadalign.estimation.view import View
    from cadalign.io.observation import Observation
    from cadalign.render import OverlayStyle
    from cadalign.render.drawing.color import ByteImage


@dataclass(frozen=True, eq=False)
class FittedFile:
    """Result of a fit of one file, its JSON form, a table, and pictures of each view.

    ``overlays`` are those of the model that were asked for.
    """

    result: Result
    data: dict[str, Any]
    table: str
    pictures: tuple[ByteImage, ...] = ()
    overlays: tuple[ByteImage, ...] = ()

    @property
    def text(self) -> str:
        """The result as JSON text."""
        return json.dumps(self.data, indent=2) + "\n"

    def write(self, out: Path, *, overlay: Path | None = None) -> list[Path]:
        """Write fit.json and the pictures to a folder; returns the pictures' paths.

        The ``overlays`` go to ``overlay``, those of further views beside it.
        """
        from cadalign.io.files import write_text

        make_folder(out)
        write_text(out / "fit.json", self.text)
        paths = _write_pictures(out / "overlay.png", self.pictures)
        return paths if overlay is None else paths + _write_pictures(overlay, self.overlays)


def _write_pictures(path: Path, pictures: tuple[ByteImage, ...]) -> list[Path]:
    """Write the first picture to a path, further ones to NAME_1 and so on; returns their paths."""
    if not pictures:
        return []
    from cadalign.io.images import write_image

    paths = [
        path.with_name(f"{path.stem}_{row}{path.suffix}") if row else path
        for row in range(len(pictures))
    ]
    for each, picture in zip(paths, pictures, strict=True):
        write_image(each, picture)
    return paths


def overlay_style(path: Path, *, mode: Any, opacity: float, has_model: bool) -> OverlayStyle:
    """The style that the options ask for.

    Raises
    ------
    InputError
        If the opacity is out of range, or the observation, read from ``path``, names no model.
    """
    from cadalign.render import OverlayStyle

    if not has_model:
        raise InputError(
            f"{path} names no model to draw",
            where="--overlay",
            fix="give the file's `model` a mesh, or leave out the option",
        )
    try:
        return OverlayStyle(mode=mode, opacity=opacity)
    except InputError as error:
        flag = f"--overlay-{error.where}"
        raise InputError(error.what, where=flag, fix=error.fix) from None


def draw(
    observation: Observation,
    result: Result,
    *,
    views: tuple[View, ...] | None,
    picture: bool,
    style: OverlayStyle | None,
) -> tuple[tuple[ByteImage, ...], tuple[ByteImage, ...]]:
    """Draw the pictures of all views, and their overlays in a style; each photo is read once.

    ``views`` are those that were aligned, None for a stretched model and keypoints alone, whose
    mesh is drawn as a box.

    Raises
    ------
    InputError
        If there is a style, and no mesh.
    DataError
        If a photo or the model cannot be read.
    """
    if not picture and style is None:
        return (), ()
    from cadalign.io.meshes.load import load_mesh
    from cadalign.render.drawing.result_overlay import draw_result, mesh_of, photo_of

    photos = [
        photo_of(image, view.camera)
        for image, view in zip(observation.views, result.views, strict=True)
    ]
    shown = bounds = None
    masks: list[FloatArray | BoolArray | None] = [None]
    if views is not None:
        mesh = shown = mesh_of(observation, result)
        masks = [view.mask_image for view in views]
    else:
        mesh = None if observation.model is None else load_mesh(observation.model)
        bounds = None if mesh is None else mesh.bounds
    pictures = (
        draw_result(image, result, photo=photo, mesh=shown, bounds=bounds, mask=mask, number=number)
        for number, (image, photo, mask) in enumerate(
            zip(observation.views, photos, masks, strict=True)
        )
    )
    drawn = tuple(pictures) if picture else ()
    if style is None:
        return drawn, ()
    if mesh is None:
        raise InputError("no mesh of the object is known", where="--overlay")
    from cadalign.render import Scene, overlay_model

    scene = Scene(mesh)
    overlays = (
        overlay_model(photo, view.camera, scene, view.alignment, style=style)
        for photo, view in zip(photos, result.views, strict=True)
    )
    return drawn, tuple(overlays)
