"""Keypoints that a camera sees, by rays to the keypoints themselves; no picture is drawn."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, as_points
from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.projection import model_rays
from cadalign.render.scene import Scene
from cadalign.render.views.lens_field import within_lens_field

# The centre, then four around it: keypoints like to sit on corners and edges, where a ray to the
# point itself may just graze the surface beside it.
_RAY_OFFSETS = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], dtype=float)


def visible_keypoints(
    scene: Scene,
    points_3d: npt.ArrayLike,
    camera: Camera,
    cam_from_model: Alignment,
    *,
    tolerance: float = 2e-3,
) -> npt.NDArray[np.bool_]:
    """Say which keypoints are inside the image, before the camera, and not hidden by the object.

    Five rays go to each keypoint: to the point itself and to four places beside it, as far off as
    the tolerance. The keypoint is hidden if all of them meet the surface before they get there.

    Parameters
    ----------
    scene : Scene
        The object.
    points_3d : (k, 3) float
        Keypoints in model coordinates, on the surface or near it.
    camera : Camera
    cam_from_model : Alignment
    tolerance : float
        How far beneath the surface a keypoint may lie, along the ray, to count as lying on it; in
        diagonals of the (stretched) model's bounding box. Parts thinner than this hide nothing
        that lies on their back.

    Returns
    -------
    (k,) bool

    Raises
    ------
    InputError
        If the points are not (k, 3) finite numbers or the tolerance is not positive.

    Examples
    --------
    >>> from cadalign import Mesh
    >>> plate = Scene(Mesh([[-1, -1, 0], [1, -1, 0], [0, 2, 0]], [[0, 1, 2]]))
    >>> camera = Camera.from_fov(640, 480, fov_x=60.0)
    >>> pose = Alignment(np.eye(3), [0, 0, 4], [1, 1, 1])
    >>> visible_keypoints(plate, [[0, 0, 0], [0, 0, 0.5], [9, 0, 0]], camera, pose).tolist()
    [True, False, False]
    """
    points = as_points(points_3d, name="points_3d", dimension=3)
    if not (np.isfinite(tolerance) and tolerance > 0):
        raise InputError(f"{tolerance!r} is not positive", where="tolerance")
    in_camera = cam_from_model.apply(points)
    visible = seen_in_image(camera, in_camera)
    chosen = np.flatnonzero(visible)
    if not len(chosen):
        return visible
    slack = tolerance * scene.stretched_diagonal(cam_from_model)
    targets = in_camera[chosen, None] + slack * _beside(in_camera[chosen])
    # In the camera frame a ray ends at its target; in the model frame its parameter is the same.
    origin, model_from_ray = model_rays(cam_from_model)
    _, distance = scene.caster.first_hits(origin, targets.reshape(-1, 3) @ model_from_ray.T)
    reach = 1 - slack / np.linalg.norm(targets, axis=2)
    visible[chosen] = (distance.reshape(reach.shape) >= reach).any(axis=1)
    return visible


def seen_in_image(camera: Camera, points_cam: FloatArray) -> npt.NDArray[np.bool_]:
    """Say which camera-frame points (k, 3) lie before the camera and inside its image; (k,)."""
    seen = within_lens_field(camera, points_cam)
    seen[seen] = camera.contains(camera.pixels_of_rays(points_cam[seen]))
    return seen


def _beside(points_cam: FloatArray) -> FloatArray:
    """Offsets across the line of sight, of length 0 or 1, (k, 5, 3)."""
    sight = points_cam / np.linalg.norm(points_cam, axis=1, keepdims=True)
    across = np.column_stack([sight[:, 2], np.zeros(len(sight)), -sight[:, 0]])
    across[np.abs(sight[:, 1]) > 0.99] = (1.0, 0.0, 0.0)  # seen by wide lenses alone
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    upright = np.cross(sight, across)
    axes = np.stack([across, upright], axis=1)
    return np.asarray(np.einsum("ra,kax->krx", _RAY_OFFSETS, axes))


def silhouette_iou(*, est: npt.ArrayLike, gt: npt.ArrayLike) -> float:
    """Intersection over union of the predicted and the observed object's pixels.

    Parameters
    ----------
    est, gt : (h, w) bool
        Where each is, for example `Geometry.mask`; of numbers, what is above half of the largest
        possible value (1 for floats, 255 for bytes) counts, so that opacities will do.

    Returns
    -------
    float
        From 0 to 1; NaN where neither is anywhere.

    Raises
    ------
    InputError
        If they are not images of one size.

    Examples
    --------
    >>> silhouette_iou(est=[[True, True, False]], gt=[[False, True, True]])
    0.3333333333333333
    """
    one, other = _as_mask(est, "est"), _as_mask(gt, "gt")
    if one.shape != other.shape:
        raise InputError(f"shape {one.shape}, but gt has {other.shape}", where="est")
    union = int((one | other).sum())
    return int((one & other).sum()) / union if union else float("nan")


def _as_mask(value: npt.ArrayLike, name: str) -> npt.NDArray[np.bool_]:
    array = np.asarray(value)
    if array.ndim != 2 or array.dtype.kind not in "buif":
        raise InputError(f"shape {array.shape}, expected (h, w) of truth values", where=name)
    if array.dtype.kind == "b":
        return array.astype(bool)
    full = 1.0 if array.dtype.kind == "f" else float(np.iinfo(array.dtype).max)
    return np.asarray(array > full / 2)
