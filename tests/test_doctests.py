"""The examples in the docstrings run and give what they say."""

from __future__ import annotations

import doctest
import importlib
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "cadalign"
OPTIONAL = {"open3d", "dask", "distributed"}


def modules_with_examples() -> list[str]:
    """Names of all modules of the package that hold a prompt, those behind links included."""
    roots = [("cadalign", PACKAGE)]
    roots += [(f"cadalign.{name}", (PACKAGE / name).resolve()) for name in ("datasets", "render")]
    names = set()
    for prefix, root in roots:
        for path in root.rglob("*.py"):
            if ">>>" in path.read_text(encoding="utf-8"):
                parts = path.relative_to(root).with_suffix("").parts
                names.add(".".join([prefix, *(part for part in parts if part != "__init__")]))
    return sorted(names)


MODULES = modules_with_examples()


def test_examples_are_looked_for_in_every_package() -> None:
    packages = {name.split(".")[1] for name in MODULES if name.count(".") > 1}
    assert {"datasets", "render"} <= packages
    assert {
        "cadalign.geometry.alignment",
        "cadalign.geometry.camera",
        "cadalign.estimation.fit",
    } <= set(MODULES)


@pytest.mark.long
@pytest.mark.parametrize("name", MODULES)
def test_examples_run(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        module = importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name not in OPTIONAL:
            raise
        pytest.skip(f"the optional package {error.name} is not installed")
    if name == "cadalign.torch":
        pytest.importorskip("torch", reason='needs pip install -e ".[torch]"')
    monkeypatch.chdir(tmp_path)  # what an example writes does not stay
    with capsys.disabled():
        results = doctest.testmod(module, optionflags=doctest.IGNORE_EXCEPTION_DETAIL)
    assert results.failed == 0
    if results.attempted == 0:
        pytest.skip("all its examples need data that is not here")
