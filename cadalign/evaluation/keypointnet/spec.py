"""Specification of the KeypointNet experiment, and what it shares with others on instances."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

from cadalign.datasets import KeypointNet
from cadalign.errors import InputError
from cadalign.evaluation.keypointnet.experiment import REQUIRED_COLUMNS, keypointnet_benchmark
from cadalign.evaluation.keypointnet.figures import draw_figures
from cadalign.evaluation.keypointnet.options import KeypointNetOptions
from cadalign.evaluation.keypointnet.shapes import NO_SHAPES, ShapeFiles
from cadalign.evaluation.keypointnet.summary import HEADLINE, console_table, lines, summarize
from cadalign.evaluation.keypointnet.tasks import KeypointTask, KeypointTasks
from cadalign.evaluation.metrics.table import INSTANCE_METRICS, UP_TO_SCALE
from cadalign.evaluation.paper.table import PERCENT_NOTE, paper_lines
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.opened import Run
from cadalign.evaluation.runs.work import Plan
from cadalign.evaluation.spec import Reference, Spec, on_datasets

# A chunk is three files: with few instances in each, large runs spend their time on files.
_CHUNK, _CHUNK_DRAWN, _LARGE_CHUNK = 64, 8, 256
_LARGE = 5_000  # views


def plan(options: KeypointNetOptions, folder: RunFolder) -> Plan[KeypointTask]:
    """Plan a run over the views of a dataset's models."""
    dataset = KeypointNet(options.root, shapenet_root=options.shapenet).subset(
        categories=options.categories, split=options.split
    )
    tasks = KeypointTasks(dataset, options)
    drawn = options.render == "overlay"
    if drawn:
        _check_drawable(dataset, options)
    shapes = NO_SHAPES
    of_shapes: dict[str, Any] = {}
    if options.shape is not None:
        shapes = ShapeFiles.find(options.shape, dataset.categories)
        of_shapes = {"shape": str(options.shape.absolute()), "shapes": shapes.fingerprint()}
    pictures = folder.made_for_pictures() if drawn else None
    benchmark = keypointnet_benchmark(options, pictures, shapes)
    given = {name: value for name, value in options.as_config().items() if name != "shape"}
    config = {
        **given,
        **of_shapes,
        "experiment": options.experiment,
        "root": str(options.root.absolute()),
        "annotations": tasks.fingerprint(),
        **benchmark.config,
    }
    large = _CHUNK if len(tasks) < _LARGE else _LARGE_CHUNK
    return Plan(benchmark, tasks, config, _CHUNK_DRAWN if drawn else large)


def _check_drawable(dataset: KeypointNet, options: KeypointNetOptions) -> None:
    """Refuse overlays, before the run, where there is no mesh to draw."""
    if options.visibility == "hull":
        raise InputError(
            "visibility hull uses no meshes, so that there is nothing to draw",
            where="render",
            fix="choose auto or rays, or draw nothing",
        )
    if not dataset.subset(with_mesh=True).ids():
        raise InputError(
            "none of the models has a mesh, so that there is nothing to draw",
            where="render",
            fix="name ShapeNet's folder by shapenet, or draw nothing",
        )


def describe(run: Run) -> str:
    """Numbers of views, models and categories, the dataset and the noise."""
    views, models = run.count("category", "model_id", "view"), run.count("category", "model_id")
    categories = run.count("category")
    view_words = "" if views == models else f"{views:,} views of "
    model_words = "1 model" if models == 1 else f"{models:,} models"
    category_words = "1 category" if categories == 1 else f"{categories:,} categories"
    noise = f"{run.noise_px or 0:g} px of noise"
    return f"on {view_words}{model_words} in {category_words} of {run.dataset}, {noise}"


def reference(runs: Sequence[Run], groups: set[str]) -> Reference:
    """The paper's numbers on the same categories; all of them are about 1 px of noise."""
    if 1.0 not in {run.noise_px for run in runs}:
        return Reference((), "")
    stated = tuple(line for line in paper_lines() if line.group in groups)
    return Reference(stated, f"{PERCENT_NOTE} Its models and views are others." if stated else "")


ON_INSTANCES: dict[str, Any] = {
    "columns": HEADLINE,
    "results": REQUIRED_COLUMNS,
    "summarize": summarize,
    "lines": lines,
    "table": console_table,
    "metrics": (*INSTANCE_METRICS, *UP_TO_SCALE),
    "kind": lambda run: "views of models",
    "title": partial(on_datasets, "alignment"),
    "describe": describe,
    "about": (
        "Each picture shows a model as it is; methods get its visible keypoints, with noise, and "
        "the model stretched by unknown factors along y and z. Green is the truth, red the "
        "prediction."
    ),
    "note": (
        "Medians over the instances that did not fail; the rates count failures, and not "
        "the instances that were skipped, since no view shows enough of their keypoints. The "
        "symmetry-aware error (sym.) takes rotations that map a model onto itself for right. A "
        "rate counts instances whose symmetry-aware rotation, translation in diagonals of the "
        "model and both scales are that good."
    ),
    "reference": reference,
}
"""Members of the specification of every experiment on views of models."""

SPEC = Spec(options=KeypointNetOptions, plan=plan, write_more=draw_figures, **ON_INSTANCES)
