"""Alignments of CAD models, their boxes and their uncertainties."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import KW_ONLY, InitVar, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, as_floats, as_points, read_only
from cadalign.errors import InputError
from cadalign.geometry.rotations import nearest_rotation

_FIELDS = ("rotation", "translation", "scale")

UNCERTAIN = 0.25
"""Relative standard deviation beyond which a stretch, a distance or a focal length is uncertain."""
UNCERTAIN_ROTATION_DEG = 30.0
NOT_DETERMINED = 1.0
"""Relative standard deviation beyond which a number is meaningless."""
NOT_DETERMINED_ROTATION_DEG = 60.0
_THIN = 0.1  # spread of nearly coplanar points across their plane, over the largest spread
_END_ON = math.cos(math.radians(15.0))
_ROUNDING = 1e-12  # relative standard deviation below which a length is known

OPENGL_AXES = np.array([1.0, -1.0, -1.0])
"""Signs (3,) that convert points (n, 3) between OpenGL's camera axes (x right, y up, z backward;
also NeRF, ARKit and ARCore) and cadalign's, in either direction."""
OPENGL_FLIP = np.diag([*OPENGL_AXES, 1.0])
"""Homogeneous transform (4, 4) between the two camera frames, in either direction."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """Pose and stretch of a model.

    ``x_cam = rotation @ diag(scale) @ x + translation``: the stretch acts along the model's own
    axes, before the rotation. Estimated alignments have ``scale[0] == 1``: one image alone cannot
    tell a large distant object from a small near one, so the model's length along x is assumed
    known.

    Parameters
    ----------
    rotation : (3, 3) float
        Orthonormal to 1e-2, with determinant +1. The nearest rotation is used.
    translation : (3,) float
        The model's origin in the camera frame [model units].
    scale : (3,) float
        Stretch along the model's x, y and z, positive.
    is_valid : bool
        Skip the checks and make the given arrays read-only. For arrays known to be valid.

    Raises
    ------
    InputError
        If a shape or value is wrong, ``rotation`` is not a rotation, or a scale is not positive.

    Examples
    --------
    >>> alignment = Alignment(np.eye(3), [0, 0, 4], [1, 2, 0.5])
    >>> alignment.apply([[1.0, 1.0, 1.0]]).tolist()
    [[1.0, 2.0, 4.5]]
    """

    rotation: FloatArray
    translation: FloatArray
    scale: FloatArray
    _: KW_ONLY
    is_valid: InitVar[bool] = False

    def __post_init__(self, is_valid: bool) -> None:
        if is_valid:
            for array in (self.rotation, self.translation, self.scale):
                array.flags.writeable = False
            return
        rotation = as_floats(self.rotation, name="rotation", shape=(3, 3))
        translation = as_floats(self.translation, name="translation", shape=(3,))
        scale = as_floats(self.scale, name="scale", shape=(3,))
        rotation = nearest_rotation(rotation)
        if (scale <= 0).any():
            raise InputError(f"{scale.tolist()} is not positive", where="scale")
        for name, value in zip(_FIELDS, (rotation, translation, scale), strict=True):
            object.__setattr__(self, name, read_only(value))

    @classmethod
    def from_vector(cls, pose: FloatArray) -> Alignment:
        """Make an alignment from a packed pose (15,): rotation row by row, translation, scale."""
        pose = pose.copy()
        return cls(pose[:9].reshape(3, 3), pose[9:12], pose[12:], is_valid=True)

    @property
    def vector(self) -> FloatArray:
        """Packed pose, (15,) float; see `from_vector`."""
        return np.concatenate([self.rotation.ravel(), self.translation, self.scale])

    @classmethod
    def identity(cls) -> Alignment:
        """Make the identity alignment."""
        return cls(np.eye(3), np.zeros(3), np.ones(3))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Alignment):
            return NotImplemented
        return bool((self.vector == other.vector).all())

    def __hash__(self) -> int:
        return hash(self.vector.tobytes())

    @property
    def linear(self) -> FloatArray:
        """The linear part ``rotation @ diag(scale)``, (3, 3) float."""
        return np.asarray(self.rotation * self.scale)

    @property
    def cam_from_model(self) -> FloatArray:
        """Homogeneous transform from model to camera coordinates, stretch included, (4, 4)."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.linear
        matrix[:3, 3] = self.translation
        return matrix

    def apply(self, points: npt.ArrayLike) -> FloatArray:
        """Transform model points (n, 3) to the camera frame; (n, 3) float."""
        return as_points(points, name="points", dimension=3) @ self.linear.T + self.translation

    def inverse(self, points_cam: npt.ArrayLike) -> FloatArray:
        """Transform camera-frame points (n, 3) to model coordinates; (n, 3) float.

        Examples
        --------
        >>> alignment = Alignment(np.eye(3), [0, 0, 4], [1, 2, 0.5])
        >>> alignment.inverse([[1.0, 2.0, 4.5]]).tolist()
        [[1.0, 1.0, 1.0]]
        """
        points = as_points(points_cam, name="points_cam", dimension=3)
        return (points - self.translation) @ self.rotation / self.scale

    def to_dict(self) -> dict[str, list[Any]]:
        """Convert to a dict of lists, for JSON."""
        return {name: getattr(self, name).tolist() for name in _FIELDS}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Alignment:
        """Read the form of `to_dict`; raises InputError if a field is missing or invalid."""
        if not isinstance(data, Mapping):
            raise InputError(f"expected an object, got {type(data).__name__}")
        for name in _FIELDS:
            if name not in data:
                raise InputError("missing", where=name)
        return cls(*(data[key] for key in _FIELDS))


