"""A view: the evidence of one image about an object, with checks of its inputs."""

from __future__ import annotations

import os
from collections.abc import Hashable, Iterable, Sequence
from copy import copy
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from cadalign.arrays import (
    BoolArray,
    FloatArray,
    as_floats,
    as_one_or_each,
    as_points,
    as_positive,
    copy_argument,
    is_number,
    read_only,
)
from cadalign.errors import InputError, quote, require_kind
from cadalign.estimation.model import checked_ids
from cadalign.estimation.options import Sigma
from cadalign.geometry.camera import Camera
from cadalign.geometry.pixels import check_pixels
from cadalign.geometry.rotations import nearest_rigid
from cadalign.io.images import ByteImage, exif_note, read_grey, read_mask, read_photo

_FILE_SCALE = 0.001  # of a 16-bit depth image: millimetres to metres
_SYMMETRY_TOLERANCE = 1e-9
_SOURCES = ("mask", "depth", "up", "camera_height", "cam_from_rig", "image")
_DEFAULTS = {"depth_sigma": 0.01, "up_sigma_deg": 1.0, "camera_height_sigma": 0.02}


class _Numbers(tuple[int, ...]):
    """Default ids of keypoints; changed copies of a view know them by this type."""


@dataclass(frozen=True, eq=False)
class View:
    """Evidence of one image about an object.

    Parameters
    ----------
    camera : Camera
        The calibrated camera; `Camera.from_size` where the focal length is to be estimated.
    points_2d : (n, 2) float
        Keypoints in the image [px]; integers are pixel centres.
    ids : sequence of n int or str, optional
        Ids or names of these keypoints in the model; default: all of the model's, in its order.
    sigma : float, (n,) float, (n, 2, 2) float, or None
        Standard deviation of all keypoints or of each [px], or covariance of each [px^2]. None
        estimates it, jointly for all such views, with a weak prior centred at 2 px.
    scores : (n,) float, optional
        Confidences of the keypoints, for a robust search.
    depth : (n,) or (h, w) float, or path, optional
        Depths of the keypoints, or a depth image registered to the photo, as an array or a 16-bit
        PNG [model units, or the desired unit of the object's size]. A depth is z in the camera's
        frame, also for a wide lens. NaN means unknown, in an image 0 too. An image is sampled
        robustly at the keypoints. Cauchy's loss tolerates one or two occluded keypoints of eight;
        give NaN for keypoints on the object's far side.
    depth_sigma : float or (n,) float
        Relative standard deviation of the depths; default: 0.01 (1 %).
    depth_scale : float, optional
        Units per count of a depth image; default: 0.001 for a file (millimetres to metres), 1 for
        an array of floats.
    up : (3,) float, optional
        The direction of the model's up axis in the camera's frame (OpenCV's: y points down), of any
        length.
    up_sigma_deg : float or (3, 3) float
        Standard deviation of the direction about each perpendicular axis [degrees], or its
        covariance [degrees squared].
    camera_height : float, optional
        Height of the camera above the plane below the object's lowest face [the desired unit of
        the object's size]. ``up`` gives the plane's normal.
    camera_height_sigma : float
        Relative standard deviation of the height.
    cam_from_rig : (4, 4) float, optional
        Known pose of the camera in a frame that several views share. Without it, the motion between
        views is unknown.
    mask : (h, w) bool or float, or path, optional
        Mask of the object, of the camera's size: bool, probabilities in [0, 1], or the path of an
        8-bit grey PNG that is nonzero on the object.
    mask_sigma : float, optional
        Standard deviation of the mask's contour along its normal [px]; None estimates it.
    image : (h, w, 3) uint8, or path, optional
        The RGB photo as evidence: the model's outline is searched for in it, near the estimate from
        all other evidence. The model needs a mesh. Ignored if the view has a mask.
    photo : path, optional
        The photo, for checks of the image size only; it is no evidence.
    number : int
        Index of the view in errors, warnings and evidence; set by `align`.

    Raises
    ------
    InputError
        If shapes don't match, ids repeat, a value is NaN or infinite, a pose is not a rigid motion,
        or an image's size is not the camera's.
    DataError
        If a file cannot be read.

    Examples
    --------
    >>> camera = Camera(640, 480, 500, 500, 319.5, 239.5)
    >>> View(camera, [[320.0, 240.0], [330.0, 250.0]], ids=["nose", "tail"]).ids
    ('nose', 'tail')
    """

    camera: Camera
    points_2d: npt.ArrayLike = ()
    ids: Sequence[Hashable] | None = None
    sigma: Sigma | None = 1.0
    scores: npt.ArrayLike | None = None
    _: KW_ONLY
    mask: npt.ArrayLike | str | os.PathLike[str] | None = None
    mask_sigma: float | None = None
    depth: npt.ArrayLike | str | os.PathLike[str] | None = None
    depth_scale: float | None = None
    depth_sigma: npt.ArrayLike | None = None
    up: npt.ArrayLike | None = None
    up_sigma_deg: npt.ArrayLike | None = None
    camera_height: float | None = None
    camera_height_sigma: float | None = None
    cam_from_rig: npt.ArrayLike | None = None
    image: npt.ArrayLike | str | os.PathLike[str] | None = None
    photo: str | os.PathLike[str] | None = field(default=None, repr=False)
    number: int = field(default=0, repr=False)

    def __post_init__(self) -> None:
        for name, value in _DEFAULTS.items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, value)
        camera = self.camera
        require_kind(camera, Camera, "camera")
        points = np.empty((0, 2)) if np.size(self.points_2d) == 0 else self.points_2d
        points = as_points(points, name="points_2d", dimension=2)
        check_pixels(points, camera.width, camera.height, where="points_2d")
        self._keep("points_2d", points)
        is_named = self.ids is not None and not self.is_numbered
        ids = checked_ids(self.ids, len(points)) if is_named else _Numbers(range(len(points)))
        object.__setattr__(self, "ids", ids)
        for name in ("sigma", "scores", "depth_sigma", "up_sigma_deg"):
            object.__setattr__(self, name, copy_argument(getattr(self, name)))
        if self.depth is not None:
            self._keep("depth", _depths(self.depth, camera, len(points), self.depth_scale))
            object.__setattr__(self, "depth_scale", None)  # a changed copy is not scaled again
        if self.up is not None:
            self._keep("up", _up_direction(self.up, self.up_sigma_deg))
        if self.cam_from_rig is not None:
            self._keep("cam_from_rig", nearest_rigid(self.cam_from_rig, where="cam_from_rig"))
        if self.mask is not None:
            self._keep("mask", _mask(self.mask, camera))
        if self.image is not None:
            self._keep("image", _photo(self.image, camera))
        if self.depth_image is not None:
            as_positive(self.depth_sigma, name="depth_sigma")
            if not len(points):
                what, fix = "a depth image needs keypoints", "give points_2d, or omit depth"
                raise InputError(what, where="depth", fix=fix)
        else:
            as_one_or_each(
                self.depth_sigma, name="depth_sigma", count=len(points), entries="keypoints"
            )
        for name in ("camera_height", "camera_height_sigma", "mask_sigma"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, as_positive(getattr(self, name), name=name))

    def _keep(self, name: str, value: npt.NDArray[Any]) -> None:
        object.__setattr__(self, name, read_only(value))

    def __repr__(self) -> str:
        return f"View({', '.join([f'{np.shape(self.points_2d)[0]} keypoints', *self.sources])})"

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the given evidence other than keypoints."""
        return tuple(name for name in _SOURCES if getattr(self, name) is not None)

    @property
    def is_numbered(self) -> bool:
        """True if the ids are the default."""
        return isinstance(self.ids, _Numbers)

    @property
    def keypoint_ids(self) -> tuple[Hashable, ...]:
        """Ids of the keypoints; see ``ids``."""
        return cast("tuple[Hashable, ...]", self.ids)

    @property
    def pixels(self) -> FloatArray:
        """The keypoints (n, 2) [px]; see ``points_2d``."""
        return cast(FloatArray, self.points_2d)

    @property
    def depth_image(self) -> FloatArray | None:
        """The depth image (h, w), NaN where unknown; None if ``depth`` is not an image."""
        is_image = self.depth is not None and np.ndim(cast(FloatArray, self.depth)) == 2
        return cast(FloatArray, self.depth) if is_image else None

    @property
    def has_mask_alone(self) -> bool:
        """True if the view has a mask, and no keypoints."""
        return self.mask is not None and not len(self.keypoint_ids)

    @property
    def has_outline(self) -> bool:
        """True if the view has a mask or a photo as evidence."""
        return self.mask is not None or self.image is not None

    @property
    def has_evidence(self) -> bool:
        """True if the view has evidence about the object by itself."""
        return bool(len(self.keypoint_ids)) or bool({*self.sources} - {"cam_from_rig", "depth"})

    @property
    def mask_image(self) -> FloatArray | BoolArray | None:
        """The mask (h, w), bool or probabilities."""
        return cast("FloatArray | BoolArray | None", self.mask)


def number_views(views: Iterable[View]) -> list[View]:
    """Copies of the views, each with its ``number``."""
    copies = list(map(copy, views))  # without checking them again
    for number, view in enumerate(copies):
        object.__setattr__(view, "number", number)
    return copies


def _depths(given: Any, camera: Camera, count: int, scale: float | None) -> FloatArray:
    """Depths of the keypoints (n,), or a depth image (h, w); NaN where unknown."""
    factor = None if scale is None else as_positive(scale, name="depth_scale")
    if isinstance(given, str | os.PathLike):
        depth = read_grey(Path(given)).astype(np.float64)
        factor = _FILE_SCALE if factor is None else factor
    else:
        depth = np.asarray(given)
        if depth.ndim == 2 and depth.dtype.kind in "iu" and factor is None:
            fix = "give `depth_scale`, for example 0.001 to convert millimetres to metres"
            raise InputError("the unit of the integers is unknown", where="depth", fix=fix)
        shape = (None,) if depth.ndim == 1 else (None, None)
        depth = as_floats(depth, name="depth", shape=shape, finite=False)
    wanted = (count,) if depth.ndim == 1 else (camera.height, camera.width)
    if depth.shape != wanted:
        what = f"shape {depth.shape}, expected ({count},) or ({camera.height}, {camera.width})"
        fix = "give a depth per keypoint, or a depth image of the camera's size"
        raise InputError(what, where="depth", fix=fix)
    known = np.isfinite(depth)
    if depth.ndim == 2:
        known &= depth != 0
    if (depth[known] <= 0).any():
        fix = "give NaN for unknown depths"
        raise InputError("has values that are not positive", where="depth", fix=fix)
    return np.where(known, depth * (1.0 if factor is None else factor), np.nan)


def _mask(given: Any, camera: Camera) -> FloatArray | BoolArray:
    """A mask (h, w): bool, or probabilities."""
    is_file = isinstance(given, str | os.PathLike)
    mask = read_mask(Path(given)) if is_file else np.asarray(given)
    if mask.shape != (camera.height, camera.width):
        is_image = mask.ndim == 2
        size = f"{mask.shape[1]} x {mask.shape[0]}" if is_image else f"an array {mask.shape}"
        what = f"the mask is {size}, the camera {camera.width} x {camera.height}"
        fix = "give the mask of this image, in its size" + ("" if is_image else ", one channel")
        raise InputError(what, where="mask", fix=fix)
    if mask.dtype == bool:
        return mask
    probabilities = as_floats(mask, name="mask", shape=(None, None))
    if probabilities.min() < 0 or probabilities.max() > 1:
        fix = "give a bool array or probabilities; for an 8-bit image give `image > 0`"
        raise InputError("has values outside [0, 1]", where="mask", fix=fix)
    return probabilities


def _photo(given: Any, camera: Camera) -> ByteImage:
    """A photo (h, w, 3) uint8 in RGB."""
    note = ""
    if isinstance(given, str | os.PathLike):
        note = exif_note(Path(given), (camera.width, camera.height))
        given = read_photo(given)
    pixels = np.asarray(given)
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] != 3:
        what = f"{pixels.dtype} of shape {pixels.shape}, expected an RGB image (h, w, 3) of uint8"
        raise InputError(what, where="image", fix="give the photo's array, or its path")
    if pixels.shape[:2] != (camera.height, camera.width):
        size = f"{pixels.shape[1]} x {pixels.shape[0]}"
        what = f"the photo is {size}, the camera {camera.width} x {camera.height}{note}"
        raise InputError(what, where="image", fix="give the photo that belongs to the camera")
    return pixels


def _up_direction(given: Any, sigma: Any) -> FloatArray:
    """The unit vector (3,) of ``up``; checks its standard deviation or covariance (3, 3)."""
    up = as_floats(given, name="up", shape=(3,))
    length = float(np.linalg.norm(up))
    if not length > 0:
        raise InputError("the direction must not be zero", where="up")
    if np.ndim(sigma) == 0:
        if not is_number(sigma) or not sigma > 0:
            raise InputError(f"{quote(sigma)} is not positive", where="up_sigma_deg")
        return up / length
    covariance = as_floats(sigma, name="up_sigma_deg", shape=(3, 3))
    size = np.abs(covariance).max()
    values = np.linalg.eigvalsh(covariance)
    is_symmetric = np.abs(covariance - covariance.T).max() <= _SYMMETRY_TOLERANCE * size
    if not is_symmetric or values[0] < -_SYMMETRY_TOLERANCE * size or not values[1] > 0:
        what = "not a covariance of rank 2 or more"
        fix = "give a positive number [degrees], or the covariance of the direction"
        raise InputError(what, where="up_sigma_deg", fix=fix)
    return up / length
