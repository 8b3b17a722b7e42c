"""Measure retrieval of objects that are not in the library: box IoU up to scale of the first match.

Objects are those of the split val; shape models are learned from the split train. The library holds
all models but the object's own and those that are the same after a stretch. Each row is a ranking:
by the fit of each model, exact or with a deviation of its shape, and by the estimated shape; models
are stretched, or not. Boxes are those of the keypoints.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from common import Benchmark, new_table, write_results
from rich.console import Console

from cadalign import Box, Library, ShapeModel
from cadalign.datasets import KeypointNet
from cadalign.errors import CadalignError
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.evaluation.unseen.options import UnseenOptions
from cadalign.evaluation.unseen.tasks import UnseenSighting, UnseenTask, UnseenTasks, observe_object
from cadalign.geometry.metrics import box_iou_up_to_scale
from cadalign.retrieval import LibraryModel
from cadalign.retrieval.models import ModelKey
from cadalign.retrieval.shape import SAME_SHAPE, shape_distance

LEAST_SHARED = 4


@dataclass
class UnseenRetrievalArguments(Benchmark):
    """Measure retrieval of objects that are not in the library."""

    root: tyro.conf.Positional[Path] = Path("KEYPOINTNET")
    """Folder in KeypointNet's layout, with splits."""
    categories: tuple[str, ...] = ("chair", "airplane", "bottle", "mug", "guitar")
    """Categories; each is a library of its own."""
    objects: int = 40
    """Objects of each category."""
    keypoints: tuple[int, ...] = (0, 7)
    """Numbers of given keypoints; 0 for all."""
    noise_px: float = 2.0
    """Standard deviation of the keypoints, in pixels."""


def rankings(shape: ShapeModel) -> dict[str, dict[str, Any]]:
    """Options of `Library.retrieve` for each ranking."""
    found: dict[str, dict[str, Any]] = {}
    for suffix, stretch in (("", {}), (", unstretched", {"stretch": "none"})):
        found[f"fit{suffix}"] = stretch
        found[f"fit, shape_sigma{suffix}"] = {"shape_sigma": 0.02, **stretch}
        found[f"shape{suffix}"] = {"shape": shape, **stretch}
    return found


def sightings(
    arguments: UnseenRetrievalArguments, category: str, count: int
) -> Iterator[tuple[str, UnseenSighting]]:
    """Ids and views of a category's objects."""
    options = UnseenOptions(
        root=arguments.root,
        categories=(category,),
        keypoints=count or None,
        noise_px=arguments.noise_px,
    )
    tasks = UnseenTasks(KeypointNet(arguments.root), options)
    step = -(-len(tasks) // arguments.objects)
    for place in range(0, len(tasks), step):
        task: UnseenTask = tasks[place]
        try:
            yield task.model_id, observe_object(task, options)
        except CadalignError as error:
            print(f"left out: {task.model_id}: {error}")


def alike(library: Library, key: ModelKey) -> list[ModelKey]:
    """A model and those that are the same after a stretch."""
    own = library[key]
    return [
        key,
        *(
            model.key
            for model in library
            if np.array_equal(np.sort(model.semantic_ids), np.sort(own.semantic_ids))
            and shape_distance(model, own) <= SAME_SHAPE
        ),
    ]


def measure(
    arguments: UnseenRetrievalArguments, category: str, count: int, shape: ShapeModel
) -> dict[str, Any]:
    """IoU and milliseconds of every query, by ranking."""
    dataset = KeypointNet(arguments.root).subset(categories=[category])
    models = [LibraryModel.of_annotated(model, with_mesh=False) for model in dataset[category]]
    library = Library.from_models(models)
    compared = rankings(shape)
    found: dict[str, Any] = {name: {"iou": [], "ms": []} for name in compared}
    for model_id, seen in sightings(arguments, category, count):
        known = np.isin(seen.semantic_ids, shape.ids)
        gt = Box.from_model(seen.bounds, seen.gt)
        if known.sum() < LEAST_SHARED or gt.volume < 1e-9:
            continue
        points, ids = seen.points_2d[known], seen.semantic_ids[known]
        excluded = alike(library, (category, model_id))
        for name, options in compared.items():
            start = time.perf_counter()
            try:
                first = library.retrieve(
                    points,
                    ids,
                    KEYPOINT_CAMERA,
                    top=1,
                    category=category,
                    sigma=arguments.noise_px,
                    exclude=excluded,
                    workers=1,
                    **options,
                )[0]
                flat = first.box.volume < 1e-9
                iou = 0.0 if flat else box_iou_up_to_scale(est=first.box, gt=gt)
            except CadalignError:
                iou = 0.0
            found[name]["ms"].append(1e3 * (time.perf_counter() - start))
            found[name]["iou"].append(iou)
    return found


def main(arguments: UnseenRetrievalArguments) -> None:
    """Measure all categories and numbers of keypoints."""
    console, results = Console(), {}
    for category in arguments.categories:
        shape = ShapeModel.from_dataset(
            KeypointNet(arguments.root), category, split="train", meshes=False
        )
        for count in arguments.keypoints:
            title = f"{category}, {count or 'all'} keypoints"
            found = results[title] = measure(arguments, category, count, shape)
            table = new_table(title, "ranking", "objects", "median IoU", "mean IoU", "ms")
            for name, values in found.items():
                ious, times = values["iou"], values["ms"]
                means = f"{np.median(ious):.3f}", f"{np.mean(ious):.3f}"
                table.add_row(name, str(len(ious)), *means, f"{np.median(times):.1f}")
            console.print(table)
    write_results(arguments.out, results)


if __name__ == "__main__":
    main(tyro.cli(UnseenRetrievalArguments))
