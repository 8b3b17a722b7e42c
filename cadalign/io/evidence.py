"""Evidence beyond keypoints: the fields of an image, and an object's known lengths."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, IntArray, as_floats, as_one_or_each, as_points, as_positive
from cadalign.errors import InputError, require_kind
from cadalign.geometry.camera import Camera
from cadalign.io.files import as_path

LENGTHS = ("width", "height", "length")
"""Names of the lengths along the model's x, y and z."""
_LENGTH_SIGMA = 0.01  # relative
_LISTED = 8  # rows of keypoints in a message


REFINED = {
    "mask_sigma": "mask",
    "depth_scale": "depth",
    "depth_sigma": "depth",
    "up_sigma_deg": "up",
    "camera_height_sigma": "camera_height",
}
"""The field without which a field means nothing."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BeyondKeypoints:
    """Evidence of an image beyond keypoints; None for what is not known.

    `cadalign.View` describes the fields.
    """

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

    @property
    def given(self) -> dict[str, Any]:
        """The fields that are known, by name."""
        values = {name: getattr(self, name) for name in EVIDENCE}
        return {name: value for name, value in values.items() if value is not None}

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the fields that are known and are evidence by themselves."""
        return tuple(name for name in self.given if name not in REFINED)


EVIDENCE = tuple(BeyondKeypoints.__dataclass_fields__)
"""Names of the fields."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ImageEvidence(BeyondKeypoints):
    """Evidence of an image as an observation file holds it, with paths of mask and depth image.

    `cadalign.View` checks their values.

    Raises
    ------
    InputError
        If a sigma or scale is given without its measurement, or an array has a wrong shape.
    """

    mask: Path | None = None
    depth: Path | None = None
    depth_sigma: float | None = None
    up: FloatArray | None = None
    up_sigma_deg: float | None = None
    cam_from_rig: FloatArray | None = None

    def __post_init__(self) -> None:
        given = self.given
        for name in given:
            # depth_sigma may be that of depths of the keypoints
            if name != "depth_sigma" and (missing := REFINED.get(name, name)) not in given:
                what, fix = f"given without {missing}", f"give {missing}, too"
                raise InputError(what, where=name, fix=fix)
        _keep_paths(self, "mask", "depth")
        for name, shape in (("up", (3,)), ("cam_from_rig", (4, 4))):
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, as_floats(value, name=name, shape=shape))


@dataclass(frozen=True, eq=False)
class Size:
    """Known lengths of an object's box along the model's axes.

    Parameters
    ----------
    width, height, length : float, optional
        Along x, y, z [the unit in which pose and size are wanted].
    sigma : float or (3,) float, optional
        Standard deviation of the lengths, relative; by default 0.01, 1 %.

    Raises
    ------
    InputError
        If no length is given, or a value is not positive.

    Examples
    --------
    >>> Size(height=0.81, sigma=0.005).lengths.tolist()
    [nan, 0.81, nan]
    """

    width: float | None = None
    height: float | None = None
    length: float | None = None
    sigma: npt.ArrayLike | None = None

    def __post_init__(self) -> None:
        for name in LENGTHS:
            if getattr(self, name) is not None:
                object.__setattr__(self, name, as_positive(getattr(self, name), name=name))
        if np.isnan(self.lengths).all():
            fix = "give width, height or length"
            raise InputError("no length is given", where="size", fix=fix)
        if self.sigma is not None:
            as_one_or_each(self.sigma, name="size.sigma", count=3, entries="lengths")

    @property
    def given(self) -> dict[str, Any]:
        """The arguments that are given, by name."""
        return {name: value for name, value in vars(self).items() if value is not None}

    @property
    def lengths(self) -> FloatArray:
        """Lengths (3,) along x, y, z; NaN where unknown."""
        return np.array([getattr(self, name) for name in LENGTHS], dtype=float)

    @property
    def deviations(self) -> FloatArray:
        """Standard deviations (3,) of the lengths; NaN where unknown."""
        relative = np.asarray(_LENGTH_SIGMA if self.sigma is None else self.sigma, dtype=float)
        return np.asarray(self.lengths * relative)


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
    ids : (n,) int, optional
        Meaning of each keypoint; the same number on all models of a category.
    names : tuple of n str, optional
        Name of each keypoint.
    scores : (n,) float, optional
        Trust in each keypoint, for the ``scores`` of `cadalign.fit`.
    image : Path, optional
        The photo.
    depths : (n,) float, optional
        Depth of each keypoint [model units]; NaN where unknown.
    evidence : ImageEvidence
        What is known beyond keypoints.
    not_found : tuple of int
        Rows of the file's keypoints that are left out here: their pixels are no measurements, see
        `cadalign.geometry.pixels.unmeasured`.

    Raises
    ------
    InputError
        If shapes don't match, a value is NaN or infinite, or depths are given twice.
    """

    points_3d: FloatArray
    points_2d: FloatArray
    camera: Camera
    sigma: FloatArray | None = None
    ids: IntArray | None = None
    names: tuple[str, ...] | None = None
    scores: FloatArray | None = None
    image: Path | None = None
    depths: FloatArray | None = field(default=None, kw_only=True)
    evidence: ImageEvidence = field(default_factory=ImageEvidence, kw_only=True)
    not_found: tuple[int, ...] = field(default=(), kw_only=True)

    def __post_init__(self) -> None:
        require_kind(self.camera, Camera, "camera")
        points_3d = as_points(self.points_3d, name="points_3d", dimension=3)
        points_2d = as_floats(self.points_2d, name="points_2d", shape=(len(points_3d), 2))
        object.__setattr__(self, "points_3d", points_3d)
        object.__setattr__(self, "points_2d", points_2d)
        _keep_paths(self, "image")
        for name in ("sigma", "scores", "depths"):
            if (value := getattr(self, name)) is not None:
                shape, finite = (len(points_3d),), name != "depths"
                checked = as_floats(value, name=name, shape=shape, finite=finite)
                object.__setattr__(self, name, checked)
        if self.depths is not None and self.evidence.depth is not None:
            what, fix = (
                "a depth image and depths of keypoints are given",
                "leave out one of the two",
            )
            raise InputError(what, where="depth", fix=fix)

    @property
    def labels(self) -> tuple[str | int, ...]:
        """Names of the keypoints in messages, or else their rows in the file."""
        count = len(self.points_2d) + len(self.not_found)
        if self.names is not None and len(set(self.names)) == len(self.names):
            return self.names
        return tuple(row for row in range(count) if row not in self.not_found)

    @property
    def text_of_not_found(self) -> str:
        """A note about the keypoints that are left out; empty where none is."""
        if not self.not_found:
            return ""
        count, rows = len(self.not_found), ", ".join(map(str, self.not_found[:_LISTED]))
        rows += ", ..." if count > _LISTED else ""
        return (
            f"{count} of {count + len(self.points_2d)} keypoints are not found and left out "
            f"(rows {rows}): their pixels are missing, (0, 0), or one and the same"
        )


def _keep_paths(given: object, *names: str) -> None:
    """Make paths of the texts in some fields of a frozen dataclass; None stays."""
    for name in names:
        if (value := getattr(given, name)) is not None:
            object.__setattr__(given, name, as_path(value, name))
