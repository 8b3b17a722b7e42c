"""The committed bundles are what the sources beside them make."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from support.web import QUIET, WEB, copy_with_modules, npm_or_skip

from cadalign.web import asset

PAGES = ("report", "annotate")


@pytest.fixture(scope="module")
def rebuilt(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of bundles made anew from a copy of the sources."""
    copy = copy_with_modules(tmp_path_factory.mktemp("web"))
    command = [npm_or_skip(), "run", "build"]
    built = subprocess.run(command, cwd=copy, env=QUIET, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    return copy / "dist"


@pytest.mark.long
def test_bundles_are_those_of_the_sources(rebuilt: Path) -> None:
    committed = {path.name: path.read_bytes() for path in (WEB / "dist").iterdir()}
    made = {path.name: path.read_bytes() for path in rebuilt.iterdir()}
    assert sorted(made) == sorted(committed)
    stale = [name for name in made if made[name] != committed[name]]
    assert not stale, f"not built from the sources as they are: {stale}; run `make web`"


@pytest.mark.parametrize("page", PAGES)
def test_a_bundle_can_stand_inside_a_page(page: str) -> None:
    assert "</script" not in asset(f"{page}.js").lower()
    assert "<!--" not in asset(f"{page}.js")
    assert "</style" not in asset(f"{page}.css").lower()


@pytest.mark.parametrize("page", PAGES)
def test_styles_ask_for_nothing_from_elsewhere(page: str) -> None:
    style = asset(f"{page}.css")
    assert "@import" not in style
    assert "url(" not in style


def test_licences_travel_with_the_bundles() -> None:
    notices = asset("LICENSES.txt")
    for library in ("plotly.js-basic-dist-min", "three"):
        assert library in notices
    assert notices.count("Permission is hereby granted") == 2
