"""States with the unknowns of contours, and steps between them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.geometry.rotations import rotation_from_vector, vector_from_rotation
from cadalign.solvers.joint.covariance import scaled_information
from cadalign.solvers.joint.evidence import State

OWN_MODES = 3
"""Unknowns of a contour: its offset outwards, its registration along x and along y."""
_LEAST_INFORMATION = 1e-12  # about a direction of the unknowns, relative


class Place(NamedTuple):
    """A state of the evidence, and the coefficients (V, 3) of the contours' own modes.

    Steps change the directions and the logarithms of the distances of objects: where the size is
    hardly known, distance and stretch rise by one factor, which is no straight line otherwise.
    """

    state: State
    own: FloatArray

    @classmethod
    def of(cls, state: State, contours: int = 0) -> Place:
        """The place of a state, nothing known of the contours' own modes."""
        return cls(state, np.zeros((contours, OWN_MODES)))

    def towards(self, other: Place, share: float) -> Place:
        """The place a share of the way to another one."""
        a, b = self.state, other.state
        poses = a.poses.copy()
        for pose, start, end in zip(poses, a.poses, b.poses, strict=True):
            pose[9:] = shifted(start[9:], share * shift_to(start[9:], end[9:]))
            turn = end[:9].reshape(3, 3) @ start[:9].reshape(3, 3).T
            part = rotation_from_vector(share * vector_from_rotation(turn))
            pose[:9] = (part @ start[:9].reshape(3, 3)).ravel()
        rest = [x + share * (y - x) for x, y in zip(a[1:], b[1:], strict=True)]
        return Place(State(poses, *rest), self.own + share * (other.own - self.own))

    def moved(self, step: FloatArray) -> Place:
        """The place after a step (U,) of poses, focal lengths, scales and own modes."""
        state, count = self.state, len(self.state.poses)
        poses = state.poses.copy()
        ends = np.cumsum([6 * count, len(state.log_focals), 3])
        steps, focals, scales, own = np.split(step, ends)
        for pose, part in zip(poses, steps.reshape(-1, 6), strict=True):
            pose[:9] = (rotation_from_vector(part[:3]) @ pose[:9].reshape(3, 3)).ravel()
            pose[9:] = shifted(pose[9:], part[3:])
        moved = state._replace(
            poses=poses,
            log_focals=state.log_focals + focals,
            log_scales=state.log_scales + scales,
        )
        return Place(moved, self.own + own.reshape(self.own.shape))


def shifted(place: FloatArray, step: FloatArray) -> FloatArray:
    """A place (3,) after a step, whose part along the direction changes the logarithm."""
    distance = float(np.linalg.norm(place))
    if not distance > 0:
        return place + step
    direction = place / distance
    along = float(direction @ step)
    across = step - along * direction
    angle = float(np.linalg.norm(across)) / distance
    turned = np.cos(angle) * direction + np.sinc(angle / np.pi) * across / distance
    return np.asarray(distance * np.exp(along / distance) * turned)


def shift_to(place: FloatArray, other: FloatArray) -> FloatArray:
    """The step that `shifted` takes from a place to another one."""
    distance, far = float(np.linalg.norm(place)), float(np.linalg.norm(other))
    if not distance > 0 or not far > 0:
        return other - place
    direction, goal = place / distance, other / far
    across = goal - (goal @ direction) * direction
    sine = float(np.linalg.norm(across))
    angle = np.arctan2(sine, goal @ direction)
    across *= angle / sine if sine > 0 else 0.0
    return np.asarray(distance * (np.log(far / distance) * direction + across))


def solved(information: FloatArray, right: FloatArray) -> FloatArray:
    """The covariance times columns (U, k), of unknowns of which next to nothing may be known."""
    matrix, sizes = scaled_information(information)
    matrix = matrix + _LEAST_INFORMATION * np.eye(len(sizes))
    return np.asarray(np.linalg.solve(matrix, right / sizes[:, None]) / sizes[:, None])


def weakest_steps(information: FloatArray, count: int) -> list[FloatArray]:
    """Steps (U,) of one standard deviation along the directions of which least is known."""
    matrix, sizes = scaled_information(information)
    values, vectors = np.linalg.eigh(matrix)
    roots = np.sqrt(np.maximum(values[:count], _LEAST_INFORMATION))
    return list((vectors[:, :count] / roots / sizes[:, None]).T)
