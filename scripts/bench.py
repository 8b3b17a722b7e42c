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

import json
import sys
from dataclasses import dataclass, field, make_dataclass
from pathlib import Path
from typing import Any

import tyro
from benchmarks.accuracy import Solvers, UnknownFocal, WideLenses
from benchmarks.annotator import Annotator
from benchmarks.cameras import PhotoLenses, Scenes
from benchmarks.cars import NoiseOfDetector, RealDetections
from benchmarks.clicks import Clicks, OutlineMethods, ProposalClicks
from benchmarks.coverage import Coverage
from benchmarks.gradients import GradientErrors, TorchLayer
from benchmarks.masks import MaskAlone, Masks
from benchmarks.mistakes import Mistakes
from benchmarks.photo import Photos, PhotoTimes
from benchmarks.retrieval import MaskRetrieval, Retrieval, UnseenRetrieval
from benchmarks.runs import Evaluation, Fits, Ransac
from benchmarks.section import BenchmarkData, NotGivenError, RatioTable, Row, Section
from benchmarks.shapes import Align, FocalShapes, Similar
from benchmarks.speed import Calls, Cold, Rendering
from benchmarks.tracks import Tracks
from benchmarks.warned import Warned
from rich.console import Console
from rich.table import Table

from cadalign.cli import plain_help
from cadalign.io.files import write_json

SECTIONS: dict[str, type[Section]] = {
    "solvers": Solvers,
    "cold": Cold,
    "calls": Calls,
    "wide": WideLenses,
    "focal": UnknownFocal,
    "focal_shapes": FocalShapes,
    "lenses": PhotoLenses,
    "scenes": Scenes,
    "calibration": Coverage,
    "render": Rendering,
    "annotator": Annotator,
    "masks": Masks,
    "mask_alone": MaskAlone,
    "mistakes": Mistakes,
    "photo": Photos,
    "photo_times": PhotoTimes,
    "clicks": Clicks,
    "outlines": OutlineMethods,
    "proposals": ProposalClicks,
    "align": Align,
    "retrieval": Retrieval,
    "evaluation": Evaluation,
    "fits": Fits,
    "detections": RealDetections,
    "ransac": Ransac,
    "unseen_retrieval": UnseenRetrieval,
    "mask_retrieval": MaskRetrieval,
    "similar": Similar,
    "torch": TorchLayer,
    "gradients": GradientErrors,
    "noise": NoiseOfDetector,
    "tracks": Tracks,
    "warned": Warned,
}
ON_REQUEST = (
    *("mask_alone", "mistakes", "photo", "photo_times", "clicks", "outlines", "proposals"),
    *("detections", "unseen_retrieval", "mask_retrieval", "similar", "tracks", "warned"),
)
STORED = Path(__file__).parent / "benchmark_ratios.json"
TOLERANCE = 0.2


@dataclass
class Common(BenchmarkData):
    """Options of all sections."""

    sections: tyro.conf.Positional[tuple[str, ...]] = ()
    """Sections to run; by default all that need no asking for."""
    stored: Path = STORED
    """Ratios to compare with."""
    store: bool = False
    """Store the measured ratios."""


def main(arguments: list[str] | None = None) -> int:
    """Run the sections; return 1 if a ratio got worse."""
    own = [(name, kind, field(default_factory=kind)) for name, kind in SECTIONS.items()]
    options_type: Any = make_dataclass("Options", own, bases=(Common,))
    options = tyro.cli(options_type, description=__doc__, args=arguments, registry=plain_help())
    named = [name.replace("-", "_") for name in options.sections]
    unknown = ", ".join(name for name in named if name not in SECTIONS)
    if unknown:
        sys.exit(f"no section {unknown}; known are {', '.join(SECTIONS)}")
    stored = json.loads(options.stored.read_text()) if options.stored.is_file() else {}
    figures: list[Row] = []
    for name in named or [each for each in SECTIONS if each not in ON_REQUEST]:
        section: Section = getattr(options, name)
        tables = []
        try:
            for table in section.run(options):
                tables.append(table)
                show(table, stored)
        except NotGivenError as error:
            if name in named:
                sys.exit(f"{name}: {error}")
            print(f"{name} is left out: {error}")
            continue
        options.out.mkdir(parents=True, exist_ok=True)
        write_json(options.out / f"{name}.json", {each.title: each.rows for each in tables})
        figures += [row for table in tables for row in table.rows if "ratio" in row]
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


def show(table: RatioTable, stored: dict[str, float]) -> None:
    """Print a table; figures with the stored ratios beside theirs."""
    printed = Table(title=table.title)
    rows = [
        row if "ratio" not in row else row | {"stored": stored.get(row["name"])}
        for row in table.rows
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
