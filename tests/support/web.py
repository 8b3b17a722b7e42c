"""The npm packages of the pages' scripts."""

from __future__ import annotations

import atexit
import os
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path

import pytest

import cadalign.web

WEB = Path(cadalign.web.__file__).parent
QUIET = {**os.environ, "npm_config_update_notifier": "false"}


def npm_or_skip() -> str:
    """Path of npm; skips the test without npm."""
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("no npm here; on Debian: apt-get install npm")
    return npm


def copy_with_modules(folder: Path) -> Path:
    """Copy the pages' sources and packages; skips the test if npm cannot install these."""
    copy = folder / "web"
    shutil.copytree(WEB, copy, ignore=shutil.ignore_patterns("node_modules", "dist", "__pycache__"))
    (copy / "node_modules").symlink_to(_modules())
    return copy


@cache
def _modules() -> Path:
    """Folder of the packages, installed once for all tests if needed."""
    if (WEB / "node_modules").is_dir():
        return WEB / "node_modules"
    npm, folder = npm_or_skip(), Path(tempfile.mkdtemp(prefix="cadalign-modules-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    for name in ("package.json", "package-lock.json"):
        shutil.copy(WEB / name, folder)
    command = [npm, "ci", "--no-audit", "--no-fund"]
    installed = subprocess.run(command, cwd=folder, env=QUIET, capture_output=True, text=True)
    if installed.returncode:
        pytest.skip(f"npm ci cannot get the packages here: {installed.stderr.strip()[-300:]}")
    return folder / "node_modules"


def axe_script() -> str:
    """Source of axe-core, which checks the accessibility of pages."""
    return (_modules() / "axe-core" / "axe.min.js").read_text(encoding="utf-8")
