"""Compare measured ratios with the stored ones; fail where one is more than 20 % worse.

    python scripts/compare_ratios.py bench/*.ratios.json            # compare
    python scripts/compare_ratios.py bench/*.ratios.json --store    # take the measured ones

A ratio is a time over that of a yardstick measured in turns with it, so it depends little on the
machine, and less is better. The benchmarks write them with ``--json FILE``, as
``{"fit, 7 points": {"value": 9.1, "unit": "us", "ratio": 0.98}}``; figures without a ratio are
shown, not compared.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

STORED = Path(__file__).parent / "benchmark_ratios.json"
TOLERANCE = 0.2


def main(arguments: list[str] | None = None) -> int:
    """Read the command line, print a table and return 1 if a figure got worse."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("measured", nargs="+", type=Path, help="figures a benchmark wrote")
    parser.add_argument("--stored", type=Path, default=STORED, help="ratios to compare with")
    parser.add_argument("--store", action="store_true", help="store the measured ratios")
    options = parser.parse_args(arguments)
    measured = {name: figure for path in options.measured for name, figure in read(path).items()}
    stored = read(options.stored) if options.stored.is_file() else {}
    if options.store:
        ratios = {name: figure["ratio"] for name, figure in measured.items() if "ratio" in figure}
        options.stored.write_text(json.dumps(stored | ratios, indent=2, sort_keys=True) + "\n")
        return 0
    worse = [name for name in sorted(measured) if report(name, measured[name], stored.get(name))]
    if worse:
        sys.stdout.write(f"more than {TOLERANCE:.0%} worse than stored: {', '.join(worse)}\n")
    return int(bool(worse))


def read(path: Path) -> dict[str, Any]:
    """Figures of a file by their names."""
    figures: dict[str, Any] = json.loads(path.read_text())
    return figures


def report(name: str, figure: dict[str, Any], stored: float | None) -> bool:
    """Print a line for a figure; True if its ratio is worse than the stored one."""
    ratio = figure.get("ratio")
    worse = ratio is not None and stored is not None and ratio > stored * (1.0 + TOLERANCE)
    compared = "" if ratio is None else f"  ratio {ratio:.3g}"
    before = "" if ratio is None or stored is None else f" (stored {stored:.3g})"
    line = f"{name:48} {figure['value']:10.4g} {figure['unit']:12}{compared}{before}"
    sys.stdout.write(line + ("  WORSE\n" if worse else "\n"))
    return worse


if __name__ == "__main__":
    sys.exit(main())
