"""Experiment on unseen objects, which are not stretched copies of any known model."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from cadalign.datasets import KeypointNet
from cadalign.errors import InputError
from cadalign.evaluation import metrics
from cadalign.evaluation.benchmark import VIEW_NAMES
from cadalign.evaluation.methods import LIMIT, SHAPE
from cadalign.evaluation.options import ViewOptions
from cadalign.evaluation.plots import cumulative_curves
from cadalign.evaluation.registry import Spec
from cadalign.evaluation.runs.work import Columns, Plan, fingerprint
from cadalign.evaluation.summary import (
    Group,
    drop_nan,
    mean,
    mean_of,
    medians,
    milliseconds,
    summarize,
)
from cadalign.io.files import create_folder

if TYPE_CHECKING:
    from cadalign.evaluation.instances.instance import KeypointTask
    from cadalign.evaluation.runs.folder import RunFolder
    from cadalign.shapes.model import ShapeModel

logger = logging.getLogger("cadalign")

METHODS = ("mean-rigid", "mean-stretched", SHAPE, "exact", LIMIT)


@dataclass(frozen=True)
class UnseenOptions(ViewOptions):
    """Evaluate alignment to objects that are not stretched copies of any known model.

    Shapes of categories are learned from the models of one split of KeypointNet. Objects of another
    split are aligned with the mean shape, with the shape model and, for comparison, with the
    object's own model. The run's folder gets results.parquet with a row per object, view and
    method, summary.csv, figures, report.html and the learned shapes. An interrupted run continues
    when the same command is started again.
    """

    experiment = "unseen"
    visibility: ClassVar[str] = "hull"

    _: KW_ONLY
    split: str = "val"
    """Split of the objects to align."""
    train: str = "train"
    """Split of the models from which shapes are learned."""
    noise_px: float = 2.0
    """Standard deviation of the keypoint noise [px]."""
    keypoints: int | None = None
    """Number of keypoints per view, drawn at random; all by default."""
    methods: tuple[str, ...] = METHODS
    """mean-rigid, mean-stretched: the category's mean shape; shape: its shape model; exact: the
    object's own model, stretched; limit: the Cramer-Rao bound of exact."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.split == self.train:
            what, fix = f"both are {self.split!r}", "learn from another split than the objects'"
            raise InputError(what, where="split, train", fix=fix)
        self.check_least(keypoints=1)
        self.check_methods(METHODS)


COLUMNS: Columns = (
    *(*VIEW_NAMES, ("status", str), ("reason", str), ("keypoints", int)),
    *(("rotation_error_deg", float), ("translation_error", float)),
    *(("translation_error_up_to_scale", float), ("box_iou", float)),
    *(("box_iou_up_to_scale", float), ("keypoint_error", float)),
    *(("rotation_level", float), ("stretch_level", float)),
    *(("keypoints_within_68", float), ("keypoints_within_95", float)),
)
"""Columns of the result table; see docs/formats/runs.md."""
_MEDIANS = (
    *(metrics.ROTATION, metrics.TRANSLATION, metrics.TRANSLATION_UP_TO_SCALE),
    *(metrics.BOX_IOU, metrics.BOX_IOU_UP_TO_SCALE, metrics.KEYPOINT_ERROR),
)
_COVERAGE = (
    *(metrics.ROTATION_IN_68, metrics.ROTATION_IN_95),
    *(metrics.STRETCH_IN_68, metrics.STRETCH_IN_95),
    *(metrics.KEYPOINTS_IN_68, metrics.KEYPOINTS_IN_95),
)
HEADLINE = (
    *(metrics.INSTANCES, metrics.FAILED, metrics.KEYPOINTS, *_MEDIANS, *_COVERAGE),
    metrics.QUERY_MILLISECONDS,
)


def _coverage_share(level: str, nominal: float) -> Callable[[Group], float]:
    """Share of the known levels up to the nominal one; NaN if none is known."""
    return lambda group: mean_of((drop_nan(group.solved[level]) <= nominal).astype(float))


