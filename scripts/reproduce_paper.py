"""Make every table and figure of the AEPnP paper anew, each beside the paper's own numbers.

Killed, it goes on where it was when it is started again with the same arguments.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

from cadalign.errors import CadalignError
from cadalign.evaluation.paper.reproduction import PaperPlan, reproduce_paper
from cadalign.evaluation.runs.run import Progress


def main() -> int:
    """Run it; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("paper"), help="folder to write to")
    parser.add_argument("--root", type=Path, help="KeypointNet, besides the sample dataset")
    parser.add_argument("--quick", action="store_true", help="few problems: about two minutes")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=-1, help="processes; -1 for all cores")
    parser.add_argument("--dask", help="address of a Dask scheduler to use instead")
    try:
        report = reproduce_paper(PaperPlan(**vars(parser.parse_args())), announce=_announce)
    except CadalignError as error:
        print(f"reproduce_paper: {error}", file=sys.stderr)
        return 1
    print(f"Report: {report}")
    return 0


def _announce(what: str) -> Callable[[Progress], None]:
    start = time.monotonic()
    shown = [0.0]

    def show(progress: Progress) -> None:
        now = time.monotonic()
        finished = progress.done == progress.total
        if finished or now - shown[0] > 5:
            shown[0] = now
            print(f"{what}: {progress.done} of {progress.total}, {now - start:.0f} s", flush=True)

    return show


if __name__ == "__main__":
    sys.exit(main())
