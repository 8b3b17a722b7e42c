"""Photos to annotate: upright pixels and cameras' intrinsics."""

from __future__ import annotations

import io
import re
from collections.abc import Set
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from PIL import Image

from cadalign.datasets.sfm.colmap import Colmap
from cadalign.errors import DataError, InputError
from cadalign.geometry.camera import Camera, require_perspective
from cadalign.io.documents import in_file
from cadalign.io.files import listed, read_bytes, reading, require_utf8
from cadalign.io.focal import FocalPrior
from cadalign.io.images import PHOTO_ENDINGS, open_photo, photo_size, upright_pixels
from cadalign.io.observation import read_camera as read_camera_file

_MASK = re.compile(r"\.mask(-[0-9]+)?\.png$")  # at the end of the name of a mask's file
_SHOWN_AS_IS = {"JPEG": "image/jpeg", "PNG": "image/png", "WEBP": "image/webp"}
_ORIENTATION = 0x0112  # the EXIF tag
_TURNED = range(2, 9)  # its values for photos that are not stored upright
_QUALITY = 95
_THUMBNAIL = (240, 180)  # [px]


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

    def thumbnail(self) -> bytes:
        """Encode the upright photo as a small JPEG; raises DataError if it is damaged."""
        with open_photo(self.path) as image:
            image.draft("RGB", _THUMBNAIL)
            small = Image.fromarray(upright_pixels(image))
        small.thumbnail(_THUMBNAIL)
        data = io.BytesIO()
        small.save(data, format="JPEG", quality=80)
        return data.getvalue()

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
        own = [p for p in photos if not _is_mask(p, stems)]
        found = sorted(own, key=lambda p: natural_key(p.name))
        if not found:
            raise InputError(
                "there are no photos in this folder",
                where=str(path),
                fix=f"file names of photos end in {', '.join(PHOTO_ENDINGS)}",
            )
        return found
    if not exists:
        raise DataError("no such file or folder", where=str(path))
    return [path]


def _is_mask(path: Path, stems: Set[str]) -> bool:
    """True for a mask of another photo of the folder, as the annotator names them."""
    stem = _MASK.sub("", path.name)
    return stem != path.name and stem in stems


@dataclass(frozen=True)
class FocalChoice:
    """The user's choice of a known focal length, or of one estimated from the pairs."""

    known: bool
    pixels: float | None = None  # as typed [px]; None for the camera's


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics of the camera that took a photo, and their source.

    Without a calibrated camera it has the photo's size and a likely focal length.
    """

    camera: Camera
    calibrated: bool  # True if the focal length was given
    prior: FocalPrior | None = None  # from the photo's EXIF data

    @property
    def likely_focal(self) -> FocalPrior:
        """Prior on an unknown focal length: of the EXIF data, or that of usual lenses."""
        if self.prior is not None:
            return self.prior
        return FocalPrior.of_usual_lenses(self.camera.width, self.camera.height)

    @property
    def note(self) -> str:
        """Source of the focal length, for the page."""
        if self.calibrated or self.prior is None:
            return ""
        return f"The photo's EXIF data give about {self.prior.focal:.0f} px, used as a prior."

    def with_focal(self, choice: FocalChoice) -> Camera:
        """The camera with the focal length that the user typed, if any.

        Where it is estimated, pixels are square, as `cadalign fit` takes them.
        """
        own = self.camera
        if not choice.known:
            return self.to_write(choice).with_focal(choice.pixels or own.fx)
        return own if choice.pixels is None else own.with_focal(choice.pixels)

    def to_write(self, choice: FocalChoice) -> Camera:
        """The camera for an observation file: without a focal length where that is estimated."""
        if choice.known:
            return self.with_focal(choice)
        own = self.camera
        return Camera.without_focal(
            own.width, own.height, cx=own.cx, cy=own.cy, distortion=own.distortion
        )


def read_camera(path: Path, size: tuple[int, int] | None = None) -> Camera:
    """Read a camera as `cadalign.io.read_camera` does, or the first one of a COLMAP model's folder.

    ``size`` is the photos', for a file that holds a calibration matrix alone.
    """
    with reading(path):
        in_folder = path.is_dir()
    if in_folder:
        return Colmap(path)[0].camera
    return read_camera_file(path, size=size)


def intrinsics_of(photo: PhotoFile, camera: Camera | None) -> Intrinsics:
    """Combine a photo's EXIF data with its calibrated camera, which may lack a focal length."""
    if camera is None:
        camera = Camera.without_focal(photo.width, photo.height)
    if (camera.width, camera.height) != (photo.width, photo.height):
        raise DataError(
            f"the photo has {photo.width} x {photo.height} pixels, the camera "
            f"{camera.width} x {camera.height}",
            where=str(photo.path),
            fix="give the camera of this photo",
        )
    with in_file(photo.path):
        require_perspective(camera, "the annotator")
    prior = FocalPrior.from_exif(photo.path)
    if camera.focal_known:
        return Intrinsics(camera, calibrated=True, prior=prior)
    likely = prior or FocalPrior.of_usual_lenses(photo.width, photo.height)
    return Intrinsics(camera.with_focal(likely.focal), calibrated=False, prior=prior)


def natural_key(name: str) -> tuple[tuple[str, int, str], ...]:
    """Key that sorts numbers in names by their values.

    Examples
    --------
    >>> sorted(["10.png", "9.png", "a2.png", "a10.png"], key=natural_key)
    ['9.png', '10.png', 'a2.png', 'a10.png']
    """
    parts = re.findall(r"\d+|\D+", name)
    key = tuple(
        ("", int(part), part) if part.isdecimal() else (part.casefold(), 0, part) for part in parts
    )
    return cast(tuple[tuple[str, int, str], ...], key)
