"""Time of the first calls after installation, when nothing is compiled yet.

    python scripts/benchmark_cold.py --json bench/cold.ratios.json

Each call runs in a new process with an empty folder of compiled code. The ratio is that to a first
call of a function of ten lines compiled by Numba, measured right before.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path

from common import figure, seconds_of_process, write_figures

POINTS = """
import numpy as np
from cadalign import Camera, RansacOptions, fit
camera = Camera(640, 480, 900.0, 900.0, 319.5, 239.5)
points = np.random.default_rng(0).uniform(-0.3, 0.3, (12, 3))
pixels = camera.project(points + [0.0, 0.0, 2.0])
"""
FIRST_FIT = POINTS + "fit(points, pixels, camera)"
FIRST_ROBUST = POINTS + "fit(points, pixels, camera, ransac=RansacOptions(), sigma=1.0)"
EVERYTHING = "from cadalign.cli import main; main(['doctor', '--compile'])"
YARDSTICK = """
import numba, numpy as np
@numba.njit
def total(a):
    found = np.zeros(a.shape[0])
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            found[i] += a[i, j] ** 2
    return np.sqrt(found).sum()
total(np.ones((3, 3)))
"""


def main() -> None:
    """Read the command line, measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    out = parser.parse_args().json
    with tempfile.TemporaryDirectory() as folder:
        yardstick = run(YARDSTICK, Path(folder) / "yardstick")[1]
        fit = run(FIRST_FIT, Path(folder) / "fit")
        robust = run(FIRST_ROBUST, Path(folder) / "fit")
        everything = run(EVERYTHING, Path(folder) / "all")
    measured = {
        "first fit": fit,
        "first robust fit, after it": robust,
        "doctor --compile, two processes": everything,
    }
    figures = {}
    for name, (wall, processor) in measured.items():
        sys.stdout.write(f"{name:32} {wall:6.1f} s, {processor:6.1f} s of processor time\n")
        figures[name] = figure(wall, "s", processor / yardstick)
    write_figures(out, figures)


def run(code: str, folder: Path) -> tuple[float, float]:
    """Wall clock and processor time of a new process that keeps compiled code in a folder."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder)}
    return seconds_of_process([sys.executable, "-c", code], environment=environment)


if __name__ == "__main__":
    main()
