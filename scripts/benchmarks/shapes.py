"""Accuracy and times of alignment with learned shapes of categories."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

import cadalign
from benchmarks import section
from benchmarks.section import BenchmarkData, Row, Tables
from cadalign.arrays import FloatArray
from cadalign.datasets import KeypointNet
from cadalign.evaluation.instances.unseen import (
    ShapeEstimate,
    UnseenObject,
    object_errors,
    observe_object,
)

_SETTINGS = {"2 px": (2.0, False), "5 px": (5.0, False), "half, 2 px": (2.0, True)}
"""Noise [px], and whether half of the keypoints are left out."""
_TIMED = ("chair", "airplane", "mug")


def shapes(given: BenchmarkData) -> Tables:
    """Accuracy on objects without their own model, and times of `align`.

    Objects are from the split val; shape models are learned from the split train. Times
    of single views are processor times after warm-up, on one thread, with up to 14 keypoints. The
    batch holds every object five times and uses two threads.
    """
    root = given.folder("keypointnet15")
    cells = "rotation error [deg]/box IoU up to scale (medians), and truths in 68,95 % regions [%]"
    yield f"Objects without their own model: {cells}", _accuracy(given, root)
    yield "Times of align with a learned shape", _times(given, root)


def _accuracy(given: BenchmarkData, root: Path) -> Iterator[Row]:
    for category in KeypointNet(root).categories:
        row: Row = {"category": category}
        for name, (noise, is_half) in _SETTINGS.items():
            how = {"noise_px": noise, "seed": given.seed}
            seen = section.unseen_objects(root, category, given.count or 100, **how)
            cases = [({}, halved(each) if is_half else each) for _, each in seen]
            errors = partial(_errors, shape=section.learned_shape(root, category))
            found = list(section.measure(cases, {"shape": errors}))
            row.setdefault("objects", len(cases))
            row[name] = _cell(found, len(cases))
            if name == "2 px":
                shares = (_values(found, f"keypoints_within_{each}").mean() for each in (68, 95))
                points = ",".join(f"{100 * share:.0f}" for share in shares)
        yield row | {"keypoints, 2 px": points}


def halved(seen: UnseenObject) -> UnseenObject:
    """The same view with half of the keypoints, rounded up."""
    return observe_object(seen.task, replace(seen.options, keypoints=-(-len(seen.xyz) // 2)))


def _errors(seen: UnseenObject, *, shape: cadalign.ShapeModel) -> Row:
    return object_errors(
        ShapeEstimate.from_result(cadalign.align(shape, seen.view_of(shape))), seen
    )


def _cell(rows: list[Row], count: int) -> str:
    """Medians and coverage in one cell, with the number of failures if there are any."""
    if not rows:
        return "all failed"
    turn, overlap = _values(rows, "rotation_error_deg"), _values(rows, "box_iou_up_to_scale")
    levels = _values(rows, "rotation_level")
    within = ",".join(f"{100 * (levels <= nominal).mean():.0f}" for nominal in (0.68, 0.95))
    failed = f" ({count - len(rows)} failed)" if len(rows) < count else ""
    iou = f"{np.median(overlap):.2f}".removeprefix("0")
    return f"{np.median(turn):.1f}/{iou} {within}{failed}"


def _values(rows: list[Row], name: str) -> FloatArray:
    """The known numbers of a column."""
    return np.array([row[name] for row in rows if row[name] is not None], dtype=float)


def _times(given: BenchmarkData, root: Path) -> Iterator[Row]:
    for category in _TIMED:
        shape = section.learned_shape(root, category)
        how = {"keypoints": 14, "noise_px": 2.0}
        found = section.unseen_objects(root, category, given.count or 40, **how)
        views = [seen.view_of(shape) for _, seen in found]
        for view in views[:2]:  # compile
            cadalign.align(shape, view)
        calls = (partial(cadalign.align, shape, view) for view in views)
        one = [1e3 * section.clock(call)[1] for call in calls]
        batch = [[view] for view in views] * 5
        call = partial(cadalign.align_batch, shape, batch, workers=2)
        yield {
            "category": category,
            "components": len(shape.components),
            "one view ms": section.spread(one),
            "batch 1/s": len(batch) / section.seconds(call),
        }
