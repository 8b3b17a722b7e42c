"""Files that tests write, and changes to the data in them."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from cadalign import Alignment, Camera
from cadalign.geometry.rotations import quat_wxyz_from_rotation

TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"
"""An OBJ file."""


def write_json(path: Path, data: Any) -> Path:
    """Write data as JSON, or text as it is, into a folder that is created where it is missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(data if isinstance(data, str) else json.dumps(data), encoding="utf-8")
    return path


def write_cameras(folder: Path, cameras: Mapping[str, tuple[Camera, Alignment]]) -> Path:
    """Write cameras and their poses by photo as COLMAP's text files, without points."""
    lines: dict[str, list[str]] = {"cameras": [], "images": [], "points3D": []}
    for number, (name, (camera, pose)) in enumerate(cameras.items(), start=1):
        entry, size = camera.to_dict(), f"{camera.width} {camera.height}"
        lines["cameras"].append(f"{number} {entry['model']} {size} {exact(entry['params'])}\n")
        values = exact([*quat_wxyz_from_rotation(pose.rotation), *pose.translation])
        lines["images"].append(f"{number} {values} {number} {name}\n\n")
    folder.mkdir(parents=True, exist_ok=True)
    for stem, text in lines.items():
        (folder / f"{stem}.txt").write_text("".join(text))
    return folder


def exact(values: Iterable[float]) -> str:
    """Numbers with all their digits, separated by spaces."""
    return " ".join(repr(float(value)) for value in values)


def replaced(data: Any, path: str, value: Any) -> Any:
    """The data with the entry at a dotted path replaced; removed where the value is `...`."""
    data = copy.deepcopy(data)
    *parents, last = [int(part) if part.isdigit() else part for part in path.split(".")]
    place: Any = data
    for part in parents:
        place = place[part]
    if value is ...:
        del place[last]
    else:
        place[last] = value
    return data
