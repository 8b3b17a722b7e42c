"""The pages' scripts and styles, bundled from the sources beside this file by ``make web``.

The bundles in ``dist`` are part of the package: using it needs no Node. A test builds them anew and
compares the bytes.
"""

from __future__ import annotations

from importlib.resources import files


def asset(name: str) -> str:
    """The text of a bundled file, such as ``report.js``."""
    return (files("cadalign.web") / "dist" / name).read_text(encoding="utf-8")
