"""What the test modules share: fixtures, random cases for hypothesis, and how they are run."""

from __future__ import annotations

import asyncio
import faulthandler
import os
import re
import shutil
import tempfile
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any

import pytest
from hypothesis import HealthCheck, settings
from playwright.sync_api import Browser, Error, expect
from support.chromium import chromium

from cadalign.datasets import write_sample_dataset
from cadalign.evaluation.plots import STYLE

# The same cases on every run: a failure can be seen again, and a pass is not luck.
settings.register_profile(
    "cadalign",
    derandomize=True,
    deadline=None,
    max_examples=40,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
settings.load_profile("cadalign")

# In memory where there is room: a disk takes some milliseconds for every file that takes another's
# place, as all do that are written whole.
_MEMORY = Path("/dev/shm")
_ROOM = 4e9  # [bytes]
if (
    os.access(_MEMORY, os.W_OK)
    and shutil.disk_usage(_MEMORY).free > _ROOM
    and not os.statvfs(_MEMORY).f_flag & os.ST_NOEXEC
):
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(_MEMORY))
    tempfile.tempdir = os.environ.setdefault("TMPDIR", str(_MEMORY))

# What a page shows is waited for; how soon it does is a matter for the tests of times.
expect.set_options(timeout=30_000)


REQUIRED = os.environ.get("CADALIGN_REQUIRED", "").split()
"""Names of optional packages that are known to be here: a test skipped for want of one fails."""


COMPILED = pytest.StashKey[Future[None]]()


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile the usual kernels while the processes of xdist, which run the tests, collect them."""
    if session.config.getoption("numprocesses", None):
        from cadalign.cli.doctor import compile_ahead

        session.config.stash[COMPILED] = ThreadPoolExecutor(1).submit(compile_ahead)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_node_collection_finished(node: Any) -> None:
    """Let the processes of xdist wait for the usual kernels; otherwise each compiles its own."""
    node.config.stash[COMPILED].result()


class BackwardFolder(pytest.Dir):
    """A folder collected from its end."""

    def collect(self) -> Iterable[pytest.Item | pytest.Collector]:
        return reversed(list(super().collect()))


def pytest_collect_directory(path: Path, parent: pytest.Collector) -> pytest.Collector | None:
    """Let every other process of xdist begin with the last folder.

    Each compiles the modules of tests that it is the first to load, and finds those of the others.
    """
    worker = getattr(parent.config, "workerinput", {"workerid": "gw0"})["workerid"]
    if int(worker.removeprefix("gw")) % 2 and path.is_relative_to(Path(__file__).parent):
        return BackwardFolder.from_parent(parent, path=path)
    return None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Let the processes of xdist begin with long modules: in the end none works on one alone.

    Those of the whole package are the longest, and need few kernels.
    """
    if hasattr(config, "workerinput"):
        long = {item.path for item in items if item.get_closest_marker("long")}
        items.sort(key=lambda item: (item.path not in long, len(item.path.parts), item.path))


HANGS_AFTER = 900  # [s]; more than the limits that tests have for what they start
STACK = pytest.StashKey[IO[str]]()
_OF_PYTEST = r"site-packages/(_pytest|pluggy|xdist|execnet)/|<string>|^$|^Extension modules"


def stacks_folder(config: pytest.Config) -> Path:
    return Path(config.stash[STACK].name).parent


def pytest_configure(config: pytest.Config) -> None:
    """Open a file for the stack of a test that hangs or crashes, one for each process."""
    given = getattr(config, "workerinput", {"stacks": ""})["stacks"]
    folder = Path(given or tempfile.mkdtemp(prefix="cadalign-stacks-"))
    config.stash[STACK] = file = (folder / str(os.getpid())).open("a")
    faulthandler.enable(file)


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node: Any) -> None:
    node.workerinput["stacks"] = str(stacks_folder(node.config))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """End the process of a test that hangs, also one that hangs in compiled code."""
    file = item.config.stash[STACK]
    print(item.nodeid, file=file, flush=True)
    faulthandler.dump_traceback_later(HANGS_AFTER, file=file, exit=True)
    try:
        return (yield)
    finally:
        faulthandler.cancel_dump_traceback_later()
        file.truncate(0)


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Print the stacks of tests that did not end, below all other results."""
    if hasattr(config, "workerinput"):
        return
    for file in stacks_folder(config).iterdir():
        for line in file.read_text().splitlines():
            if not re.search(_OF_PYTEST, line):
                terminalreporter.write_line(line)
    shutil.rmtree(stacks_folder(config))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, Any, Any]:
    report = yield
    if report.skipped and not hasattr(report, "wasxfail"):
        _, _, reason = report.longrepr
        for name in REQUIRED:
            if name in reason.lower():
                report.outcome, report.longrepr = "failed", f"{name} is required: {reason}"
    return report


@pytest.fixture(scope="session", autouse=True)
def font_type() -> Iterator[int]:
    """Draw the letters of PDF files: to pick them out of a TrueType font takes half of a figure.

    Gives the setting that figures have otherwise.
    """
    with pytest.MonkeyPatch.context() as patched:
        usual = STYLE["pdf.fonttype"]
        patched.setitem(STYLE, "pdf.fonttype", 3)
        yield usual


@pytest.fixture
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make figures, but draw no pixel of their files, which takes most of a small run."""
    # By its name: most tests need no matplotlib.
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda _, path, **rest: path.touch())


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of the real data; tests that need it are skipped where it is not named."""
    folder = os.environ.get("CADALIGN_DATA")
    if not folder:
        pytest.skip("CADALIGN_DATA does not name the folder of the real data")
    return Path(folder)


@pytest.fixture(scope="session")
def sample_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sample data set with one model of every category; to be read, not changed."""
    return write_sample_dataset(tmp_path_factory.mktemp("data") / "sample", per_category=1)


@pytest.fixture(scope="session")
def launched() -> Iterator[tuple[Browser, asyncio.AbstractEventLoop]]:
    """One Chromium for all modules, and Playwright's event loop, which is hidden between them.

    That loop runs as long as Playwright does, and no other could beside it. Tests are skipped where
    there is no Chromium.
    """
    with ExitStack() as stack:
        try:
            found = stack.enter_context(chromium())
        except Error as error:
            reason = error.message.strip().splitlines()[0]
            pytest.skip(f"no Chromium here ({reason}); on Debian: apt-get install chromium")
        loop = asyncio.get_running_loop()
        asyncio._set_running_loop(None)
        yield found, loop
        asyncio._set_running_loop(loop)


@pytest.fixture(scope="module")
def browser(launched: tuple[Browser, asyncio.AbstractEventLoop]) -> Iterator[Browser]:
    """See `launched`; not for modules whose tests have an event loop of their own."""
    found, loop = launched
    asyncio._set_running_loop(loop)
    yield found
    asyncio._set_running_loop(None)
