"""The demonstration: stretched models aligned to pictures of the originals."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from cadalign.errors import DataError
from cadalign.evaluation.experiments.keypointnet import ON_INSTANCES, KeypointNetOptions
from cadalign.evaluation.options import ExperimentOptions
from cadalign.evaluation.registry import Spec
from cadalign.evaluation.runs.work import Plan

if TYPE_CHECKING:
    from cadalign.evaluation.instances.instance import KeypointTask
    from cadalign.evaluation.runs.folder import RunFolder

METHOD = "optimal"
_LEAST_SAMPLE = 12  # models of each category of a sample dataset


@dataclass(frozen=True)
class DemoOptions(ExperimentOptions):
    """Align stretched models to pictures of the originals and show the result.

    For each model: choose a view, render it, stretch the model by factors from 0.5 to 2 along y
    and z, add noise to its visible keypoints, fit, and draw true (green) and predicted (red) box.
    Writes results.parquet and index.html.
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
    noise_px: float = 1.0
    """Standard deviation of the keypoints' noise, in pixels."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_least(per_category=1)
        self.check_noise("noise_px")

    @property
    def default_workers(self) -> int:
        """A demonstration is over before worker processes have started."""
        return 0


def plan(options: DemoOptions, folder: RunFolder) -> Plan[KeypointTask]:
    """Plan one view of the first models with a mesh of every category."""
    from cadalign.datasets import KeypointNet, write_sample_dataset
    from cadalign.evaluation.experiments.keypointnet import KeypointTasks, keypointnet_benchmark

    root = options.root
    if root is None:
        folder.make()
        least = max(options.per_category, _LEAST_SAMPLE)
        place = folder.path / "sample_dataset"
        root = write_sample_dataset(place, per_category=least)
    dataset = KeypointNet(root).subset(categories=options.categories, with_mesh=True)
    if not dataset.ids():
        raise DataError(
            "none of the annotated models has a mesh",
            where=str(dataset.root),
            fix="put the meshes beside the annotations, or name the folder that holds both",
        )
    views = KeypointNetOptions(
        root,
        methods=(METHOD,),
        noise_px=options.noise_px,
        seed=options.seed,
        max_models=options.per_category,
    )
    tasks = KeypointTasks(dataset, views)
    benchmark = keypointnet_benchmark(views, folder.made_for_pictures())
    more = {"methods": [METHOD], "annotations": tasks.fingerprint()}
    return benchmark.plan(replace(options, root=root), tasks, chunk=1, **more)


SPEC = Spec(options=DemoOptions, plan=plan, **ON_INSTANCES)
