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

if TYPE_CHECKING:
    from cadalign.evaluation.runs.folder import RunFolder

_LEAST_SAMPLE = 12  # models of each category of a sample dataset
_METHOD = "optimal"
_LEARNED = ", learned shape"
"""End of the category's name of objects whose own model is not used."""
_UNSEEN = ("bottle", "chair")
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


class DemoViews(KeypointViews):
    """Views of models; for learned shapes, the model's box is that of its keypoints."""

    def instances(self, tasks: Sequence[KeypointTask]) -> list[Instance | Exception]:
        return list(map(_with_box, tasks, super().instances(tasks)))


def _with_box(task: KeypointTask, found: Instance | Exception) -> Instance | Exception:
    if isinstance(found, Exception) or not task.category.endswith(_LEARNED):
        return found
    points = found.gt.inverse(found.cam_from_model.apply(task.hull.xyz))
    return replace(found, bounds=extent(points))


def solve_view(view: KeypointView, *, views: DemoViews) -> Any:
    """Align the model, or the learned shape of its category."""
    from cadalign.estimation.align import align
    from cadalign.estimation.view import View
    from cadalign.shapes.model import ShapeModel

    task, seen = view
    if not task.category.endswith(_LEARNED):
        return fit_methods()[_METHOD].solve(views.method_input(view))
    shape, sigma = ShapeModel.pretrained(task.category.removesuffix(_LEARNED)), views.options.sigma
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
    learned = [
        replace(task, category=f"{task.category}{_LEARNED}", view=1)
        for task in tasks
        if options.root is None and task.category in _UNSEEN
    ]
    views = DemoViews(chosen, folder.made_for_pictures())
    benchmark = Benchmark(views, (Method(_METHOD, partial(solve_view, views=views)),))
    more = {"methods": list(chosen.methods), "annotations": tasks.fingerprint()}
    return benchmark.plan(replace(options, root=root), [*tasks, *learned], chunk=1, **more)


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
