"""The committed bundles are what the sources beside them make."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

import cadalign.web
from cadalign.web import asset

WEB = Path(cadalign.web.__file__).parent
PAGES = ("report", "annotate")


@pytest.fixture(scope="module")
def rebuilt(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of bundles made anew from a copy of the sources."""
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("no npm here; on Debian: apt-get install npm")
    copy = tmp_path_factory.mktemp("web") / "web"
    shutil.copytree(WEB, copy, ignore=shutil.ignore_patterns("node_modules", "dist", "__pycache__"))
    quiet = {**os.environ, "npm_config_update_notifier": "false"}
    if (WEB / "node_modules").is_dir():
        (copy / "node_modules").symlink_to(WEB / "node_modules")
    else:
        command = [npm, "ci", "--no-audit", "--no-fund"]
        installed = subprocess.run(command, cwd=copy, env=quiet, capture_output=True, text=True)
        if installed.returncode:
            pytest.skip(f"npm ci cannot get the packages here: {installed.stderr.strip()[-300:]}")
    built = subprocess.run(
        [npm, "run", "build"], cwd=copy, env=quiet, capture_output=True, text=True
    )
    assert built.returncode == 0, built.stderr
    return copy / "dist"


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
