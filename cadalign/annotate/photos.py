"""Photos to annotate: upright pixels, cameras, and masks of objects."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image

from cadalign.arrays import BoolArray
from cadalign.errors import DataError, InputError
from cadalign.geometry.camera import Camera
from cadalign.io.documents import name_file
from cadalign.io.files import guard_reading, list_folder, read_bytes, require_utf8
from cadalign.io.focal import FocalPrior
from cadalign.io.images import open_photo, open_picture, photo_size, read_mask, upright_pixels
from cadalign.io.kinds import PHOTO_ENDINGS

_MASK = re.compile(r"\.mask(-[0-9]+)?\.png$")  # at the end of the name of a mask's file
_SHOWN_AS_IS = {"JPEG": "image/jpeg", "PNG": "image/png", "WEBP": "image/webp"}
_ORIENTATION = 0x0112  # the EXIF tag
_TURNED = range(2, 9)  # its values for photos that are not stored upright
_QUALITY = 95
_LONGEST_CUT = 800  # longest side of the photo for the segmentation [px]
_LEAST_BOX = 4.0  # [px]
_CUT_ROUNDS = 5


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
        """Prior on an unknown focal length: from the EXIF data, or for usual lenses."""
        exif = FocalPrior.from_exif(self.path)
        return exif or FocalPrior.from_size(self.width, self.height)

    def encode(self) -> tuple[str, bytes]:
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
    """List the photos of a folder in natural order of their names, or the given photo."""
    with guard_reading(path):
        in_folder, exists = path.is_dir(), path.exists()
        entries = list_folder(path) if in_folder else []
    if in_folder:
        photos = [p for p in entries if p.suffix.lower() in PHOTO_ENDINGS and p.is_file()]
        stems = {p.stem for p in photos}
        # Leave out the masks that the annotator has written.
        own = [p for p in photos if p.name == (stem := _MASK.sub("", p.name)) or stem not in stems]
        if not own:
            fix = f"file names of photos end in {', '.join(PHOTO_ENDINGS)}"
            raise InputError("there are no photos in this folder", where=str(path), fix=fix)
        return sorted(own, key=lambda p: natural_key(p.name))
    if not exists:
        raise DataError("no such file or folder", where=str(path))
    return [path]


def camera_of(photo: PhotoFile, camera: Camera | None) -> Camera:
    """Return a photo's camera, by default without a focal length; raises DataError for others."""
    if camera is None:
        return Camera.from_size(photo.width, photo.height)
    if (camera.width, camera.height) != (photo.width, photo.height):
        raise DataError(
            f"the photo has {photo.width} x {photo.height} pixels, the camera "
            f"{camera.width} x {camera.height}",
            where=str(photo.path),
            fix="give the camera of this photo",
        )
    with name_file(photo.path):
        if camera.is_wide:
            what = f"the annotator does not support {camera.lens} lenses"
            fix = "undistort the photo, or crop it to a pinhole's view"
            raise InputError(what, where="camera.lens", fix=fix)
    return camera


def natural_key(name: str) -> tuple[tuple[str, int], ...]:
    """Return a key that sorts numbers in names by their values.

    Examples
    --------
    >>> sorted(["10.png", "9.png", "a2.png", "a10.png"], key=natural_key)
    ['9.png', '10.png', 'a2.png', 'a10.png']
    """
    parts = re.findall(r"\d+|\D+", name)
    return tuple(("", int(p)) if p.isdecimal() else (p.casefold(), 0) for p in parts)


@dataclass(frozen=True)
class ObjectMask:
    """A mask: a file, or a drawn mask as the bytes of a PNG file."""

    file: Path | None = None
    sigma: float | None = None  # of its contour [px]
    png: bytes = b""

    @classmethod
    def from_pixels(cls, inside: BoolArray) -> ObjectMask:
        """Make a drawn mask from pixels (h, w)."""
        return cls(png=cv2.imencode(".png", 255 * inside.astype(np.uint8))[1].tobytes())

    def pixels(self, width: int, height: int) -> BoolArray:
        """Return the mask (h, w); raises DataError if its file has another size."""
        if self.file is None:
            with open_picture(io.BytesIO(self.png), len(self.png), where="mask") as image:
                return np.asarray(image) > 0
        mask = read_mask(self.file)
        if mask.shape != (height, width):
            raise DataError(
                f"the mask has {mask.shape[1]} x {mask.shape[0]} pixels, the photo "
                f"{width} x {height}",
                where=str(self.file),
                fix="give a mask of the photo's size",
            )
        return mask


def segment_box(photo: npt.NDArray[np.uint8], corners: npt.NDArray[np.float64]) -> BoolArray:
    """Segment the object in a box of the photo (h, w, 3) by its colours, by GrabCut.

    ``corners`` (2, 2) are opposite corners of the box [px]. Raises InputError if the box is too
    small, fills the photo, or looks like its surroundings.

    Rother, Kolmogorov, Blake, "GrabCut: interactive foreground extraction using iterated graph
    cuts" (2004).
    """
    height, width = photo.shape[:2]
    scale = min(1.0, _LONGEST_CUT / max(width, height))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = cv2.resize(photo, size, interpolation=cv2.INTER_AREA)
    low, high = np.clip(np.sort(corners, axis=0), 0, (width - 1, height - 1))
    if (high - low).min() < _LEAST_BOX:
        raise InputError("the box is too small", where="box", fix="draw it around the object")
    left, top = np.floor(low * scale).astype(int).tolist()
    right, bottom = np.ceil(high * scale).astype(int).tolist()
    labels = np.full(small.shape[:2], cv2.GC_BGD, dtype=np.uint8)
    labels[top : bottom + 1, left : right + 1] = cv2.GC_PR_FGD
    if not (labels == cv2.GC_BGD).any():
        fix = "draw it close around the object"
        raise InputError("the box fills the photo", where="box", fix=fix)
    cv2.setRNGSeed(0)
    bgr = cv2.cvtColor(small, cv2.COLOR_RGB2BGR)
    colors = np.zeros((2, 1, 65))
    whole = (0, 0, 1, 1)  # not used with labels
    cv2.grabCut(bgr, labels, whole, colors[0], colors[1], _CUT_ROUNDS, cv2.GC_INIT_WITH_MASK)
    found = (255 * np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD))).astype(np.uint8)
    if not found.any():
        what = "nothing in the box differs from its surroundings"
        raise InputError(what, where="box", fix="draw it closer around the object")
    return np.asarray(cv2.resize(found, (width, height), interpolation=cv2.INTER_LINEAR) >= 128)
