"""Pictures, mesh previews and records of instances: inside the page, or in files beside it."""

from __future__ import annotations

import base64
import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote as url_quote

import msgspec

from cadalign.errors import DataError, quote
from cadalign.evaluation.instances.record import RECORD_COLUMNS, record_stem
from cadalign.evaluation.runs.opened import Run
from cadalign.io.files import dense_json, read_bytes, reading, write_text, write_whole, writing
from cadalign.report.instances import InstanceTable

INLINE_LIMIT = 60_000_000
"""A page that would be larger has its pictures in files beside it [bytes]."""
_OURS = ("picture_*.webp", "thumb_*.webp", "exhibits_*.js", "mesh_*.js")
_PER_FILE = 64


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
    _calls: list[list[str]] = field(default_factory=list)
    _exhibit_files: list[str] = field(default_factory=list)

    def fill(self, runs: Sequence[Run], table: InstanceTable) -> None:
        """Take in the pictures and records of runs, and enter their keys in the table."""
        if self.assets is not None:
            with writing(self.assets):
                self.assets.mkdir(parents=True, exist_ok=True)
                for pattern in _OURS:
                    for old in self.assets.glob(pattern):
                        old.unlink()
        for index, run in enumerate(runs):
            pictures, thumbs = _Files.of(run.folder.pictures), _Files.of(run.folder.thumbs)
            previews = _Files.of(run.folder.previews)
            for row in run.records(RECORD_COLUMNS):
                name = (row["category"], row["model_id"], row["view"])
                place = table.places.get((index, name))
                if place is None:
                    continue
                stem = record_stem(*name)
                keys = {
                    "picture": self._image(pictures, stem, self.pictures),
                    "mesh": self._mesh(previews, record_stem(*name[:2])),
                }
                thumb = self._image(thumbs, stem, self.thumbs)
                table.instances["thumb"][place] = -1 if thumb is None else int(thumb)
                table.instances["exhibit"][place] = place
                record = _object(row["exhibit"], run.folder.records)
                self._keep(place, {**keys, **record})

    def to_dict(self) -> dict[str, Any]:
        """The page's part of it; writes the files that are beside the page."""
        found: dict[str, Any] = {"pictures": self.pictures, "thumbs": self.thumbs}
        if self.assets is None:
            return {**found, "exhibits": self.records, "meshes": self.meshes}
        for index, calls in enumerate(self._calls):
            if calls or not self._exhibit_files[index]:
                self._write_records(index)
        return {
            **found,
            "exhibit_files": self._exhibit_files,
            "exhibits_per_file": _PER_FILE,
            "mesh_files": {
                key: self._write_script(
                    f"mesh_{key}.js", [f"cadalignMesh({dense_json(key)}, {dense_json(mesh)})"]
                )
                for key, mesh in self.meshes.items()
            },
        }

    def _image(self, files: _Files, stem: str, store: dict[str, str]) -> str | None:
        """Store a picture of an instance; its key, None where there is none."""
        data = files.read(f"{stem}.webp")
        if data is None:
            return None
        kind = files.folder.name
        digest = (kind, hashlib.sha256(data).digest())  # compared runs show the same ones
        if digest not in self._known:
            key = str(len(store))
            store[key] = self._stored(data, f"{kind[:-1]}_{int(key):06d}.webp")
            self._known[digest] = key
        return self._known[digest]

    def _mesh(self, files: _Files, stem: str) -> str | None:
        data = files.read(f"{stem}.json")
        if data is None:
            return None
        digest = ("mesh", hashlib.sha256(data).digest())
        if digest not in self._known:
            key = f"m{len(self.meshes)}"
            self.meshes[key] = _object(data, files.folder)
            self._known[digest] = key
        return self._known[digest]

    def _stored(self, data: bytes, name: str) -> str:
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
        while len(self._calls) <= index:
            self._calls.append([])
            self._exhibit_files.append("")
        text = msgspec.json.encode(record).decode()
        self._calls[index].append(f"cadalignExhibit({place}, {text})")
        if len(self._calls[index]) == _PER_FILE:
            self._write_records(index)

    def _write_records(self, index: int) -> None:
        """Write a file of records."""
        calls, self._calls[index] = self._calls[index], []
        self._exhibit_files[index] = self._write_script(f"exhibits_{index:04d}.js", calls)

    def _write_script(self, name: str, calls: Sequence[str]) -> str:
        assert self.assets is not None
        write_text(self.assets / name, ";\n".join(calls) + ";\n")
        return self._address(name)

    def _address(self, name: str) -> str:
        """A file's address, relative to the page."""
        assert self.assets is not None
        folder = os.path.relpath(self.assets, self.page.parent)
        return url_quote(f"{Path(folder).as_posix()}/{name}")


@dataclass(frozen=True)
class _Files:
    """A folder's files; their names are read once, as asking for thousands takes seconds."""

    folder: Path
    names: frozenset[str]

    @classmethod
    def of(cls, folder: Path) -> _Files:
        if not folder.is_dir():
            return cls(folder, frozenset())
        with reading(folder), os.scandir(folder) as entries:
            return cls(folder, frozenset(entry.name for entry in entries if entry.is_file()))

    def read(self, name: str) -> bytes | None:
        """A file's bytes; None where there is none."""
        if name not in self.names:
            return None
        path = self.folder / name
        return read_bytes(path)


def _object(text: str | bytes, path: Path) -> dict[str, Any]:
    """The JSON object that a text of a file is."""
    try:
        found = msgspec.json.decode(text)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        found = None
    if not isinstance(found, dict):
        what = f"{quote(text)} is not an object of JSON"
        raise DataError(what, where=str(path), fix="remove it: the run is shown without it")
    return found
