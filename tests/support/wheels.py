"""Wheels of this checkout, and environments that have nothing else of it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = (("cadalign", ""), ("datasets", "cadalign/"), ("render", "cadalign/"))
"""Folders of the checkout, and where their files are installed."""


def build_wheel(folder: Path) -> Path:
    """Build a wheel from a copy, so that nothing old in `build/` gets into it."""
    source = folder / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    ignored = shutil.ignore_patterns("__pycache__", "node_modules")
    for name, _ in PACKAGES:
        shutil.copytree(ROOT / name, source / name, symlinks=True, ignore=ignored)
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation"]
    command += ["--outdir", str(folder / "out"), str(source)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    (path,) = (folder / "out").glob("*.whl")
    return path


def source_files() -> dict[str, Path]:
    """Every Python file of the checkout by the name that it is to be installed under."""
    files = {}
    for folder, prefix in PACKAGES:
        for path in (ROOT / folder).rglob("*.py"):
            name = path.relative_to(ROOT).as_posix()
            if not name.startswith(("cadalign/datasets/", "cadalign/render/")):
                files[prefix + name] = path
    return files


@dataclass(frozen=True)
class Environment:
    """A virtual environment that has cadalign from a wheel, and whose commands run in ``home``.

    What cadalign depends on it shares with the environment of the tests.
    """

    folder: Path
    home: Path

    @classmethod
    def with_wheel(cls, wheel: Path, folder: Path) -> Environment:
        """Make the environment and install the wheel into it."""
        subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True)
        home = folder / "home"
        home.mkdir()
        made = cls(folder, home)
        (made.site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
        pip = [sys.executable, "-m", "pip", "--python", str(folder / "bin" / "python")]
        options = ("--quiet", "--no-index", "--no-deps", "--force-reinstall", "--no-compile")
        subprocess.run([*pip, "install", *options, str(wheel)], check=True)
        return made

    @property
    def site(self) -> Path:
        """Folder of the installed packages."""
        (site,) = self.folder.glob("lib/python*/site-packages")
        return site

    def run(self, command: str, arguments: Sequence[str], *, timeout: float = 600) -> str:
        """Run a command of the environment; returns what it writes, and fails with it."""
        keep = {name: os.environ[name] for name in ("LANG", "HOME") if name in os.environ}
        done = subprocess.run(
            [str(self.folder / "bin" / command), *arguments],
            cwd=self.home,
            env={**keep, "PATH": f"{self.folder}/bin:/usr/bin:/bin", "MPLBACKEND": "agg"},
            capture_output=True,
            text=True,
            timeout=timeout,
            check=False,
        )
        assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
        return done.stdout