def model_rays(cam_from_model: Alignment) -> tuple[FloatArray, FloatArray]:
    """Camera rays in the model's frame: their origin (3,), and a matrix (3, 3) for directions.

    The matrix maps (u, v, 1) to a direction; the ray's point at depth z is origin + z direction.
    """
    model_from_ray = cam_from_model.rotation.T / cam_from_model.scale[:, None]
    return -model_from_ray @ cam_from_model.translation, model_from_ray


# Corner i lies at the high side of axis k if bit k of i is set.
_CORNER_SIGNS = np.array([[1 if i >> k & 1 else -1 for k in range(3)] for i in range(8)]) / 2
BOX_EDGES = tuple((i, i | 1 << k) for k in range(3) for i in range(8) if not i >> k & 1)
"""The 12 edges as pairs of corner numbers: four along x, four along y, four along z."""
BOX_FACES = (
    *((0, 2, 1), (1, 2, 3), (4, 5, 6), (5, 7, 6), (0, 1, 4), (1, 5, 4)),
    *((2, 6, 3), (3, 6, 7), (0, 4, 2), (2, 4, 6), (1, 3, 5), (3, 7, 5)),
)
"""The 12 triangles of the faces, counter-clockwise from outside: z, y, x, the low face first."""


def extent(points: FloatArray) -> FloatArray:
    """Least and greatest coordinates (2, 3) of points (n, 3)."""
    return np.array([points.min(axis=0), points.max(axis=0)])


def are_on_a_line(points: FloatArray, flat: float) -> bool:
    """True if points (n, 3) have a second principal extent of at most ``flat`` times the first."""
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(extents[1] <= flat * extents[0])


def describe_plane(points_3d: FloatArray) -> str | None:
    """Describe how points (n, 3) are degenerate; None if they span a volume."""
    mean = points_3d.mean(axis=0)
    rows = np.vstack([points_3d - mean, np.zeros((3, 3))])  # at least three
    if not np.isfinite(rows).all():
        return None
    _, spread, axes = np.linalg.svd(rows, full_matrices=False)
    if spread[0] <= 1e-14 * np.abs(points_3d).max(initial=0.0):
        return "all points are the same"
    if spread[1] < 1e-6 * spread[0]:
        return "the points lie on one line"
    if spread[2] > 1e-6 * spread[0]:
        return None
    axis = int(np.argmax(np.abs(axes[2])))
    if abs(axes[2, axis]) > 1 - 1e-6:
        return f"the points lie in the plane {'xyz'[axis]} = {mean[axis]:.4g}"
    return "the points lie in one plane"


def bounds_corners(low: FloatArray, high: FloatArray) -> FloatArray:
    """Corners (8, 3) of the axis-aligned box between two points (3,), in the order of a `Box`."""
    return np.where(_CORNER_SIGNS > 0, high, low)


@dataclass(frozen=True, eq=False)
class Box:
    """An oriented box.

    Raises
    ------
    InputError
        If a shape or value is wrong, or an extent is negative.
    """

    center: FloatArray
    """Centre (3,)."""
    rotation: FloatArray
    """Axes of the box as columns (3, 3)."""
    extents: FloatArray
    """Full side lengths along these axes (3,), not negative."""

    def __post_init__(self) -> None:
        center = as_floats(self.center, name="center", shape=(3,))
        rotation = nearest_rotation(as_floats(self.rotation, name="rotation", shape=(3, 3)))
        extents = as_floats(self.extents, name="extents", shape=(3,))
        if (extents < 0).any():
            raise InputError(f"{extents.tolist()} is negative", where="extents")
        for name, value in (("center", center), ("rotation", rotation), ("extents", extents)):
            object.__setattr__(self, name, read_only(value))

    @classmethod
    def from_model(cls, bounds: npt.ArrayLike, alignment: Alignment) -> Box:
        """Make the box of an aligned model, in the camera frame.

        ``bounds`` (2, 3) are the model's least and greatest coordinates in its own frame.

        Examples
        --------
        >>> alignment = Alignment(np.eye(3), [0, 0, 4], [1, 2, 0.5])
        >>> box = Box.from_model([[-1, -1, -1], [1, 1, 1]], alignment)
        >>> box.center.tolist(), box.extents.tolist()
        ([0.0, 0.0, 4.0], [2.0, 4.0, 1.0])
        """
        bounds = as_floats(bounds, name="bounds", shape=(2, 3))
        pose = alignment.rotation, alignment.translation, alignment.scale
        return cls(*oriented_box(bounds, *pose))

    @property
    def corners(self) -> FloatArray:
        """The 8 corners, (8, 3) float; `BOX_EDGES` lists the pairs that an edge joins."""
        return self.center + (_CORNER_SIGNS * self.extents) @ self.rotation.T

    @property
    def volume(self) -> float:
        """Volume [model units cubed]."""
        width, height, length = self.extents.tolist()
        return float(width * height * length)


