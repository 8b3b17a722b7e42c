"""Runs on a Dask cluster: equal bytes, also if a worker dies during the run."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from cadalign.cli import main
from cadalign.errors import CadalignError
from cadalign.evaluation.api import run
from cadalign.evaluation.experiments.simulation import SweepOptions
from cadalign.evaluation.runs.engine import Progress
from cadalign.evaluation.runs.folder import RunFolder

distributed = pytest.importorskip(
    "distributed", reason="Dask is not installed: pip install 'cadalign[dask]'"
)

pytestmark = pytest.mark.long

KIND = SweepOptions("points", values=(8, 20), runs=200, methods=("optimal", "aepnp-paper", "limit"))


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:
        yield cluster


@pytest.mark.long
def test_a_worker_killed_in_the_middle_leaves_the_bytes_as_they_are(
    tmp_path: Path, cluster: Any
) -> None:
    calm, hit = RunFolder(tmp_path / "calm"), RunFolder(tmp_path / "hit")
    run(KIND, calm, workers=0, dask=None)
    killed: list[int] = []

    def kill_one(progress: Progress) -> None:
        if progress.done >= 128 and not killed:
            worker = next(iter(cluster.workers.values()))
            killed.append(worker.pid)
            os.kill(worker.pid, signal.SIGKILL)

    run(KIND, hit, workers=None, dask=cluster.scheduler_address, on_progress=kill_one)
    assert killed
    assert hit.results.read_bytes() == calm.results.read_bytes()


@pytest.mark.timing
@pytest.mark.parametrize(
    ("address", "reason"),
    [
        ("nonsense", "missing port number in address 'nonsense'"),
        ("nonsense://x", "unknown address scheme 'nonsense'"),
        ("tcp://" + "a" * 300 + ":1", "label"),
    ],
)
def test_what_is_no_address_is_refused_at_once(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], address: str, reason: str
) -> None:
    start = time.monotonic()
    options = ["--runs", "2", "--methods", "aepnp", "--out", str(tmp_path / "run")]
    assert main(["simulate", "points", *options, "--dask", address]) == 1
    gc.collect()  # a client that was not closed would now wait for a minute
    assert time.monotonic() - start < 20
    text = capfd.readouterr().err
    assert "no Dask scheduler answers (" in text
    assert reason in text
    assert "start one with `dask scheduler`" in text
    assert "Traceback" not in text


_CLUSTER = """
import sys
from distributed import LocalCluster
if __name__ == "__main__":
    options = {"n_workers": 1, "threads_per_worker": 1, "dashboard_address": None}
    with LocalCluster(processes=True, **options) as cluster:
        print(cluster.scheduler_address, flush=True)
        sys.stdin.read()
"""


@pytest.mark.long
def test_a_lost_scheduler_is_told_of_and_the_run_goes_on(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    calm, hit = RunFolder(tmp_path / "calm"), RunFolder(tmp_path / "hit")
    process = subprocess.Popen(
        [sys.executable, "-c", _CLUSTER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert process.stdout is not None
    address = process.stdout.readline().strip()
    done: list[int] = []

    def kill(progress: Progress) -> None:
        done.append(progress.done)
        if progress.done >= 128 and process.poll() is None:
            process.kill()
            process.wait()

    with pytest.raises(CadalignError, match="no Dask scheduler answers") as caught:
        run(KIND, hit, workers=None, dask=address, on_progress=kill)
    assert caught.value.where == address
    assert "Traceback" not in capfd.readouterr().err
    run(KIND, calm, workers=0, dask=None)
    seen: list[int] = []
    run(KIND, hit, workers=0, dask=None, on_progress=lambda progress: seen.append(progress.done))
    assert seen[0] >= 128
    assert hit.results.read_bytes() == calm.results.read_bytes()
