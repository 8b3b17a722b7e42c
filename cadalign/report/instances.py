"""The instances of runs: compact columns of their errors, pictures, mesh previews and records.

Instances of several runs are joined by what names them.
"""

from __future__ import annotations

import base64
import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote as url_quote

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
from cadalign.io.files import (
    dense_json,
    made_folder,
    read_bytes,
    reading,
    write_text,
    write_whole,
    writing,
)

InstanceName = tuple[str, str, int]
"""Category, model id, view."""
INLINE_LIMIT = 60_000_000
"""A page that would be larger has its pictures in files beside it [bytes]."""
_OURS = ("picture_*.webp", "thumb_*.webp", "exhibits_*.js", "mesh_*.js")
_PER_FILE = 64
_COLUMNS = (
    *("id", "run", "category", "model", "view", "keypoints", "true_y", "true_z", "noise"),
    *("exhibit", "thumb"),
)


@dataclass(frozen=True, eq=False)
class InstanceTable:
    """Columns of instances, one for each run that has it, and of their rows.

    ``strings`` are all texts, each once; other columns hold their places. The column ``id`` is the
    same for the same instance of several runs. ``places`` are those of instances by (run, name).
    """

    strings: list[str]
    instances: dict[str, list[Any]]
    rows: dict[str, list[Any]]
    places: dict[tuple[int, InstanceName], int]

    def to_dict(self) -> dict[str, Any]:
        """The tables for the page."""
        return {"strings": self.strings, "instances": self.instances, "rows": self.rows}


def instance_table(
    runs: Sequence[Run], methods: Sequence[str], metrics: Sequence[Metric]
) -> InstanceTable:
    """The table of runs over views of models, their methods and metrics of the rows."""
    texts: dict[str, int] = {}

    def place_of(text: str) -> int:
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
                    "category": place_of(name[0]),
                    "model": place_of(name[1]),
                    "view": name[2],
                    "keypoints": cells["keypoints"][row],
                    "true_y": cells["stretch_y"][row],
                    "true_z": cells["stretch_z"][row],
                    "noise": run.noise_px,
                    "exhibit": -1,
                    "thumb": -1,
                }
                for column, cell in instance.items():
                    instances[column].append(cell)
            reason = cells["reason"][row]
            rows["instance"].append(places[key])
            rows["reason"].append(place_of(reason) if reason else -1)
        rows["method"] += [number[name] for name in cells["method"]]
        rows["status"] += [int(status != OK) for status in cells["status"]]
        for metric in metrics:
            rows[metric.key] += cells[metric.key]
    return InstanceTable(list(texts), instances, rows, places)


def _cells(run: Run, metrics: Sequence[Metric]) -> dict[str, list[Any]]:
    """The columns of a run's results as lists, without what was left out or skipped."""
    without = pc.is_in(run.results["status"], value_set=pa.array([LEFT_OUT, SKIPPED]))
    table = run.results.filter(pc.invert(without))
    cells: dict[str, list[Any]] = {}
    for name in ("category", "model_id", "view", "method", "status", "reason", "keypoints"):
        cells[name] = table[name].to_pylist()
    for name in ("stretch_y", "stretch_z", *(metric.key for metric in metrics)):
        cells[name] = [None] * len(table)
        if name in table.column_names:
            cells[name] = compact(table[name].to_numpy(zero_copy_only=False))
    return cells


# Media --------------------------------------------------------------------------------------------


def inline_bytes(runs: Sequence[Run]) -> int:
    """Rough size of a page with everything inside [bytes]."""
    files = [
        path
        for run in runs
        for folder in (run.folder.pictures, run.folder.thumbs, run.folder.previews)
        if folder.is_dir()
        for path in folder.iterdir()
        if path.is_file()
    ]
    pictures = sum(path.stat().st_size for path in files)
    return sum(run.record_bytes() for run in runs) + pictures * 4 // 3