def oriented_box(
    bounds: FloatArray, rotation: FloatArray, translation: FloatArray, scale: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Centre (..., 3), axes (..., 3, 3) and side lengths (..., 3) of aligned models' boxes.

    Parameters are stacked: ``bounds`` (..., 2, 3), ``rotation`` (..., 3, 3), ``translation`` and
    ``scale`` (..., 3).
    """
    low, high = bounds[..., 0, :], bounds[..., 1, :]
    linear = rotation * scale[..., None, :]
    middle = ((low + high) / 2)[..., None, :] @ linear.swapaxes(-1, -2)
    return middle[..., 0, :] + translation, rotation, (high - low) * scale


@dataclass(frozen=True)
class Uncertainty:
    """Predicted standard deviations of an alignment."""

    rotation_deg: float
    """Rotation [degrees]: square root of the sum of the variances about three axes."""
    translation: tuple[float, float, float]
    """Translation along the camera's axes [model units]."""
    scale: tuple[float, float, float]
    """Scale along the model's x, y, z, relative (0.02 is 2 %); 0 if it is known."""
    focal: float
    """Focal length, relative; 0 if it is known."""


def uncertainty_of(covariance: FloatArray) -> Uncertainty:
    """Standard deviations from a covariance (9, 9) or (10, 10)."""
    variance = np.maximum(covariance.diagonal(), 0.0)
    variance[6:9][variance[6:9] < _ROUNDING**2] = 0.0
    x, y, z, sx, sy, sz = np.sqrt(variance[3:9]).tolist()
    return Uncertainty(
        rotation_deg=float(np.degrees(np.sqrt(variance[:3].sum()))),
        translation=(x, y, z),
        scale=(sx, sy, sz),
        focal=float(np.sqrt(variance[9:].sum())),
    )


def distance_deviation(alignment: Alignment, covariance: FloatArray) -> float:
    """Relative standard deviation of the distance from the camera to the model's origin."""
    translation = alignment.translation
    square = float(translation @ translation)
    if not square > 0:
        return math.inf
    along = translation @ covariance[3:6, 3:6] @ translation
    return math.sqrt(max(float(along), 0.0)) / square


def uncertain_of(alignment: Alignment, covariance: FloatArray) -> tuple[str, ...]:
    """Names of the uncertain quantities.

    These are "s_x", "s_y", "s_z", "distance", "focal length" and "rotation".

    Examples
    --------
    >>> pose = Alignment(np.eye(3), [0, 0, 5.0], [1, 1, 1])
    >>> uncertain_of(pose, np.diag([1e-4] * 3 + [0, 0, 4.0] + [0, 0.01, 0.09]))
    ('s_z', 'distance')
    """
    std = uncertainty_of(covariance)
    relative = dict(zip(("s_x", "s_y", "s_z"), std.scale, strict=True))
    relative |= {"distance": distance_deviation(alignment, covariance), "focal length": std.focal}
    found = [name for name, deviation in relative.items() if deviation > UNCERTAIN]
    return (*found, *(["rotation"] if std.rotation_deg > UNCERTAIN_ROTATION_DEG else []))


def deviation_text(relative: float) -> str:
    """Format a relative standard deviation, to append to a number.

    Examples
    --------
    >>> deviation_text(0.02), deviation_text(120.0), deviation_text(0)
    (' +- 2 %', ' (not determined)', '')
    """
    if relative > NOT_DETERMINED:
        return " (not determined)"
    return f" +- {100 * relative:.2g} %" if relative else ""


def why_open(name: str, points_3d: FloatArray, alignment: Alignment) -> str:
    """Explain an uncertain stretch, in brackets, to append to its name; empty if unexplained."""
    axis = {"s_x": 0, "s_y": 1, "s_z": 2}.get(name)
    if axis is None or not len(points_3d):
        return ""
    spread, center, letter = points_3d.std(axis=0), points_3d.mean(axis=0), "xyz"[axis]
    if spread[axis] < _THIN * spread.max():
        return f" (the keypoints lie nearly in the plane {letter} = {center[axis]:.3g})"
    ray = alignment.apply(center[None])[0]
    cosine = abs(ray @ alignment.rotation[:, axis]) / np.linalg.norm(ray)
    return f" (the model's {letter} axis is seen nearly end-on)" if cosine > _END_ON else ""