_STATISTICS = {
    "keypoints": mean("keypoints"),
    **medians(*_MEDIANS),
    **{
        f"{name}_in_{percent}": _coverage_share(f"{name}_level", percent / 100)
        for name in ("rotation", "stretch")
        for percent in (68, 95)
    },
    **{name: mean(name) for name in ("keypoints_within_68", "keypoints_within_95")},
    "milliseconds": milliseconds,
}
_CONSOLE = (
    *(metrics.INSTANCES, metrics.FAILED, replace(metrics.ROTATION, digits=2)),
    *(replace(metrics.TRANSLATION_UP_TO_SCALE, digits=3), metrics.BOX_IOU_UP_TO_SCALE),
    *(replace(metrics.KEYPOINT_ERROR, digits=3), *_COVERAGE, metrics.QUERY_MILLISECONDS),
)
_CURVES = (
    (metrics.ROTATION, np.array([0.5, 1, 2, 3, 5, 7.5, 10, 15, 20, 30])),
    (replace(metrics.BOX_IOU_UP_TO_SCALE, log=False), np.arange(0, 1.01, 0.1)),
)

# Learned shapes -----------------------------------------------------------------------------------


@lru_cache(maxsize=32)
def learned_shape(folder: Path, category: str) -> ShapeModel:
    """Open the shape model of a category, once per process."""
    from cadalign.shapes.model import ShapeModel

    return ShapeModel.open(folder / f"{category}.shape")


def learn(
    dataset: KeypointNet, categories: Sequence[str], *, split: str, folder: RunFolder
) -> Path:
    """Learn shapes from the models of a split, unless the run's folder holds them already.

    Returns the folder of the shape models, which is named after a hash of the models. Boxes enclose
    the keypoints. Raises InputError if the split does not exist, or a category has too few models
    in it.
    """
    from cadalign.shapes.model import ShapeModel

    train = dataset.subset(categories=categories, split=split)
    models = {category: list(train[category]) for category in categories}
    parts = (
        part
        for category in categories
        for model in models[category]
        for part in (category, model.model_id, model.keypoints.ids, model.keypoints.xyz)
    )
    place = create_folder(folder.path / "learned" / fingerprint(*parts))
    for category in categories:
        file = place / f"{category}.shape"
        if not file.is_file():
            logger.info("learning the shape of %s from %d models", category, len(models[category]))
            ShapeModel.from_dataset(dataset, category, split=split, meshes=False).save(file)
    return place.absolute()


def plan(options: UnseenOptions, folder: RunFolder) -> Plan[KeypointTask]:
    """Plan a run over a split's objects; the run's folder gets the learned shapes."""
    from cadalign.evaluation.instances.unseen import unseen_benchmark, unseen_tasks

    dataset = KeypointNet(options.root, shapenet_root=options.shapenet)
    tasks = unseen_tasks(dataset, options)
    categories = sorted({category for category, _ in tasks.keys})
    learned = learn(dataset, categories, split=options.train, folder=folder)
    benchmark = unseen_benchmark(learned, options)
    return benchmark.plan(options, tasks, annotations=tasks.fingerprint(), learned=learned.name)


SPEC = Spec(
    options=UnseenOptions,
    plan=plan,
    results=COLUMNS,
    columns=HEADLINE,
    summarize=partial(summarize, statistics=_STATISTICS),
    console=_CONSOLE,
    console_note="lengths in model diagonals; scaled: up to a scale about the camera centre",
    plots=partial(cumulative_curves, curves=_CURVES, of="of unseen objects"),
    topic="unseen objects",
    subject="views of objects that are not stretched copies of a known model",
    metrics=_MEDIANS,
    about=(
        "Green is the object with the box of its keypoints, red the estimate of a method: the "
        "object warped to the estimated keypoints, and their box."
    ),
    note=(
        "Medians over the objects that did not fail; lengths in diagonals of the object. Up to "
        "scale: the estimate is first scaled about the camera centre, since one image does not "
        "determine an object's size. Within 68 % and 95 %: the share of truths inside the stated "
        "regions of these probabilities. Uncertainties are calibrated if share and probability "
        "agree."
    ),
)
