"""Options of the experiment on unseen objects."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from cadalign.errors import InputError
from cadalign.evaluation.options import FunctionOptions, ModelOptions, NoiseOption

RANDOM_RIGID, RANDOM_STRETCHED = "random-rigid", "random-stretched"
NEAREST = "nearest"
MEAN_RIGID, MEAN_STRETCHED = "mean-rigid", "mean-stretched"
SHAPE, EXACT, LIMIT = "shape", "exact", "limit"
METHODS = (
    *(RANDOM_RIGID, RANDOM_STRETCHED, NEAREST, MEAN_RIGID, MEAN_STRETCHED),
    *(SHAPE, EXACT, LIMIT),
)


@dataclass(frozen=True)
class UnseenOptions(ModelOptions, NoiseOption, FunctionOptions):
    """Evaluate alignment to objects that are no stretched copy of any model.

    Objects of one split of KeypointNet are aligned with what the other split tells of their
    category: another model, the nearest one of a library, the mean shape, or the learned shape
    model; and, for comparison, with the object's own model. The run's folder gets results.parquet
    with a row per object, view and method, summary.csv, figures, report.html and the learned
    shapes. Killed, it goes on where it was when the same command is started again.
    """

    experiment = "unseen"

    root: Annotated[Path, tyro.conf.Positional]
    """Folder in KeypointNet's layout, with splits."""
    _: KW_ONLY
    split: str = "val"
    """Split of the objects."""
    train: str = "train"
    """Split of the models to learn from."""
    noise_px: float = 2.0
    """Standard deviation of the keypoints' noise, in pixels."""
    keypoints: int | None = None
    """Number of keypoints that are given, drawn at random; all by default."""
    outliers: float = 0.0
    """Share of the given keypoints that are moved to anywhere in the image; methods then search
    for those that agree."""
    views_per_model: int = 1
    """Number of views of each object."""
    meshes: bool = False
    """Keep small copies of the objects' meshes, which the report shows warped to the estimates."""
    methods: tuple[str, ...] = METHODS
    """random-rigid, random-stretched: a random model of the category; nearest: the best of the
    library; mean-rigid, mean-stretched: the category's mean; shape: its shape model; exact: the
    object's own model, stretched; limit: the Cramer-Rao bound of the latter."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_least(keypoints=1, views_per_model=1)
        if not 0 <= self.outliers < 1:
            raise InputError(f"{self.outliers} is not a share below 1", where="outliers")
        from cadalign.evaluation.methods.registry import checked_names

        object.__setattr__(self, "methods", checked_names(self.methods, METHODS))
        if self.split == self.train:
            what, fix = f"both are {self.split!r}", "objects must not be among the models"
            raise InputError(what, where="split, train", fix=fix)


OPTIONS = UnseenOptions
