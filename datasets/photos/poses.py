"""Estimated poses of models in photos, as result files hold them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cadalign.datasets.photos.photo import Photo
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
    problems: tuple[DataError, ...] = ()


class PoseFile(ABC):
    """The poses of a file that was opened on a data set, by photo.

    Attributes
    ----------
    problems : tuple of DataError
        Why some of its records could not be read.
    """

    problems: tuple[DataError, ...] = ()

    @abstractmethod
    def poses_in(self, photo: Photo) -> tuple[PoseEstimate, ...]:
        """The estimates of a photo's objects, in the unit of the data set."""

    @abstractmethod
    def strays(self, names: Sequence[str]) -> int:
        """Number of estimates, or scans, of photos that are not among these."""
