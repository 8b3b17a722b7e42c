"""What was run, on what, in words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import PurePath
from typing import Any

import pyarrow.compute as pc

from cadalign.evaluation.accuracy.methods import LIMIT
from cadalign.report.runs import CORRESPONDENCES, INSTANCES, RETRIEVAL, SIMULATION, Run

_SETTINGS = {
    "root": "dataset",
    "path": "dataset",
    "categories": "categories",
    "split": "split",
    "noise_px": "noise",
    "noises_px": "noise",
    "keypoints": "keypoints",
    "protocols": "protocols",
    "min_visible": "least visible keypoints",
    "views_per_model": "views per model",
    "max_models": "most models per category",
    "visibility": "visibility",
    "render": "pictures",
    "outliers": "outliers",
    "draws": "draws",
    "max_reproj_error": "inliers within",
    "max_iterations": "most samples",
    "methods": "methods",
    "seed": "seed",
}
_UNITS = {"noise_px": " px", "noises_px": " px", "max_reproj_error": " px"}


def summary_of(runs: Sequence[Run]) -> str:
    """One paragraph on what was run, on what, when, and how far it is."""
    return " ".join(_sentences(runs))


def title_of(runs: Sequence[Run]) -> str:
    """What to call a report, in a few words."""
    run = runs[0]
    if run.family == SIMULATION:
        what = f"simulation: {run.config['sweep']['name']}"
    else:
        names = list(dict.fromkeys(_dataset(run) for run in runs))
        kind = "alignment" if run.family == INSTANCES else run.family
        what = f"{kind} on {', '.join(names)}"
    if len(runs) > 1:
        return f"{len(runs)} runs compared: {what}"
    return what[0].upper() + what[1:]


def settings_of(run: Run) -> list[tuple[str, str]]:
    """A run's settings by name."""
    config = {**run.config, **run.config.get("sweep", {})}
    found = [
        (label, f"{_text(config[key])}{_UNITS.get(key, '')}")
        for key, label in _SETTINGS.items()
        if config.get(key) is not None
    ]
    version = run.config.get("versions", {}).get("cadalign")
    return [*found, ("cadalign", str(version))] if version else found


def _sentences(runs: Sequence[Run]) -> Iterator[str]:
    for run in runs:
        before = f"{run.name}: " if len(runs) > 1 else ""
        version = run.config.get("versions", {}).get("cadalign", "of an unknown version")
        yield f"{before}{_what(run)}, with cadalign {version} on {run.day}."
        if not run.is_finished:
            yield (
                f"The run is unfinished, {run.done:,} of {run.total:,} tasks are done: the numbers "
                "are those of the finished ones."
            )
    if runs[0].family == INSTANCES:
        yield (
            "Each picture shows a model as it is; methods get its visible keypoints, with noise, "
            "and the model stretched by unknown factors along y and z. Green is the truth, red the "
            "prediction."
        )


def _what(run: Run) -> str:
    names = [name for name in run.methods if name != LIMIT]
    methods = "one method" if len(names) == 1 else f"{len(names)} methods"
    if LIMIT in run.methods:
        methods += " and the Cramer-Rao limit"
    methods = methods[0].upper() + methods[1:]
    if run.family == INSTANCES:
        return f"{methods} on {_instances(run)}, {run.noise_px or 0:g} px of noise"
    if run.family == CORRESPONDENCES:
        images = len(pc.unique(run.results["image"]))
        return (
            f"{methods} on real correspondences in {_count(images, 'image')} of "
            f"{_dataset(run)}, with a share of them moved to anywhere in the image"
        )
    if run.family == RETRIEVAL:
        models = run.results.group_by(["category", "model_id"]).aggregate([])
        return f"{methods} of finding {_count(len(models), 'model')} of {_dataset(run)} again"
    kind = run.config["sweep"]
    return (
        f"{methods} on the AEPnP paper's simulation, {kind['name']} varied, "
        f"{kind['runs']:,} problems for each value"
    )


def _instances(run: Run) -> str:
    """How many views of how many models of how many categories, and of which dataset."""
    keys = run.results.select(["category", "model_id", "view"])
    views = len(keys.group_by(keys.column_names).aggregate([]))
    models = len(keys.group_by(["category", "model_id"]).aggregate([]))
    categories = len(pc.unique(keys["category"]))
    model_words = f"{_count(models, 'model')} in {_count(categories, 'category', 'categories')}"
    view_words = "" if views == models else f"{_count(views, 'view')} of "
    return f"{view_words}{model_words} of {_dataset(run)}"


def _dataset(run: Run) -> str:
    """The name of the dataset's folder."""
    path = PurePath(str(run.config.get("root") or run.config.get("path") or ""))
    return path.name or "an unknown dataset"


def _count(number: int, one: str, many: str | None = None) -> str:
    return f"{number:,} {one if number == 1 else many or one + 's'}"


def _text(value: Any) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(_text(item) for item in value)
    return f"{value:g}" if isinstance(value, float) else str(value)
