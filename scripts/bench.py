"""Measure accuracy and speed by sections, and compare ratios with the stored ones.

    python scripts/bench.py                            # what `make bench` measures
    python scripts/bench.py cold speed                 # two sections
    python scripts/bench.py retrieval --sizes 1000 10000 --count 10
    python scripts/bench.py cold --store               # take the measured ratios

Each section prints its tables and writes them to bench/<section>.json. A figure with a name has a
ratio to other work measured in turns with it, which depends little on the machine, and less is
better; one that is more than 20 % worse than in benchmark_ratios.json makes the exit code 1.
"""

from __future__ import annotations

import json
import sys

import tyro
from benchmarks.accuracy import accuracy
from benchmarks.cars import cars
from benchmarks.coverage import coverage
from benchmarks.evidence import evidence
from benchmarks.photo import photo
from benchmarks.retrieval import retrieval
from benchmarks.runs import cold, runs, speed
from benchmarks.section import BenchmarkData, NotGivenError, Row, Section, markdown
from benchmarks.shapes import shapes

from cadalign.io.files import write_json

SECTIONS: dict[str, Section] = {
    each.__name__: each
    for each in (accuracy, coverage, shapes, retrieval, runs, speed, cold) + (evidence, photo, cars)
}
ON_REQUEST = {"evidence", "photo", "cars"}
TOLERANCE = 0.2


def main(arguments: list[str] | None = None) -> int:
    """Run the sections; return 1 if a ratio got worse."""
    options = tyro.cli(BenchmarkData, description=__doc__, args=arguments)
    unknown = ", ".join(name for name in options.sections if name not in SECTIONS)
    if unknown:
        sys.exit(f"no section {unknown}; known are {', '.join(SECTIONS)}")
    stored = json.loads(options.stored.read_text()) if options.stored.is_file() else {}
    figures: list[Row] = []
    for name in options.sections or [each for each in SECTIONS if each not in ON_REQUEST]:
        tables: dict[str, list[Row]] = {}
        try:
            for title, rows in SECTIONS[name](options):
                tables[title] = [
                    row | ({"stored": stored.get(row["name"])} if "ratio" in row else {})
                    for row in rows
                ]
                print(f"\n{title}\n\n{markdown(tables[title])}", flush=True)
        except NotGivenError as error:
            if name in options.sections:
                sys.exit(f"{name}: {error}")
            print(f"the rest of {name} is left out: {error}")
        options.out.mkdir(parents=True, exist_ok=True)
        write_json(options.out / f"{name}.json", tables)
        figures += [row for rows in tables.values() for row in rows if "ratio" in row]
    if options.store:
        ratios = stored | {row["name"]: row["ratio"] for row in figures}
        options.stored.write_text(json.dumps(ratios, indent=2, sort_keys=True) + "\n")
        return 0
    worse = [
        row["name"]
        for row in figures
        if row["stored"] is not None and row["ratio"] > row["stored"] * (1 + TOLERANCE)
    ]
    if worse:
        print(f"more than {TOLERANCE:.0%} worse than stored: {', '.join(worse)}")
    return int(bool(worse))


if __name__ == "__main__":
    sys.exit(main())
