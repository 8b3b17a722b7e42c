"""The demonstration: align stretched models to pictures of the originals, and show the result."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from pathlib import Path

from cadalign import __version__
from cadalign.datasets import KeypointNet, write_sample_dataset
from cadalign.errors import DataError
from cadalign.evaluation.accuracy.outcome import Outcome
from cadalign.evaluation.keypointnet.experiment import KeypointNetExperiment, Trial
from cadalign.evaluation.keypointnet.tasks import KeypointTask
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import write_rows
from cadalign.io.files import write_json, write_text

METHOD = "optimal"
"""What the demonstration aligns with."""


def open_dataset(root: Path | None, *, out: Path, per_category: int) -> KeypointNet:
    """The dataset at ``root``, or the sample dataset, written below ``out`` where it is not yet."""
    if root is None:
        root = write_sample_dataset(out / "sample_dataset", per_category=max(per_category, 12))
    return KeypointNet(root)


def choose_models(
    dataset: KeypointNet, *, categories: Sequence[str] | None, per_category: int
) -> list[tuple[str, str]]:
    """The first models with a mesh of every category, as (category, model id).

    Raises
    ------
    DataError
        If there is no mesh at all.
    """
    meshed = dataset.subset(categories=categories, with_mesh=True)
    chosen = [key for category in meshed.categories for key in meshed.ids(category)[:per_category]]
    if not chosen:
        raise DataError(
            "none of the annotated models has a mesh",
            where="root",
            fix="put the meshes beside the annotations, or name the folder that holds both",
        )
    return chosen


def run_demo(
    dataset: KeypointNet,
    keys: Sequence[tuple[str, str]],
    *,
    out: Path,
    noise_px: float = 1.0,
    seed: int = 0,
) -> Iterator[Trial]:
    """Align one view of every model and draw it; yields a trial each.

    Writes ``overlays/<category>_<model id>.png`` below ``out``, and the same picture without boxes
    and a sketch of the model. A model that cannot be used, for whatever reason, yields a trial with
    a failed outcome, and the next one is taken.

    Parameters
    ----------
    dataset : KeypointNet
    keys : sequence of (category, model id)
    out : Path
    noise_px : float
        Noise of the keypoints [px].
    seed : int

    Yields
    ------
    Trial
    """
    folder = RunFolder(out.absolute())
    folder.make_for_pictures()
    experiment = KeypointNetExperiment((METHOD,), noise_px=noise_px, seed=seed, drawn_in=folder)
    for category, model_id in keys:
        task = KeypointTask.of_model(dataset, category, model_id)
        yield from experiment.trials([task])


def write_results(
    out: Path, trials: Sequence[Trial], *, root: Path, noise_px: float, seed: int
) -> None:
    """Write ``results.csv`` with a row per outcome, and the files of a run for the report.

    Raises
    ------
    DataError
        If a file cannot be written.
    """
    outcomes = [outcome for trial in trials for outcome in trial.outcomes]
    text = io.StringIO()
    writer = csv.DictWriter(
        text, fieldnames=[*Outcome.columns(), "seed", "seconds"], lineterminator="\n"
    )
    writer.writeheader()
    for outcome in outcomes:
        writer.writerow({**outcome.row(), "seed": seed, "seconds": outcome.seconds})
    write_text(out / "results.csv", text.getvalue())
    folder = RunFolder(out)
    settings = {"root": str(root.absolute()), "noise_px": noise_px, "seed": seed}
    write_json(
        folder.config_file,
        {
            "experiment": "demo",
            **settings,
            "methods": [METHOD],
            "tasks": len(trials),
            "versions": {"cadalign": __version__},
        },
    )
    experiment = KeypointNetExperiment((METHOD,))
    exhibits = [row for trial in trials for row in trial.exhibits]
    write_rows(folder.exhibits, experiment.exhibit_columns, exhibits)
    write_rows(folder.results, experiment.columns, [outcome.row() for outcome in outcomes])
