"""Camera intrinsics of a photo: calibrated, from EXIF data, or a default field of view."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from cadalign.annotate.document import FocalChoice
from cadalign.annotate.photos import Photo
from cadalign.errors import DataError
from cadalign.fitting.focal.prior import FocalPrior
from cadalign.geometry.camera import Camera
from cadalign.io.documents import in_file, read_json
from cadalign.render.views.camera_files import read_camera_views

_DEFAULT_FOV = 60.0  # of a telephone's or a compact camera's lens [degrees]


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics of the camera that took a photo, and their source.

    Without a calibrated camera it has the photo's size and a likely focal length.
    """

    camera: Camera
    calibrated: bool  # True if the focal length was given
    prior: FocalPrior | None = None  # from the photo's EXIF data
    note: str = ""  # source of the focal length, for the page

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
    if not path.is_dir():
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
    if prior is None:
        likely = max(photo.width, photo.height) / 2 / math.tan(math.radians(_DEFAULT_FOV / 2))
        return Intrinsics(camera.with_focal(likely), calibrated=False)
    note = f"The photo's EXIF data give about {prior.focal:.0f} px, used as a prior."
    return Intrinsics(camera.with_focal(prior.focal), calibrated=False, prior=prior, note=note)
