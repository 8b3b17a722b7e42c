"""Results of a run over many observations, read from the run's folder.

The tables are those of `cadalign.batch.outputs`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError, DataError
from cadalign.estimation.result import Result
from cadalign.io.documents import in_file

if TYPE_CHECKING:
    import pyarrow as pa

TABLE = "results.parquet"
_RECORDS = "records.parquet"
_FIX = "give a folder that `cadalign fit` or `cadalign.fit_many` has written"


@dataclass(eq=False)
class StoredResults:
    """Single results of a run, read when they are asked for; one row group of the file is kept."""

    path: Path
    starts: list[int]
    number: int = -1
    group: Any = None

    @classmethod
    def open(cls, folder: Path, *, in_memory: bool) -> Self:
        """The results in a run's folder; the whole table for a folder that goes away."""
        import pyarrow.parquet as pq

        path = folder / _RECORDS
        with _reading(path):
            if in_memory:
                return cls(path, [0], 0, pq.read_table(path, use_threads=False))
            metadata = pq.read_metadata(path)
        sizes = [metadata.row_group(k).num_rows for k in range(metadata.num_row_groups)]
        return cls(path, np.concatenate([[0], np.cumsum(sizes)]).astype(int).tolist())

    def single(self, row: int) -> Result:
        """The result of an observation that has one."""
        import pyarrow.parquet as pq

        number = int(np.searchsorted(self.starts, row, side="right")) - 1
        if number != self.number:
            with _reading(self.path), pq.ParquetFile(self.path) as file:
                self.group, self.number = file.read_row_group(number, use_threads=False), number
        record = self.group.slice(row - self.starts[number], 1).to_pylist()[0]
        with in_file(f"{self.path}, row {row}"):
            return Result.from_json(record["result"])


def read_arrays(folder: Path) -> dict[str, Any]:
    """The arguments of `Results` for a run's folder, without ``single``.

    The table is that of `cadalign.batch.outputs`.
    """
    import pyarrow.parquet as pq
    from scipy.spatial.transform import Rotation

    path = folder / TABLE
    if not path.is_file():
        is_run = (folder / "run.json").is_file()
        what = "the run is not finished" if is_run else "not the folder of a run of fits"
        fix = "start the command that made it again: it goes on" if is_run else _FIX
        raise DataError(what, where=str(folder), fix=fix)
    with _reading(path):
        table = pq.read_table(path, use_threads=False)
    missing = {"status", "reason", "qw", "residuals", "covariance"} - set(table.column_names)
    if missing:
        what = f"not the table of a run of fits: there is no column {min(missing)!r}"
        raise DataError(what, where=str(path), fix=_FIX)
    solved = np.array([status == "ok" for status in table["status"].to_pylist()], dtype=bool)
    reasons = table["reason"].to_pylist()
    errors: dict[int, CadalignError] = {
        row: DataError(reasons[row]) for row in np.flatnonzero(~solved).tolist()
    }
    counts = np.where(solved, _numbers(table, "keypoints"), 0).astype(np.int64)
    flat, inliers = (
        table[name].combine_chunks().flatten().to_numpy(zero_copy_only=False)
        for name in ("residuals", "is_inlier")
    )
    rotations = np.full((len(table), 3, 3), np.nan)
    if solved.any():
        xyzw = np.column_stack([_numbers(table, f"q{axis}") for axis in "xyzw"])
        rotations[solved] = Rotation.from_quat(xyzw[solved]).as_matrix()
    return {
        "rotation": rotations,
        "translation": np.column_stack([_numbers(table, f"t{axis}") for axis in "xyz"]),
        "scale": np.column_stack([_numbers(table, f"scale_{axis}") for axis in "xyz"]),
        "rms": _numbers(table, "rms_px"),
        "focal_length": _numbers(table, "focal_length"),
        "fisher_covariance": None,
        "stated_covariance": _covariances(table, solved),
        "residuals": flat.astype(np.float64).reshape(-1, 2),
        "inliers": inliers.astype(bool),
        "offsets": np.concatenate([[0], np.cumsum(counts)]),
        "errors": errors,
        "is_single": not (_numbers(table, "views") > 1).any(),
    }


def _numbers(table: pa.Table, name: str) -> FloatArray:
    return np.asarray(table[name].to_numpy().astype(np.float64))


def _covariances(table: pa.Table, solved: Any) -> FloatArray | None:
    """Covariances (B, 9, 9) or (B, 10, 10); None where no method is statistical."""
    column = table["covariance"].combine_chunks()
    sizes = {len(each) for each in column if each.is_valid and len(each)}
    if not sizes:
        return None
    width = int(np.sqrt(max(sizes)))
    found = np.full((len(table), width, width), np.nan)
    for row in np.flatnonzero(solved).tolist():
        values = column[row].as_py()
        if values:
            own = int(np.sqrt(len(values)))
            found[row, :own, :own] = np.reshape(values, (own, own))
    return found


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Convert the errors of a Parquet file that cannot be read."""
    import pyarrow as pa

    try:
        yield
    except (OSError, UnicodeError, pa.ArrowException) as error:
        reason = " ".join(str(error).split())[:200]
        what = f"not a table that can be read ({reason})"
        raise DataError(what, where=str(path), fix=_FIX) from None
