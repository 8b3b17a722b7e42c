"""Estimated poses of models in photos or scenes, as result files of benchmarks hold them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from cadalign.errors import DataError
from cadalign.geometry.alignment import Alignment


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """A model's estimated pose in a photo.

    Parameters
    ----------
    scene : str
        The scene's id; empty where the file does not tell it.
    image : str
        The photo's id in its scene.
    model_id : str
        The model's id.
    cam_from_model : Alignment
        The pose, in the unit of the data set.
    score : float
        Confidence; higher is better.
    seconds : float, optional
        Time that the estimate took, of all objects in the photo.
    """

    scene: str
    image: str
    model_id: str
    cam_from_model: Alignment
    score: float = 1.0
    seconds: float | None = None


@dataclass(frozen=True, eq=False)
class Estimates:
    """The poses in a result file, and why some of its records could not be read.

    Parameters
    ----------
    path : Path
    poses : tuple of PoseEstimate
    problems : tuple of DataError
    """

    path: Path
    poses: tuple[PoseEstimate, ...]
    problems: tuple[DataError, ...] = field(default=())

    @property
    def name(self) -> str:
        """The method's name: the file's, or that of its folder for ``scene_gt.json``."""
        return self.path.parent.name if self.path.name == "scene_gt.json" else self.path.stem
