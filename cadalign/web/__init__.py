"""Scripts, styles and HTML of the pages, bundled from the sources beside this file by ``make web``.

The bundles in ``dist`` are part of the package: using it needs no Node. A test builds them anew and
compares the bytes.
"""

from __future__ import annotations

from importlib.resources import files
from string import Template


def asset(name: str) -> str:
    """Read a bundled file, such as ``report.js``."""
    return (files("cadalign.web") / "dist" / name).read_text(encoding="utf-8")


def fill(name: str, **values: object) -> str:
    """Fill the ``$placeholders`` of a bundled HTML file with values, which must be escaped."""
    return Template(asset(name)).substitute(values)
