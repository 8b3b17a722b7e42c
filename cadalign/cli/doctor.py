"""`cadalign doctor`: check this machine and show how to enable missing parts."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from cadalign.cli.options import JsonOption
from cadalign.cli.output import new_console

if TYPE_CHECKING:
    from cadalign.health import Health


@dataclass(frozen=True)
class Doctor(JsonOption):
    """Check the renderers and their speed, and show how to enable missing ones.

    Also shows the processor cores and the cache of compiled solvers.
    """

    def run(self) -> int:
        """Run the checks; returns the exit code, 0 if ray casting works."""
        from cadalign.health import examine

        with new_console().status("trying the renderers, each in a process of its own ..."):
            health = examine()
        if self.json:
            sys.stdout.write(json.dumps(asdict(health), indent=2) + "\n")
        else:
            _print(health)
        return 0 if health.renderers[-1].works else 1


def _print(health: Health) -> None:
    from rich.table import Column, Table

    console = new_console(stderr=False)
    heads = (
        "renderer",
        "works",
        Column("ms", justify="right"),
        "versions",
        "drawn by / what is wrong",
    )
    caption = "ms: a frame of 640 x 480 px, 20,480 triangles"
    table = Table(*heads, title="Renderers", caption=caption)
    for renderer in health.renderers:
        table.add_row(
            renderer.name,
            "yes" if renderer.works else "no",
            "" if renderer.milliseconds is None else f"{renderer.milliseconds:.0f}",
            renderer.versions,
            renderer.detail,
        )
    console.print(table)
    console.print(f"--renderer auto takes: {health.best}", markup=False)
    for name, command in health.remedies.items():
        console.print(f"To enable {name}: {command}", markup=False)
    console.print(f"Python {health.python}, NumPy {health.numpy}, Numba {health.numba}")
    console.print(f"Cores: {health.cores}, of which this process may use {health.usable_cores}")
    console.print(f"Compiled solvers: {health.cache}", markup=False)
