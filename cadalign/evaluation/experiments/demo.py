"""The demonstration: stretched models aligned to pictures of the originals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cadalign.errors import DataError
from cadalign.evaluation import metrics
from cadalign.evaluation.experiments.keypointnet import ON_INSTANCES, TABLE, KeypointNetOptions
from cadalign.evaluation.options import NoiseOption
from cadalign.evaluation.registry import Spec
from cadalign.evaluation.runs.work import Plan
from cadalign.evaluation.summary import ALL, ConsoleTable, Summary, csv_text
from cadalign.io.files import write_text

if TYPE_CHECKING:
    from cadalign.evaluation.instances.instance import KeypointTask
    from cadalign.evaluation.runs.folder import RunFolder
    from cadalign.evaluation.runs.tables import Run

METHOD = "optimal"
_LEAST_SAMPLE = 12  # models of each category of a sample dataset
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


def plan(options: DemoOptions, folder: RunFolder) -> Plan[KeypointTask]:
    """Plan one view of the first models with a mesh of every category.

    Another demonstration in the folder is replaced, one that was interrupted goes on.
    """
    from cadalign.datasets import KeypointNet, write_sample_dataset
    from cadalign.evaluation.instances.instance import AUTO, KeypointTask
    from cadalign.evaluation.instances.views import keypointnet_benchmark

    root = options.root
    if root is None:
        folder.make()
        least = max(options.per_category, _LEAST_SAMPLE)
        place = folder.path / "sample_dataset"
        root = write_sample_dataset(place, per_category=least, keep=True)
    dataset = KeypointNet(root)
    meshed = dataset.subset(categories=options.categories, with_mesh=True)
    keys = [
        key
        for category in meshed.categories
        for key in meshed.ids(category)[: options.per_category]
    ]
    if not keys:
        raise DataError(
            "none of the annotated models has a mesh",
            where=str(dataset.root),
            fix="put the meshes beside the annotations, or name the folder that holds both",
        )
    config = {
        "experiment": options.experiment,
        "root": str(dataset.root.absolute()),
        "noise_px": options.noise_px,
        "seed": options.seed,
        "methods": [METHOD],
        "models": ["/".join(key) for key in keys],
    }
    _clear(folder, config)
    views = KeypointNetOptions(
        root, methods=(METHOD,), noise_px=options.noise_px, seed=options.seed
    )
    benchmark = keypointnet_benchmark(views, folder.made_for_pictures())
    tasks = [KeypointTask.of_model(dataset, *key, visibility=AUTO) for key in keys]
    return Plan(benchmark, tasks, config, chunk_size=1)


def _clear(folder: RunFolder, config: dict[str, Any]) -> None:
    """Remove a demonstration that is finished or another one."""
    found = folder.read_config()
    if found is None or found.get("experiment") != config["experiment"]:
        return
    if not folder.is_finished and all(found.get(name) == config[name] for name in config):
        return
    folder.remove()


def _table(run: Run, summaries: Sequence[Summary]) -> ConsoleTable:
    counts = (metrics.INSTANCES, metrics.FAILED)
    return ConsoleTable(
        title="Medians per category",
        labels=("category",),
        heads=tuple(column.heading for column in (*counts, *TABLE)),
        rows=[
            (s.group, *(column.text(s[column.key]) for column in (*counts, *TABLE)))
            for s in summaries
            if s.group != ALL
        ],
        note="",
        grouped=False,
        wraps=True,
    )


def _write_csv(run: Run, summaries: Sequence[Summary]) -> None:
    names = run.results.column_names
    seconds = ["" if time != time else time for time in run.cells["seconds"].tolist()]
    rows = [
        [*(row[name] for name in names), run.config["seed"], time]
        for row, time in zip(run.results.to_pylist(), seconds, strict=True)
    ]
    write_text(run.folder.path / "results.csv", csv_text([[*names, "seed", "seconds"], *rows]))


SPEC = Spec(
    options=DemoOptions, plan=plan, write_more=_write_csv, **{**ON_INSTANCES, "table": _table}
)
