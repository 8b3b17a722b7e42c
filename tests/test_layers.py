"""The README's list of layers: every module imports only what stands above it."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.layers import layers as listed

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "cadalign"


def layers() -> list[str]:
    """Layers of the package itself; scripts are none."""
    return [name for name in listed() if name != "scripts"]


def modules() -> list[Path]:
    """All Python files of the package, those behind its links included."""
    roots = [PACKAGE, *(PACKAGE / name for name in ("datasets", "render"))]
    return sorted({path for root in roots for path in root.rglob("*.py")})


def layer_of(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def imports_in(source: str) -> Iterator[str]:
    """The layers that code imports: lazily, for type checking or by a module's name as text too."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.module == "cadalign":
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from layer_named(node.module or "")
        elif isinstance(node, ast.Import):
            yield from (name for alias in node.names for name in layer_named(alias.name))
        elif isinstance(node, ast.Constant) and re.match(r"cadalign\.\w+(\.|$)", str(node.value)):
            yield from (name for name in layer_named(str(node.value)) if name in layers())


def layer_named(module: str) -> list[str]:
    """The layer that a module belongs to, ``__init__`` for the root; none for foreign modules."""
    top, _, rest = module.partition(".")
    if top in ("datasets", "render"):
        return [f"{top} from the top level"]
    return [rest.split(".")[0] or "__init__"] if top == "cadalign" else []


def forbidden(layer: str, source: str) -> list[str]:
    """Imports in a layer's code of what does not stand above it."""
    order = layers()
    allowed = {*order[: order.index(layer) + 1], "__version__"}
    return [name for name in imports_in(source) if name not in allowed]


def test_the_list_names_every_module_of_the_root() -> None:
    assert {layer_of(path) for path in modules()} - {"__init__"} == set(layers())
    assert len(layers()) == len(set(layers()))


def test_the_root_holds_at_most_eight_modules() -> None:
    assert len(list(PACKAGE.glob("*.py"))) <= 8


@pytest.mark.long
@pytest.mark.parametrize("layer", layers())
def test_a_layer_imports_only_what_stands_above_it(layer: str) -> None:
    found = [
        (path.relative_to(PACKAGE).as_posix(), name)
        for path in modules()
        if layer_of(path) == layer
        for name in forbidden(layer, path.read_text(encoding="utf-8"))
    ]
    assert found == []


@pytest.mark.parametrize(
    "source",
    [
        "from cadalign.report.page import write_page",
        "from cadalign import report",
        "import cadalign.report.page",
        "import numpy, cadalign.report as pages",
        "def draw():\n    from cadalign.report import page",
        "if TYPE_CHECKING:\n    from cadalign.report.page import Page",
        'def __getattr__(name):\n    return import_module(f"cadalign.report.{name}")',
        'NAMES = {"Page": "cadalign.report.page"}',
    ],
)
def test_every_way_of_importing_what_stands_below_is_seen(source: str) -> None:
    assert forbidden("retrieval", source) == ["report"]
    assert forbidden("annotate", source) == []


@pytest.mark.parametrize(
    "source", ["from cadalign import fit", "import cadalign", "import datasets.sample"]
)
def test_layers_import_neither_the_root_nor_links_by_their_top_names(source: str) -> None:
    assert len(forbidden("cli", source)) == 1
    assert forbidden("cli", "import numpy\nfrom scipy import stats") == []
