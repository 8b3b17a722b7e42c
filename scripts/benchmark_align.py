"""Measure the time of `align` with learned shapes: one view, two views, and a batch.

Objects are those of the split val, seen with noisy keypoints; shape models are learned from the
split train. Times of single objects are those of the processor, warm and on one thread.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from common import Benchmark, new_table, write_results
from rich.console import Console

from cadalign import Alignment, ShapeModel, View, align, align_batch
from cadalign.arrays import FloatArray
from cadalign.datasets import KeypointNet
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.evaluation.unseen.options import UnseenOptions
from cadalign.evaluation.unseen.tasks import UnseenTasks, observe_object
from cadalign.geometry.rotations import rotation_from_vector

SECOND_VIEW = rotation_from_vector(np.array([0.0, np.radians(25.0), 0.0]))


@dataclass
class AlignArguments(Benchmark):
    """Measure the time of `align` with learned shapes."""

    root: tyro.conf.Positional[Path] = Path("KEYPOINTNET")
    """Folder in KeypointNet's layout, with splits."""
    categories: tuple[str, ...] = ("chair", "airplane", "mug")
    """Categories."""
    objects: int = 40
    """Objects of each category."""
    keypoints: int = 14
    """Most keypoints of an object."""
    noise_px: float = 2.0
    """Standard deviation of the keypoints, in pixels."""
    repeats: int = 5
    """Times that the batch holds every object."""
    workers: int = 2
    """Threads of the batch."""


def pairs_of_views(arguments: AlignArguments, category: str, shape: ShapeModel) -> list[list[View]]:
    """Two views of every object."""
    options = UnseenOptions(
        root=arguments.root,
        categories=(category,),
        keypoints=arguments.keypoints,
        noise_px=arguments.noise_px,
    )
    tasks = UnseenTasks(KeypointNet(arguments.root), options)
    step = -(-len(tasks) // arguments.objects)
    pairs = []
    for place in range(0, len(tasks), step):
        seen = observe_object(tasks[place], options)
        known = np.isin(seen.semantic_ids, shape.ids)
        points, ids = seen.xyz[seen.rows][known], seen.semantic_ids[known]
        turned = Alignment(SECOND_VIEW @ seen.gt.rotation, seen.gt.translation, seen.gt.scale)
        noise = np.random.default_rng(place).normal(0, arguments.noise_px, points[:, :2].shape)
        second = KEYPOINT_CAMERA.project(turned.apply(points)) + noise
        pixels: Sequence[FloatArray] = (seen.points_2d[known], second)
        pairs.append(
            [View(KEYPOINT_CAMERA, each, ids=ids, sigma=arguments.noise_px) for each in pixels]
        )
    return pairs


def milliseconds(shape: ShapeModel, objects: Sequence[Sequence[View]]) -> list[float]:
    """Processor time of each object."""
    times = []
    for views in objects:
        start = time.process_time()
        align(shape, views)
        times.append(1e3 * (time.process_time() - start))
    return times


def main(arguments: AlignArguments) -> None:
    """Measure all categories."""
    results = {}
    columns = "category", "components", "one view ms", "90th pct.", "two views ms", "batch 1/s"
    table = new_table("align with a learned shape", *columns)
    for category in arguments.categories:
        shape = ShapeModel.from_dataset(
            KeypointNet(arguments.root), category, split="train", meshes=False
        )
        pairs = pairs_of_views(arguments, category, shape)
        singles = [views[:1] for views in pairs]
        milliseconds(shape, singles[:2] + pairs[:2])  # compile
        one, two = milliseconds(shape, singles), milliseconds(shape, pairs)
        start = time.perf_counter()
        align_batch(shape, singles * arguments.repeats, workers=arguments.workers)
        rate = arguments.repeats * len(singles) / (time.perf_counter() - start)
        results[category] = {"one_view_ms": one, "two_views_ms": two, "batch_per_second": rate}
        figures = np.median(one), np.percentile(one, 90), np.median(two)
        texts = (f"{figure:.1f}" for figure in figures)
        table.add_row(category, str(len(shape.components)), *texts, f"{rate:.0f}")
    Console().print(table)
    write_results(arguments.out, results)


if __name__ == "__main__":
    main(tyro.cli(AlignArguments))
