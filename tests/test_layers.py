"""The README's list of layers: every module imports only what stands above it."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "cadalign"


def layers() -> list[str]:
    """Packages and modules in the order of the README's list, such as ``solvers``, ``errors``."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    found = re.search(r"## How it is built\n\n```\n(.*?)```", text, re.S)
    assert found is not None
    names = [re.split(r"/|\.py| ", line.strip())[0] for line in found[1].splitlines()]
    return [name for name in names if name not in ("cadalign", "scripts")]


def modules() -> list[Path]:
    """All Python files of the package, those behind its links included."""
    roots = [PACKAGE, *(PACKAGE / name for name in ("datasets", "render"))]
    return sorted({path for root in roots for path in root.rglob("*.py")})


def layer_of(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def imports_of(path: Path) -> Iterator[str]:
    """The layers that a file imports, lazily too, but not for type checking alone."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module == "cadalign":
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("cadalign."):
            yield str(node.module).split(".")[1]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names if alias.name.startswith("cadalign")]
            yield from (name.partition(".")[2].split(".")[0] or "__init__" for name in names)


def test_the_list_names_every_module_of_the_root() -> None:
    assert {layer_of(path) for path in modules()} - {"__init__"} == set(layers())
    assert len(layers()) == len(set(layers()))


def test_the_root_holds_at_most_eight_modules() -> None:
    assert len(list(PACKAGE.glob("*.py"))) <= 8


@pytest.mark.parametrize("layer", layers())
def test_a_layer_imports_only_what_stands_above_it(layer: str) -> None:
    order = layers()
    allowed = {*order[: order.index(layer) + 1], "__version__"}
    found = [
        (path.relative_to(PACKAGE).as_posix(), name)
        for path in modules()
        if layer_of(path) == layer
        for name in imports_of(path)
        if name not in allowed
    ]
    assert found == []
