"""Photos to annotate, upright by their EXIF orientation."""

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
    """A photo with its upright size.

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
        """Read a photo's size and orientation; raises DataError if it is missing or no photo."""
        with open_photo(path) as image:
            orientation = image.getexif().get(_ORIENTATION, _UPRIGHT)
            width, height = image.size
            kind = image.format or ""
        if orientation in _SIDEWAYS:
            width, height = height, width
        if orientation not in range(1, 9):  # invalid EXIF data
            orientation = _UPRIGHT
        return cls(path, width, height, orientation, kind)

    def encoded(self) -> tuple[str, bytes]:
        """Encode the upright photo for a browser: media type and bytes.

        A file that browsers show upright is passed on unchanged.

        Raises
        ------
        DataError
            If the file is damaged.
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
    """List the photos of a folder by name, or the given photo.

    Raises
    ------
    DataError
        If the path does not exist.
    InputError
        If the folder holds no photos.
    """
    if path.is_dir():
        found = sorted(p for p in path.iterdir() if p.suffix.lower() in ENDINGS and p.is_file())
        if not found:
            raise InputError(
                "there are no photos in this folder",
                where=str(path),
                fix=f"file names of photos end in {', '.join(ENDINGS)}",
            )
        return found
    if not path.exists():
        raise DataError("no such file or folder", where=str(path))
    return [path]
