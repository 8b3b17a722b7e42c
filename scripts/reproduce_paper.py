"""Make every table and figure of the AEPnP paper anew, each beside the paper's own numbers.

Killed, it goes on where it was when it is started again with the same arguments.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import tyro

from cadalign.errors import CadalignError
from cadalign.evaluation.experiments.paper import PaperPlan, reproduce_paper
from cadalign.evaluation.runs.run import Progress


def main() -> int:
    """Run it; returns the exit code."""
    plan = tyro.cli(PaperPlan, description=__doc__)
    try:
        report = reproduce_paper(plan, announce=_announce)
    except CadalignError as error:
        print(f"reproduce_paper: {error}", file=sys.stderr)
        return 1
    print(f"Report: {report}")
    return 0


def _announce(what: str) -> Callable[[Progress], None]:
    start = time.monotonic()
    shown = 0.0

    def show(progress: Progress) -> None:
        nonlocal shown
        now = time.monotonic()
        if progress.done == progress.total or now - shown > 5:
            shown = now
            print(f"{what}: {progress.done} of {progress.total}, {now - start:.0f} s", flush=True)

    return show


if __name__ == "__main__":
    sys.exit(main())
