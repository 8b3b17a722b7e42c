"""Small glTF files: a square of two triangles, and what is changed in them."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], "<f4")
FACES = np.array([0, 1, 2, 0, 2, 3], "<u2")
VIEWS = [
    {"buffer": 0, "byteLength": 48},
    {"buffer": 0, "byteOffset": 48, "byteLength": 12},
]
POSITIONS = {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"}
CORNERS = {"bufferView": 1, "componentType": 5123, "count": 6, "type": "SCALAR"}


def data_uri(data: bytes) -> str:
    """Data as a part of the text."""
    return "data:application/octet-stream;base64," + base64.b64encode(data).decode()


def write_gltf(path: Path, *, more: bytes = b"", **changes: Any) -> Path:
    """Write a square (accessors 0 and 1); ``more`` follows in the buffer from byte 60 on."""
    data = SQUARE.tobytes() + FACES.tobytes() + more
    document: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"byteLength": len(data), "uri": data_uri(data)}],
        "bufferViews": VIEWS,
        "accessors": [POSITIONS, CORNERS],
    }
    path.write_text(json.dumps(document | changes))
    return path
