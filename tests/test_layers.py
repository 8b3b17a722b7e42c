"""The README's list of layers: each imports only what stands above it."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "cadalign"


def layers() -> list[str]:
    """Packages and modules in the order of the README's list, such as ``solvers``, ``fitting``."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    found = re.search(r"## How it is built\n\n```\n(.*?)```", text, re.S)
    assert found is not None
    names = [re.split(r"/|\.py| ", line.strip())[0] for line in found[1].splitlines()]
    return [name for name in names if name not in ("cadalign", "scripts")]


def imports_of(layer: str) -> Iterator[tuple[Path, str]]:
    """The files of a layer with the modules of the package that they import, lazily too."""
    folder = PACKAGE / layer
    for path in sorted(folder.rglob("*.py")) if folder.is_dir() else [folder.with_suffix(".py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module == "cadalign":
                yield from ((path, alias.name) for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("cadalign."):
                yield path, str(node.module).split(".")[1]


def test_the_list_names_every_package() -> None:
    packages = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    assert packages - {"web"} <= set(layers())


@pytest.mark.parametrize("layer", layers())
def test_a_layer_imports_only_what_stands_above_it(layer: str) -> None:
    order = layers()
    below = order[order.index(layer) + 1 :]
    assert [(path.name, name) for path, name in imports_of(layer) if name in below] == []
