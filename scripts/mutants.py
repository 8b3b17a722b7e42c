"""Mutation testing: change the code at random places, and count the changes that tests notice.

    python scripts/mutants.py --count 200              # what `make mutants` runs
    python scripts/mutants.py --rooms geometry io      # of two rooms
    python scripts/mutants.py --whole                  # by the whole suite
    python scripts/mutants.py --coverage .coverage     # by the tests that run the changed line

Each mutant swaps an operator, a comparison or a condition at one place of a copy of the checkout,
with ``--numbers`` also a number: many of these are dimensions of sample models, defaults and
thresholds, which a test could only repeat. Survivors are printed as differences: each needs a test,
or changes nothing that matters.

`pytest --cov --cov-context=test` writes the data for ``--coverage``. A test that does not run a
line cannot notice its change, so this asks the whole suite at a hundredth of its time: first the
tests of the mutant's room, then the others. Lines of compiled kernels are not in the data: their
mutants are tested by the room and by `estimation`.
"""

from __future__ import annotations

import ast
import copy
import difflib
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import zip_longest
from pathlib import Path

import pytest
import tyro

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("cadalign", "datasets", "render")
COPIED = (
    *(*FOLDERS, "tests", "docs", "scripts"),
    *("pyproject.toml", "README.md", "LICENSE", "Makefile"),
)
_PAIRS: tuple[tuple[type[ast.AST], type[ast.AST]], ...] = (
    *((ast.Lt, ast.LtE), (ast.Gt, ast.GtE), (ast.Eq, ast.NotEq), (ast.Is, ast.IsNot)),
    *((ast.In, ast.NotIn), (ast.Add, ast.Sub), (ast.Mult, ast.Div), (ast.And, ast.Or)),
)
SWAPS = dict(_PAIRS) | {second: first for first, second in _PAIRS}


@dataclass(kw_only=True)
class Arguments:
    """Mutation testing with a fixed seed."""

    count: int = 200
    """Number of mutants."""
    seed: int = 0
    """Seed of their places."""
    rooms: tuple[str, ...] = ()
    """Rooms to mutate, such as geometry; by default all."""
    numbers: bool = False
    """Mutate numbers, too."""
    whole: bool = False
    """Run the whole suite on each mutant rather than the tests of its room."""
    coverage: Path | None = None
    """Data of pytest-cov with a context per test: run the tests that run the changed line."""
    most: int = 60
    """With coverage data, the number of tests per mutant of its room, and of the others."""
    first: int = 1
    """Number of the mutant to begin with, to continue a run that was stopped."""
    timeout: float = 900.0
    """Seconds after which a mutant counts as caught: it hangs."""


@dataclass(frozen=True)
class Mutant:
    """A changed file: ``path`` relative to the checkout, its ``line`` and its ``text``."""

    path: Path
    line: int
    text: str


def main(arguments: Arguments) -> int:
    """Test the mutants; returns 1 if one survived."""
    found = [place for path in sources(arguments.rooms) for place in places_of(path)]
    places = [(path, place) for path, place, is_number in found if arguments.numbers >= is_number]
    chosen = random.Random(arguments.seed).sample(places, min(arguments.count, len(places)))
    catchers, survivors = Counter[str](), []
    with tempfile.TemporaryDirectory() as folder:
        checkout = Path(folder) / "checkout"
        copy_to(checkout)
        for number, (path, place) in enumerate(chosen[arguments.first - 1 :], arguments.first):
            mutant = mutated(path, place)
            catcher = caught_by(checkout, mutant, arguments)
            print(f"{number:4} {catcher or 'SURVIVED':9} {path}:{mutant.line}", flush=True)
            if catcher:
                catchers[catcher] += 1
            else:
                survivors.append(mutant)
    for mutant in survivors:
        print(difference(mutant))
    tested = catchers.total() + len(survivors)
    by = ", ".join(f"{count} by {name}" for name, count in catchers.items())
    share = 100 * catchers.total() / max(tested, 1)
    print(f"caught {catchers.total()} of {tested} mutants ({share:.0f} %): {by}")
    return int(bool(survivors))


