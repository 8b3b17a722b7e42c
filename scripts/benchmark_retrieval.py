"""Measure retrieval: time of a query and memory, for real models and growing synthetic libraries.

The synthetic models are the real ones with their keypoints moved by 3 % of the extent. Times are
the least of three calls with as many threads as there are cores, after warm-up. Ratios are those of
processor time to `common.reference_seconds`, measured in turns.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from common import figure, processor_seconds, reference_seconds, write_figures

from cadalign import Library
from cadalign.datasets import KeypointNet
from cadalign.errors import DegenerateError
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.evaluation.retrieval.tasks import RetrievalQuery, RetrievalTask, observe_model
from cadalign.retrieval import LibraryModel

KEYPOINTS = 8
CALLS = 3


@dataclass
class RetrievalArguments:
    """Measure retrieval: time of a query and memory."""

    root: tyro.conf.Positional[Path]
    """Folder in KeypointNet's layout."""
    queries: int = 20
    """Timed queries per size of the library and noise."""
    sizes: tuple[int, ...] = (50_000,)
    """Models of the libraries that are filled up with synthetic ones; a curve: 1000 10000 50000
    200000."""
    json: Path | None = None
    """File for the figures, as `compare_ratios.py` reads them."""


def jittered(models: Sequence[LibraryModel], count: int) -> Library:
    """A library of so many models, the given ones first, then variations of them."""
    rng = np.random.default_rng(0)
    made = list(models[:count])
    while len(made) < count:
        model = models[len(made) % len(models)]
        extent = np.linalg.norm(np.ptp(model.xyz, axis=0))
        xyz = model.xyz + 0.03 / np.sqrt(3) * extent * rng.standard_normal(model.xyz.shape)
        name = f"{model.model_id}-{len(made)}"
        made.append(replace(model, model_id=name, xyz=xyz, mesh_path=None))
    return Library.from_models(made)


def observed(
    models: Sequence[LibraryModel], noise_px: float, *, seed: int
) -> Iterator[tuple[LibraryModel, RetrievalQuery]]:
    """The models that show enough keypoints, each with an observation of it."""
    for model in models:
        try:
            seen = observe_model(model, RetrievalTask(*model.key, noise_px, KEYPOINTS), seed=seed)
        except DegenerateError:
            continue
        yield model, seen


def retrieve(library: Library, seen: RetrievalQuery, noise_px: float) -> Any:
    """The matches of an observation."""
    return library.retrieve(seen.points_2d, seen.semantic_ids, KEYPOINT_CAMERA, sigma=noise_px)


def measure(
    library: Library, models: Sequence[LibraryModel], noise_px: float, queries: int
) -> dict[str, dict[str, Any]]:
    """Print times of queries for some of the models; returns the figures by name."""
    wall, busy, found = [], [], 0
    reference = reference_seconds()
    for model, seen in islice(observed(models, noise_px, seed=0), queries):
        least_wall, least_busy = np.inf, np.inf
        for _ in range(CALLS):
            start, start_busy = time.perf_counter(), time.process_time()
            matches = retrieve(library, seen, noise_px)
            least_wall = min(least_wall, time.perf_counter() - start)
            least_busy = min(least_busy, time.process_time() - start_busy)
        reference = min(reference, reference_seconds())
        wall.append(1e3 * least_wall)
        busy.append(1e3 * least_busy)
        found += (matches[0].category, matches[0].model_id) == model.key
    print(
        f"  {noise_px:g} px: median {np.median(wall):.0f} ms, longest {max(wall):.0f} ms "
        f"(processor time {np.median(busy):.0f} ms, {max(busy):.0f} ms); "
        f"{found} of {len(wall)} found first"
    )
    name = f"query among {len(library):,}, {noise_px:g} px"
    return {
        f"{name}, median": figure(np.median(wall), "ms", np.median(busy) / (1e3 * reference)),
        f"{name}, longest": figure(max(wall), "ms", max(busy) / (1e3 * reference)),
    }


def main(arguments: RetrievalArguments) -> None:
    """Measure all libraries."""
    real = list(Library.from_dataset(KeypointNet(arguments.root)))
    rng = np.random.default_rng(0)
    mixed = [real[k] for k in rng.permutation(len(real)).tolist()]
    print(f"{os.cpu_count()} cores, {KEYPOINTS} keypoints, models of all categories compared")
    figures = {}
    for size in (len(real), *arguments.sizes):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "library")
            jittered(mixed, size).save(path)
            reference = reference_seconds()
            start = time.perf_counter()
            busy = processor_seconds(partial(Library.open, path))
            seconds = time.perf_counter() - start
            opened = Library.open(path)
            print(
                f"{len(opened):,} models: {path.stat().st_size / 1e6:.1f} MB, "
                f"opened in {seconds:.3f} s"
            )
            figures[f"opening {size:,} models"] = figure(1e3 * seconds, "ms", busy / reference)
            models = [model for model in mixed[:size] if len(model.xyz) >= KEYPOINTS]
            warm_up = next(observed(models, 1.0, seed=1), None)
            if warm_up is None:
                raise SystemExit("no model shows enough keypoints")
            retrieve(opened, warm_up[1], 1.0)
            for noise_px in (1.0, 3.0, 5.0):
                figures |= measure(opened, models, noise_px, arguments.queries)
    write_figures(arguments.json, figures)


if __name__ == "__main__":
    main(tyro.cli(RetrievalArguments))
