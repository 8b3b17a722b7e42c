"""Options of the experiment on real correspondences."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from cadalign.errors import InputError
from cadalign.evaluation.options import FunctionOptions

if TYPE_CHECKING:
    from cadalign.estimation.options import RansacOptions


@dataclass(frozen=True)
class CorrespondenceOptions(FunctionOptions):
    """Evaluate methods on real correspondences with outliers.

    For every image, share of outliers and draw, the scene is stretched by factors from 0.5 to 2
    along y and z, and the share of the image points is moved to anywhere in the image; all methods
    get the same input. The run's folder gets results.parquet with a row per input and method,
    summary.csv, figures and report.html. Killed, it goes on where it was when the same command is
    started again. Times are best measured with --workers 1.
    """

    experiment = "correspondences"

    path: Annotated[Path, tyro.conf.Positional]
    """Folder of a COLMAP or Bundler model, or of a blind-PnP data set's split."""
    _: KW_ONLY
    format: Literal["auto", "colmap", "bundler", "blind-pnp"] = "auto"
    """Format of the folder; auto goes by the names of the files."""
    outliers: tuple[float, ...] = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)
    """Shares of the image points that are moved, from 0 to less than 1."""
    draws: int = 20
    """Number of draws of scales and outliers for every image and share."""
    methods: tuple[str, ...] = (
        "epnp",
        "aepnp-paper",
        "ransac-aepnp",
        "ransac-aepnp-refined",
        "ransac-optimal",
    )
    """Methods of `cadalign fit`, optimal-huber, optimal-cauchy, and those that search for inliers:
    ransac-optimal, ransac-ap4p, and the paper's two steps, ransac-aepnp and ransac-aepnp-refined.
    The others get all points."""
    max_reproj_error: float = 4.0
    """Largest reprojection error of an inlier, in pixels."""
    max_iterations: int = 10_000
    """Bound on the samples of a search for inliers."""
    max_images: int | None = None
    """Largest number of images, the first ones."""

    def __post_init__(self) -> None:
        from cadalign.evaluation.methods.fitted import LIMIT
        from cadalign.evaluation.methods.registry import checked_names

        super().__post_init__()
        object.__setattr__(self, "methods", checked_names(self.methods))
        if LIMIT in self.methods:
            raise InputError(
                "the Cramer-Rao bound needs the noise of the image points, unknown in real images",
                where="methods",
                fix=f"leave {LIMIT!r} out",
            )
        shares = tuple(sorted({float(share) for share in self.outliers}))
        object.__setattr__(self, "outliers", shares)
        if not shares:
            raise InputError("none is given", where="outliers", fix="give shares such as 0 0.5")
        for share in shares:
            if not 0 <= share < 1:
                raise InputError(
                    f"{share:g} is not a share of outliers",
                    where="outliers",
                    fix="give numbers from 0 to less than 1",
                )
        self.check_least(draws=1, max_images=1)
        self.ransac(0)

    def ransac(self, seed: int) -> RansacOptions:
        """The options of a search for inliers; the minimal solver is the method's."""
        from cadalign.estimation.options import RansacOptions

        return RansacOptions(
            max_reproj_error=self.max_reproj_error, max_iterations=self.max_iterations, seed=seed
        )


OPTIONS = CorrespondenceOptions
