"""Reading of queries: observation files whose keypoints need no model points."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cadalign.errors import DataError
from cadalign.io.documents import in_file, read_json
from cadalign.io.observation import Observation

_ORIGIN = [0.0, 0.0, 0.0]


def read_query(path: Path) -> Observation:
    """Read an observation file for retrieval.

    The format is that of `cadalign.io.observation`, but keypoints must have a ``semantic_id`` and
    may lack ``xyz``, which is zero in the returned observation and not used.

    Raises
    ------
    DataError
        If the file is missing, is not JSON, or a field is missing, unknown or invalid.
    """
    data = _with_model_points(read_json(path))
    with in_file(path):
        query = Observation.from_dict(data, folder=path.parent)
        if query.semantic_ids is None:
            raise DataError(
                "the keypoints have no semantic_id",
                fix="give each the id of the library's models for it",
            )
    return query


def _with_model_points(data: Any) -> Any:
    """Fill in model points for keypoints that have none."""
    keypoints = data.get("keypoints") if isinstance(data, Mapping) else None
    if not isinstance(keypoints, list):
        return data
    filled = [
        {"xyz": _ORIGIN, **keypoint} if isinstance(keypoint, Mapping) else keypoint
        for keypoint in keypoints
    ]
    return {**data, "keypoints": filled}
