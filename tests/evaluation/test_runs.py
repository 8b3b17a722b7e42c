"""Runs: interrupted, restarted, in parallel; with tasks that fail, crash or kill their worker."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from support.forked import MAIN, Program, finished
from support.squares import Squares

from cadalign.errors import CadalignError, DataError, InputError
from cadalign.evaluation.runs.engine import (
    KILLED_REASON,
    Progress,
    execute,
    workers_of,
)
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import ROW_GROUP, read_table, write_rows, write_tables
from cadalign.evaluation.runs.work import AbortError, Columns, Plan, reason_of
from cadalign.io import files


def run_squares(
    path: Path, experiment: Squares, *, count: int = 100, workers: int = 0, config: int = 1
) -> list[dict[str, object]]:
    folder = RunFolder(path)
    plan = Plan(experiment, range(count), {"value": config}, 7)
    execute(plan, folder, workers=workers_of(workers, None))
    return read_table(folder.results).to_pylist()


@pytest.mark.long
def test_results_are_in_the_order_of_the_tasks_whatever_the_workers(tmp_path: Path) -> None:
    rows = run_squares(tmp_path / "none", Squares())
    assert [row["task"] for row in rows] == list(range(100))
    run_squares(tmp_path / "two", Squares(), workers=2)
    plan, folder = Plan(Squares(), range(100), {"value": 1}, 7), RunFolder(tmp_path / "threads")
    execute(plan, folder, workers=workers_of(0, None, threads=3))
    files = [tmp_path / name / "results.parquet" for name in ("none", "two", "threads")]
    assert len({path.read_bytes() for path in files}) == 1
    records = read_table(tmp_path / "two" / "records.parquet")
    assert set(records["process"].to_pylist()).isdisjoint({0, os.getpid()})


def test_tasks_that_raise_become_failed_rows_and_spare_the_others(tmp_path: Path) -> None:
    rows = run_squares(tmp_path, Squares(raises=(3, 50)))
    failed = {row["task"]: row["reason"] for row in rows if row["square"] is None}
    assert failed == {3: "ValueError: cannot square 3", 50: "ValueError: cannot square 50"}
    assert len(rows) == 100
    assert reason_of(RuntimeError("no\n luck ")) == "RuntimeError: no luck"
    assert reason_of(ValueError()) == "ValueError"


@pytest.mark.long
def test_a_chunk_that_kills_its_workers_becomes_failed_rows(tmp_path: Path) -> None:
    rows = run_squares(tmp_path, Squares(kills=(8,)), workers=2)
    failed = {row["task"]: row["reason"] for row in rows if row["square"] is None}
    assert failed == dict.fromkeys(range(7, 14), KILLED_REASON)
    assert [row["task"] for row in rows] == list(range(100))


@pytest.mark.long
def test_a_chunk_is_repeated_after_its_worker_died(tmp_path: Path) -> None:
    run_squares(tmp_path / "calm", Squares())
    run_squares(tmp_path / "hit", Squares(kills_once=(20, 71), scratch=tmp_path), workers=2)
    assert (tmp_path / "killed_20").exists()
    assert (tmp_path / "killed_71").exists()
    calm, hit = (tmp_path / name / "results.parquet" for name in ("calm", "hit"))
    assert calm.read_bytes() == hit.read_bytes()


@pytest.mark.long
def test_workers_that_die_at_once_end_the_run_with_a_reason(tmp_path: Path) -> None:
    with pytest.raises(CadalignError, match="die before they finish a chunk"):
        run_squares(tmp_path, Squares(dead_on_arrival=True), workers=1)


def test_an_abort_error_ends_the_run(tmp_path: Path) -> None:
    with pytest.raises(AbortError, match="no room"):
        run_squares(tmp_path, Squares(full_disk=True))


@pytest.mark.slow
def test_an_interrupted_run_continues(tmp_path: Path) -> None:
    done: list[int] = []

    class InterruptedError_(Exception):
        pass

    def interrupt(progress: Progress) -> None:
        done.append(progress.done)
        if progress.done >= 35:
            raise InterruptedError_

    folder = RunFolder(tmp_path / "cut")
    plan, workers = Plan(Squares(), range(100), {"value": 1}, 7), workers_of(0, None)
    with pytest.raises(InterruptedError_):
        execute(plan, folder, workers=workers, on_progress=interrupt)
    assert not folder.is_finished
    seen: list[int] = []
    execute(plan, folder, workers=workers, on_progress=lambda p: seen.append(p.done))
    assert seen[0] == 35
    run_squares(tmp_path / "whole", Squares())
    assert folder.results.read_bytes() == (tmp_path / "whole" / "results.parquet").read_bytes()
    assert not folder.parts.exists()


def cut_short(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-20])


def of_another_schema(path: Path) -> None:
    write_rows(path, (("task", str),), [{"task": "a"}])


@pytest.mark.long
@pytest.mark.parametrize("damage", [cut_short, of_another_schema])
def test_a_damaged_chunk_is_named_and_done_again_once_removed(
    tmp_path: Path, damage: Callable[[Path], None]
) -> None:
    folder = RunFolder(tmp_path / "run")
    plan, workers = Plan(Squares(), range(100), {"value": 1}, 7), workers_of(0, None)

    def interrupt(progress: Progress) -> None:
        if progress.done >= 35:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        execute(plan, folder, workers=workers, on_progress=interrupt)
    part = folder.parts / "0000002.parquet"
    damage(part)
    with pytest.raises(DataError, match=r"0000002\.parquet: .*table.*remove it and"):
        execute(plan, folder, workers=workers)
    part.unlink()
    execute(plan, folder, workers=workers)
    run_squares(tmp_path / "whole", Squares())
    assert folder.results.read_bytes() == (tmp_path / "whole" / "results.parquet").read_bytes()
    assert len(read_table(folder.timings)) == 100


def test_long_differences_are_cut(tmp_path: Path) -> None:
    plans = [
        Plan(Squares(), range(7), {f"value{k}": [k * sign] * 500 for k in range(1, 20)}, 7)
        for sign in (1, -1)
    ]
    execute(plans[0], RunFolder(tmp_path), workers=workers_of(0, None))
    with pytest.raises(DataError, match=r"\.\.\. now; and 13 more differences; give") as caught:
        execute(plans[1], RunFolder(tmp_path), workers=workers_of(0, None))
    assert len(str(caught.value)) < 2000


def test_a_finished_run_is_not_done_again(tmp_path: Path) -> None:
    run_squares(tmp_path, Squares())
    before = (tmp_path / "results.parquet").stat().st_mtime_ns
    run_squares(tmp_path, Squares(full_disk=True))
    assert (tmp_path / "results.parquet").stat().st_mtime_ns == before


def test_another_configuration_is_refused_with_the_difference(tmp_path: Path) -> None:
    run_squares(tmp_path, Squares())
    with pytest.raises(DataError, match="value is 1 there and 2 now") as caught:
        run_squares(tmp_path, Squares(), config=2)
    assert caught.value.fix is not None
    with pytest.raises(DataError, match="tasks is 100 there and 99 now"):
        run_squares(tmp_path, Squares(), count=99)


def test_a_run_of_another_version_is_refused(tmp_path: Path) -> None:
    run_squares(tmp_path, Squares())
    file = tmp_path / "run.json"
    config = json.loads(file.read_text())
    config["versions"]["cadalign"] = "0.0.1"
    file.write_text(json.dumps(config))
    with pytest.raises(DataError, match=r'versions.cadalign is "0.0.1" there'):
        run_squares(tmp_path, Squares())


def test_results_without_a_run_file_are_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "results.parquet").touch()
    with pytest.raises(DataError, match="holds results but no run"):
        run_squares(tmp_path, Squares())


def test_two_processes_cannot_share_a_run(tmp_path: Path) -> None:
    with (tmp_path / ".lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(DataError, match="another process"):
            run_squares(tmp_path, Squares())


@pytest.mark.slow
def test_a_full_disk_leaves_no_half_files_and_the_run_continues(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = os.replace
    writes = iter(range(100))

    def replace(source: Path, target: Path) -> None:
        if next(writes) >= 6:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(files.os, "replace", replace)
        with pytest.raises(DataError, match="No space left"):
            run_squares(tmp_path / "full", Squares())
    assert not list((tmp_path / "full").rglob(".unfinished-*"))
    run_squares(tmp_path / "full", Squares())
    run_squares(tmp_path / "calm", Squares())
    full, calm = (tmp_path / name / "results.parquet" for name in ("full", "calm"))
    assert full.read_bytes() == calm.read_bytes()


def test_the_bytes_of_a_table_do_not_depend_on_its_chunks(tmp_path: Path) -> None:
    import pyarrow as pa

    columns: Columns = (("name", str), ("value", float))
    count = ROW_GROUP + 1000
    whole = pa.table({"name": [str(i) for i in range(count)], "value": np.arange(count) / 7})
    pieces = [whole.slice(first, 777) for first in range(0, count, 777)]
    write_tables(tmp_path / "whole.parquet", columns, [whole])
    write_tables(tmp_path / "pieces.parquet", columns, pieces)
    assert (tmp_path / "whole.parquet").read_bytes() == (tmp_path / "pieces.parquet").read_bytes()
    assert pq.read_metadata(tmp_path / "whole.parquet").num_row_groups == 2


@pytest.mark.parametrize("count", [-2, -10, "a", 1.5])
def test_a_wrong_number_of_workers_is_an_error(count: Any) -> None:
    with pytest.raises(InputError, match="not a number of processes"):
        workers_of(count, None)


@pytest.mark.long
@pytest.mark.timing
@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="needs Linux's /proc")
def test_workers_end_soon_after_their_run_is_killed(tmp_path: Path) -> None:
    write_annotations(tmp_path / "data", models=120)
    tag = f"CADALIGN_TEST={tmp_path}".encode()
    process = subprocess.Popen(
        [sys.executable, "-c", MAIN, *options(tmp_path, tmp_path / "run", workers=2)],
        stdout=subprocess.DEVNULL,
        env={**os.environ, "CADALIGN_TEST": str(tmp_path)},
    )
    wait_for_part(tmp_path / "run", process, more=True)
    assert len(processes_with(tag)) >= 3
    process.send_signal(signal.SIGKILL)
    process.wait()
    end = time.monotonic() + 10
    while processes_with(tag) and time.monotonic() < end:
        time.sleep(0.2)
    assert not processes_with(tag)


def processes_with(tag: bytes) -> list[str]:
    """The processes with a string in their environment variables."""
    found = []
    for file in Path("/proc").glob("[0-9]*/environ"):
        try:
            if tag in file.read_bytes().split(b"\0"):
                found.append(file.parent.name)
        except OSError:  # gone, or not ours
            continue
    return found


@pytest.mark.long
def test_a_real_run_killed_twice_ends_with_the_same_bytes(tmp_path: Path) -> None:
    write_annotations(tmp_path / "data", models=120)
    calm, killed = tmp_path / "calm", tmp_path / "killed"
    finished(MAIN, *options(tmp_path, calm, workers=0, views=8))
    rng = random.Random(0)
    kills = 0
    # One while results arrive, the other during start-up.
    for workers, more in ((2, True), (1, False)):
        process = Program(MAIN, *options(tmp_path, killed, workers=workers, views=8))
        wait_for_part(killed, process, more=more)
        time.sleep(rng.uniform(0, 0.15))
        if process.poll() is not None:
            break
        process.send_signal(signal.SIGKILL)
        process.wait()
        kills += 1
    finished(MAIN, *options(tmp_path, killed, workers=0, views=8))
    assert kills == 2
    for name in ("results.parquet", "records.parquet", "summary.csv", "run.json"):
        assert (killed / name).read_bytes() == (calm / name).read_bytes(), name
    pictures = sorted(path.name for path in (calm / "figures").iterdir())
    assert pictures
    for name in pictures:
        assert (killed / "figures" / name).read_bytes() == (calm / "figures" / name).read_bytes()


def wait_for_part(run: Path, process: Program | subprocess.Popen[bytes], *, more: bool) -> None:
    """Wait for one more finished chunk, or for a moment."""
    before = len(list((run / "parts").glob("*")))
    end = time.monotonic() + (120 if more else 0.7)
    while time.monotonic() < end and process.poll() is None:
        if len(list((run / "parts").glob("*"))) > before and more:
            return
        time.sleep(0.005)


def options(root: Path, out: Path, *, workers: int, views: int = 20) -> list[str]:
    given = ["--views-per-model", str(views), "--methods", "optimal", "limit", "--json"]
    places = [str(root / "data"), "--out", str(out), "--workers", str(workers)]
    return ["evaluate", "keypointnet", *places, *given]


def write_annotations(root: Path, *, models: int) -> None:
    """Annotations of random models without meshes; one has too few keypoints."""
    rng = np.random.default_rng(0)
    entries = []
    for number in range(models):
        points = rng.uniform(-0.3, 0.3, (5 if number == 7 else 12, 3))
        keypoints = [
            {
                "xyz": point,
                "semantic_id": row,
                "mesh_info": {"face_index": 0, "face_uv": [1.0, 0.0, 0.0]},
            }
            for row, point in enumerate(points.tolist())
        ]
        entries.append(
            {"class_id": "03001627", "model_id": f"model{number:04d}", "keypoints": keypoints}
        )
    (root / "annotations").mkdir(parents=True)
    (root / "annotations" / "chair.json").write_text(json.dumps(entries))
