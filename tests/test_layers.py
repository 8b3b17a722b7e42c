"""Layers and circles: modules import what the README lists above them, and not each other."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components
from support.layers import layers as listed

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "cadalign"
PUBLISHED = {"_asdict", "_exit", "_fields", "_make", "_replace", "_typeshed"}
"""Names with an underscore that their documentation has."""


@cache
def parsed(source: str) -> list[ast.AST]:
    """Imports and constants in code; the rest of its tree is not kept."""
    kinds = (ast.Import, ast.ImportFrom, ast.Constant)
    return [node for node in ast.walk(ast.parse(source)) if isinstance(node, kinds)]


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
    for node in parsed(source):
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
    assert {layer_of(path) for path in modules()} - {"__init__", "__main__"} == set(layers())
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


def name_of(path: Path) -> str:
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(("cadalign", *(part for part in parts if part != "__init__")))


def imported_by(source: str, names: set[str]) -> set[str]:
    """The package's modules that code imports, also in functions and for type checking."""
    found: set[str] = set()
    for node in parsed(source):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            inner = {f"{node.module}.{alias.name}" for alias in node.names} & names
            found.update(inner or {node.module})
    return found & names


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Sorted modules of which each imports each other, directly or not."""
    links = np.array([[other in graph[name] for other in graph] for name in graph])
    count, groups = connected_components(links, connection="strong")
    found = [sorted(np.array(list(graph))[groups == group].tolist()) for group in range(count)]
    return [group for group in found if len(group) > 1]


def test_circles_are_found_whole() -> None:
    graph = {"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": {"e"}, "e": {"d"}, "f": {"a"}}
    assert sorted(circles(graph)) == [["a", "b", "c"], ["d", "e"]]
    lazy = "def draw():\n    from cadalign.report import page\n    import cadalign.io"
    names = {"cadalign.report", "cadalign.report.page", "cadalign.io"}
    assert imported_by(lazy, names) == {"cadalign.report.page", "cadalign.io"}


def test_no_circle_of_imports_is_larger_than_two_modules() -> None:
    sources = {name_of(path): path.read_text(encoding="utf-8") for path in modules()}
    graph = {name: imported_by(source, set(sources)) for name, source in sources.items()}
    assert [circle for circle in circles(graph) if len(circle) > 2] == []


def private_names(tree: ast.AST, own: set[str]) -> set[str]:
    """Names with an underscore that code takes from others than the package."""
    taken = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and not (node.module or "").startswith("cadalign"):
            taken.update([*(node.module or "").split("."), *(alias.name for alias in node.names)])
    private = {name for name in taken if name.startswith("_") and not name.startswith("__")}
    return private - own - PUBLISHED


def test_private_names_of_libraries_stand_in_one_module() -> None:
    sources = {path: ast.parse(path.read_text(encoding="utf-8")) for path in modules()}
    own: set[str] = set()
    for node in (node for tree in sources.values() for node in ast.walk(tree)):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            own.add(node.name)
        elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            own.add(node.id if isinstance(node, ast.Name) else node.attr)
    found = {name_of(path): private_names(tree, own) for path, tree in sources.items()}
    assert [name for name, private in found.items() if private] == ["cadalign.compile.once"]
