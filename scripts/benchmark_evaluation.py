"""Measure evaluation: instances a second on annotations alone, by one core.

Ratios are those of processor time to `common.reference_seconds`, measured in turns.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import tyro
from common import figure, processor_seconds, reference_seconds, write_figures

from cadalign.datasets import KeypointNet
from cadalign.evaluation.keypointnet.experiment import KeypointNetExperiment
from cadalign.evaluation.keypointnet.options import KeypointNetOptions
from cadalign.evaluation.keypointnet.tasks import KeypointTasks

CHUNK = 100


@dataclass
class Arguments:
    """Measure evaluation."""

    root: tyro.conf.Positional[Path]
    """Folder in KeypointNet's layout."""
    count: int = 2000
    """Instances on annotations alone."""
    json: Path | None = None
    """File for the figures, as `compare_ratios.py` reads them."""


def evaluate_all(experiment: KeypointNetExperiment, tasks: KeypointTasks, count: int) -> None:
    """Evaluate the first tasks, chunk by chunk."""
    for start in range(0, count, CHUNK):
        experiment.evaluate(tasks[start : min(start + CHUNK, count)])


def on_annotations(root: Path, count: int, method: str) -> dict[str, Any]:
    """Rate of instances whose meshes are not looked at."""
    options = KeypointNetOptions(root, visibility="hull", methods=(method,))
    tasks = KeypointTasks(KeypointNet(root), options)
    experiment = KeypointNetExperiment(options, None)
    experiment.warm_up()
    count = min(count, len(tasks))
    reference = reference_seconds()
    seconds = processor_seconds(partial(evaluate_all, experiment, tasks, count))
    reference = min(reference, reference_seconds())
    return figure(count / seconds, "1/s", 1e3 * seconds / count / reference)


def main(arguments: Arguments) -> None:
    """Measure all, print and write the figures."""
    figures = {}
    for method in ("aepnp", "optimal"):
        name = f"evaluation on annotations, {method}"
        figures[name] = on_annotations(arguments.root, arguments.count, method)
    for name, found in figures.items():
        print(f"{name:36} {found['value']:8.1f} {found['unit']:4} ratio {found['ratio']:.2f}")
    write_figures(arguments.json, figures)


if __name__ == "__main__":
    main(tyro.cli(Arguments))
