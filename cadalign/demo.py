"""The demonstration: align stretched models to pictures of the originals, and show the result."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

from cadalign.datasets import KeypointNet, write_sample_dataset
from cadalign.errors import DataError
from cadalign.evaluation.keypoint_tasks import KeypointTask
from cadalign.evaluation.keypointnet import KeypointNetExperiment
from cadalign.evaluation.outcome import Outcome

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
) -> Iterator[Outcome]:
    """Align one view of every model and draw it; yields an outcome each.

    Writes ``overlays/<category>_<model id>.png`` below ``out``. A model that cannot be used, for
    whatever reason, yields a failed outcome, and the next one is taken.

    Parameters
    ----------
    dataset : KeypointNet
    keys : sequence of (category, model id)
    out : Path
        An existing folder.
    noise_px : float
        Noise of the keypoints [px].
    seed : int

    Yields
    ------
    Outcome
    """
    overlays = out / "overlays"
    overlays.mkdir(exist_ok=True)
    experiment = KeypointNetExperiment(
        (METHOD,), noise_px=noise_px, seed=seed, overlays=overlays.absolute()
    )
    for category, model_id in keys:
        task = KeypointTask.of_model(dataset, category, model_id)
        yield from experiment.outcomes([task])


def write_results(path: Path, outcomes: Sequence[Outcome], *, seed: int) -> None:
    """Write a CSV file with a row per outcome."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=[*Outcome.columns(), "seed", "seconds"])
        writer.writeheader()
        for outcome in outcomes:
            writer.writerow({**outcome.row(), "seed": seed, "seconds": outcome.seconds})
