"""Photos to annotate, upright by their EXIF orientation, and their cameras' intrinsics."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from pathlib import Path

from PIL import ImageOps

from cadalign.annotate.document import FocalChoice
from cadalign.errors import DataError, InputError
from cadalign.fitting.focal.prior import FocalPrior
from cadalign.geometry.camera import Camera
from cadalign.io.documents import in_file, read_json
from cadalign.io.files import reading
from cadalign.io.images import open_photo, photo_size
from cadalign.render.views.camera_files import read_camera_views

ENDINGS = (".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp")
_SHOWN_AS_IS = {"JPEG": "image/jpeg", "PNG": "image/png", "WEBP": "image/webp"}
_ORIENTATION = 0x0112  # the EXIF tag
_TURNED = range(2, 9)  # its values for photos that are not stored upright
_QUALITY = 95
_DEFAULT_FOV = 60.0  # of a telephone's or a compact camera's lens [degrees]


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
    with reading(path):
        in_folder, exists = path.is_dir(), path.exists()
        entries = list(path.iterdir()) if in_folder else []
    if in_folder:
        found = sorted(p for p in entries if p.suffix.lower() in ENDINGS and p.is_file())
        if not found:
            raise InputError(
                "there are no photos in this folder",
                where=str(path),
                fix=f"file names of photos end in {', '.join(ENDINGS)}",
            )
        return found
    if not exists:
        raise DataError("no such file or folder", where=str(path))
    return [path]


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics of the camera that took a photo, and their source.

    Without a calibrated camera it has the photo's size and a likely focal length.
    """

    camera: Camera
    calibrated: bool  # True if the focal length was given
    prior: FocalPrior | None = None  # from the photo's EXIF data

    @property
    def note(self) -> str:
        """Source of the focal length, for the page."""
        if self.calibrated or self.prior is None:
            return ""
        return f"The photo's EXIF data give about {self.prior.focal:.0f} px, used as a prior."

    def with_focal(self, choice: FocalChoice) -> Camera:
        """The camera with the focal length that the user typed, if any."""
        return self.camera if choice.pixels is None else self.camera.with_focal(choice.pixels)

    def to_write(self, choice: FocalChoice) -> Camera:
        """The camera for an observation file: without a focal length where that is estimated."""
        if choice.known:
            return self.with_focal(choice)
        camera = self.camera
        return Camera.without_focal(
            camera.width, camera.height, cx=camera.cx, cy=camera.cy, distortion=camera.distortion
        )


def read_camera(path: Path) -> Camera:
    """Read a camera in COLMAP's form, or the first one of an Open3D, NeRF or COLMAP file."""
    with reading(path):
        in_folder = path.is_dir()
    if not in_folder:
        data = read_json(path)
        if isinstance(data, dict) and "params" in data:
            with in_file(path):
                return Camera.from_dict(data)
    return read_camera_views(path)[0].camera


def intrinsics_of(photo: Photo, camera: Camera | None) -> Intrinsics:
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
    prior = FocalPrior.from_exif(photo.path)
    if camera.focal_known:
        return Intrinsics(camera, calibrated=True, prior=prior)
    default = max(photo.width, photo.height) / 2 / math.tan(math.radians(_DEFAULT_FOV / 2))
    likely = default if prior is None else prior.focal
    return Intrinsics(camera.with_focal(likely), calibrated=False, prior=prior)
