"""Rotations that map an object onto itself, and the truth nearest to an estimate under them.

An estimate that is off by such a rotation shows the same object in the same place: that is no
error. `cadalign.datasets.models.annotated_symmetry` tells which rotations a model has.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.models.annotated_symmetry import rotations_of
from cadalign.datasets.models.keypoints import Symmetries
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.rotations import rotation_from_vector


@dataclass(frozen=True, eq=False)
class InstanceSymmetry:
    """Rotations about one point that map an object onto itself.

    Parameters
    ----------
    center : (3,) float
        The point [model units].
    rotations : (g, 3, 3) float
        Single rotations; the first is the identity.
    axis : (3,) float, optional
        Any rotation about this axis, of length 1, through the point is a symmetry as well.
    """

    center: FloatArray
    rotations: FloatArray
    axis: FloatArray | None = None

    @property
    def is_trivial(self) -> bool:
        """True where the identity is the only symmetry."""
        return self.axis is None and len(self.rotations) == 1

    def __str__(self) -> str:
        if self.axis is not None:
            return "circle"
        return "none" if self.is_trivial else f"{len(self.rotations)} rotations"

    def nearest_truth(self, *, est: Alignment, gt: Alignment) -> Alignment:
        """The truth, among those that look the same, whose rotation is nearest to the estimate's.

        The symmetries are the object's, so they act on the model after the stretch that makes the
        object of it: x -> R (c + G (S x - c)) + t with the truth's R, S, t. That is again an
        alignment, of the rotation R G and the same scale S, which is why a stretched model's
        truth may be turned without shearing it. An estimate that looks like the truth has zero
        error; one with wrong scales about a right axis keeps the error of its scales.

        The best angle about an axis a follows in closed form: with N = G' R_gt' R_est the trace
        of Rot(a, angle)' N is A cos(angle) + B sin(angle) + a'N a, where A = tr N - a'N a and
        B = a . (N_32 - N_23, N_13 - N_31, N_21 - N_12).
        """
        if self.is_trivial:
            return gt
        relative = gt.rotation.T @ est.rotation
        candidates = [self._turned(rotation, relative) for rotation in self.rotations]
        traces = [float(np.sum(candidate * relative)) for candidate in candidates]
        best = candidates[int(np.argmax(traces))]
        return Alignment(
            gt.rotation @ best,
            gt.translation + gt.rotation @ (self.center - best @ self.center),
            gt.scale,
            is_valid=True,
        )

    def _turned(self, rotation: FloatArray, relative: FloatArray) -> FloatArray:
        """The rotation, turned about the axis as near as possible to ``relative``."""
        if self.axis is None:
            return rotation
        n = rotation.T @ relative
        along = float(self.axis @ n @ self.axis)
        turn = np.array([n[2, 1] - n[1, 2], n[0, 2] - n[2, 0], n[1, 0] - n[0, 1]])
        angle = np.arctan2(float(self.axis @ turn), float(np.trace(n)) - along)
        return np.asarray(rotation @ rotation_from_vector(self.axis * float(angle)))


def symmetry_group(xyz: FloatArray, symmetries: Symmetries) -> InstanceSymmetry:
    """The rotations that map a model with the keypoints (k, 3) onto itself."""
    return InstanceSymmetry(*rotations_of(xyz, symmetries))
