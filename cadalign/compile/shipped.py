"""Compiled kernels that came with the installation, for any processor of the usual kind.

`scripts/build_wheel.py` puts them into a wheel. They are compiled for a level of the instruction
set (x86-64-v3: what desktop and server processors have had since 2013 or so) in place of one
processor; where the processor has less, the kernels are compiled on first use as they are without.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from cadalign.compile.loading import CodeFiles

FOLDER = Path(__file__).parent / "kernels"
TARGET = "target.json"


@dataclass(frozen=True)
class ShippedFiles:
    """Index and code of one shipped kernel."""

    file: Any
    target: tuple[str, str, str]

    def load(self, key: Any) -> Any:
        """Code for a signature, whatever the processor."""
        signature, _, *rest = key
        return self.file.load((signature, self.target, *rest))


def shipped_files(name: str, stamp: str) -> ShippedFiles | None:
    """Files of a kernel in the installation, None if it has none for this processor."""
    target = usable_target(FOLDER)
    return target and ShippedFiles(CodeFiles(str(FOLDER), name, stamp), target)


@cache
def usable_target(folder: Path) -> tuple[str, str, str] | None:
    """Target of the shipped kernels, None if this processor does not run them."""
    path = folder / TARGET
    if not path.is_file():
        return None
    from llvmlite import binding

    target = json.loads(path.read_text())
    has = binding.get_host_cpu_features()
    same = target["triple"] == binding.get_process_triple()
    if not same or not all(has.get(feature) for feature in target["needs"]):
        return None
    return target["triple"], target["cpu"], target["features"]
