"""Options of the KeypointNet experiment."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from cadalign.evaluation.options import FunctionOptions, ModelOptions, NoiseOption


@dataclass(frozen=True)
class KeypointNetOptions(ModelOptions, NoiseOption, FunctionOptions):
    """Evaluate methods on views of KeypointNet's models.

    Each view shows a model as it is; methods get its visible keypoints, with noise, and the model
    stretched by factors from 0.5 to 2 along y and z. The run's folder gets results.parquet with a
    row per model, view and method, summary.csv, figures, report.html and, if asked for, overlays.
    Killed, it goes on where it was when the same command is started again.
    """

    experiment = "keypointnet"

    root: Annotated[Path, tyro.conf.Positional]
    """Folder in KeypointNet's layout."""
    _: KW_ONLY
    split: str | None = None
    """The dataset's split to take, such as test; all models by default."""
    min_visible: int = 6
    """Least number of keypoints that a view must show."""
    views_per_model: int = 1
    """Number of views of each model."""
    methods: tuple[str, ...] = ("optimal", "aepnp", "aepnp-paper", "epnp", "limit")
    """Methods of `cadalign fit`, optimal-huber, optimal-cauchy, ransac-optimal, ransac-ap4p,
    ransac-aepnp, and limit: the Cramer-Rao bound."""
    shape: Path | None = None
    """File of `cadalign shape learn`, or a folder of such files: adds the method shape, which
    aligns the learned shape of the category and knows nothing of the model; and errors up to scale,
    since one image does not tell the object's size."""
    visibility: Literal["auto", "rays", "hull"] = "auto"
    """Keypoints are seen that rays cast at the mesh reach, or by a rule on the hull of the
    keypoints; auto takes rays where there is a mesh."""
    render: Literal["none", "overlay"] = "none"
    """Draw the first method's result for every model with a mesh, or nothing."""

    def __post_init__(self) -> None:
        from cadalign.evaluation.methods.registry import checked_names

        super().__post_init__()
        object.__setattr__(self, "methods", checked_names(self.methods))
        self.check_least(min_visible=1, views_per_model=1)
        self.check_known(visibility=("auto", "rays", "hull"), render=("none", "overlay"))


OPTIONS = KeypointNetOptions
