"""Names of an annotator's files, such that no two photos of a folder share one, and their lock.

The observation of `photo.jpg` is `photo.json`. It is `photo.jpg.json` where the shorter name might
be another file's: photos of one folder differ only in their endings, or the name without its ending
ends like a derived one (`chair.keypoints.jpg`, `photo.png.jpg`). An observation of an earlier
session that names the photo is found under either name.
"""

from __future__ import annotations

import hashlib
import os
import unicodedata
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

from cadalign.datasets.models.model_keypoints import SUFFIX
from cadalign.errors import DataError, InputError
from cadalign.io.documents import path_from, read_json
from cadalign.io.files import checksum, locked, read_bytes
from cadalign.io.images import PHOTO_ENDINGS

_MOST_BYTES = 255  # of a file's name, in the common file systems
_AMBIGUOUS = (SUFFIX.removesuffix(".json"), *PHOTO_ENDINGS)
_OTHER_FOLDER = "give another --observation or --out"
_LOCK = ".annotate-lock"


@contextmanager
def only_annotator(folder: Path) -> Iterator[None]:
    """Keep other annotators off a folder; a killed process holds no lock. Raises DataError."""
    what = "another annotator has this folder open"
    with locked(folder / _LOCK, what, fix=f"go on in its page or end it, or {_OTHER_FOLDER}"):
        yield


@dataclass
class LastContent:
    """The content of a file as it was last read or written: who changes it is no annotator."""

    _known: bytes | None = None  # its checksum; None without a file

    def note(self, path: Path) -> None:
        """Remember the content of the file, or that there is none."""
        self._known = _content(path)

    def refuse_changed(self, path: Path) -> None:
        """Raise DataError if the file has other content by now."""
        if _content(path) not in (None, self._known):
            what = "was changed by another program since the annotator read or wrote it"
            fix = "rename it to have all marks saved, or start anew to go on with that file"
            raise DataError(what, where=str(path), fix=fix)


def _content(path: Path) -> bytes | None:
    return checksum(read_bytes(path)) if path.exists() else None


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


def free_mask_file(observation: Path) -> Path:
    """Path of a new mask beside an observation: `.mask.png`, `.mask-2.png` and so on."""
    endings = (f".mask{'' if number == 1 else f'-{number}'}.png" for number in count(1))
    paths = (observation.with_name(file_name(observation.stem, ending)) for ending in endings)
    return next(path for path in paths if not path.exists())


def observation_file(photo: Path, folder: Path, others: Iterable[Path] = ()) -> Path:
    """Path of a photo's observation in a folder: that of an earlier session, or a new one.

    ``others`` are files of other photos that may not be there yet. Raises DataError if the files of
    these names belong to other photos.
    """
    short, full = (folder / file_name(name, ".json") for name in (photo.stem, photo.name))
    named = {path: _named_photos(path) for path in (short, full)}
    for path, found in named.items():
        if any(other.samefile(photo) for other in found):
            return path
    taken = {path for path, found in named.items() if found} | set(others)
    is_plain = not _folded(photo.stem).endswith(_AMBIGUOUS) or bool(_observation(short))
    if is_plain and short not in taken and not _has_namesake(photo):
        return short
    if full not in taken:
        return full
    owner = f"the photo {named[full][0]}" if named[full] else "another photo of its name"
    raise DataError(f"belongs to {owner}, not {photo}", where=str(full), fix=_OTHER_FOLDER)


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


def _observation(path: Path) -> dict[str, Any]:
    """The fields of an observation file; empty where there is none."""
    data: Any = None
    if path.is_file():  # a pipe would be waited for
        with suppress(DataError):
            data = read_json(path)
    if not isinstance(data, dict):
        return {}
    is_one = {"camera", "keypoints"} <= data.keys() or isinstance(data.get("views"), list)
    return data if is_one else {}


def _named_photos(path: Path) -> list[Path]:
    """Photos that an observation names and that are there."""
    data = _observation(path)
    views = data.get("views", [data])
    images = [view.get("image") for view in views if isinstance(view, dict)]
    named = [path_from(each, path.parent) for each in images if isinstance(each, str) and each]
    return [photo for photo in named if os.path.exists(photo)]


def _has_namesake(photo: Path) -> bool:
    """Find out if another photo of the folder has the same name but for ending and case."""
    try:
        names = os.listdir(photo.parent)
    except OSError:  # a folder whose files can be opened, but not listed
        return False
    return any(
        name != photo.name
        and _folded(Path(name).stem) == _folded(photo.stem)
        and Path(name).suffix.lower() in PHOTO_ENDINGS
        for name in names
    )


def _folded(name: str) -> str:
    """The name as file systems compare it that ignore case and forms of Unicode."""
    return unicodedata.normalize("NFC", name).casefold()
