"""The demonstration: views of sample models, aligned with the models and with learned shapes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cadalign.datasets import KeypointNet
from cadalign.errors import DataError
from cadalign.evaluation.benchmark import Benchmark
from cadalign.evaluation.experiments import keypointnet
from cadalign.evaluation.experiments.keypointnet import (
    KeypointNetOptions,
    KeypointTasks,
    KeypointView,
    KeypointViews,
)
from cadalign.evaluation.instances.instance import Instance, KeypointTask
from cadalign.evaluation.instances.record import aligned_shape
from cadalign.evaluation.methods import Method, fit_methods
from cadalign.evaluation.options import ExperimentOptions
from cadalign.evaluation.runs.work import Plan
from cadalign.geometry.alignment import extent
from cadalign.io.pretrained import pretrained_path

if TYPE_CHECKING:
    from cadalign.evaluation.runs.folder import RunFolder

_LEAST_SAMPLE = 12  # models of each category of a sample dataset
_METHOD = "optimal"
_SHAPES = ("bottle", "chair")
"""Categories of the sample dataset whose keypoints have KeypointNet's ids."""


@dataclass(frozen=True)
class DemoOptions(ExperimentOptions):
    """Align stretched models to pictures of the originals and show the results.

    For each model: draw a view, render it, stretch the model by random factors from 0.5 to 2 along
    y and z, add 1 px of noise to its visible keypoints, fit, and draw the true (green) and the
    estimated (red) box. Bottles and chairs of the generated dataset are also aligned with the
    learned shapes that come with the package, which know nothing of these models; boxes are those
    of the keypoints there. Writes results.parquet and index.html.
    """

    experiment = "demo"
    command = "demo"

    root: Path | None = None
    """Folder in KeypointNet's layout; a generated sample dataset by default."""
    _: KW_ONLY
    categories: tuple[str, ...] | None = None
    """Categories to use; all by default."""
    per_category: int = 6
    """Maximum number of models per category."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_least(per_category=1)

    @property
    def default_workers(self) -> int:
        """None: starting worker processes would take longer than the demonstration."""
        return 0


class ShapeTask(KeypointTask):
    """One view of an object whose own model is not used, but its category's learned shape."""


class DemoViews(KeypointViews):
    """Views of models; for learned shapes, the model's box is that of its keypoints."""

    def instances(self, tasks: Sequence[KeypointTask]) -> list[Instance | Exception]:
        found = super().instances(tasks)
        for row, (task, each) in enumerate(zip(tasks, found, strict=True)):
            if isinstance(task, ShapeTask) and isinstance(each, Instance):
                points = each.gt.inverse(each.cam_from_model.apply(task.hull.xyz))
                found[row] = replace(each, bounds=extent(points))
        return found


def solve_view(view: KeypointView, *, views: DemoViews) -> Any:
    """Align the model, or the learned shape of its category."""
    from cadalign.estimation.align import align
    from cadalign.estimation.view import View
    from cadalign.shapes.model import open_shape

    task, seen = view
    if not isinstance(task, ShapeTask):
        return fit_methods()[_METHOD].solve(views.method_input(view))
    assert task.model is not None
    shape, sigma = open_shape(pretrained_path(task.model.category)), views.options.sigma
    known = np.isin(seen.ids, shape.ids)
    ids = seen.ids[known].tolist()
    found = align(shape, View(seen.camera, seen.points_2d[known], ids=ids, sigma=sigma))
    rows, points = shape.rows(ids), seen.points_3d[known]
    return aligned_shape(found, rows, points, model_bounds=seen.bounds, sigma=sigma, result=found)


def plan(options: DemoOptions, folder: RunFolder) -> Plan[KeypointTask]:
    """Plan one view of the first models with a mesh in every category."""
    root = options.root
    if root is None:
        from cadalign.datasets import write_sample_dataset

        folder.make()
        least = max(options.per_category, _LEAST_SAMPLE)
        root = write_sample_dataset(folder.path / "sample_dataset", per_category=least)
    dataset = KeypointNet(root).subset(categories=options.categories, with_mesh=True)
    if not dataset.ids():
        raise DataError(
            "none of the annotated models has a mesh",
            where=str(dataset.root),
            fix="put the meshes beside the annotations, or give the folder that holds both",
        )
    chosen = KeypointNetOptions(
        root, methods=(_METHOD,), seed=options.seed, max_models=options.per_category
    )
    tasks = KeypointTasks(dataset, chosen)
    of_shapes = [
        ShapeTask(**vars(task) | {"category": f"{task.category}, learned shape", "view": 1})
        for task in tasks
        if options.root is None and task.category in _SHAPES
    ]
    views = DemoViews(chosen, folder.made_for_pictures())
    benchmark = Benchmark(views, (Method(_METHOD, partial(solve_view, views=views)),))
    more = {"methods": list(chosen.methods), "annotations": tasks.fingerprint()}
    return benchmark.plan(replace(options, root=root), [*tasks, *of_shapes], chunk=1, **more)


_ABOUT = (
    "With a learned shape, methods get the shape of the category and no model; boxes are those of "
    "the keypoints."
)
SPEC = replace(
    keypointnet.SPEC,
    options=DemoOptions,
    plan=plan,
    plots=lambda runs: [],
    about=f"{keypointnet.SPEC.about} {_ABOUT}",
)
