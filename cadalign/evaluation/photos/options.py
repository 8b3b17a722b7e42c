"""Options of the experiment on data sets of photos."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from cadalign.errors import InputError
from cadalign.evaluation.options import FunctionOptions, is_function
from cadalign.evaluation.photos import protocols


@dataclass(frozen=True)
class PhotosOptions(FunctionOptions):
    """Evaluate methods on photos of real objects, by the metrics of their data set.

    The folder may hold Scan2CAD, PASCAL3D+, ObjectNet3D or Pix3D. Keypoints
    are the annotated or detected ones; where there are none, visible points of the model's mesh are
    projected with the true pose, with noise, and called simulated. The model's width (x) is given,
    as one image leaves size open; with a shape model in metres it is estimated. The
    run's folder gets results.parquet with a row per object and method, summary.csv, figures and
    report.html. A killed run continues when the same command is started again.
    """

    experiment = "photos"

    root: Annotated[Path, tyro.conf.Positional]
    """Folder of the data set, in any of the known formats."""
    _: KW_ONLY
    categories: tuple[str, ...] | None = None
    """Categories to take; all by default."""
    methods: tuple[str, ...] = ()
    """epnp, rigid; stretched, prior (stretched, with a prior on the scales), similar (prior, and
    keypoints that differ from the model's), shape (a shape model); each also with evidence, as in
    rigid+mask, rigid+image (the photo itself) or similar+mask+gravity; and truth. By default the
    first five, shape where there is one, and the evidence that the data have but the image."""
    shape: tuple[Path, ...] = ()
    """Files of `cadalign shape learn`, each for its category."""
    similar_sigma: float = 0.04
    """Standard deviation of the object's keypoints from the model's, for the method similar, in
    diagonals of the model."""
    max_photos: int | None = None
    """Number of photos to take, the first ones; all by default."""
    pictures: int = 100
    """Number of photos whose pictures the report shows, the first ones."""
    simulated_noise_px: float = 1.0
    """Standard deviation of simulated keypoints, in pixels."""
    simulated_points: int = 24
    """Number of points on a model of which the visible ones are simulated keypoints."""
    sigma: float | None = None
    """Standard deviation of annotated keypoints that methods are given, in pixels; by
    default that of the data set."""
    min_keypoints: int = 6
    """Objects with fewer keypoints are left out."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_least(max_photos=1, pictures=0, simulated_points=4, min_keypoints=1)
        for name in ("sigma", "similar_sigma"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise InputError(f"{value} is not positive", where=name)
        self.check_noise("simulated_noise_px")
        self.replace_values(methods=tuple(dict.fromkeys(self.methods)))
        own = [each for each in self.methods if not is_function(each)]
        for name in own:
            protocols.check_method(name)
        if self.methods:
            self.check_methods((*protocols.BASES, protocols.TRUTH, *own))
