"""Retrieval: time and memory of queries, and objects that are not in the library."""

from __future__ import annotations

import tempfile
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from benchmarks import section
from benchmarks.section import COMMAND, BenchmarkData, Row, Table, Tables
from cadalign import Box, Library, Observation, ShapeModel
from cadalign.datasets import KeypointNet
from cadalign.evaluation.experiments.retrieval import (
    RetrievalQuery,
    RetrievalTask,
    observe_model,
    same_shapes,
)
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.metrics import box_iou_up_to_scale
from cadalign.retrieval import LibraryModel, Match

_KEYPOINTS = 8
_CALLS = 3
_LEAST_SHARED = 4
_FLAT = 1e-9
_NOISE_PX = 2.0  # of unseen objects
_RUN_QUERIES = 1000
_RANKINGS: dict[str, dict[str, Any]] = {"fit": {}, "fit, shape_sigma": {"shape_sigma": 0.02}}


def retrieval(given: BenchmarkData) -> Tables:
    """Time and memory of queries, and objects that are not in the library."""
    yield from _times(given)
    yield _unseen(given)


def _times(given: BenchmarkData) -> Tables:
    """Time of a query and memory, for real models and growing synthetic libraries.

    The synthetic models are the real ones with their keypoints moved by 3 % of the extent, models
    of all categories are compared. Times are the least of three calls with as many threads as there
    are cores, after warm-up. Ratios are those of processor time to `reference_seconds`. A run of
    `cadalign retrieve` has two processes.
    """
    real = list(Library.from_models(KeypointNet(given.folder("keypointnet"))))
    mixed = [real[k] for k in np.random.default_rng(0).permutation(len(real)).tolist()]
    for size in (len(real), *given.sizes):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "library")
            _jittered(mixed, size).save(path)
            yield _measure(path, mixed[:size], given.count or 20)
            if size in given.sizes:
                yield "Queries as a run", [_run(path, mixed[:size])]


def _measure(path: Path, models: Sequence[LibraryModel], queries: int) -> Table:
    reference = section.reference_seconds()
    wall, busy, library = section.clocked(partial(Library.open, path))
    size = f"{len(library):,}"
    rows = [section.figure(f"opening {size} models", 1e3 * wall, "ms", busy / reference)]
    shown = [model for model in models if len(model.xyz) >= _KEYPOINTS]
    _, warm_up = next(_observed(shown, 1.0, seed=1))
    _retrieve(library, warm_up, 1.0)
    for noise_px in (1.0, 3.0, 5.0):
        rows += _queries(library, shown, noise_px, queries)
    return f"{size} models, {path.stat().st_size / 1e6:.1f} MB", rows


def _run(path: Path, models: Sequence[LibraryModel]) -> Row:
    seeds = range(1 + _RUN_QUERIES)  # each model may show enough keypoints once only
    found = chain.from_iterable(_observed(models, 1.0, seed=seed) for seed in seeds)
    file = path.with_name("queries.jsonl")
    with file.open("wb") as queries:
        for _, seen in islice(found, _RUN_QUERIES):
            points, ids = np.zeros((len(seen.points_2d), 3)), np.asarray(seen.ids)
            query = Observation(points, seen.points_2d, KEYPOINT_CAMERA, ids=ids)
            queries.write(msgspec.json.encode(query.to_dict()) + b"\n")
    command = ["retrieve", str(file), f"--library={path}", f"--out={path.with_name('run')}"]
    call = partial(section.used_by, [*COMMAND, *command, "--no-picture", "--workers=2"])
    used, reference = section.with_reference(call)
    name = f"run of {_RUN_QUERIES:,} queries, two processes"
    row = section.figure(name, _RUN_QUERIES / used.wall, "1/s", used.processor / reference)
    return row | {"MB": used.megabytes}


