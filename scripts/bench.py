"""Measure accuracy and speed by sections: the numbers of docs/results.md.

    python scripts/bench.py                            # the sections of `make bench`
    python scripts/bench.py cold speed                 # two sections
    python scripts/bench.py retrieval --sizes 1000 10000 --count 10

Each section prints its tables. A column `ratio` compares a time with a reference that is measured
alternately; it depends little on the machine, and less is better.
"""

from __future__ import annotations

import sys

import tyro
from benchmarks.accuracy import accuracy
from benchmarks.cars import cars
from benchmarks.coverage import coverage
from benchmarks.evidence import evidence
from benchmarks.photo import photo
from benchmarks.retrieval import retrieval
from benchmarks.runs import runs
from benchmarks.section import BenchmarkData, Section, markdown
from benchmarks.shapes import shapes
from benchmarks.speed import cold, speed

from cadalign.errors import DataError

SECTIONS: dict[str, Section] = {
    each.__name__: each
    for each in (accuracy, coverage, shapes, evidence, photo, cars, retrieval, runs, speed, cold)
}
ON_REQUEST = {"evidence", "photo", "cars"}


def main(arguments: list[str] | None = None) -> None:
    """Run the chosen sections."""
    options = tyro.cli(BenchmarkData, description=__doc__, args=arguments)
    unknown = ", ".join(name for name in options.sections if name not in SECTIONS)
    if unknown:
        sys.exit(f"unknown section {unknown}; known are {', '.join(SECTIONS)}")
    for name in options.sections or [each for each in SECTIONS if each not in ON_REQUEST]:
        try:
            for title, rows in SECTIONS[name](options):
                print(f"\n{title}\n\n{markdown(list(rows))}", flush=True)
        except DataError as error:
            if name in options.sections:
                sys.exit(f"{name}: {error}")
            print(f"the rest of {name} is skipped: {error}")


if __name__ == "__main__":
    main()