def sources(rooms: tuple[str, ...]) -> list[Path]:
    """Modules of the chosen rooms, relative to the checkout."""
    found = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
    links = ("cadalign", "datasets"), ("cadalign", "render")
    inside = [path.relative_to(ROOT) for path in found]
    inside = [path for path in inside if path.parts[:2] not in links]
    return [path for path in inside if not rooms or room_of(path) in rooms]


def room_of(path: Path) -> str:
    """Folder of the tests that are about a module; empty for modules beside the rooms."""
    parts = path.parts[1:] if path.parts[0] == "cadalign" else path.parts
    return parts[0] if len(parts) > 1 else ""


def places_of(path: Path) -> Iterator[tuple[Path, int, bool]]:
    """A module's nodes that can be mutated: their place in `ast.walk`, and if they are numbers."""
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    hidden = set(unmutated(tree))
    for number, node in enumerate(ast.walk(tree)):
        if node not in hidden and swapped(node) is not None:
            is_number = isinstance(node, ast.Constant) and not isinstance(node.value, bool)
            yield path, number, is_number


def unmutated(tree: ast.AST) -> Iterator[ast.AST]:
    """Nodes that no test should notice: annotations, texts, types, and settings.

    Settings are the flags of decorators, `zip(strict=)`, and the numbers that modules name at their
    top: thresholds chosen by judgement, which a test could only repeat.
    """
    for node in ast.walk(tree):
        match node:
            case ast.JoinedStr():
                parts = [node]
            case ast.arg(annotation=noted) | ast.AnnAssign(annotation=noted):
                parts = [noted]
            case ast.FunctionDef(returns=noted, decorator_list=decorators):
                parts = [noted, *decorators]
            case ast.ClassDef(decorator_list=decorators):
                parts = list(decorators)
            case ast.keyword(arg="strict", value=value):
                parts = [value]
            case ast.Module(body=body):
                parts = [e.value for e in body if isinstance(e, ast.Assign | ast.AnnAssign)]
            case ast.If(test=test) if "TYPE_CHECKING" in ast.unparse(test):
                parts = [node]
            case _:
                continue
        for part in parts:
            if part is not None:
                yield from ast.walk(part)


def swapped(node: ast.AST) -> ast.expr | None:
    """The expression in place of a node, or None if there is none."""
    if isinstance(node, ast.Compare) and len(node.ops) == 1 and type(node.ops[0]) in SWAPS:
        changed = copy.deepcopy(node)
        changed.ops = [SWAPS[type(node.ops[0])]()]  # type: ignore[list-item]
        return changed
    if isinstance(node, ast.BinOp | ast.BoolOp) and type(node.op) in SWAPS:
        either = copy.deepcopy(node)
        either.op = SWAPS[type(node.op)]()  # type: ignore[assignment]
        return either
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        return node.operand
    if isinstance(node, ast.Constant) and isinstance(node.value, bool | int | float):
        value = not node.value if isinstance(node.value, bool) else node.value + 1
        return ast.Constant(value)
    return None


def mutated(path: Path, place: int) -> Mutant:
    """The file with the node of that number swapped."""
    text = (ROOT / path).read_text(encoding="utf-8")
    node = next(node for number, node in enumerate(ast.walk(ast.parse(text))) if number == place)
    new = swapped(node)
    assert isinstance(node, ast.expr)
    assert new is not None
    assert node.end_lineno is not None
    assert node.end_col_offset is not None
    lines = text.encode().splitlines(keepends=True)
    start = sum(map(len, lines[: node.lineno - 1])) + node.col_offset
    end = sum(map(len, lines[: node.end_lineno - 1])) + node.end_col_offset
    changed = text.encode()[:start] + f"({ast.unparse(new)})".encode() + text.encode()[end:]
    return Mutant(path, node.lineno, changed.decode())


def copy_to(checkout: Path) -> None:
    """Copy the checkout with its compiled kernels, which keep the times of their sources."""
    checkout.mkdir()
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            ignore = shutil.ignore_patterns("node_modules", "_build", "*.pyc")
            shutil.copytree(source, checkout / name, symlinks=True, ignore=ignore)
        else:
            shutil.copy2(source, checkout / name)


