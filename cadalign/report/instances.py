"""Instances of runs: columns of their errors, pictures, mesh previews and records.

Instances of several runs are joined by their names.
"""

from __future__ import annotations

import hashlib
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import pyarrow as pa
import pyarrow.compute as pc

from cadalign.errors import DataError, quote
from cadalign.evaluation.instances.record import RECORD_COLUMNS, record_stem
from cadalign.evaluation.metrics import Metric
from cadalign.evaluation.plots import compact
from cadalign.evaluation.registry import spec_of
from cadalign.evaluation.runs.tables import Run
from cadalign.evaluation.runs.work import LEFT_OUT, OK, SKIPPED
from cadalign.io.files import list_folder, read_bytes

InstanceName = tuple[str, str, int]
"""Category, model id, view."""
MEDIA_LIMIT = 60_000_000
"""Largest size of the pictures and records on a page [bytes]."""
_COLUMNS = ("id", "run", "category", "model", "view", "keypoints", "exhibit", "thumb")


@dataclass(frozen=True, eq=False)
class InstanceTable:
    """Columns of instances and of their rows, one row per method; see `cadalign.report.page`.

    An instance in several runs has the same ``id`` and an entry per run. Columns of texts are
    indices into ``strings``. ``places`` are the indices of instances by (run, name).
    """

    strings: list[str]
    instances: dict[str, list[Any]]
    rows: dict[str, list[Any]]
    places: dict[tuple[int, InstanceName], int]

    def to_dict(self) -> dict[str, Any]:
        """The tables in the page's format."""
        return {"strings": self.strings, "instances": self.instances, "rows": self.rows}


def instance_table(
    runs: Sequence[Run], methods: Sequence[str], metrics: Sequence[Metric]
) -> InstanceTable:
    """Make the table of runs, with the given methods and metrics."""
    texts: dict[str, int] = {}

    def index_of(text: str) -> int:
        return texts.setdefault(text, len(texts))

    instances: dict[str, list[Any]] = {name: [] for name in _COLUMNS}
    rows: dict[str, list[Any]] = {name: [] for name in ("instance", "method", "status", "reason")}
    rows |= {metric.key: [] for metric in metrics}
    places: dict[tuple[int, InstanceName], int] = {}
    ids: dict[InstanceName | tuple[str, int], int] = {}
    number = {name: place for place, name in enumerate(methods)}
    for run_index, run in enumerate(runs):
        cells = _cells(run, metrics)
        names = list(zip(cells["category"], cells["model_id"], cells["view"], strict=True))
        joins = spec_of(run).joins
        for row, name in enumerate(names):
            key = (run_index, name)
            if key not in places:
                places[key] = len(places)
                instance = {
                    "id": ids.setdefault(name[1:] if joins else name, len(ids)),
                    "run": run_index,
                    "category": index_of(name[0]),
                    "model": index_of(name[1]),
                    "view": name[2],
                    "keypoints": cells["keypoints"][row],
                    "exhibit": -1,
                    "thumb": -1,
                }
                for column, cell in instance.items():
                    instances[column].append(cell)
            reason = cells["reason"][row]
            rows["instance"].append(places[key])
            rows["reason"].append(index_of(reason) if reason else -1)
        rows["method"] += [number[name] for name in cells["method"]]
        rows["status"] += [int(status != OK) for status in cells["status"]]
        for metric in metrics:
            rows[metric.key] += cells[metric.key]
    return InstanceTable(list(texts), instances, rows, places)


def _cells(run: Run, metrics: Sequence[Metric]) -> dict[str, list[Any]]:
    """Columns of a run's results as lists, without instances that were left out or skipped."""
    dropped = pc.is_in(run.results["status"], value_set=pa.array([LEFT_OUT, SKIPPED]))
    table = run.results.filter(pc.invert(dropped))
    named = ("category", "model_id", "view", "method", "status", "reason", "keypoints")
    cells = {name: table[name].to_pylist() for name in named}
    for name in (metric.key for metric in metrics):
        cells[name] = [None] * len(table)
        if name in table.column_names:
            cells[name] = compact(table[name].to_numpy(zero_copy_only=False))
    return cells


# Media --------------------------------------------------------------------------------------------


@dataclass
class Media:
    """Pictures, mesh previews and instance records of a page, without duplicates."""

    pictures: dict[str, str] = field(default_factory=dict)
    thumbs: dict[str, str] = field(default_factory=dict)
    meshes: dict[str, Any] = field(default_factory=dict)
    exhibits: dict[str, Any] = field(default_factory=dict)
    left_out: int = 0
    """Number of instances without pictures and records, for lack of room."""
    _known: dict[bytes, str] = field(default_factory=dict)
    _size: int = 0

    def fill(self, runs: Sequence[Run], table: InstanceTable) -> None:
        """Read the pictures and records of runs, and write their keys into the table."""
        for index, run in enumerate(runs):
            folder = run.folder
            folders = folder.pictures, folder.thumbs, folder.previews
            # List each folder once: checking thousands of files takes seconds.
            there = {path for each in folders if each.is_dir() for path in list_folder(each)}
            for row in run.records(RECORD_COLUMNS):
                name = (row["category"], row["model_id"], row["view"])
                place = table.places.get((index, name))
                if place is None:
                    continue
                if self._size > MEDIA_LIMIT:
                    self.left_out += 1
                    continue
                view, model = f"{record_stem(*name)}.webp", f"{record_stem(*name[:2])}.json"
                paths = folder.pictures / view, folder.thumbs / view, folder.previews / model
                stores = self.pictures, self.thumbs, self.meshes
                picture, thumb, mesh = (
                    self._key_of(path, store) if path in there else None
                    for path, store in zip(paths, stores, strict=True)
                )
                table.instances["thumb"][place] = -1 if thumb is None else int(thumb)
                table.instances["exhibit"][place] = place
                record = _object(row["exhibit"], folder.records)
                self.exhibits[str(place)] = {"picture": picture, "mesh": mesh, **record}
                self._size += len(row["exhibit"])

    def to_dict(self) -> dict[str, Any]:
        """The media in the page's format."""
        names = ("pictures", "thumbs", "exhibits", "meshes")
        return {name: getattr(self, name) for name in names}

    def _key_of(self, path: Path, store: dict[str, Any]) -> str:
        """Store a file, unless the same content is stored; returns its key."""
        data = read_bytes(path)
        digest = hashlib.sha256(path.parent.name.encode() + data).digest()
        if digest not in self._known:
            self._size += len(data) * 4 // 3
            self._known[digest] = key = str(len(store))
            code = "data:image/webp;base64,"
            is_mesh = store is self.meshes
            store[key] = _object(data, path) if is_mesh else code + b64encode(data).decode()
        return self._known[digest]


def _object(text: str | bytes, path: Path) -> dict[str, Any]:
    try:
        found = msgspec.json.decode(text)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        found = None
    if not isinstance(found, dict):
        what = f"{quote(text)} is not an object of JSON"
        raise DataError(what, where=str(path), fix="remove it: the run is shown without it")
    return found
