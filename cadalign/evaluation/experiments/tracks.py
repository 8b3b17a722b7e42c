"""The experiment on tracks: objects through videos, of a shape that is no model's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from cadalign.errors import InputError
from cadalign.evaluation.benchmark import VIEW_NAMES
from cadalign.evaluation.metrics import table as metrics
from cadalign.evaluation.metrics.photos import DEPTH, YAW
from cadalign.evaluation.options import FunctionOptions, NoiseOption, SplitOptions
from cadalign.evaluation.plots import cumulative_curves
from cadalign.evaluation.registry import Spec
from cadalign.evaluation.runs.work import Columns, Plan
from cadalign.evaluation.summary import (
    ConsoleTable,
    Summary,
    by_category_and_method,
    mean,
    median,
    milliseconds,
)

if TYPE_CHECKING:
    from cadalign.evaluation.instances.tracks import TrackTask
    from cadalign.evaluation.runs.folder import RunFolder
    from cadalign.evaluation.runs.tables import Run

METHODS = ("frames", "shared", "smooth", "online")
_SAMPLE = 60  # models of each category of a generated data set


@dataclass(frozen=True)
class TracksOptions(SplitOptions, NoiseOption, FunctionOptions):
    """Evaluate tracks of objects through videos.

    Videos are simulated of the objects of one split of KeypointNet, whose shape is learned from the
    other split, by category: an object moves smoothly, and frames show a part of its keypoints. Or
    they are tracks of a folder of KITTI's cars with car_tracks.json, whose keypoints a network
    found. The run's folder gets results.parquet with a row per video and method, summary.csv,
    figures, report.html and the learned shapes. A killed run continues when the same command is
    started again.
    """

    experiment = "tracks"

    root: Annotated[Path | None, tyro.conf.Positional] = None
    """Folder in KeypointNet's layout, or of KITTI's cars; by default a sample dataset is
    generated."""
    _: KW_ONLY
    categories: tuple[str, ...] | None = None
    """Categories to take; all by default."""
    max_models: int | None = None
    """Largest number of models of each category."""
    noise_px: float = 2.0
    """Standard deviation of the keypoints' noise, in pixels; of KITTI's what methods are told."""
    frames: int = 40
    """Frames of a simulated video."""
    rate: float | None = None
    """Frames in a second; by default 30, of KITTI 10."""
    visible: float = 0.7
    """Share of the keypoints that a simulated frame shows."""
    correlation: float = 0.0
    """Correlation of the noise of a keypoint in successive simulated frames."""
    flipped: float = 0.0
    """Share of the simulated frames whose keypoints are those of the object turned by half;
    methods then expect outliers."""
    outliers: float = 0.0
    """Share of the simulated keypoints that are moved to anywhere in the image; likewise."""
    robust: bool = False
    """Let methods expect outliers in any case."""
    methods: tuple[str, ...] = METHODS
    """frames: each frame alone; shared: one shape for all frames, unknown motion; smooth: with
    smooth motion as well; online: the newest frame of a running video."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_least(max_models=1, frames=3)
        for name in ("rate", "visible"):
            value = getattr(self, name)
            if value is not None and not 0 < value < np.inf:
                raise InputError(f"{value:g} is not positive", where=name)
        for name in ("visible", "correlation", "flipped", "outliers"):
            if not 0 <= getattr(self, name) <= 1:
                what = f"{getattr(self, name):g} is not between 0 and 1"
                raise InputError(what, where=name)
        self.check_methods(METHODS)

    @property
    def is_robust(self) -> bool:
        """True if methods are to expect outliers."""
        return self.robust or self.flipped > 0 or self.outliers > 0


