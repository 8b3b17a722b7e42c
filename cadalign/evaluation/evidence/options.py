"""Options of the experiment on evidence beyond keypoints."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import tyro

from cadalign.errors import InputError
from cadalign.evaluation.options import FunctionOptions, ModelOptions, NoiseOption

KEYPOINTS = "keypoints"
MASK, DEPTH, GRAVITY, LENGTH = "mask", "depth", "gravity", "length"
VIEWS_FREE = {"views-2-free": 2, "views-5-free": 5}
VIEWS_KNOWN = {"views-2": 2, "views-5": 5}
DAMAGED = {
    f"mask-{name}": name for name in ("dilated", "eroded", "smoothed", "hidden", "hole", "blob")
}
COMBINED = {
    "gravity+length": (GRAVITY, LENGTH),
    "mask+gravity": (MASK, GRAVITY),
    "mask+depth": (MASK, DEPTH),
    "mask+views-2": (MASK, "views-2"),
    "all": (MASK, DEPTH, GRAVITY, LENGTH, "views-2"),
}
METHODS = (
    *(KEYPOINTS, GRAVITY, LENGTH, DEPTH, *VIEWS_FREE, *VIEWS_KNOWN, MASK, *DAMAGED, *COMBINED),
)
_DEFAULT = tuple(name for name in METHODS if name not in DAMAGED or name == "mask-dilated")


@dataclass(frozen=True)
class EvidenceRunOptions(ModelOptions, NoiseOption, FunctionOptions):
    """Evaluate what masks, further views, depth, gravity and lengths add to keypoints.

    Each view shows a model with a mesh as it is; methods get its visible keypoints with noise, the
    model stretched by factors from 0.5 to 2 along y and z, and one kind of evidence or several.
    Every error is compared with the Cramer-Rao bound of its own instance. The run's folder gets
    results.parquet with a row per view and method, summary.csv, figures and report.html. Killed, it
    goes on where it was when the same command is started again.
    """

    experiment = "evidence"
    visibility: ClassVar[str] = "rays"

    root: Annotated[Path, tyro.conf.Positional]
    """Folder in KeypointNet's layout, with meshes."""
    _: KW_ONLY
    split: str | None = None
    """The dataset's split to take, such as test; all models by default."""
    min_visible: int = 6
    """Least number of keypoints that the first view must show."""
    views_per_model: int = 1
    """Number of instances of each model."""
    methods: tuple[str, ...] = _DEFAULT
    """keypoints: these alone; gravity, length (the height), depth (of the keypoints), mask (of the
    first view): these and one kind of evidence; views-2, views-5: two and five views with known
    camera motion, views-2-free, views-5-free with unknown motion; mask-dilated, mask-eroded (by 2
    px), mask-smoothed (at random, 2 px), mask-hidden (a quarter), mask-hole, mask-blob: damaged
    masks; gravity+length, mask+gravity, mask+depth, mask+views-2, all."""
    depth_sigma: float = 0.005
    """Relative noise of the depths."""
    up_sigma_deg: float = 1.0
    """Noise of the upward direction about each axis across it, in degrees."""
    length_sigma: float = 0.01
    """Relative noise of the height."""
    turn_deg: float = 25.0
    """Angle about the object between neighbouring cameras, in degrees."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_least(min_visible=4, views_per_model=1)
        for name in ("depth_sigma", "up_sigma_deg", "length_sigma", "turn_deg"):
            value = getattr(self, name)
            if not 0 < value < 90:
                raise InputError(f"{value} is not between 0 and 90", where=name)
        from cadalign.evaluation.methods.registry import checked_names

        object.__setattr__(self, "methods", checked_names(self.methods, METHODS))


OPTIONS = EvidenceRunOptions
