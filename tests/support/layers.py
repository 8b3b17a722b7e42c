"""The layers of the package, as the README lists them."""

from __future__ import annotations

import re
from pathlib import Path

README = Path(__file__).resolve().parents[2] / "README.md"


def layers() -> list[str]:
    """Packages and modules in the order of the README's list, such as ``solvers``, ``errors``."""
    text = README.read_text(encoding="utf-8")
    found = re.search(r"## How it is built\n\n```\n(.*?)```", text, re.S)
    return [name for line in found[1].splitlines() for name in line.split("   ")[0].split()]
