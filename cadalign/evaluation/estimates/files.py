"""Files of estimates: a name for each, and its poses, read once in every process."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

from cadalign.datasets.photos.dataset import PhotoDataset
from cadalign.datasets.photos.poses import PoseFile
from cadalign.errors import InputError, quote


def method_names(paths: Sequence[Path]) -> tuple[str, ...]:
    """A name for each file: its own without the ending, with its folder's where that is needed.

    Raises
    ------
    InputError
        If a file is given twice.
    """
    twice = next((each for row, each in enumerate(paths) if each in paths[:row]), None)
    if twice is not None:
        raise InputError(f"{quote(str(twice))} is given twice", where="estimates")
    general = ("scene_gt", "annotations", "full_annotations")
    names = [
        f"{path.absolute().parent.name}/{path.stem}" if path.stem in general else path.stem
        for path in paths
    ]
    if len(set(names)) < len(names):
        names = [path.with_suffix("").as_posix() for path in paths]
    return tuple(names)


@lru_cache(maxsize=8)
def opened_estimates(path: Path, dataset: PhotoDataset) -> PoseFile:
    """Open a file of estimates on a data set, once in every process."""
    return dataset.open_poses(path)
