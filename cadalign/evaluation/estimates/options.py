"""Options of the experiment on estimates of other programs."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import ClassVar

from cadalign.errors import InputError
from cadalign.evaluation.options import ExperimentOptions


@dataclass(frozen=True)
class EstimatesOptions(ExperimentOptions):
    """Score poses that other programs estimated, on photos of a data set.

    The files are BOP's results (CSV) or ``scene_gt.json``, or JSON in the form of Scan2CAD's
    annotations; each is a method, named after its file.
    """

    experiment = "estimates"
    command: ClassVar[str] = "report"

    root: Path
    """Folder of the data set."""
    _: KW_ONLY
    estimates: tuple[Path, ...] = ()
    """Files of estimates."""
    max_photos: int | None = None
    """Number of photos to take, the first ones; all by default."""
    pictures: int = 100
    """Number of photos whose pictures the report shows, the first ones."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_least(max_photos=1, pictures=0)
        if not self.estimates:
            raise InputError("give at least one file", where="estimates")

    @property
    def default_workers(self) -> int:
        """None: starting them takes longer than scoring the poses of hundreds of photos."""
        return 0


OPTIONS = EstimatesOptions
