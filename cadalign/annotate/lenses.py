"""What is known of the camera of a photo: from a file, from the photo, or next to nothing."""

from __future__ import annotations

import math
from pathlib import Path

from cadalign.annotate.alignment import Lens
from cadalign.annotate.photos import Photo
from cadalign.errors import CadalignError, DataError
from cadalign.fitting.focal.prior import FocalPrior
from cadalign.geometry.camera import Camera
from cadalign.io.documents import read_json
from cadalign.render.views.camera_files import read_camera_views

_LIKELY_FOV = 60.0  # of a telephone's or a compact camera's lens [degrees]


def read_camera(path: Path) -> Camera:
    """Read a camera in COLMAP's form, or the first one of an Open3D, NeRF or COLMAP file.

    Raises
    ------
    DataError
        If it is missing or none of these.
    """
    if path.is_dir():
        return read_camera_views(path)[0].camera
    data = read_json(path)
    if not isinstance(data, dict) or "params" not in data:
        return read_camera_views(path)[0].camera
    try:
        return Camera.from_dict(data)
    except CadalignError as error:
        raise DataError(error.what, where=f"{path}: {error.where}", fix=error.fix) from None


def lens_of(photo: Photo, camera: Camera | None) -> Lens:
    """The lens of a photo.

    Parameters
    ----------
    photo : Photo
    camera : Camera, optional
        The calibrated camera, if there is one; also one without a focal length.

    Raises
    ------
    DataError
        If the camera's image has another size than the photo.
    """
    if camera is None:
        camera = Camera.without_focal(photo.width, photo.height)
    if (camera.width, camera.height) != (photo.width, photo.height):
        raise DataError(
            f"the photo is {photo.width} x {photo.height}, the camera "
            f"{camera.width} x {camera.height}",
            where=str(photo.path),
            fix="give the camera of this photo",
        )
    prior = FocalPrior.from_exif(photo.path)
    if camera.focal_known:
        return Lens(camera, calibrated=True, prior=prior)
    if prior is None:
        likely = max(photo.width, photo.height) / 2 / math.tan(math.radians(_LIKELY_FOV / 2))
        return Lens(camera.with_focal(likely), calibrated=False)
    note = f"The photo's EXIF data say about {prior.focal:.0f} px, which is taken as a hint."
    return Lens(camera.with_focal(prior.focal), calibrated=False, prior=prior, note=note)
