"""A new user: an environment with the wheel alone, what it lists, and what the documents run."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from support.wheels import ROOT, Environment, build_wheel

import cadalign

pytestmark = pytest.mark.long

DOCS = ROOT / "docs"
PAGES = [
    page
    for page in [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
    if "_build" not in page.relative_to(ROOT).parts
    and "```python" in page.read_text(encoding="utf-8")
]
RUN_SNIPPETS = r"""
import re, sys
from pathlib import Path

import cadalign
from cadalign.estimation.result_parts import MISFIT_KINDS

BAD = {*MISFIT_KINDS, "contradiction", "unit", "noise", "chance"}
for page in sys.argv[1:]:
    names = {}
    for block in re.findall(r"```python\n(.*?)```", Path(page).read_text("utf-8"), re.DOTALL):
        exec(compile(block, page, "exec"), names)
    for name, found in names.items():
        for each in found if isinstance(found, list | tuple) else [found]:
            each = getattr(each, "result", each)
            if not isinstance(each, cadalign.Result):
                continue
            assert not {w.kind for w in each.warnings} & BAD, (page, name, str(each))
            assert 0.25 < each.stretch.min() <= each.stretch.max() < 4, (page, name, str(each))
            in_sigmas = [e.rms_sigmas for e in each.evidence if each.sigma is not None]
            assert max(in_sigmas, default=0) < 3, (page, name, str(each))
    print("ran", page)
"""
IPYTHON = """
from IPython.core.completer import provisionalcompleter
from IPython.core.interactiveshell import InteractiveShell

shell = InteractiveShell.instance()
shell.Completer.use_jedi = False
shell.run_cell("import cadalign")
with provisionalcompleter():
    for text in ("cadalign.fi", "cadalign.da"):
        print(*(found.text.strip(".") for found in shell.Completer.completions(text, len(text))))
"""


@pytest.fixture(scope="module")
def user(tmp_path_factory: pytest.TempPathFactory) -> Environment:
    folder = tmp_path_factory.mktemp("user")
    return Environment.with_wheel(build_wheel(folder), folder / "venv")


def python(user: Environment, code: str) -> str:
    return user.run("python", ["-c", code])


@pytest.mark.long
def test_package_and_command_are_those_of_the_wheel(user: Environment) -> None:
    code = (
        "import cadalign, cadalign.datasets; print(cadalign.__file__, cadalign.datasets.__file__)"
    )
    assert all(Path(path).is_relative_to(user.site) for path in python(user, code).split())
    shown = user.run("cadalign", ["--version"])
    assert shown.split() == ["cadalign", cadalign.__version__]
    assert user.run("python", ["-m", "cadalign", "--version"]) == shown
    assert "fit" in user.run("cadalign", ["--help"])


@pytest.mark.long
def test_help_describes_arguments_result_and_errors(user: Environment) -> None:
    shown = python(user, "import cadalign; help(cadalign.fit)")
    for part in ("points_3d", "Parameters", "Returns", "Raises", ">>> "):
        assert part in shown
    described = python(user, "import cadalign; help(cadalign)")
    assert {"fit", "Library", "ShapeModel"} <= set(re.findall(r"\w+", described))


@pytest.mark.long
def test_jedi_completes_names_before_anything_runs(user: Environment) -> None:
    pytest.importorskip("jedi")
    code = (
        "import jedi\n"
        "def names(text):\n"
        "    return {name.name for name in jedi.Script(text).complete()}\n"
        "assert {'fit', 'fit_batch'} <= names('import cadalign\\ncadalign.fi')\n"
        "assert 'retrieve' in names('import cadalign\\ncadalign.Library.re')\n"
        "made = 'import cadalign\\ncadalign.Camera.from_fov(640, 480, 35.0).pro'\n"
        "assert 'project' in names(made)\n"
        "result = 'import cadalign\\ncadalign.fit([], [], None).ali'\n"
        "assert 'alignment' in names(result)\n"
    )
    python(user, code)


@pytest.mark.long
def test_ipython_completes_names(user: Environment) -> None:
    pytest.importorskip("IPython")
    found = python(user, IPYTHON).split()
    assert {"fit", "fit_batch", "datasets"} <= set(found)


@pytest.mark.long
def test_snippets_of_readme_and_site_run(user: Environment) -> None:
    user.run("cadalign", ["demo", "--files", "."])
    assert len(PAGES) > 5
    ran = user.run("python", ["-c", RUN_SNIPPETS, *map(str, PAGES)])
    assert [line for line in ran.splitlines() if line.startswith("ran ")] == [
        f"ran {page}" for page in PAGES
    ]
