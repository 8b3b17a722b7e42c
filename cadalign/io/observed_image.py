"""One image of an observation: its keypoints, and what else is known about the object in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.arrays import FloatArray, IntArray, as_floats, as_points, as_positive
from cadalign.errors import InputError
from cadalign.geometry.camera import Camera

_REFINES = {
    "mask_sigma": "mask",
    "depth_scale": "depth",
    "up_sigma_deg": "up",
    "camera_height_sigma": "camera_height",
}

_NUMBERS = (*_REFINES, "depth_sigma", "camera_height")


@dataclass(frozen=True, eq=False, kw_only=True)
class ImageEvidence:
    """Evidence of an image beyond keypoints; None for what is not known.

    Parameters
    ----------
    mask : Path, optional
        PNG of the camera's size, nonzero where the object is seen.
    mask_sigma : float, optional
        Standard deviation of its contour [px].
    depth : Path, optional
        Depth image of the camera's size, a PNG of 16 bits.
    depth_scale : float, optional
        Model units of one count of it.
    depth_sigma : float, optional
        Relative standard deviation of depths, of the image or of the keypoints.
    up : (3,) float, optional
        The model's up axis in the camera's frame.
    up_sigma_deg : float, optional
        Its standard deviation [degrees].
    camera_height : float, optional
        Height of the camera above the plane the object stands on [model units].
    camera_height_sigma : float, optional
        Its relative standard deviation.
    cam_from_rig : (4, 4) float, optional
        The camera's known pose in the frame that the views share.

    Raises
    ------
    InputError
        If a number is not positive, a deviation or scale is given without what it is of, or an
        array has a wrong shape.
    """

    mask: Path | None = None
    mask_sigma: float | None = None
    depth: Path | None = None
    depth_scale: float | None = None
    depth_sigma: float | None = None
    up: FloatArray | None = None
    up_sigma_deg: float | None = None
    camera_height: float | None = None
    camera_height_sigma: float | None = None
    cam_from_rig: FloatArray | None = None

    def __post_init__(self) -> None:
        for name, of in _REFINES.items():
            if getattr(self, name) is not None and getattr(self, of) is None:
                raise InputError(f"given without {of}", where=name, fix=f"give {of}, too")
        for name in _NUMBERS:
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, as_positive(value, name=name))
        for name, shape in (("up", (3,)), ("cam_from_rig", (4, 4))):
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, as_floats(value, name=name, shape=shape))

    @property
    def given(self) -> dict[str, Any]:
        """The fields that are known."""
        return {name: value for name, value in vars(self).items() if value is not None}


@dataclass(frozen=True, eq=False)
class ObservedImage:
    """Keypoints of the object in one image, and further evidence of the image.

    Parameters
    ----------
    points_3d : (n, 3) float
        Model points [model units].
    points_2d : (n, 2) float
        Image points [px].
    camera : Camera
    sigma : (n,) float, optional
        Standard deviation of each image point [px].
    semantic_ids : (n,) int, optional
        Meaning of each keypoint; the same number on all models of a category.
    names : tuple of n str, optional
        Name of each keypoint.
    confidences : (n,) float, optional
        Trust in each keypoint, for the ``confidences`` of `cadalign.fit`.
    image : Path, optional
        The photo.
    depths : (n,) float, optional
        Depth of each keypoint [model units]; NaN where unknown.
    evidence : ImageEvidence
        What is known beyond keypoints.

    Raises
    ------
    InputError
        If shapes don't match, a value is NaN or infinite, or depths are given twice.
    """

    points_3d: FloatArray
    points_2d: FloatArray
    camera: Camera
    sigma: FloatArray | None = None
    semantic_ids: IntArray | None = None
    names: tuple[str, ...] | None = None
    confidences: FloatArray | None = None
    image: Path | None = None
    depths: FloatArray | None = field(default=None, kw_only=True)
    evidence: ImageEvidence = field(default_factory=ImageEvidence, kw_only=True)

    def __post_init__(self) -> None:
        points_3d = as_points(self.points_3d, name="points_3d", dimension=3)
        points_2d = as_floats(self.points_2d, name="points_2d", shape=(len(points_3d), 2))
        object.__setattr__(self, "points_3d", points_3d)
        object.__setattr__(self, "points_2d", points_2d)
        for name in ("sigma", "confidences"):
            if (value := getattr(self, name)) is not None:
                checked = as_floats(value, name=name, shape=(len(points_3d),))
                object.__setattr__(self, name, checked)
        if self.depths is None:
            if self.evidence.depth_sigma is not None and self.evidence.depth is None:
                raise InputError("given without depth", where="depth_sigma", fix="give depth, too")
            return
        if self.evidence.depth is not None:
            raise InputError(
                "a depth image and depths of keypoints are given",
                where="depth",
                fix="leave out one of the two",
            )
        depths = np.asarray(self.depths, dtype=np.float64)
        if depths.shape != (len(points_3d),):
            what = f"shape {depths.shape}, expected ({len(points_3d)},)"
            raise InputError(what, where="depths")
        object.__setattr__(self, "depths", depths)

    @property
    def has_more(self) -> bool:
        """True where more than keypoints is known."""
        return self.depths is not None or bool(self.evidence.given)


@dataclass(frozen=True, kw_only=True)
class KnownSize:
    """Known lengths of the object's box along x, y and z; None where unknown.

    Parameters
    ----------
    width, height, length : float, optional
        Along x, y, z [model units].
    sigma : float or sequence of 3 float, optional
        Relative standard deviation of all, or of each.

    Raises
    ------
    InputError
        If no length is given, or neither one deviation nor three.
    """

    width: float | None = None
    height: float | None = None
    length: float | None = None
    sigma: float | Sequence[float] | None = None

    def __post_init__(self) -> None:
        if self.width is None and self.height is None and self.length is None:
            raise InputError("no length is given", fix="give width, height or length")
        if isinstance(self.sigma, Sequence) and len(self.sigma) != 3:
            what = f"{len(self.sigma)} numbers"
            raise InputError(what, where="sigma", fix="give one, or one for each of 3 lengths")

    @property
    def given(self) -> dict[str, Any]:
        """The fields that are known."""
        return {name: value for name, value in vars(self).items() if value is not None}