def caught_by(checkout: Path, mutant: Mutant, arguments: Arguments) -> str:
    """Name of the tests of which one fails on the mutant, empty if none does.

    The copy is as before afterwards.
    """
    target = checkout / mutant.path
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
    environment = {**os.environ, "PYTHONPATH": str(checkout), "PYTHONDONTWRITEBYTECODE": "1"}
    target.write_text(mutant.text, encoding="utf-8")
    try:
        for name, tests in tests_of(mutant, arguments).items():
            done = subprocess.run(
                [*command, *tests],
                cwd=checkout,
                env=environment,
                capture_output=True,
                timeout=arguments.timeout,
                check=False,
            )
            if done.returncode not in (0, pytest.ExitCode.NO_TESTS_COLLECTED):
                return name
    except subprocess.TimeoutExpired:
        return "time"
    finally:
        shutil.copy2(ROOT / mutant.path, target)
    return ""


def tests_of(mutant: Mutant, arguments: Arguments) -> dict[str, list[str]]:
    """Arguments of pytest that choose the tests of a mutant, by the name of the choice."""
    folder = f"tests/{room_of(mutant.path)}"
    room = folder if folder != "tests/" and (ROOT / folder).is_dir() else "tests"
    quick = ["-m", "not long and not timing"]
    if arguments.whole:
        return {"all": ["-m", "not timing", "tests"]}
    if arguments.coverage is None:
        return {"room": [*quick, room]}
    lines = covering_tests(arguments.coverage)
    covering = lines.get((str(mutant.path), mutant.line), [])
    if not covering:
        rooms = (f"{room}/", "tests/estimation/") if room == "tests/solvers" else (f"{room}/",)
        covering = [name for names in lines.values() for name in names if name.startswith(rooms)]
    every = all_tests(arguments.coverage)
    inside = beginning_with([name for name in covering if name.startswith(f"{room}/")], every)
    outside = beginning_with([name for name in covering if not name.startswith(f"{room}/")], every)
    groups = {"room": inside, "others": outside}
    return {name: [*quick, *tests[: arguments.most]] for name, tests in groups.items() if tests}


def beginning_with(covering: list[str], every: set[str]) -> list[str]:
    """The covering tests, then the others of their files, those of most of them first.

    What a fixture runs that several tests share is in the data of the first of them alone.
    """
    files = Counter(name.split("::")[0] for name in set(covering))
    others = sorted(every.difference(covering))
    further = [name for file, _ in files.most_common() for name in others if name.startswith(file)]
    return in_turns(covering) + further


def in_turns(names: list[str]) -> list[str]:
    """Tests taken from one file after the other."""
    files: dict[str, list[str]] = {}
    for name in sorted(set(names)):
        files.setdefault(name.split("::")[0], []).append(name)
    rounds = zip_longest(*files.values())
    return [name for each in rounds for name in each if name is not None]


@cache
def covering_tests(data: Path) -> dict[tuple[str, int], list[str]]:
    """Tests by the file and line that they run, from the data of a run with coverage."""
    from coverage import CoverageData  # only with --coverage

    found = CoverageData(str(data))
    found.read()
    tests: dict[tuple[str, int], list[str]] = {}
    for file in found.measured_files():
        parts = Path(file).parts
        inside = next((n for n, part in enumerate(parts) if n and part in FOLDERS), 0)
        path = str(Path(*parts[inside:]))
        for line, contexts in found.contexts_by_lineno(file).items():
            names = {name.split("|")[0] for name in contexts if name}
            tests.setdefault((path, line), []).extend(sorted(names))
    return tests


@cache
def all_tests(data: Path) -> set[str]:
    """Names of all tests in the data of a run with coverage."""
    return {name for names in covering_tests(data).values() for name in names}


def difference(mutant: Mutant) -> str:
    """The change as a unified difference."""
    before = (ROOT / mutant.path).read_text(encoding="utf-8").splitlines()
    named = str(mutant.path)
    lines = difflib.unified_diff(before, mutant.text.splitlines(), named, named, "", "", 1, "")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Arguments)))
