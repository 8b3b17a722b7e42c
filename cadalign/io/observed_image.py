"""One image of an observation: its keypoints, and what else is known about the object in it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cadalign.arrays import FloatArray, IntArray, as_floats, as_points
from cadalign.errors import InputError
from cadalign.geometry.camera import Camera
from cadalign.io.evidence import ImageEvidence
from cadalign.names import renamed


@renamed(semantic_ids="ids", confidences="scores")
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

    def __post_init__(self) -> None:
        points_3d = as_points(self.points_3d, name="points_3d", dimension=3)
        points_2d = as_floats(self.points_2d, name="points_2d", shape=(len(points_3d), 2))
        object.__setattr__(self, "points_3d", points_3d)
        object.__setattr__(self, "points_2d", points_2d)
        for name in ("sigma", "scores"):
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
