"""Options of the demonstration."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from pathlib import Path

from cadalign.evaluation.options import NoiseOption

_THREADS = 2


@dataclass(frozen=True)
class DemoOptions(NoiseOption):
    """Align stretched models to pictures of the originals and show the result.

    For each model: choose a view, render it, stretch the model by factors from 0.5 to 2 along y
    and z, add noise to its visible keypoints, fit, and draw true (green) and predicted (red) box.
    Writes results.csv, overlays/*.png and index.html.
    """

    experiment = "demo"
    command = "demo"

    root: Path | None = None
    """Folder of a dataset in KeypointNet's layout; by default a sample dataset is generated."""
    _: KW_ONLY
    categories: tuple[str, ...] | None = None
    """Categories to take; all by default."""
    per_category: int = 6
    """Largest number of models of each category."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_least(per_category=1)

    @property
    def default_workers(self) -> int:
        """A demonstration is over before worker processes have started."""
        return 0

    @property
    def threads(self) -> int:
        """Drawing, most of the work, lets go of the interpreter lock."""
        return _THREADS


OPTIONS = DemoOptions
