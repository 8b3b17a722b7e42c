"""Measure accuracy and speed by sections, and compare ratios with the stored ones.

    python scripts/bench.py                            # what `make bench` measures
    python scripts/bench.py cold calls                 # two sections
    python scripts/bench.py retrieval --retrieval.sizes 1000 10000
    python scripts/bench.py cold --store               # take the measured ratios

Each section prints its tables and writes them to bench/<section>.json. A figure with a name has a
ratio to other work measured in turns with it, which depends little on the machine, and less is
better; one that is more than 20 % worse than in benchmark_ratios.json makes the exit code 1.
"""

from __future__ import annotations

import inspect
import json
import sys
from collections.abc import Callable
from dataclasses import make_dataclass
from functools import partial, wraps
from typing import Annotated, Any

import tyro
from benchmarks.accuracy import solvers, unknown_focal, wide_lenses
from benchmarks.annotator import annotator
from benchmarks.cars import real_cars, real_detections
from benchmarks.coverage import coverage
from benchmarks.evidence import evidence
from benchmarks.gradients import gradient_errors, torch_layer
from benchmarks.masks import mask_alone, masks
from benchmarks.mistakes import mistakes
from benchmarks.photo import clicks, photo_times, photos
from benchmarks.retrieval import retrieval, unseen_retrieval
from benchmarks.runs import evaluation, fits, ransac
from benchmarks.section import BenchmarkData, NotGivenError, Row, Tables
from benchmarks.shapes import align, focal_shapes, photo_lenses
from benchmarks.speed import calls, cold, rendering
from benchmarks.warned import warned
from rich.console import Console
from rich.table import Table

from cadalign.io.files import write_json

USUAL: dict[str, Callable[..., Tables]] = {
    "solvers": solvers,
    "cold": cold,
    "calls": calls,
    "wide": wide_lenses,
    "focal": unknown_focal,
    "focal_shapes": focal_shapes,
    "lenses": photo_lenses,
    "calibration": coverage,
    "render": rendering,
    "annotator": annotator,
    "masks": masks,
    "align": align,
    "retrieval": retrieval,
    "evaluation": evaluation,
    "fits": fits,
    "ransac": ransac,
    "torch": torch_layer,
    "gradients": gradient_errors,
}
ON_REQUEST: dict[str, Callable[..., Tables]] = {
    "evidence": evidence,
    "mask_alone": mask_alone,
    "mistakes": mistakes,
    "photo": photos,
    "photo_times": photo_times,
    "clicks": clicks,
    "kitti": real_cars,
    "detections": real_detections,
    "unseen_retrieval": unseen_retrieval,
    "warned": warned,
}
SECTIONS = USUAL | ON_REQUEST
TOLERANCE = 0.2


def options_of(section: Callable[..., Tables]) -> Callable[..., Any]:
    """The section as a function of its options, which returns it with these."""

    @wraps(section)
    def chosen(**options: Any) -> Callable[..., Tables]:
        return partial(section, **options)

    signature = inspect.signature(section)
    _, *options = signature.parameters.values()
    vars(chosen)["__signature__"] = signature.replace(parameters=options)
    return chosen


def main(arguments: list[str] | None = None) -> int:
    """Run the sections; return 1 if a ratio got worse."""
    own = [
        (name, Annotated[Any, tyro.conf.arg(constructor=options_of(section))])
        for name, section in SECTIONS.items()
    ]
    options_type: Any = make_dataclass("Options", own, bases=(BenchmarkData,), kw_only=True)
    options = tyro.cli(options_type, description=__doc__, args=arguments)
    named = [name.replace("-", "_") for name in options.sections]
    unknown = ", ".join(name for name in named if name not in SECTIONS)
    if unknown:
        sys.exit(f"no section {unknown}; known are {', '.join(SECTIONS)}")
    stored = json.loads(options.stored.read_text()) if options.stored.is_file() else {}
    figures: list[Row] = []
    for name in named or [each for each in SECTIONS if each not in ON_REQUEST]:
        tables: dict[str, list[Row]] = {}
        try:
            for title, rows in getattr(options, name)(options):
                tables[title] = list(rows)
                show(title, tables[title], stored)
        except NotGivenError as error:
            if name in named:
                sys.exit(f"{name}: {error}")
            print(f"{name} is left out: {error}")
            continue
        options.out.mkdir(parents=True, exist_ok=True)
        write_json(options.out / f"{name}.json", tables)
        figures += [row for rows in tables.values() for row in rows if "ratio" in row]
    if options.store:
        ratios = stored | {row["name"]: row["ratio"] for row in figures}
        options.stored.write_text(json.dumps(ratios, indent=2, sort_keys=True) + "\n")
        return 0
    worse = [row["name"] for row in figures if is_worse(row, stored)]
    if worse:
        print(f"more than {TOLERANCE:.0%} worse than stored: {', '.join(worse)}")
    return int(bool(worse))


def is_worse(row: Row, stored: dict[str, float]) -> bool:
    """True for a figure whose ratio is worse than the stored one."""
    return row["ratio"] > stored.get(row["name"], float("inf")) * (1 + TOLERANCE)


def show(title: str, rows: list[Row], stored: dict[str, float]) -> None:
    """Print a table; figures with the stored ratios beside theirs."""
    printed = Table(title=title)
    rows = [
        row if "ratio" not in row else row | {"stored": stored.get(row["name"])} for row in rows
    ]
    columns = list(dict.fromkeys(column for row in rows for column in row))
    for column in columns:
        printed.add_column(column, justify="right")
    for row in rows:
        style = "red" if "ratio" in row and is_worse(row, stored) else None
        printed.add_row(*(cell(row.get(column)) for column in columns), style=style)
    Console(width=220, highlight=False).print(printed)


def cell(value: Any) -> str:
    """Text of a cell; of a pair, the second number in parentheses."""
    if value is None:
        return ""
    if isinstance(value, tuple):
        return f"{cell(value[0])} ({cell(value[1])})"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    sys.exit(main())
