"""Points for which the lens model is valid."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.geometry.camera import Camera
from cadalign.geometry.pixels import perspective

_STEPS = 24


def within_lens_field(camera: Camera, points_cam: FloatArray) -> npt.NDArray[np.bool_]:
    """Find the points up to which the lens model maps outer points farther out than inner ones.

    A distortion polynomial turns back at some radius and from there on folds far-off directions
    into the image. Points beyond are not seen by the camera, wherever the model puts them.
    For points (n, 3), tell if the camera sees them and if the distorted radius grows all the way
    from the centre to the point, (n,) bool.
    """
    seen = camera.sees(points_cam)
    if camera.is_wide or not camera.distortion:
        return seen
    normalized = perspective(np.where(seen[:, None], points_cam, 1.0))
    share = np.linspace(0, 1, _STEPS + 1)
    path = (normalized[:, None, :] * share[:, None]).reshape(-1, 2)
    pixels = camera.pixels_from_normalized(path).reshape(len(normalized), _STEPS + 1, 2)
    step = np.diff((pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy), axis=1)
    growth = np.einsum("nsk,nk->ns", step, normalized)
    return np.asarray(seen & (growth >= 0).all(axis=1))
