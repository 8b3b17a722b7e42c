"""Photos to annotate: upright pixels, and the cameras that took them."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from PIL import Image

from cadalign.datasets.sfm.colmap import Colmap
from cadalign.errors import DataError, InputError
from cadalign.estimation.focal import FocalPrior
from cadalign.geometry.camera import Camera, require_perspective
from cadalign.io.documents import in_file
from cadalign.io.files import listed, read_bytes, reading, require_utf8
from cadalign.io.images import PHOTO_ENDINGS, open_photo, photo_size, upright_pixels
from cadalign.io.observation import read_camera as read_camera_file

_MASK = re.compile(r"\.mask(-[0-9]+)?\.png$")  # at the end of the name of a mask's file
_SHOWN_AS_IS = {"JPEG": "image/jpeg", "PNG": "image/png", "WEBP": "image/webp"}
_ORIENTATION = 0x0112  # the EXIF tag
_TURNED = range(2, 9)  # its values for photos that are not stored upright
_QUALITY = 95


@dataclass(frozen=True)
class PhotoFile:
    """A photo with its upright size [px]."""

    path: Path
    width: int
    height: int

    @classmethod
    def open(cls, path: Path) -> PhotoFile:
        """Read a photo's size; raises DataError if it is missing or no photo."""
        require_utf8(path)
        return cls(path, *photo_size(path))

    @cached_property
    def likely_focal(self) -> FocalPrior:
        """Prior on an unknown focal length: of the EXIF data, or that of usual lenses."""
        exif = FocalPrior.from_exif(self.path)
        return exif or FocalPrior.of_usual_lenses(self.width, self.height)

    def encoded(self) -> tuple[str, bytes]:
        """Encode the upright photo for a browser: media type and bytes.

        A file that browsers show upright is passed on unchanged. Raises DataError if the file is
        damaged.
        """
        with open_photo(self.path) as image:
            image.load()
            is_turned = image.getexif().get(_ORIENTATION) in _TURNED
            if not is_turned and image.format in _SHOWN_AS_IS:
                return _SHOWN_AS_IS[image.format], read_bytes(self.path)
            upright = upright_pixels(image)
        data = io.BytesIO()
        Image.fromarray(upright).save(data, format="JPEG", quality=_QUALITY, subsampling=0)
        return "image/jpeg", data.getvalue()


def find_photos(path: Path) -> list[Path]:
    """List the photos of a folder by name, numbers in order, or the given photo."""
    with reading(path):
        in_folder, exists = path.is_dir(), path.exists()
        entries = listed(path) if in_folder else []
    if in_folder:
        photos = [p for p in entries if p.suffix.lower() in PHOTO_ENDINGS and p.is_file()]
        stems = {p.stem for p in photos}
        # Without the masks of photos, as the annotator names them.
        own = [p for p in photos if p.name == (stem := _MASK.sub("", p.name)) or stem not in stems]
        if not own:
            fix = f"file names of photos end in {', '.join(PHOTO_ENDINGS)}"
            raise InputError("there are no photos in this folder", where=str(path), fix=fix)
        return sorted(own, key=lambda p: natural_key(p.name))
    if not exists:
        raise DataError("no such file or folder", where=str(path))
    return [path]


def read_camera(path: Path, size: tuple[int, int] | None = None) -> Camera:
    """Read a camera as `cadalign.io.read_camera` does, or the first one of a COLMAP model's folder.

    ``size`` is the photos', for a file that holds a calibration matrix alone.
    """
    with reading(path):
        in_folder = path.is_dir()
    return Colmap(path)[0].camera if in_folder else read_camera_file(path, size=size)


def camera_of(photo: PhotoFile, camera: Camera | None) -> Camera:
    """The camera that took a photo, by default one without a focal length; raises DataError."""
    if camera is None:
        return Camera.without_focal(photo.width, photo.height)
    if (camera.width, camera.height) != (photo.width, photo.height):
        raise DataError(
            f"the photo has {photo.width} x {photo.height} pixels, the camera "
            f"{camera.width} x {camera.height}",
            where=str(photo.path),
            fix="give the camera of this photo",
        )
    with in_file(photo.path):
        require_perspective(camera, "the annotator")
    return camera


def natural_key(name: str) -> tuple[tuple[str, int], ...]:
    """Key that sorts numbers in names by their values.

    Examples
    --------
    >>> sorted(["10.png", "9.png", "a2.png", "a10.png"], key=natural_key)
    ['9.png', '10.png', 'a2.png', 'a10.png']
    """
    parts = re.findall(r"\d+|\D+", name)
    return tuple(("", int(p)) if p.isdecimal() else (p.casefold(), 0) for p in parts)
