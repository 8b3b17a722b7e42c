"""`cadalign observe --every`: an observation of every object of every photo of a file."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.progress import track

from cadalign.cli.output import make_folder, new_console
from cadalign.errors import CadalignError, InputError

if TYPE_CHECKING:
    from cadalign.cli.observe import Observe
    from cadalign.datasets import ImageKeypoints, ModelKeypoints


def observe_all(command: Observe, objects: Sequence[ImageKeypoints], model: ModelKeypoints) -> int:
    """Write an observation of each object; returns the exit code, 3 where some are left out."""
    for name in ("object", "mask", "depth"):
        if getattr(command, name) is not None:
            raise InputError("is for one photo", where=f"--{name}", fix="leave out --every")
    if command.image is not None and not command.image.is_dir():
        what = f"{command.image} is not a folder of photos"
        raise InputError(what, where="--image", fix="give the photos' folder, or leave out --every")
    folder = command.out or command.keypoints.with_name(f"{command.keypoints.stem}_observations")
    make_folder(folder)
    console = new_console()
    failed = 0
    shown = track(
        list(zip(objects, _names(objects), strict=True)),
        "observing",
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )
    for found, name in shown:
        try:
            photo = _photo(found, command.image)
            command.observe(found, model, photo, folder / f"{name}.json")
        except CadalignError as error:
            failed += 1
            console.print(f"left out: {name}: {error}", markup=False)
    text = f"{len(objects) - failed} of {len(objects)} objects: {folder}"
    new_console(stderr=False).print(text, markup=False)
    if failed == len(objects):
        return 1
    return 3 if failed else 0


def _photo(found: ImageKeypoints, folder: Path | None) -> Path | None:
    """The photo of an object in a folder, if it is there."""
    if folder is None or found.image is None:
        return None
    path = folder / Path(found.image).name
    return path if path.exists() else None


def _names(objects: Sequence[ImageKeypoints]) -> list[str]:
    """File names of objects: the photo's, numbered where it has several."""
    stems = [re.sub(r"[^\w.-]+", "_", Path(found.image or "").stem) or "photo" for found in objects]
    counts, seen = Counter(stems), Counter[str]()
    names = []
    for stem in stems:
        names.append(stem if counts[stem] == 1 else f"{stem}_{seen[stem]}")
        seen[stem] += 1
    return names
