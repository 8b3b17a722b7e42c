"""Unknown focal lengths of views: those of equal cameras are one, the others each their own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.estimation.focal import FocalPrior, focal_grid, log_focal_range
from cadalign.estimation.view import View
from cadalign.geometry.camera import Camera
from cadalign.solvers.joint.evidence import Focals

_SETTLED = 1e-8  # change of a log focal length
ROUNDS = 12  # of linearising lenses with distortion about the focal lengths


@dataclass(frozen=True)
class Lenses:
    """Cameras of views (V,), with focal lengths that are to be estimated.

    Parameters
    ----------
    cameras : tuple of Camera
        The reference of each view: the estimate is a multiple of its focal length.
    groups : tuple of int
        Numbers the focal length of each view; -1 where it is known.
    prior : FocalPrior, optional
    """

    cameras: tuple[Camera, ...]
    groups: tuple[int, ...]
    prior: FocalPrior | None = None

    @classmethod
    def of(cls, views: Sequence[View], focal: str, prior: FocalPrior | None) -> Lenses:
        """The cameras of views, their focal lengths known or to be estimated."""
        cameras = tuple(view.camera for view in views)
        if focal == "known":
            for camera in cameras:
                camera.require_focal()
            return cls(cameras, (-1,) * len(cameras))
        distinct = list(dict.fromkeys(cameras))
        reference = []
        for camera in cameras:
            grid = focal_grid(camera, prior)
            known = prior.focal if prior is not None else float(grid[len(grid) // 2])
            reference.append(camera.with_focal(known))
        return cls(tuple(reference), tuple(distinct.index(camera) for camera in cameras), prior)

    @property
    def count(self) -> int:
        """Number of unknown focal lengths."""
        return max(self.groups, default=-1) + 1

    @property
    def have_distortion(self) -> bool:
        """True if an unknown lens has distortion."""
        return any(
            camera.distortion and group >= 0
            for camera, group in zip(self.cameras, self.groups, strict=True)
        )

    def focals(self) -> Focals:
        """Bounds and priors in the form of the kernels."""
        firsts = [self.cameras[self.groups.index(group)] for group in range(self.count)]
        ranges = [log_focal_range(camera, self.prior, camera.fx) for camera in firsts]
        columns = np.ascontiguousarray(np.array(ranges).reshape(-1, 4).T)
        return Focals(np.array(self.groups, dtype=np.int64), *columns)

    def at(self, log_focals: FloatArray) -> Lenses:
        """The lenses, their references moved to exp(log_focals) (F,) times their focals."""
        return Lenses(tuple(self.cameras_at(log_focals)), self.groups, self.prior)

    def cameras_at(self, log_focals: FloatArray) -> list[Camera]:
        """The cameras of all views at focal lengths (F,), logarithms relative to the references."""
        return [
            camera if group < 0 else camera.with_focal(camera.fx * math.exp(log_focals[group]))
            for camera, group in zip(self.cameras, self.groups, strict=True)
        ]

    def grid(self) -> list[FloatArray]:
        """Focal lengths to start from: (F,) logarithms relative to the references, each."""
        firsts = [self.cameras[self.groups.index(group)] for group in range(self.count)]
        grids = [np.log(focal_grid(camera, self.prior) / camera.fx) for camera in firsts]
        return list(np.array(grids).T) if grids else [np.zeros(0)]

    @staticmethod
    def is_settled(log_focals: FloatArray) -> bool:
        """True if the references are where the estimate is."""
        return bool(np.abs(log_focals).max(initial=0.0) < _SETTLED)
