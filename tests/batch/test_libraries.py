"""Every library that was written can be opened, for all coordinates."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cadalign import Library
from cadalign.datasets import KeypointNet, write_sample_dataset
from cadalign.errors import InputError
from cadalign.retrieval import LibraryModel


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_sample_dataset(tmp_path / "sample", per_category=4, categories=["chair", "bottle"])


PLY = """ply
format ascii 1.0
element vertex 3
property double x
property double y
property double z
element face 1
property list uchar int vertex_indices
end_header
0 0 0
1e60 0 0
0 1 0
3 0 1 2
"""


def test_a_library_that_is_written_can_be_opened(root: Path, tmp_path: Path) -> None:
    """Whatever the coordinates: of a keypoint, and of a mesh."""
    path = root / "annotations" / "chair.json"
    entries = json.loads(path.read_text())
    entries[0]["keypoints"][0]["xyz"][0] = 1e300
    path.write_text(json.dumps(entries))
    mesh = KeypointNet(root)["bottle"][0].mesh_path
    assert mesh is not None
    mesh.write_text(PLY)
    Library.from_models(KeypointNet(root)).save(tmp_path / "lib")
    assert len(Library.open(tmp_path / "lib")) == 7
    with pytest.raises(InputError, match=r"^chair, model a: a coordinate exceeds 1e\+50"):
        LibraryModel("chair", "a", [[1e60, 0, 0]], [0], [[0, 0, 0], [1, 1, 1]])
