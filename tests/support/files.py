"""Files that tests write, and changes to the data in them."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"
"""An OBJ file."""


def write_json(path: Path, data: Any) -> Path:
    """Write data as JSON, or text as it is, into a folder that is created where it is missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(data if isinstance(data, str) else json.dumps(data), encoding="utf-8")
    return path


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
