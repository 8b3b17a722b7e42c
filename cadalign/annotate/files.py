"""Files of an annotator: their options and names, their lock, and changes by other programs.

The observation of `photo.jpg` is `photo.json`, or `photo.jpg.json` if another photo has the shorter
name. An observation of an earlier session is found under either name.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from cadalign.datasets.model_keypoints import SUFFIX
from cadalign.errors import DataError, InputError
from cadalign.io.documents import path_from, read_json
from cadalign.io.files import checksum, hold_lock, read_bytes
from cadalign.io.pretrained import category_of

logger = logging.getLogger("cadalign")

_MOST_BYTES = 255  # of a file's name, in the common file systems
_OTHER_FOLDER = "give another --observation or --out"
_LOCK = ".annotate-lock"


@dataclass(frozen=True, kw_only=True)
class SessionOptions:
    """Options of a session: photos, model, their files, and the object's shape."""

    image: Path
    """A photo, or a folder of photos."""
    model: Path | None = None
    """CAD model; without it, the keypoints of the shape are marked."""
    observation: Path | None = None
    """Observation file of a single photo, by default beside the photo. An existing file is
    continued."""
    out: Path | None = None
    """Folder for the observation files; by default the folder of the photos."""
    camera: Path | None = None
    """Camera calibration file for photos without an observation file: a 3 x 3 matrix K as text, or
    JSON with COLMAP's fields. Without a camera, the focal length is estimated."""
    focal: float | None = None
    """Focal length of photos without an observation file [px]; overrides the camera file."""
    keypoints: Path | None = None
    """The model's keypoint file; by default model.keypoints.json beside the model."""
    up_axis: Literal["x", "y", "z"] | None = None
    """The model's up axis, for its view and for gravity; by default the observation file's axis, or
    y."""
    shape: Path | None = None
    """Category of a shape that comes with cadalign, such as chair, or shape file: estimate the
    object's own shape within its category. Only keypoints with a semantic id or name of the shape
    count."""


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Lock a folder until this process ends; raises DataError if another annotator holds it."""
    what = "another annotator has this folder open"
    with hold_lock(folder / _LOCK, what, fix=f"use or close its page, or {_OTHER_FOLDER}"):
        yield


@dataclass
class LastContent:
    """Content of a file when it was last read or written, to detect changes by other programs."""

    _known: bytes | None = None  # checksum; None without a file

    def note(self, path: Path) -> None:
        """Remember the content of the file, or that there is none."""
        self._known = _content(path)

    def refuse_changed(self, path: Path) -> None:
        """Raise DataError if the content of the file has changed since."""
        if _content(path) not in (None, self._known):
            what = "was changed by another program since the annotator read or wrote it"
            fix = "rename it to save the marks of this session, or restart to go on from it"
            raise DataError(what, where=str(path), fix=fix)


def _content(path: Path) -> bytes | None:
    return checksum(read_bytes(path)) if path.exists() else None


def keypoints_file(model: Path, folder: Path) -> Path:
    """Path of a model's keypoints file in a folder."""
    return folder / f"{model.stem}{SUFFIX}"


def observation_file(photo: Path, folder: Path, others: Iterable[Path] = ()) -> Path:
    """Return the path of a photo's observation in a folder, from an earlier session or new.

    ``others`` are the files of other photos, which need not exist yet. Raises DataError if both
    names belong to other photos.
    """
    short, full = folder / f"{photo.stem}.json", folder / f"{photo.name}.json"
    owners = {path: _named_photos(path) for path in (short, full)}
    for path, named in owners.items():
        if any(other.samefile(photo) for other in named):
            return path
    taken = {_key(path) for path in others}
    for path, named in owners.items():
        if _key(path) not in taken and not named:
            return path
    what = f"{full.name} belongs to another photo, not {photo}"
    raise DataError(what, where=str(folder), fix=_OTHER_FOLDER)


def refuse_collisions(written: Iterable[Path], read: Iterable[Path]) -> None:
    """Raise InputError if two files to write are the same, or one is also read.

    Also raises it for names that are too long, and for paths that are not regular files.
    """
    seen = {_key(path) for path in read}
    for path in written:
        if len(os.fsencode(path.name)) > _MOST_BYTES:
            fix = "rename the photo or model, or give --observation"
            raise InputError("the name is too long for a file", where=str(path), fix=fix)
        if path.exists() and not path.is_file():
            raise InputError("not a regular file", where=str(path), fix=_OTHER_FOLDER)
        if _key(path) in seen:
            what = "would be written twice, or over a file that is read"
            raise InputError(what, where=str(path), fix=f"rename it, or {_OTHER_FOLDER}")
        seen.add(_key(path))


def refuse_other_source(
    kind: Literal["model", "shape"], named: Path | None, own: Path | None, *, where: Path
) -> None:
    """Raise DataError if a file names another model or shape than the session's ``own``.

    If the named one no longer exists, it counts as renamed, and a warning is logged.
    """
    if named is None or (own is not None and named.resolve() == own.resolve()):
        return
    if own is not None and not named.exists():
        message = "%s: its %s %s no longer exists, %s is used instead"
        logger.warning(message, where, kind, named, category_of(own) or own)
        return
    name, *others = [category_of(each) or each.resolve() for each in (named, own) if each]
    what = f"belongs to the {kind} {name}" + "".join(f", not {other}" for other in others)
    raise DataError(what, where=str(where), fix=f"give that {kind}, or {_OTHER_FOLDER}")


def refuse_other_photo(named: Path | None, photo: Path, *, where: Path) -> None:
    """Raise DataError for an observation of another photo; a missing photo counts as renamed."""
    if named is not None and named.exists() and not named.samefile(photo):
        what = f"belongs to the photo {named.name}, not {photo.name}"
        fix = "give another --observation, or correct the field image in this one"
        raise DataError(what, where=str(where), fix=fix)


def _key(path: Path) -> str:
    """The path in the form that file systems compare if they ignore case."""
    return str(path.parent.resolve() / path.name).casefold()


def _named_photos(path: Path) -> list[Path]:
    """The existing photos that an observation names; none if the file is no observation."""
    data: Any = None
    if os.path.isfile(path):  # reading a pipe would block
        with suppress(DataError):
            data = read_json(path)
    if not isinstance(data, dict):
        return []
    views = data["views"] if isinstance(data.get("views"), list) else [data]
    images = [view.get("image") for view in views if isinstance(view, dict)]
    named = [path_from(each, path.parent) for each in images if isinstance(each, str) and each]
    return [photo for photo in named if os.path.exists(photo)]
