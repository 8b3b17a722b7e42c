"""Reading of queries: observation files whose keypoints need no model points."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cadalign.errors import CadalignError, DataError
from cadalign.io.documents import read_json
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
    try:
        query = Observation.from_dict(_with_model_points(read_json(path)), folder=path.parent)
    except DataError as error:
        if error.where is not None and error.where.startswith(str(path)):
            raise
        raise _in_file(path, error) from None
    except CadalignError as error:
        raise _in_file(path, error) from None
    if query.semantic_ids is None:
        raise DataError(
            "the keypoints have no semantic_id",
            where=str(path),
            fix="give each the id of the library's models for it",
        )
    return query


def _in_file(path: Path, error: CadalignError) -> DataError:
    where = f"{path}: {error.where}" if error.where else str(path)
    return DataError(error.what, where=where, fix=error.fix)


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
