"""Parts of a shape model: components, training models, box margins and error statistics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, as_floats, is_number, read_only
from cadalign.errors import InputError, quote

KeypointId = int | str
"""A keypoint's semantic id or name."""

BOX_ROWS = 2  # the box's least and greatest corner, after the keypoints
FEW = 6  # number of keypoints down to which the inflation decreases
OUTWARD = np.array([[-1.0], [1.0]])
"""Signs of the outward directions at a box's least and greatest faces."""


@dataclass(frozen=True, eq=False)
class ShapeComponent:
    """One Gaussian of a shape model.

    Shapes are ``mean + sum_k c_k modes[k] + e``, with coefficients ``c`` of unit variance and a
    residual ``e`` of the same variance in every coordinate.

    Raises InputError if a shape is wrong, a value is NaN, infinite or negative, or the weight is
    not in (0, 1].
    """

    weight: float  # in the mixture
    mean: FloatArray
    """(m + 2, 3), the m keypoints, then the least and the greatest corner of the bounding box
    [model units]."""
    modes: FloatArray
    """(K, m + 2, 3), directions of deformation, one standard deviation long, the longest first
    [model units]."""
    residual_sigma: float
    """Standard deviation of the residual per coordinate [model units]."""

    def __post_init__(self) -> None:
        mean = as_floats(self.mean, name="mean", shape=(None, 3))
        modes = as_floats(self.modes, name="modes", shape=(None, None, 3))
        if len(mean) <= BOX_ROWS:
            raise InputError(f"{len(mean)} rows hold no keypoints besides the box", where="mean")
        if modes.shape[1] != len(mean):
            what = f"shape {modes.shape}, expected (n, {len(mean)}, 3), one row for each of mean"
            raise InputError(what, where="modes")
        if not is_number(self.residual_sigma) or self.residual_sigma < 0:
            what = f"{self.residual_sigma!r} is not a standard deviation"
            raise InputError(what, where="residual_sigma", fix="give a number, 0 or more")
        if not is_number(self.weight) or not 0 < self.weight <= 1:
            raise InputError(f"{self.weight!r} is not in (0, 1]", where="weight")
        object.__setattr__(self, "weight", float(self.weight))
        object.__setattr__(self, "residual_sigma", float(self.residual_sigma))
        object.__setattr__(self, "mean", read_only(mean))
        object.__setattr__(self, "modes", read_only(modes))

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the stacked rows, (3 (m + 2), 3 (m + 2)) float [model units squared]."""
        flat = self.modes.reshape(len(self.modes), self.mean.size)
        return np.asarray(flat.T @ flat + self.residual_sigma**2 * np.eye(flat.shape[1]))

    @property
    def variance(self) -> FloatArray:
        """Sum of all rows' variances by mode, (K,) float [model units squared]."""
        return np.asarray((self.modes**2).sum(axis=(1, 2)))


@dataclass(frozen=True, eq=False)
class TrainingShapes:
    """Keypoints of the models that a shape model was learned from.

    Raises InputError if lengths or shapes don't match, or a coordinate is infinite.
    """

    model_ids: tuple[str, ...]  # one for each model
    points_3d: npt.NDArray[np.float32]
    """(N, m, 3) float32, keypoints in the order of the shape model's ids [model units]; NaN if
    missing."""
    mesh_paths: tuple[Path | None, ...]  # one for each model

    def __post_init__(self) -> None:
        points = np.ascontiguousarray(self.points_3d, dtype=np.float32)
        count = len(self.model_ids)
        if points.ndim != 3 or points.shape[0] != count or points.shape[2] != 3:
            what = f"shape {points.shape}, expected ({count}, m, 3), one row for each model id"
            raise InputError(what, where="points_3d")
        if np.isinf(points).any():
            raise InputError("infinite coordinates", where="points_3d")
        if len(self.mesh_paths) != count:
            what = f"{len(self.mesh_paths)} paths for {count} models"
            raise InputError(what, where="mesh_paths")
        names = tuple(check_text(each, f"model_ids[{k}]") for k, each in enumerate(self.model_ids))
        object.__setattr__(self, "model_ids", names)
        object.__setattr__(self, "points_3d", read_only(points))

    def __len__(self) -> int:
        return len(self.model_ids)

    @property
    def rows_with_mesh(self) -> list[int]:
        """Rows of the models that have a mesh."""
        return [row for row, path in enumerate(self.mesh_paths) if path is not None]


@dataclass(frozen=True, eq=False)
class BoxMargins:
    """Correction of the linear box, which the Gaussian estimates, by the given keypoints.

    Raises InputError if a shape is wrong, a value is NaN or infinite, or a tolerance is negative.

    Examples
    --------
    Faces within the tolerance of the keypoints are moved to them; faces far beyond belong to other
    parts and stay:

    >>> rule = BoxMargins(np.zeros((2, 3)), np.full((2, 3), 0.1))
    >>> points = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    >>> rule.bounds(np.array([[-0.05, 0.0, -0.5], [1.0, 1.05, 1.0]]), points).tolist()
    [[-0.0, -0.0, -0.5], [1.0, 1.0, 1.0]]
    """

    margins: FloatArray
    """(2, 3), median distance of the least and the greatest face along x, y, z beyond the outermost
    keypoint [model units]."""
    tolerances: FloatArray
    """(2, 3), 95th percentile of the distance of the linear box, from all keypoints, beyond the
    true face, over held-out models [model units]."""

    def __post_init__(self) -> None:
        for name in ("margins", "tolerances"):
            value = as_floats(getattr(self, name), name=name, shape=(2, 3))
            object.__setattr__(self, name, read_only(value))
        if (self.tolerances < 0).any():
            raise InputError("a distance is negative", where="tolerances")

    def bounds(self, linear: FloatArray, points: FloatArray) -> FloatArray:
        """Box (2, 3) of an object, from the linear box (2, 3) and the given keypoints (n, 3)."""
        reached = OUTWARD * np.array([points.min(axis=0), points.max(axis=0)]) + self.margins
        outward = OUTWARD * linear
        return np.asarray(OUTWARD * np.where(outward > reached + self.tolerances, outward, reached))


