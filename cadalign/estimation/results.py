"""Results of many problems or objects: a table, and a sequence of single results."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.errors import CadalignError, DataError, InputError
from cadalign.estimation.result import Result
from cadalign.geometry.alignment import Alignment
from cadalign.io.documents import in_file
from cadalign.io.files import as_path
from cadalign.solvers.constants import POSE_SIZE

if TYPE_CHECKING:
    import pandas as pd

TABLE, RECORDS = "results.parquet", "records.parquet"
"""Files of a run's folder, see `cadalign.batch.outputs`."""
_FIX = "give a folder that `cadalign fit` or `cadalign.fit_many` has written"


@dataclass(frozen=True, eq=False, repr=False)
class Results(Sequence[Result | CadalignError]):
    """Results of B independent problems or objects.

    As a sequence it has a `Result`, or the error in its place, for each of them; ``results[k]`` is
    what a single call returns. Its arrays have a row for each: those of a problem without solution
    are NaN, ``errors`` has the reason. Poses and focal lengths of several views are the first's.

    Parameters
    ----------
    poses : (B, 15) float
        ``rotation``, ``translation`` and ``scale`` in one array; see `Alignment.packed`.
    rms : (B,) float
        Root mean square length of the inliers' residuals [px].
    focal_length : (B,) float
        Horizontal focal length of the cameras [px], estimated where it was unknown.
    fisher_covariance : (B, 9, 9) or (B, 10, 10) float or None
        See `cadalign.Result`.
    residuals : (n, 2) float
        Residuals of all problems, one after the other [px].
    inliers : (n,) bool
        The keypoints that were fitted.
    offsets : (B + 1,) int
        Problem b has the rows ``offsets[b]`` to ``offsets[b + 1]`` of residuals and inliers.
    errors : mapping of int to CadalignError
        Reasons why problems have no solution, by problem.
    single : callable
        Makes the result of one problem that has a solution.
    is_single : bool
        Each of the results has one view.
    stated_covariance : (B, 9, 9) or (B, 10, 10) float, optional
        Stated covariances where they are known, as those of a run that was opened, whose
        ``fisher_covariance`` only single results have.
    """

    poses: FloatArray
    rms: FloatArray
    focal_length: FloatArray
    fisher_covariance: FloatArray | None
    residuals: FloatArray
    inliers: BoolArray
    offsets: IntArray
    errors: Mapping[int, CadalignError]
    single: Callable[[int], Result]
    is_single: bool = True
    stated_covariance: FloatArray | None = None
    _made: dict[int, Result] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.poses)

    @overload
    def __getitem__(self, place: int) -> Result | CadalignError: ...
    @overload
    def __getitem__(self, place: slice) -> list[Result | CadalignError]: ...
    def __getitem__(self, place: Any) -> Any:
        if isinstance(place, slice):
            return [self[k] for k in range(len(self))[place]]
        k = range(len(self))[place]
        if k in self.errors:
            return self.errors[k]
        if k not in self._made:
            self._made[k] = self.single(k)
        return self._made[k]

    @property
    def rotation(self) -> FloatArray:
        """Rotations (B, 3, 3)."""
        return self.poses[:, :9].reshape(-1, 3, 3)

    @property
    def translation(self) -> FloatArray:
        """Translations (B, 3) [model units]."""
        return self.poses[:, 9:12]

    @property
    def scale(self) -> FloatArray:
        """Scales (B, 3)."""
        return self.poses[:, 12:]

    @property
    def solved(self) -> BoolArray:
        """Marks the problems that have a solution, (B,) bool."""
        solved = np.ones(len(self), dtype=bool)
        solved[list(self.errors)] = False
        return solved

    @cached_property
    def covariance(self) -> FloatArray | None:
        """Stated covariances (B, 9, 9) or (B, 10, 10), computed now; see `Result.covariance`."""
        if self.fisher_covariance is None:
            return self.stated_covariance
        stated = np.full(self.fisher_covariance.shape, np.nan)
        for k, result in enumerate(self):
            if k not in self.errors and result.covariance is not None:  # type: ignore[union-attr]
                stated[k] = result.covariance  # type: ignore[union-attr]
        return stated

    def __repr__(self) -> str:
        return f"Results({len(self)} problems, {len(self.errors)} without solution)"

    def alignment(self, problem: int) -> Alignment:
        """The alignment of one problem.

        Raises
        ------
        CadalignError
            The reason why the problem has none.
        """
        if problem in self.errors:
            raise self.errors[problem]
        return Alignment.from_packed(self.poses[problem].copy())

    def to_dataframe(self) -> pd.DataFrame:
        """One row for each view of each problem, as a pandas DataFrame.

        Columns: ``result`` and ``view``, numbers from 0; ``solved``; of the view ``rms`` of the
        inliers' residuals [px], ``keypoints``, ``inliers``, ``rotation_x`` to ``rotation_z``
        (rotation vector [degrees]), ``translation_x`` to ``_z`` [model units], ``scale_x`` to
        ``_z``, ``focal_length`` [px]; and ``error``, the reason where there is no solution.

        Examples
        --------
        >>> from cadalign import Camera, fit_batch
        >>> corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
        >>> camera = Camera(640, 480, 900, 900, 319.5, 239.5)
        >>> seen = camera.project(corners + [0.1, 0.2, 5.0])
        >>> frame = fit_batch([corners, corners], [seen, seen], camera).to_dataframe()
        >>> frame[["result", "view", "solved", "keypoints"]].to_numpy().tolist()
        [[0, 0, True, 8], [1, 0, True, 8]]
        """
        import pandas as pd
        from scipy.spatial.transform import Rotation

        table, number, view = self._of_views()
        vectors, solved = np.full((len(table), 3), np.nan), table.solved
        if solved.any():
            turns = Rotation.from_matrix(table.rotation[solved])
            vectors[solved] = turns.as_rotvec(degrees=True)
        kept = np.concatenate([[0], np.cumsum(table.inliers)])
        columns: dict[str, Any] = {
            "result": number,
            "view": view,
            "solved": solved,
            "rms": table.rms,
            "keypoints": np.diff(table.offsets),
            "inliers": np.diff(kept[table.offsets]),
        }
        named = {"rotation": vectors, "translation": table.translation, "scale": table.scale}
        for name, values in named.items():
            columns |= {f"{name}_{axis}": values[:, k] for k, axis in enumerate("xyz")}
        columns["focal_length"] = table.focal_length
        columns["error"] = [str(table.errors.get(row, "")) for row in range(len(table))]
        return pd.DataFrame(columns)

    def _of_views(self) -> tuple[Results, Sequence[int], Sequence[int]]:
        """Every view as a result of its own, with the numbers of its result and of itself."""
        if self.is_single:
            return self, range(len(self)), [0] * len(self)
        rows: list[tuple[int, int, Result | CadalignError]] = []
        for k, result in enumerate(self):
            if isinstance(result, CadalignError):
                rows.append((k, 0, result))
            else:
                numbered = enumerate(result.views)
                rows += [(k, v, replace(result, views=(view,))) for v, view in numbered]
        table = Results.of([each for _, _, each in rows])
        return table, [k for k, _, _ in rows], [v for _, v, _ in rows]

    @classmethod
    def open(cls, folder: str | os.PathLike[str]) -> Results:
        """Read the results of a run of `cadalign fit` or `cadalign.fit_many`.

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
        path = as_path(folder, "folder")
        arrays = _read_arrays(path)
        return cls(**arrays, single=_Stored(path / RECORDS).single)

    @classmethod
    def of(
        cls,
        given: Sequence[Result | CadalignError],
        *,
        counts: Sequence[int] | IntArray | None = None,
        unknowns: int = 9,
    ) -> Results:
        """Arrange single results, or the errors in their place.

        ``counts`` are the problems' keypoints; without them, failed ones have none. Covariances
        have so many unknowns.
        """
        errors = {k: each for k, each in enumerate(given) if isinstance(each, CadalignError)}
        found = {k: each for k, each in enumerate(given) if isinstance(each, Result)}
        if counts is None:
            counts = [len(found[k].inliers) if k in found else 0 for k in range(len(given))]
        offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        poses = np.full((len(given), POSE_SIZE), np.nan)
        rms, focals = np.full((2, len(given)), np.nan)
        covariance: FloatArray | None = np.full((len(given), unknowns, unknowns), np.nan)
        if found and all(each.fisher_covariance is None for each in found.values()):
            covariance = None
        residuals = np.full((int(offsets[-1]), 2), np.nan)
        inliers = np.zeros(len(residuals), dtype=bool)
        for k, each in found.items():
            rows = slice(offsets[k], offsets[k + 1])
            poses[k], rms[k], focals[k] = each.alignment.packed, each.rms, each.camera.fx
            residuals[rows], inliers[rows] = each.residuals, each.inliers
            information = each.fisher_covariance
            if covariance is not None and information is not None and len(information) == unknowns:
                covariance[k] = information
        is_single = all(len(each.views) == 1 for each in found.values())
        arrays = poses, rms, focals, covariance, residuals, inliers, offsets
        return cls(*arrays, errors, found.__getitem__, is_single)

    @classmethod
    def joined(cls, parts: Sequence[Results]) -> Results:
        """Put the results of successive parts of a batch together."""
        if len(parts) == 1:
            return parts[0]
        names = ("poses", "rms", "focal_length", "fisher_covariance", "residuals", "inliers")
        columns = {name: [getattr(part, name) for part in parts] for name in names}
        arrays: dict[str, Any] = {
            name: None if any(one is None for one in each) else np.concatenate(each)
            for name, each in columns.items()
        }
        sizes = np.concatenate([np.diff(part.offsets) for part in parts])
        places = [(part, b) for part in parts for b in range(len(part))]
        return cls(
            **arrays,
            offsets=np.concatenate([[0], np.cumsum(sizes)]),
            errors={k: part.errors[b] for k, (part, b) in enumerate(places) if b in part.errors},
            single=partial(_single, places),
            is_single=all(part.is_single for part in parts),
        )


def to_dataframe(
    results: Result | CadalignError | Iterable[Result | CadalignError],
) -> pd.DataFrame:
    """One row for each view of each result, as a pandas DataFrame.

    Parameters
    ----------
    results : Results or iterable of Result or CadalignError
        Results of `cadalign.fit_batch`, `cadalign.align_batch`, or of single calls; or one result.

    Returns
    -------
    pandas.DataFrame
        Columns as of `Results.to_dataframe`.

    Raises
    ------
    InputError
        If something among the results is neither a result nor an error.

    Examples
    --------
    >>> import cadalign
    >>> corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    >>> camera = cadalign.Camera(640, 480, 900, 900, 319.5, 239.5)
    >>> seen = camera.project(corners + [0.1, 0.2, 5.0])
    >>> view, model = cadalign.View(camera, seen), cadalign.Model(points_3d=corners)
    >>> frame = cadalign.to_dataframe(cadalign.align_batch(model, [view, view]))
    >>> frame[["solved", "keypoints"]].to_numpy().tolist()
    [[True, 8], [True, 8]]
    """
    if not isinstance(results, Results):
        single = isinstance(results, Result | CadalignError)
        given: Any = [results] if single else results
        if not isinstance(given, Iterable):
            what = f"expected results, got {type(given).__name__}"
            raise InputError(what, where="results", fix="give a list of them, or one result")
        given = list(given)
        for number, result in enumerate(given):
            if not isinstance(result, Result | CadalignError):
                what = f"expected a result or an error, got {type(result).__name__}"
                raise InputError(what, where=f"results[{number}]")
        results = Results.of(given)
    return results.to_dataframe()


def _single(places: Sequence[tuple[Results, int]], k: int) -> Result:
    part, b = places[k]
    return part.single(b)


class _Stored:
    """Single results of a run, read when they are asked for; one row group of the file is kept."""

    def __init__(self, path: Path) -> None:
        import pyarrow.parquet as pq

        with _reading(path):
            found = pq.read_metadata(path)
        sizes = [found.row_group(k).num_rows for k in range(found.num_row_groups)]
        self.path, self.starts = path, np.cumsum([0, *sizes]).tolist()
        self.number, self.group = -1, dict[str, Any]()

    def single(self, row: int) -> Result:
        """The result of an observation that has one."""
        import pyarrow.parquet as pq

        number = int(np.searchsorted(self.starts, row, side="right")) - 1
        if number != self.number:
            with _reading(self.path), pq.ParquetFile(self.path) as file:
                self.group, self.number = file.read_row_group(number, use_threads=False), number
        with in_file(f"{self.path}, row {row}"):
            return Result.from_json(self.group["result"][row - self.starts[number]].as_py())


def _read_arrays(folder: Path) -> dict[str, Any]:
    """The arguments of `Results` for a run's folder, without ``single``."""
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

    def numbers(*names: str) -> FloatArray:
        return np.column_stack([table[name].to_numpy().astype(float) for name in names])

    solved = np.array([status == "ok" for status in table["status"].to_pylist()], dtype=bool)
    reasons = table["reason"].to_pylist()
    poses = np.full((len(table), POSE_SIZE), np.nan)
    poses[:, 9:] = numbers("tx", "ty", "tz", "scale_x", "scale_y", "scale_z")
    if solved.any():
        rotations = Rotation.from_quat(numbers("qx", "qy", "qz", "qw")[solved])
        poses[solved, :9] = rotations.as_matrix().reshape(-1, 9)
    flat, inliers = (
        table[name].combine_chunks().flatten().to_numpy(zero_copy_only=False)
        for name in ("residuals", "is_inlier")
    )
    counts = np.where(solved, numbers("keypoints")[:, 0], 0).astype(np.int64)
    return {
        "poses": poses,
        "rms": numbers("rms_px")[:, 0],
        "focal_length": numbers("focal_length")[:, 0],
        "fisher_covariance": None,
        "stated_covariance": _covariances(table["covariance"].to_pylist()),
        "residuals": flat.astype(np.float64).reshape(-1, 2),
        "inliers": inliers.astype(bool),
        "offsets": np.concatenate([[0], np.cumsum(counts)]),
        "errors": {row: DataError(reasons[row]) for row in np.flatnonzero(~solved).tolist()},
        "is_single": not (numbers("views") > 1).any(),
    }


def _covariances(cells: Sequence[list[float] | None]) -> FloatArray | None:
    """Covariances (B, 9, 9) or (B, 10, 10); None where no method is statistical."""
    width = int(np.sqrt(max((len(each) for each in cells if each), default=0)))
    found = np.full((len(cells), width, width), np.nan)
    for row, values in enumerate(cells):
        if values:
            own = int(np.sqrt(len(values)))
            found[row, :own, :own] = np.reshape(values, (own, own))
    return found if width else None


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