@dataclass
class AssetStore:
    """Pictures, mesh previews and instance records: inside the page, or in a folder ``assets``."""

    page: Path
    assets: Path | None
    pictures: dict[str, str] = field(default_factory=dict)
    thumbs: dict[str, str] = field(default_factory=dict)
    meshes: dict[str, Any] = field(default_factory=dict)
    records: dict[str, Any] = field(default_factory=dict)
    _known: dict[tuple[str, bytes], str] = field(default_factory=dict)
    _calls: dict[int, list[str]] = field(default_factory=dict)
    _files: dict[int, str] = field(default_factory=dict)

    def fill(self, runs: Sequence[Run], table: InstanceTable) -> None:
        """Take in the pictures and records of runs, and enter their keys in the table."""
        if self.assets is not None:
            with writing(made_folder(self.assets)):
                for pattern in _OURS:
                    for old in self.assets.glob(pattern):
                        old.unlink()
        for index, run in enumerate(runs):
            pictures, thumbs = _Files.of(run.folder.pictures), _Files.of(run.folder.thumbs)
            previews, records = _Files.of(run.folder.previews), run.folder.records
            for row in run.records(RECORD_COLUMNS):
                name = (row["category"], row["model_id"], row["view"])
                place = table.places.get((index, name))
                if place is None:
                    continue
                view, model = f"{record_stem(*name)}.webp", f"{record_stem(*name[:2])}.json"
                picture = self._key_of(view, pictures, self.pictures)
                thumb = self._key_of(view, thumbs, self.thumbs)
                mesh = self._key_of(model, previews, self.meshes)
                table.instances["thumb"][place] = -1 if thumb is None else int(thumb)
                table.instances["exhibit"][place] = place
                record = _object(row["exhibit"], records)
                self._keep(place, {"picture": picture, "mesh": mesh, **record})

    def to_dict(self) -> dict[str, Any]:
        """The page's part of it; writes the files that are beside the page."""
        found: dict[str, Any] = {"pictures": self.pictures, "thumbs": self.thumbs}
        if self.assets is None:
            return {**found, "exhibits": self.records, "meshes": self.meshes}
        count = 1 + max([*self._calls, *self._files], default=-1)
        for index in range(count):
            if index in self._calls or index not in self._files:
                self._write_records(index)
        return {
            **found,
            "exhibit_files": [self._files[index] for index in range(count)],
            "exhibits_per_file": _PER_FILE,
            "mesh_files": {
                key: self._write_script(
                    f"mesh_{key}.js", [f"cadalignMesh({dense_json(key)}, {dense_json(mesh)})"]
                )
                for key, mesh in self.meshes.items()
            },
        }

    def _key_of(self, name: str, files: _Files, store: dict[str, Any]) -> str | None:
        """Store a file, once for all with its content; returns its key, None if it is not there."""
        if name not in files.names:
            return None
        path = files.folder / name
        data, kind = read_bytes(path), files.folder.name
        digest = (kind, hashlib.sha256(data).digest())  # compared runs show the same ones
        if digest not in self._known:
            if store is self.meshes:
                key = f"m{len(store)}"
                store[key] = _object(data, path)
            else:
                key = str(len(store))
                store[key] = self._address_of(data, f"{kind[:-1]}_{len(store):06d}.webp")
            self._known[digest] = key
        return self._known[digest]

    def _address_of(self, data: bytes, name: str) -> str:
        """The address of a picture: its own data, or a file's."""
        if self.assets is None:
            return "data:image/webp;base64," + base64.b64encode(data).decode("ascii")
        write_whole(self.assets / name, lambda path: path.write_bytes(data))
        return self._address(name)

    def _keep(self, place: int, record: dict[str, Any]) -> None:
        """Keep an instance's record; beside a page as text, whose file is written once full."""
        if self.assets is None:
            self.records[str(place)] = record
            return
        index = place // _PER_FILE
        text = msgspec.json.encode(record).decode()
        calls = self._calls.setdefault(index, [])
        calls.append(f"cadalignExhibit({place}, {text})")
        if len(calls) == _PER_FILE:
            self._write_records(index)

    def _write_records(self, index: int) -> None:
        calls = self._calls.pop(index, [])
        self._files[index] = self._write_script(f"exhibits_{index:04d}.js", calls)

    def _write_script(self, name: str, calls: Sequence[str]) -> str:
        assert self.assets is not None
        write_text(self.assets / name, ";\n".join(calls) + ";\n")
        return self._address(name)

    def _address(self, name: str) -> str:
        assert self.assets is not None
        folder = os.path.relpath(self.assets, self.page.parent)
        return url_quote(f"{Path(folder).as_posix()}/{name}")


class _Files(NamedTuple):
    """A folder and the names of its files, read once: asking for thousands takes seconds."""

    folder: Path
    names: frozenset[str]

    @classmethod
    def of(cls, folder: Path) -> _Files:
        if not folder.is_dir():
            return cls(folder, frozenset())
        with reading(folder), os.scandir(folder) as entries:
            return cls(folder, frozenset(entry.name for entry in entries if entry.is_file()))


def _object(text: str | bytes, path: Path) -> dict[str, Any]:
    try:
        found = msgspec.json.decode(text)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        found = None
    if not isinstance(found, dict):
        what = f"{quote(text)} is not an object of JSON"
        raise DataError(what, where=str(path), fix="remove it: the run is shown without it")
    return found
