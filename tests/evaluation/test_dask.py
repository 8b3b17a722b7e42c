"""Runs on a Dask cluster: the same bytes, also where a worker dies in the middle."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from cadalign.errors import DataError
from cadalign.evaluation.api import run, simulate
from cadalign.evaluation.runs.cluster import DaskWorkers
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.run import Progress
from cadalign.evaluation.simulation.experiment import SweepExperiment
from cadalign.evaluation.simulation.options import SweepOptions

distributed = pytest.importorskip(
    "distributed", reason="Dask is not installed: pip install 'cadalign[dask]'"
)

pytestmark = pytest.mark.slow

KIND = SweepOptions("points", values=(8, 20), runs=600, methods=("optimal", "aepnp-paper", "limit"))


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:
        yield cluster


def test_a_worker_killed_in_the_middle_leaves_the_bytes_as_they_are(
    tmp_path: Path, cluster: Any
) -> None:
    calm, hit = RunFolder(tmp_path / "calm"), RunFolder(tmp_path / "hit")
    run(KIND, calm, workers=0)
    killed: list[int] = []

    def kill_one(progress: Progress) -> None:
        if progress.done >= 128 and not killed:
            worker = next(iter(cluster.workers.values()))
            killed.append(worker.pid)
            os.kill(worker.pid, signal.SIGKILL)

    run(KIND, hit, dask=cluster.scheduler_address, on_progress=kill_one)
    assert killed
    assert hit.results.read_bytes() == calm.results.read_bytes()


def test_simulate_takes_the_address(cluster: Any) -> None:
    table = simulate(
        "noise",
        values=[1],
        points=20,
        runs=5,
        methods=["aepnp"],
        dask=cluster.scheduler_address,
    )
    assert table.status.tolist() == ["ok"] * 5


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nonsense://x"])
def test_an_address_where_no_scheduler_is_gives_an_error(address: str) -> None:
    workers = DaskWorkers(address, timeout=1.0)
    with pytest.raises(DataError, match="no Dask scheduler answers") as caught:
        next(workers.evaluate(SweepExperiment(KIND.kind, seed=0), []))
    assert caught.value.where == address
