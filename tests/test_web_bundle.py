"""The committed bundles match their sources."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from support.web import QUIET, WEB, copy_with_modules, npm_or_skip

from cadalign.web import asset

PAGES = ("report", "annotate")


@pytest.fixture(scope="module")
def rebuilt(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of bundles built from a copy of the sources."""
    copy = copy_with_modules(tmp_path_factory.mktemp("web"))
    command = [npm_or_skip(), "run", "build"]
    built = subprocess.run(command, cwd=copy, env=QUIET, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    return copy / "dist"


@pytest.mark.long
def test_bundles_match_the_sources(rebuilt: Path) -> None:
    committed = {path.name: path.read_bytes() for path in (WEB / "dist").iterdir()}
    built = {path.name: path.read_bytes() for path in rebuilt.iterdir()}
    assert sorted(built) == sorted(committed)
    stale = [name for name in built if built[name] != committed[name]]
    assert not stale, f"out of date: {stale}; run `make web`"


@pytest.mark.parametrize("page", PAGES)
def test_bundles_can_be_inlined_in_html(page: str) -> None:
    assert "</script" not in asset(f"{page}.js").lower()
    assert "<!--" not in asset(f"{page}.js")
    assert "</style" not in asset(f"{page}.css").lower()


@pytest.mark.parametrize("page", PAGES)
def test_styles_load_no_external_files(page: str) -> None:
    style = asset(f"{page}.css")
    assert "@import" not in style
    assert "url(" not in style


def test_licences_are_bundled() -> None:
    notices = asset("LICENSES.txt")
    for library in ("plotly.js-basic-dist-min", "three"):
        assert library in notices
    assert notices.count("Permission is hereby granted") == 2
