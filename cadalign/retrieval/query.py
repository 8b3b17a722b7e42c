"""Reading what is asked for: an observation file whose keypoints need no model points."""

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

    It is the file that `cadalign.io.observation` describes, but keypoints may lack ``xyz``, since
    the model is not known, and must have a ``semantic_id``.

    Parameters
    ----------
    path : Path

    Returns
    -------
    Observation
        Model points that are not given are zero; retrieval doesn't look at them.

    Raises
    ------
    DataError
        If the file is missing, is not JSON, or a field is missing, unknown or invalid; the message
        names file and field.
    """
    data = _with_model_points(read_json(path))
    with in_file(path):
        query = Observation.from_dict(data, folder=path.parent)
    if query.semantic_ids is None:
        raise DataError(
            "the keypoints have no semantic_id",
            where=str(path),
            fix="give each the id that its category's models have for it",
        )
    return query


def _with_model_points(data: Any) -> Any:
    """The parsed file with model points for keypoints that have none."""
    keypoints = data.get("keypoints") if isinstance(data, Mapping) else None
    if not isinstance(keypoints, list):
        return data
    filled = [
        {"xyz": _ORIGIN, **keypoint} if isinstance(keypoint, Mapping) else keypoint
        for keypoint in keypoints
    ]
    return {**data, "keypoints": filled}
