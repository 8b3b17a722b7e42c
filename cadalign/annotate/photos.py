"""Photos to annotate, upright by their EXIF orientation."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

from PIL import ImageOps

from cadalign.errors import DataError, InputError
from cadalign.io.images import open_photo, photo_size

ENDINGS = (".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp")
_SHOWN_AS_IS = {"JPEG": "image/jpeg", "PNG": "image/png", "WEBP": "image/webp"}
_ORIENTATION = 0x0112  # the EXIF tag
_TURNED = range(2, 9)  # its values for photos that are not stored upright
_QUALITY = 95


@dataclass(frozen=True)
class Photo:
    """A photo with its upright size [px]."""

    path: Path
    width: int
    height: int

    @classmethod
    def open(cls, path: Path) -> Photo:
        """Read a photo's size; raises DataError if it is missing or no photo."""
        return cls(path, *photo_size(path))

    def encoded(self) -> tuple[str, bytes]:
        """Encode the upright photo for a browser: media type and bytes.

        A file that browsers show upright is passed on unchanged. Raises DataError if the file is
        damaged.
        """
        with open_photo(self.path) as image:
            image.load()
            is_turned = image.getexif().get(_ORIENTATION) in _TURNED
            if not is_turned and image.format in _SHOWN_AS_IS:
                return _SHOWN_AS_IS[image.format], self.path.read_bytes()
            upright = ImageOps.exif_transpose(image).convert("RGB")
        data = io.BytesIO()
        upright.save(data, format="JPEG", quality=_QUALITY, subsampling=0)
        return "image/jpeg", data.getvalue()


def find_photos(path: Path) -> list[Path]:
    """List the photos of a folder by name, or the given photo."""
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
