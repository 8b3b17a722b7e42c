"""Names of an annotator's files, such that no two photos of a folder share one.

The observation of `photo.jpg` is `photo.json`. It is `photo.jpg.json` where the shorter name might
be another file's: photos of one folder differ only in their endings, or the name without its ending
ends like a derived one (`photo.unfinished.jpg`, `chair.keypoints.jpg`, `photo.png.jpg`). An
observation of an earlier session that names the photo is found under either name.
"""

from __future__ import annotations

import hashlib
import os
import unicodedata
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from cadalign.annotate.photos import ENDINGS
from cadalign.datasets.models.model_keypoints import SUFFIX
from cadalign.errors import DataError, InputError
from cadalign.io.documents import path_from, read_json

UNFINISHED = ".unfinished.json"
"""Ending of the file of unfinished pairs."""

_MOST_BYTES = 255  # of a file's name, in the common file systems
_AMBIGUOUS = (UNFINISHED.removesuffix(".json"), SUFFIX.removesuffix(".json"), *ENDINGS)
_OTHER_FOLDER = "give another --observation or --out"


def file_name(stem: str, ending: str) -> str:
    """Append an ending to a stem, of which one too long for a file is cut and marked by a hash."""
    name = stem + ending
    if len(os.fsencode(name)) <= _MOST_BYTES:
        return name
    mark = f"~{hashlib.sha256(os.fsencode(stem)).hexdigest()[:12]}"
    while len(os.fsencode(name)) > _MOST_BYTES:
        stem = stem[:-1]
        name = stem + mark + ending
    return name


def keypoints_file(model: Path, folder: Path) -> Path:
    """Path of a model's keypoints file in a folder."""
    return folder / file_name(model.stem, SUFFIX)


def unfinished_file(observation: Path) -> Path:
    """Path of the unfinished pairs' file beside an observation."""
    return observation.with_name(file_name(observation.stem, UNFINISHED))


def observation_file(photo: Path, folder: Path) -> Path:
    """Path of a photo's observation in a folder: that of an earlier session, or a new one.

    Raises DataError if the files of these names belong to other photos.
    """
    short, full = (folder / file_name(name, ".json") for name in (photo.stem, photo.name))
    named = {path: _named_photo(path) for path in (short, full)}
    for path, other in named.items():
        if other is not None and other.samefile(photo):
            return path
    taken = {path for path, other in named.items() if other is not None}
    if not _has_namesake(photo) and short not in taken:
        is_plain = not _folded(photo.stem).endswith(_AMBIGUOUS)
        if is_plain or _is_observation(short):
            return short
    if full not in taken:
        return full
    raise DataError(
        f"belongs to the photo {named[full]}, not {photo}", where=str(full), fix=_OTHER_FOLDER
    )


def refuse_collisions(written: Iterable[Path], read: Iterable[Path]) -> None:
    """Refuse files to be written that are one, or one that is read, or no files of their own.

    Raises InputError.
    """
    seen = {_key(path) for path in read}
    for path in written:
        if path.exists() and not path.is_file():
            raise InputError("not a regular file", where=str(path), fix=_OTHER_FOLDER)
        if _key(path) in seen:
            raise InputError(
                "would be written twice, or over a file that is read",
                where=str(path),
                fix=f"rename it, or {_OTHER_FOLDER}",
            )
        seen.add(_key(path))


def _key(path: Path) -> Path:
    return path.parent.resolve() / path.name


def _load(path: Path) -> dict[str, Any]:
    """The object of a JSON file; empty if there is none."""
    data: Any = None
    if path.is_file():  # a pipe would be waited for
        with suppress(DataError):
            data = read_json(path)
    return data if isinstance(data, dict) else {}


def _is_observation(path: Path) -> bool:
    return {"camera", "keypoints"} <= _load(path).keys()


def _named_photo(path: Path) -> Path | None:
    """Photo that an observation names, if it is there; None for what is no observation."""
    image = _load(path).get("image") if _is_observation(path) else None
    photo = path_from(image, path.parent) if isinstance(image, str) and image else None
    return photo if photo is not None and os.path.exists(photo) else None


def _has_namesake(photo: Path) -> bool:
    """Find out if another photo of the folder has the same name but for ending and case."""
    try:
        names = os.listdir(photo.parent)
    except OSError:  # a folder whose files can be opened, but not listed
        return False
    return any(
        name != photo.name
        and _folded(Path(name).stem) == _folded(photo.stem)
        and Path(name).suffix.lower() in ENDINGS
        for name in names
    )


def _folded(name: str) -> str:
    """The name as file systems compare it that ignore case and forms of Unicode."""
    return unicodedata.normalize("NFC", name).casefold()
