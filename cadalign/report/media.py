"""Pictures, mesh previews and records of instances: inside the page, or in files beside it."""

from __future__ import annotations

import base64
import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote as url_quote

from cadalign.errors import DataError, quote
from cadalign.evaluation.instances.record import RECORD_COLUMNS, record_stem
from cadalign.evaluation.runs.opened import Run
from cadalign.io.files import dense_json, reading, write_text, write_whole, writing
from cadalign.report.instances import InstanceName, InstanceTable

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
    records: dict[str, str] = field(default_factory=dict)
    _known: dict[tuple[str, bytes], str] = field(default_factory=dict)

    def fill(self, runs: Sequence[Run], table: InstanceTable) -> None:
        """Take in the pictures and records of runs, and enter their keys in the table."""
        if self.assets is not None:
            with writing(self.assets):
                self.assets.mkdir(parents=True, exist_ok=True)
                for pattern in _OURS:
                    for old in self.assets.glob(pattern):
                        old.unlink()
        for index, run in enumerate(runs):
            for row in run.records(RECORD_COLUMNS):
                name = (row["category"], row["model_id"], row["view"])
                place = table.places.get((index, name))
                if place is None:
                    continue
                keys = {
                    "picture": self._image(run.folder.pictures, name, self.pictures),
                    "mesh": self._mesh(run, name),
                }
                thumb = self._image(run.folder.thumbs, name, self.thumbs)
                table.instances["thumb"][place] = -1 if thumb is None else int(thumb)
                table.instances["exhibit"][place] = place
                # As text: there may be many.
                record = _object(row["exhibit"], run.folder.records)
                self.records[str(place)] = dense_json({**keys, **record})

    def to_dict(self) -> dict[str, Any]:
        """The page's part of it; writes the files that are beside the page."""
        found: dict[str, Any] = {"pictures": self.pictures, "thumbs": self.thumbs}
        if self.assets is None:
            exhibits = {key: json.loads(text) for key, text in self.records.items()}
            return {**found, "exhibits": exhibits, "meshes": self.meshes}
        return {
            **found,
            "exhibit_files": self._write_records(),
            "exhibits_per_file": _PER_FILE,
            "mesh_files": {
                key: self._write_script(
                    f"mesh_{key}.js", [f"cadalignMesh({dense_json(key)}, {dense_json(mesh)})"]
                )
                for key, mesh in self.meshes.items()
            },
        }

    def _image(self, folder: Path, name: InstanceName, store: dict[str, str]) -> str | None:
        """Store a picture of an instance; its key, None where there is none."""
        data = _read(folder / f"{record_stem(*name)}.webp")
        if data is None:
            return None
        digest = (folder.name, hashlib.sha256(data).digest())  # compared runs show the same ones
        if digest not in self._known:
            key = str(len(store))
            store[key] = self._stored(data, f"{folder.name[:-1]}_{int(key):06d}.webp")
            self._known[digest] = key
        return self._known[digest]

    def _mesh(self, run: Run, name: InstanceName) -> str | None:
        data = _read(run.folder.previews / f"{record_stem(*name[:2])}.json")
        if data is None:
            return None
        digest = ("mesh", hashlib.sha256(data).digest())
        if digest not in self._known:
            key = f"m{len(self.meshes)}"
            self.meshes[key] = _object(data, run.folder.previews)
            self._known[digest] = key
        return self._known[digest]

    def _stored(self, data: bytes, name: str) -> str:
        """The address of a picture: its own data, or a file's."""
        if self.assets is None:
            return "data:image/webp;base64," + base64.b64encode(data).decode("ascii")
        write_whole(self.assets / name, lambda path: path.write_bytes(data))
        return self._address(name)

    def _write_records(self) -> list[str]:
        files: list[list[str]] = []
        for key, text in self.records.items():
            index = int(key) // _PER_FILE
            files += [[] for _ in range(index + 1 - len(files))]
            files[index].append(f"cadalignExhibit({key}, {text})")
        return [
            self._write_script(f"exhibits_{index:04d}.js", calls)
            for index, calls in enumerate(files)
        ]

    def _write_script(self, name: str, calls: Sequence[str]) -> str:
        assert self.assets is not None
        write_text(self.assets / name, ";\n".join(calls) + ";\n")
        return self._address(name)

    def _address(self, name: str) -> str:
        """A file's address, relative to the page."""
        assert self.assets is not None
        folder = os.path.relpath(self.assets, self.page.parent)
        return url_quote(f"{Path(folder).as_posix()}/{name}")


def _read(path: Path) -> bytes | None:
    """A file's bytes; None where there is none."""
    if not path.is_file():
        return None
    with reading(path):
        return path.read_bytes()


def _object(text: str | bytes, path: Path) -> dict[str, Any]:
    """The JSON object that a text of a file is."""
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict):
        what = f"{quote(text)} is not an object of JSON"
        raise DataError(what, where=str(path), fix="remove it: the run is shown without it")
    return found
