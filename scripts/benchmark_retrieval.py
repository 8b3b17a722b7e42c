"""Measure retrieval: time of a query and memory, for real and for 50,000 synthetic models.

    python scripts/benchmark_retrieval.py KEYPOINTNET

The synthetic models are the real ones with their keypoints moved by 3 % of the extent. Times are
the least of three calls with as many threads as there are cores, after warm-up.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cadalign import Library
from cadalign.datasets import KeypointNet
from cadalign.errors import DegenerateError
from cadalign.evaluation.retrieval.tasks import RetrievalTask, observe_model
from cadalign.retrieval import LibraryModel

KEYPOINTS = 8
CALLS = 3


def jittered(models: Sequence[LibraryModel], count: int) -> Library:
    """A library of so many models, the given ones first, then variations of them."""
    rng = np.random.default_rng(0)
    made = list(models)
    while len(made) < count:
        model = models[len(made) % len(models)]
        extent = np.linalg.norm(np.ptp(model.xyz, axis=0))
        xyz = model.xyz + 0.03 / np.sqrt(3) * extent * rng.standard_normal(model.xyz.shape)
        name = f"{model.model_id}-{len(made)}"
        made.append(replace(model, model_id=name, xyz=xyz, mesh_path=None))
    return Library.from_models(made)


def measure(library: Library, models: Sequence[LibraryModel], noise_px: float, queries: int) -> str:
    """Text on the times of queries for some of the models."""
    wall, busy, found = [], [], 0
    for model in models:
        try:
            seen = observe_model(model, RetrievalTask(*model.key, noise_px, KEYPOINTS), seed=0)
        except DegenerateError:
            continue
        least_wall, least_busy = np.inf, np.inf
        for _ in range(CALLS):
            start, start_busy = time.perf_counter(), time.process_time()
            matches = library.retrieve(
                seen.points_2d, seen.semantic_ids, seen.camera, sigma=noise_px
            )
            least_wall = min(least_wall, time.perf_counter() - start)
            least_busy = min(least_busy, time.process_time() - start_busy)
        wall.append(1e3 * least_wall)
        busy.append(1e3 * least_busy)
        found += (matches[0].category, matches[0].model_id) == model.key
        if len(wall) == queries:
            break
    return (
        f"{noise_px:g} px: median {np.median(wall):.0f} ms, longest {max(wall):.0f} ms "
        f"(processor time {np.median(busy):.0f} ms, {max(busy):.0f} ms); "
        f"{found} of {len(wall)} found first"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("root", type=Path, help="folder in KeypointNet's layout")
    parser.add_argument("--queries", type=int, default=20)
    parser.add_argument("--made", type=int, default=50_000)
    arguments = parser.parse_args()
    real = Library.from_dataset(KeypointNet(arguments.root))
    rng = np.random.default_rng(0)
    models = [model for model in real if len(model.xyz) >= KEYPOINTS]
    models = [models[k] for k in rng.permutation(len(models)).tolist()]
    print(f"{os.cpu_count()} cores, {KEYPOINTS} keypoints, models of all categories compared")
    for library in (real, jittered(list(real), arguments.made)):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "library")
            library.save(path)
            start = time.perf_counter()
            opened = Library.open(path)
            seconds = time.perf_counter() - start
            print(
                f"{len(opened):,} models: {path.stat().st_size / 1e6:.1f} MB, "
                f"opened in {seconds:.3f} s"
            )
            opened.retrieve(*_first_query(models), sigma=1.0)
            for noise_px in (1.0, 3.0, 5.0):
                print(f"  {measure(opened, models, noise_px, arguments.queries)}")


def _first_query(models: Sequence[LibraryModel]) -> tuple:
    """A query to warm up with."""
    for model in models:
        try:
            seen = observe_model(model, RetrievalTask(*model.key, 1.0, KEYPOINTS), seed=1)
        except DegenerateError:
            continue
        return seen.points_2d, seen.semantic_ids, seen.camera
    raise SystemExit("no model shows enough keypoints")


if __name__ == "__main__":
    main()