def _queries(
    library: Library, models: Sequence[LibraryModel], noise_px: float, queries: int
) -> list[Row]:
    wall, busy = [], []
    reference = section.reference_seconds()
    for _, seen in islice(_observed(models, noise_px, seed=0), queries):
        call = partial(_retrieve, library, seen, noise_px)
        walls, busies, _ = zip(*(section.clocked(call) for _ in range(_CALLS)), strict=True)
        wall.append(1e3 * min(walls))
        busy.append(1e3 * min(busies))
        reference = min(reference, section.reference_seconds())
    name = f"query among {len(library):,}, {noise_px:g} px"
    return [
        section.figure(f"{name}, {which}", take(wall), "ms", take(busy) / (1e3 * reference))
        for which, take in (("median", np.median), ("longest", max))
    ]


def _jittered(models: Sequence[LibraryModel], count: int) -> Library:
    rng = np.random.default_rng(0)
    filled = list(models[:count])
    while len(filled) < count:
        model = models[len(filled) % len(models)]
        extent = np.linalg.norm(np.ptp(model.xyz, axis=0))
        xyz = model.xyz + 0.03 / np.sqrt(3) * extent * rng.standard_normal(model.xyz.shape)
        name = f"{model.model_id}-{len(filled)}"
        filled.append(replace(model, model_id=name, xyz=xyz, mesh_path=None))
    return Library.from_models(filled)


def _observed(
    models: Sequence[LibraryModel], noise_px: float, *, seed: int
) -> Iterator[tuple[LibraryModel, RetrievalQuery]]:
    for model in models:
        task = RetrievalTask(*model.key, noise_px, _KEYPOINTS)
        seen = section.attempt(observe_model, model, task, seed=seed)
        if seen is not None:
            yield model, seen


def _retrieve(library: Library, seen: RetrievalQuery, noise_px: float) -> Any:
    return library.retrieve(seen.points_2d, seen.ids, KEYPOINT_CAMERA, sigma=noise_px)


def _unseen(given: BenchmarkData) -> Table:
    """Retrieval of objects that are not in the library: box IoU up to scale of the first match.

    Objects are those of the split val, with all keypoints and 2 px of noise; shape models are
    learned from the split train. The library holds all models but the object's own and those that
    are the same after a stretch. Each column is a ranking: by the fit of each model, exact or with
    an uncertainty of its shape, and by the estimated shape. Boxes are those of the keypoints.
    """
    dataset, rows = KeypointNet(given.folder("keypointnet")), []
    for category in ("chair", "airplane", "bottle", "mug", "guitar"):
        shape = section.learned_shape(dataset, category)
        library = Library.from_models(
            [LibraryModel.of_annotated(model, with_mesh=False) for model in dataset[category]]
        )
        rows.append({"category": category} | _ranked(dataset, library, shape, given.count or 40))
    return "first matches: median IoU", rows


def _ranked(dataset: KeypointNet, library: Library, shape: ShapeModel, count: int) -> Row:
    found: dict[str, list[float]] = defaultdict(list)
    how = {"keypoints": None, "noise_px": _NOISE_PX}
    for _, seen in section.unseen_objects(dataset, str(shape.category), count, **how):
        known = np.isin(seen.ids, shape.ids)
        gt = Box.from_model(seen.task.hull.bounds, seen.gt)
        if known.sum() < _LEAST_SHARED or gt.volume < _FLAT:
            continue
        call = partial(
            library.retrieve,
            seen.points_2d[known],
            seen.ids[known],
            KEYPOINT_CAMERA,
            top=1,
            category=shape.category,
            sigma=_NOISE_PX,
            exclude=same_shapes(library, (str(shape.category), seen.task.model_id)),
            workers=1,
        )
        for name, options in (_RANKINGS | {"shape": {"shape": shape}}).items():
            found[name].append(_first_iou(section.attempt(call, **options), gt))
    return {name: float(np.median(ious)) for name, ious in found.items()}


def _first_iou(matches: list[Match] | None, gt: Box) -> float:
    """IoU of the first match of a query; 0 where there is none, or a flat one."""
    if not matches or matches[0].box.volume < _FLAT:
        return 0.0
    return section.attempt(box_iou_up_to_scale, est=matches[0].box, gt=gt) or 0.0