COLUMNS: Columns = (
    *(*VIEW_NAMES, ("status", str), ("reason", str)),
    *(("frames", int), ("keypoints", float), ("found", float)),
    *(("rotation_error_deg", float), ("rotation_error_deg_90", float), ("yaw_error_deg", float)),
    ("depth_error_relative", float),
    *(("absolute_rotation_deg", float), ("absolute_translation", float)),
    *(("relative_rotation_deg", float), ("relative_translation", float)),
    *(("jitter_deg", float), ("flips", int), ("rotation_in_95", float)),
)
"""Columns of the result table; see docs/formats/runs.md."""
_MEDIANS = (
    *(metrics.ROTATION, metrics.ROTATION_90, YAW, DEPTH),
    *(metrics.ABSOLUTE_ROTATION, metrics.ABSOLUTE_TRANSLATION),
    *(metrics.RELATIVE_ROTATION, metrics.RELATIVE_TRANSLATION, metrics.JITTER),
)
_MEANS = (metrics.KEYPOINTS, metrics.FOUND_FRAMES, metrics.FLIPS, metrics.ROTATION_IN_95)
_SHOWN = (
    *(replace(metrics.ROTATION, digits=2), replace(metrics.ROTATION_90, digits=1), *_MEDIANS[2:4]),
    *(metrics.RELATIVE_ROTATION, metrics.JITTER, metrics.FLIPS, metrics.ROTATION_IN_95),
)


def console_table(run: Run, summaries: Sequence[Summary]) -> ConsoleTable:
    """The summaries for the console, without columns that no video has."""
    columns = (metrics.INSTANCES, metrics.FAILED, *_SHOWN, metrics.QUERY_MILLISECONDS, *run.metrics)
    return ConsoleTable.of(
        "Medians over the videos, per category and method",
        summaries,
        [c for c in columns if metrics.told(c, [s.number(c.key) for s in summaries])],
        note="a video's rotation and depth error are its frames' median, R90 their 90th percentile",
        narrow=True,
        wraps=True,
    )


_CURVES = (
    (metrics.ROTATION, np.array([0.5, 1, 2, 3, 5, 7.5, 10, 15, 20, 30])),
    (metrics.JITTER, np.array([0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10])),
)

plots = partial(cumulative_curves, curves=_CURVES, of="of videos")
"""Shares of videos within an error, as `Spec.plots`."""


def plan(options: TracksOptions, folder: RunFolder) -> Plan[TrackTask]:
    """Plan a run over simulated videos, or over the tracks of a folder of KITTI's cars."""
    from cadalign.datasets import write_sample_dataset
    from cadalign.evaluation.instances.tracks import recorded_videos, simulated_videos

    root = options.root
    if root is None:
        folder.make()
        place = folder.path / "sample_dataset"
        root = write_sample_dataset(place, per_category=_SAMPLE, keep=True)
    is_recorded = (root / "car_tracks.json").is_file()
    tasks, benchmark, data = (
        recorded_videos(root, options) if is_recorded else simulated_videos(root, options, folder)
    )
    return benchmark.plan(options, tasks, chunk=1, data=data)


def _describe(run: Run) -> str:
    count = run.count("category", "model_id", "view")
    return f"on {count:,} videos of {run.dataset}, {run.noise_px or 0:g} px of noise"


SPEC = Spec(
    options=TracksOptions,
    plan=plan,
    results=COLUMNS,
    columns=(
        *(metrics.INSTANCES, metrics.FAILED, *_MEANS[:2], *_MEDIANS, *_MEANS[2:]),
        metrics.QUERY_MILLISECONDS,
    ),
    summarize=lambda run: by_category_and_method(
        run,
        {
            **{each.key: median(each.key) for each in _MEDIANS},
            **{each.key: mean(each.key) for each in _MEANS},
            "milliseconds": milliseconds,
        },
    ),
    table=console_table,
    plots=plots,
    topic="tracks",
    describe=_describe,
    note=(
        "Medians over the videos that did not fail, of each video's median over its frames (90 %: "
        "its 90th percentile); flips are means. Places are those of the box's centre. Absolute and "
        "relative pose errors are root mean squares over a video, the relative ones of motions "
        "from frame to frame; jitter is the standard deviation of the rotation's second "
        "difference. Within 95 %: how often a frame's true rotation lies in the region of this "
        "probability that a method states."
    ),
)
