"""Known directions and distances as the kernels take them: gravity, camera height, lengths."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.estimation.prior import ShapePrior
from cadalign.estimation.view import View
from cadalign.io.evidence import LENGTHS, Size
from cadalign.solvers.joint.evidence import Directions, Offsets

_CAMERA = -1  # in the place of a point's row


def known_directions(prior: ShapePrior, views: Sequence[View]) -> Directions:
    """Gravity in the views.

    Raises InputError if a view has some and the model no up axis.
    """
    told = [number for number, view in enumerate(views) if view.up is not None]
    ups = [cast(FloatArray, views[number].up) for number in told]
    whitening = [
        _across(up, views[number].up_sigma_deg) for number, up in zip(told, ups, strict=True)
    ]
    return Directions(
        np.array([_upward("up", prior, number) for number in told], dtype=float).reshape(-1, 3),
        np.array(ups, dtype=float).reshape(-1, 3),
        np.array(told, dtype=np.int64),
        np.array(whitening).reshape(-1, 3, 3),
    )


def _across(direction: FloatArray, sigma_deg: Any) -> FloatArray:
    """Whitening (3, 3) of a difference from a unit vector [1/rad]; along it as weak as across.

    ``sigma_deg`` is its deviation about each axis across it [degrees], or a covariance (3, 3).
    """
    sigma = np.asarray(sigma_deg, dtype=np.float64)
    if not sigma.ndim:
        return np.asarray(np.eye(3) / np.radians(sigma))
    along = np.outer(direction, direction)
    across = np.eye(3) - along
    covariance = across @ np.radians(np.radians(sigma)) @ across
    largest = np.linalg.eigvalsh(covariance)[-1]
    return np.asarray(np.linalg.cholesky(np.linalg.inv(covariance + largest * along)).T)


def known_distances(prior: ShapePrior, views: Sequence[View], size: Size | None) -> Offsets:
    """Lengths of the box between its corners, and heights of cameras above the lowest corner.

    Raises InputError if a view has a height and the model no up axis, or no extent along a length.
    """
    shape = prior.components[0]
    corners = len(shape.mean) - 2
    ends, images, directions, values, sigmas = [], [], [], [], []
    if size is not None:
        own = (shape.spread[-2:] ** 2).sum()  # corners move by themselves
        for axis in np.flatnonzero(np.isfinite(size.lengths)).tolist():
            if not prior.lengths[axis] > 0:
                what = f"the model has no extent along its {'xyz'[axis]}"
                raise InputError(what, where=f"size.{LENGTHS[axis]}", fix="leave it away")
            ends.append((corners, corners + 1))
            images.append(-1)
            directions.append(np.eye(3)[axis])
            values.append(float(size.lengths[axis]))
            sigmas.append(float(np.sqrt(size.deviations[axis] ** 2 + own)))
    for number, view in enumerate(views):
        if view.camera_height is None:
            continue
        up = _upward("camera_height", prior, number)
        lowest = corners + (0 if up.sum() > 0 else 1)  # the corner that lies in the lowest face
        ends.append((lowest, _CAMERA))
        images.append(number)
        directions.append(up)
        values.append(view.camera_height)
        relative = cast(float, view.camera_height_sigma)
        sigmas.append(float(np.hypot(view.camera_height * relative, shape.spread[lowest])))
    return Offsets(
        np.array(ends, dtype=np.int64).reshape(-1, 2),
        np.array(images, dtype=np.int64),
        np.array(directions, dtype=float).reshape(-1, 3),
        np.array(values, dtype=float),
        np.array([1.0 / sigma for sigma in sigmas], dtype=float),
    )


def _upward(field: str, prior: ShapePrior, view: int) -> FloatArray:
    """The model's up axis (3,); without one an InputError names the ``field`` that asks for it."""
    if prior.up is None:
        fix = f"learn it with an up axis, or leave `{field}` away"
        raise InputError("the model has no up axis", where=f"views[{view}].{field}", fix=fix)
    return prior.up
