"""The packages that the pages' scripts are made of, as npm gets them."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

import cadalign.web

WEB = Path(cadalign.web.__file__).parent
QUIET = {**os.environ, "npm_config_update_notifier": "false"}


def npm_or_skip() -> str:
    """The program npm; the test is skipped where there is none."""
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("no npm here; on Debian: apt-get install npm")
    return npm


def copy_with_modules(folder: Path) -> Path:
    """Copy the pages' sources with their packages beside them; skip where npm cannot get these."""
    npm, copy = npm_or_skip(), folder / "web"
    shutil.copytree(WEB, copy, ignore=shutil.ignore_patterns("node_modules", "dist", "__pycache__"))
    if (WEB / "node_modules").is_dir():
        (copy / "node_modules").symlink_to(WEB / "node_modules")
        return copy
    command = [npm, "ci", "--no-audit", "--no-fund"]
    installed = subprocess.run(command, cwd=copy, env=QUIET, capture_output=True, text=True)
    if installed.returncode:
        pytest.skip(f"npm ci cannot get the packages here: {installed.stderr.strip()[-300:]}")
    return copy


def axe_script(folder: Path) -> str:
    """The source of axe-core, which finds what a page lacks for those who cannot see or click."""
    place = Path("node_modules", "axe-core", "axe.min.js")
    if not (WEB / place).is_file():
        return (copy_with_modules(folder) / place).read_text(encoding="utf-8")
    return (WEB / place).read_text(encoding="utf-8")
