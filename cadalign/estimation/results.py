"""Results of many problems or objects, as a sequence, as arrays and as a table."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import CadalignError, DataError
from cadalign.estimation.result import Result
from cadalign.geometry.alignment import Alignment
from cadalign.io.documents import name_file, parse_json
from cadalign.io.files import as_path
from cadalign.solvers.constants import POSE_SIZE

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = POSE_SIZE + 2
"""Columns of a table of results: a packed alignment, rms and focal length."""
_TABLE, _RECORDS = "results.parquet", "records.parquet"  # of a run, see `cadalign.batch.outputs`
_FIX = "give a folder that `cadalign fit` or `cadalign.batch.run_many` has written"

Entry = Result | CadalignError | Callable[[], Result]


class Results(Sequence[Result | CadalignError]):
    """Results of B independent problems or objects.

    A sequence with one `Result` or error per problem; ``results[k]`` is what a single call returns.
    The arrays have one row per problem, with NaN for a problem without solution; ``errors`` has the
    reason. With several views, pose and focal length are the first view's.

    Parameters
    ----------
    entries : iterable of Result or CadalignError
        Results of single calls, or functions that compute them on access.
    table : (B, 17) float, optional
        Packed alignments, rms and focal lengths, if known before the single results.
    """

    def __init__(self, entries: Iterable[Entry], table: FloatArray | None = None) -> None:
        self._entries, self._known = list(entries), table

    def __len__(self) -> int:
        return len(self._entries)

    @overload
    def __getitem__(self, place: int) -> Result | CadalignError: ...
    @overload
    def __getitem__(self, place: slice) -> list[Result | CadalignError]: ...
    def __getitem__(self, place: Any) -> Any:
        if isinstance(place, slice):
            return [self[k] for k in range(len(self))[place]]
        entry = self._entries[place]
        if not isinstance(entry, Result | CadalignError):
            entry = self._entries[place] = entry()
        return entry

    def __repr__(self) -> str:
        return f"Results({len(self)} problems, {len(self.errors)} without solution)"

    @property
    def errors(self) -> dict[int, CadalignError]:
        """Errors of problems without solution, by index."""
        entries = enumerate(self._entries)
        return {k: entry for k, entry in entries if isinstance(entry, CadalignError)}

    @property
    def solved(self) -> BoolArray:
        """Problems with a solution, (B,) bool."""
        return np.array([not isinstance(each, CadalignError) for each in self._entries], dtype=bool)

    @cached_property
    def _table(self) -> FloatArray:
        if self._known is not None:
            return self._known
        table = np.full((len(self), COLUMNS), np.nan)
        for k, each in enumerate(self):
            if isinstance(each, Result):
                table[k] = *each.alignment.vector, each.rms, each.camera.fx
        return table

    @property
    def rotation(self) -> FloatArray:
        """Rotations (B, 3, 3)."""
        return self._table[:, :9].reshape(-1, 3, 3)

    @property
    def translation(self) -> FloatArray:
        """Translations (B, 3) [model units]."""
        return self._table[:, 9:12]

    @property
    def scale(self) -> FloatArray:
        """Scales (B, 3)."""
        return self._table[:, 12:15]

    @property
    def rms(self) -> FloatArray:
        """Root mean square length (B,) of the inliers' residuals [px]."""
        return self._table[:, 15]

    @property
    def focal_length(self) -> FloatArray:
        """Horizontal focal length (B,) of the cameras [px], given or estimated."""
        return self._table[:, 16]

    def alignment(self, problem: int) -> Alignment:
        """The alignment of one problem.

        Raises
        ------
        CadalignError
            If the problem has no solution.
        """
        entry = self._entries[problem]
        if isinstance(entry, CadalignError):
            raise entry
        return Alignment.from_vector(self._table[problem, :POSE_SIZE].copy())

    def to_dataframe(self) -> pd.DataFrame:
        """One row for each problem, as a pandas DataFrame with the columns of ``results.csv``.

        docs/how_to/many_photos.md describes the columns; columns with file names are left out.
        Pose, camera and their standard deviations are the first view's. A problem without solution
        has the ``status`` "failed" and a ``reason``.

        Examples
        --------
        >>> from cadalign import Camera, fit_batch
        >>> corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
        >>> camera = Camera(640, 480, 900, 900, 319.5, 239.5)
        >>> seen = camera.project(corners + [0.1, 0.2, 5.0])
        >>> frame = fit_batch([corners, corners], [seen, seen], camera).to_dataframe()
        >>> frame[["row", "status", "keypoints", "uncertain"]].to_numpy().tolist()
        [[0, 'ok', 8, ''], [1, 'ok', 8, '']]
        """
        import pandas as pd

        from cadalign.export.results import RESULT_COLUMNS, failed_row, row_of

        rows = (
            {"row": number} | (row_of(each) if isinstance(each, Result) else failed_row(str(each)))
            for number, each in enumerate(self)
        )
        return pd.DataFrame(rows, columns=["row", *(name for name, _ in RESULT_COLUMNS)])

    @classmethod
    def open(cls, folder: str | os.PathLike[str]) -> Results:
        """Read the results of a run of `cadalign fit` or `cadalign.batch.run_many`.

        Parameters
        ----------
        folder : str or path-like
            The run's folder.

        Returns
        -------
        Results
            In the order of the observations.

        Raises
        ------
        DataError
            If it is not the folder of a finished run, or a file in it cannot be read.

        Examples
        --------
        >>> results = Results.open("runs/fit")  # doctest: +SKIP
        >>> results[0].alignment, results.to_dataframe()  # doctest: +SKIP
        """
        import pyarrow as pa
        import pyarrow.parquet as pq

        path = as_path(folder, "folder")
        if not (path / _TABLE).is_file():
            is_run = (path / "run.json").is_file()
            what = "the run is not finished" if is_run else "not the folder of a run of fits"
            fix = "run the same command again: it resumes" if is_run else _FIX
            raise DataError(what, where=str(path), fix=fix)
        try:
            cells = pq.read_table(path / _TABLE, columns=["status", "reason"], use_threads=False)
            texts = pq.read_table(path / _RECORDS, columns=["result"], use_threads=False)["result"]
            states, reasons = (cells[name].to_pylist() for name in ("status", "reason"))
        except (OSError, UnicodeError, KeyError, pa.ArrowException) as error:
            what = f"not a table that can be read ({' '.join(str(error).split())[:200]})"
            raise DataError(what, where=str(path), fix=_FIX) from None
        return cls(
            partial(_read_result, texts, row, f"{path / _RECORDS}, row {row}")
            if state == "ok"
            else DataError(reasons[row])
            for row, state in enumerate(states)
        )


def _read_result(texts: Any, row: int, where: str) -> Result:
    with name_file(where):
        return Result.from_dict(parse_json(texts[row].as_py(), "result"))