def probability_within(
    squares: npt.ArrayLike, dimension: int, degrees_of_freedom: float | None = None
) -> Any:
    """Probability that errors are smaller than given ones.

    ``squares`` are squared errors of ``dimension`` coordinates, in standard deviations. Errors
    follow a t distribution with ``degrees_of_freedom`` > 2, None for Gaussian errors.

    Examples
    --------
    >>> round(float(probability_within(1.0, 1)), 4), round(float(probability_within(1.0, 1, 5)), 4)
    (0.6827, 0.7468)
    """
    from scipy.special import fdtr, gammainc

    if degrees_of_freedom is None:
        return gammainc(dimension / 2, np.asarray(squares) / 2)  # the distribution of chi-square
    share = degrees_of_freedom / (degrees_of_freedom - 2)
    return fdtr(dimension, degrees_of_freedom, np.asarray(squares) / dimension * share)


def radius_of(
    probability: float, dimension: int = 1, degrees_of_freedom: float | None = None
) -> float:
    """Radius, in standard deviations, of the region that holds the truth with a probability.

    The inverse of `probability_within`.

    Examples
    --------
    >>> round(radius_of(0.95), 2), round(radius_of(0.95, 3), 2), round(radius_of(0.95, 1, 5), 2)
    (1.96, 2.8, 1.99)
    """
    from scipy.special import fdtri, gammaincinv

    if degrees_of_freedom is None:
        return float(np.sqrt(2 * gammaincinv(dimension / 2, probability)))
    share = (degrees_of_freedom - 2) / degrees_of_freedom
    return float(np.sqrt(dimension * share * fdtri(dimension, degrees_of_freedom, probability)))


@dataclass(frozen=True)
class FewKeypoints:
    """Decrease of the inflation for few given keypoints.

    With few keypoints, errors lie mainly along the main modes, whose variances are learned best, so
    that less inflation is needed.

    Raises InputError if a number is out of range.

    Examples
    --------
    >>> FewKeypoints(typical=12.0, share=0.81).share_of(6)
    0.81
    """

    typical: float  # number of keypoints from which the whole inflation applies
    share: float  # share of the inflation with at most `FEW` keypoints, in (0, 1]

    def __post_init__(self) -> None:
        for name, least, most in (("typical", FEW, math.inf), ("share", 0, 1)):
            value = getattr(self, name)
            if not is_number(value) or not least < value <= most:
                what = f"{value!r} is not a number above {least}, up to {most}"
                raise InputError(what, where=name)
            object.__setattr__(self, name, float(value))

    def share_of(self, count: float) -> float:
        """Share of the inflation for a number of given keypoints."""
        position = math.log(max(count, FEW) / FEW) / math.log(self.typical / FEW)
        return math.pow(self.share, 1 - min(position, 1.0))


def inflation_with(count: float, inflation: float, few_keypoints: FewKeypoints | None) -> float:
    """Inflation for a number of given keypoints."""
    return inflation if few_keypoints is None else inflation * few_keypoints.share_of(count)


def check_text(text: object, where: str) -> str:
    """Check and convert a text; other types could be saved, but not read back."""
    if not isinstance(text, str):
        what = f"expected a text, got {type(text).__name__} {quote(text)}"
        raise InputError(what, where=where, fix="give str(...) of it")
    return str(text)


def check_axis(axis: object, where: str) -> None:
    """Raise an InputError if a value is not "x", "y" or "z"."""
    if not isinstance(axis, str) or axis not in ("x", "y", "z"):
        raise InputError(f"{quote(axis)} is not an axis", where=where, fix="give x, y or z")


def check_box(box: npt.ArrayLike, where: str) -> FloatArray:
    """Check least and greatest corners (2, 3); raises InputError if they are not in order."""
    corners = as_floats(box, name=where, shape=(2, 3))
    if (corners[0] > corners[1]).any():
        what = f"the least corner {corners[0].tolist()} exceeds {corners[1].tolist()}"
        raise InputError(what, where=where)
    return corners


def plain_name(name: Any) -> Any:
    """Normalise a name for comparison: lower case, spaces for ``_`` and ``-``; numbers stay."""
    if not isinstance(name, str):
        return name
    return " ".join(name.casefold().replace("_", " ").replace("-", " ").split())


def check_ids(ids: Sequence[KeypointId], where: str) -> tuple[KeypointId, ...]:
    """Check keypoint ids: whole numbers or texts, of one kind, each once."""
    found: list[KeypointId] = []
    for row, label in enumerate(ids):
        if isinstance(label, int | np.integer) and not isinstance(label, bool | np.bool_):
            found.append(int(label))
        elif isinstance(label, str) and label.strip():
            found.append(str(label))
        else:
            what = f"{label!r} is neither a whole number nor a name"
            raise InputError(what, where=f"{where}[{row}]")
    if not found:
        raise InputError("there are none", where=where)
    if len({type(label) for label in found}) > 1:
        raise InputError("some are numbers and some are names", where=where, fix="use one kind")
    if len(set(found)) < len(found):
        twice = next(label for row, label in enumerate(found) if label in found[:row])
        raise InputError(f"{twice!r} occurs twice", where=where)
    return tuple(found)
