"""A fitted observation: its result as text, JSON and pictures, and their files."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cadalign.cli.common import make_folder
from cadalign.errors import DataError, InputError
from cadalign.io.documents import read_json, written_path
from cadalign.io.files import finite, keeping, remove_earlier, write_text

if TYPE_CHECKING:
    from cadalign.arrays import BoolArray, FloatArray
    from cadalign.estimation.result import Result
    from cadalign.estimation.uncertainty.summary import Contribution, Uncertainty
    from cadalign.estimation.view import View
    from cadalign.io.observation import Observation
    from cadalign.render import OverlayStyle
    from cadalign.render.drawing.canvas import ByteImage

_HEADS = ("standard deviations", "rotation", "position", "x", "y", "z", "focal length")


@dataclass(frozen=True, eq=False)
class FittedFile:
    """Result of a fit of one file, and pictures of each view.

    ``sources`` are the files of the observation, of the learned shape and of a mask alone, which
    fit.json states; ``inputs`` those and what the observation names, which are not written over.
    ``overlays`` are those of the model that were asked for. ``is_tabulated`` adds the contributions
    of the pieces of evidence.
    """

    result: Result
    sources: dict[str, Path]
    is_tabulated: bool
    inputs: tuple[Path, ...]
    pictures: tuple[ByteImage, ...] = ()
    overlays: tuple[ByteImage, ...] = ()

    @property
    def table(self) -> str:
        """The contributions as text; empty without any."""
        return tabulate_contributions(self.result) if self.is_tabulated else ""

    def text(self, out: Path) -> str:
        """The result as JSON for a folder, which its sources are relative to."""
        sources = {
            name: written_path(path.absolute(), folder=out.absolute())
            for name, path in self.sources.items()
        }
        added = list_contributions(self.result) if self.is_tabulated else {}
        return json.dumps(self.result.to_dict() | added | sources, indent=2) + "\n"

    def write(self, out: Path, *, overlay: Path | None = None) -> list[Path]:
        """Write fit.json and the pictures to a folder; returns the pictures' paths.

        The ``overlays`` go to ``overlay``, those of further views beside it. Pictures of an earlier
        fit are removed.
        """
        make_folder(out)
        earlier = {path.absolute() for path in _written_files(out)}
        with keeping(self.inputs):
            # First what somebody names, which may be refused.
            further = [] if overlay is None else _write_pictures(overlay, self.overlays)
            write_text(out / "fit.json", self.text(out))
            written = _write_pictures(out / "overlay.png", self.pictures) + further
            paths = (*written, out / "fit.json")
            remove_earlier(out, earlier.difference(path.absolute() for path in paths))
            return written

    def drawn(
        self,
        observation: Observation,
        *,
        views: tuple[View, ...] | None,
        picture: bool,
        style: OverlayStyle | None,
    ) -> FittedFile:
        """The same with pictures of all views, and overlays in a style; each photo is read once.

        ``views`` are those that were aligned, None for a stretched model and keypoints alone, whose
        mesh is drawn as a box. Raises InputError if there is a style and no mesh, DataError if a
        photo or the model cannot be read.
        """
        if not picture and style is None:
            return self
        from cadalign.io.meshes.files import load_mesh
        from cadalign.render.drawing.model_overlay import draw_result, mesh_of, photo_of

        result = self.result
        seen = list(zip(observation.views, result.views, strict=True))
        photos = [photo_of(image, view.camera) for image, view in seen]
        mesh = shown = bounds = None
        masks: list[FloatArray | BoolArray | None] = [None]
        if views is not None:
            mesh = shown = mesh_of(observation, result)
            masks = [view.mask_image for view in views]
        elif observation.model is not None:
            mesh = load_mesh(observation.model)
            bounds = mesh.bounds
        found = self
        if picture:
            of_views = enumerate(zip(observation.views, photos, masks, strict=True))
            pictures = (
                draw_result(
                    image, result, photo=photo, mesh=shown, bounds=bounds, mask=mask, number=number
                )
                for number, (image, photo, mask) in of_views
            )
            found = replace(found, pictures=tuple(pictures))
        if style is None:
            return found
        if mesh is None:
            raise InputError("no mesh of the object is known", where="--overlay")
        from cadalign.render import Scene, overlay_model

        scene = Scene(mesh)
        overlays = (
            overlay_model(photo, view.camera, scene, view.alignment, style=style)
            for photo, view in zip(photos, result.views, strict=True)
        )
        return replace(found, overlays=tuple(overlays))


def _written_files(folder: Path) -> list[Path]:
    """The files that a fit wrote to a folder, by its fit.json: this, and the pictures."""
    path = folder / "fit.json"
    found: Any = None
    with suppress(DataError):
        found = read_json(path)
    views = found.get("views") if isinstance(found, dict) else None
    if not isinstance(views, list) or not views:
        return []
    return [path, *_picture_paths(folder / "overlay.png", len(views))]


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


def tabulate_contributions(result: Result) -> str:
    """Table of standard deviations with all evidence and without each piece; empty for one piece.

    Rotation [degrees], position [units of the translation], lengths along x, y, z [%] and, where
    it is estimated, the focal length [%].
    """
    pieces = result.contributions()
    if len(pieces) < 2 or result.std is None:
        return ""
    rows: list[tuple[str, ...]] = [_HEADS, ("with all evidence", *_cells(result.std))]
    several = len(result.views) > 1
    rows += [(f"without {_label(piece, several)}", *_cells(piece.without)) for piece in pieces]
    if result.focal == "known":
        rows = [row[:-1] for row in rows]
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = [
        "  ".join(
            [row[0].ljust(widths[0])]
            + [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
        )
        for row in rows
    ]
    return "\n" + "\n".join(f"  {line}" for line in lines)


def list_contributions(result: Result) -> dict[str, Any]:
    """The same for JSON, as ``contributions``; null for what is not determined."""
    pieces = result.contributions()
    if len(pieces) < 2:
        return {}
    return {
        "contributions": [
            {
                "kind": piece.kind,
                "view": piece.view,
                "name": piece.name,
                "std_without": finite(asdict(piece.without)),
            }
            for piece in pieces
        ]
    }


def _label(piece: Contribution, several: bool) -> str:
    """The kind of a piece and, of several views, the one in the file's ``views``."""
    return (
        f"{piece.kind} of views[{piece.view}]" if several and piece.view is not None else piece.kind
    )


def _cells(std: Uncertainty) -> tuple[str, ...]:
    position = float(np.linalg.norm(std.translation))
    lengths = [_text(100 * each, " %") for each in (*std.scale, std.focal)]
    return _text(std.rotation_deg, " deg"), _text(position, ""), *lengths


def _text(value: float, unit: str) -> str:
    return f"{value:.2g}{unit}" if np.isfinite(value) else "unknown"
