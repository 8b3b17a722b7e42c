"""Photos to annotate: found, checked, and shown upright."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

from PIL import ImageOps

from cadalign.errors import DataError, InputError
from cadalign.io.images import open_photo

ENDINGS = (".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp")
_SHOWN_AS_IS = {"JPEG": "image/jpeg", "PNG": "image/png", "WEBP": "image/webp"}
_ORIENTATION = 0x0112  # the EXIF tag; 1 is upright
_UPRIGHT = 1
_SIDEWAYS = (5, 6, 7, 8)
_QUALITY = 95


@dataclass(frozen=True)
class Photo:
    """A photo, measured upright: as its EXIF orientation says it is to be shown.

    Parameters
    ----------
    path : Path
    width, height : int
        Size of the upright photo [px].
    orientation : int
        The EXIF orientation, 1 for a photo that is stored upright.
    kind : str
        Pillow's name of the file format.
    """

    path: Path
    width: int
    height: int
    orientation: int
    kind: str

    @classmethod
    def open(cls, path: Path) -> Photo:
        """Read a photo's size and orientation.

        Raises
        ------
        DataError
            If it is missing or not a photo.
        """
        with open_photo(path) as image:
            orientation = image.getexif().get(_ORIENTATION, _UPRIGHT)
            width, height = image.size
            kind = image.format or ""
        if orientation in _SIDEWAYS:
            width, height = height, width
        if orientation not in range(1, 9):  # EXIF that lies
            orientation = _UPRIGHT
        return cls(path, width, height, orientation, kind)

    def encoded(self) -> tuple[str, bytes]:
        """Media type and bytes of the upright photo, for a browser.

        A file that a browser shows upright is passed on as it is, so that no pixel changes.

        Raises
        ------
        DataError
            If it cannot be read to its end.
        """
        with open_photo(self.path) as image:
            image.load()
            if self.orientation == _UPRIGHT and self.kind in _SHOWN_AS_IS:
                return _SHOWN_AS_IS[self.kind], self.path.read_bytes()
            upright = ImageOps.exif_transpose(image).convert("RGB")
        data = io.BytesIO()
        upright.save(data, format="JPEG", quality=_QUALITY, subsampling=0)
        return "image/jpeg", data.getvalue()


def find_photos(path: Path) -> list[Path]:
    """The photos of a folder by name, or the one that a path names.

    Raises
    ------
    DataError
        If there is no such file or folder.
    InputError
        If the folder holds no photos.
    """
    if path.is_dir():
        found = sorted(p for p in path.iterdir() if p.suffix.lower() in ENDINGS and p.is_file())
        if not found:
            raise InputError(
                "there are no photos in this folder",
                where=str(path),
                fix=f"photos end in {', '.join(ENDINGS)}",
            )
        return found
    if not path.exists():
        raise DataError("no such file or folder", where=str(path))
    return [path]
