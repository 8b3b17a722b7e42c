"""Results of many problems or objects: a table, and a sequence of single results."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.errors import CadalignError, InputError
from cadalign.estimation.assemble import keypoints_of_solution, result_of_keypoints
from cadalign.estimation.fitted import Diagnosis
from cadalign.estimation.options import FitOptions, Sigma
from cadalign.estimation.problems import Problems, Solutions, full_covariances
from cadalign.estimation.result import Result
from cadalign.estimation.symmetry import carried, held_axes
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.symmetry import Symmetry
from cadalign.geometry.symmetry_group import group_of
from cadalign.io.files import as_path
from cadalign.solvers.constants import POSE_SIZE

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False, repr=False)
class Results(Sequence[Result | CadalignError]):
    """Results of B independent problems or objects.

    As a sequence it has a `Result`, or the error in its place, for each of them; ``results[k]`` is
    what a single call returns. Its arrays have a row for each: those of a problem without solution
    are NaN, ``errors`` has the reason. Poses and focal lengths of several views are the first's.

    Parameters
    ----------
    rotation : (B, 3, 3) float
    translation : (B, 3) float
        [model units]
    scale : (B, 3) float
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

    rotation: FloatArray
    translation: FloatArray
    scale: FloatArray
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
        return len(self.rotation)

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
        own = (array[problem].copy() for array in (self.rotation, self.translation, self.scale))
        return Alignment(*own, is_valid=True)

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
        vectors = np.full((len(table), 3), np.nan)
        if table.solved.any():
            turns = Rotation.from_matrix(table.rotation[table.solved])
            vectors[table.solved] = turns.as_rotvec(degrees=True)
        kept = np.concatenate([[0], np.cumsum(table.inliers)])
        columns: dict[str, Any] = {
            "result": number,
            "view": view,
            "solved": table.solved,
            "rms": table.rms,
            "keypoints": np.diff(table.offsets),
            "inliers": np.diff(kept[table.offsets]),
        }
        named = {"rotation": vectors, "translation": table.translation, "scale": table.scale}
        for name, values in named.items():
            columns |= {f"{name}_{axis}": values[:, k] for k, axis in enumerate("xyz")}
        columns["focal_length"] = table.focal_length
        columns["error"] = [
            str(table.errors[row]) if row in table.errors else "" for row in range(len(table))
        ]
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
    def open(cls, folder: str | os.PathLike[str], *, in_memory: bool = False) -> Results:
        """Read the results of a run of `cadalign fit` or `cadalign.fit_many`.

        Parameters
        ----------
        folder : str or path-like
            The run's folder.
        in_memory : bool
            Read single results at once, not when they are asked for: for a folder that goes away.

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
        from cadalign.estimation.results_file import StoredResults, read_arrays

        arrays = read_arrays(path)
        return cls(**arrays, single=StoredResults.open(path, in_memory=in_memory).single)

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
        covariance = np.full((len(given), unknowns, unknowns), np.nan)
        residuals = np.full((int(offsets[-1]), 2), np.nan)
        inliers = np.zeros(len(residuals), dtype=bool)
        for k, each in found.items():
            rows = slice(offsets[k], offsets[k + 1])
            poses[k], rms[k], focals[k] = each.alignment.packed, each.rms, each.camera.fx
            residuals[rows], inliers[rows] = each.residuals, each.inliers
            information = each.fisher_covariance
            if information is not None and len(information) == unknowns:
                covariance[k] = information
        return cls(
            *_split(poses),
            rms=rms,
            focal_length=focals,
            fisher_covariance=covariance,
            residuals=residuals,
            inliers=inliers,
            offsets=offsets,
            errors=errors,
            single=found.__getitem__,
            is_single=all(len(each.views) == 1 for each in found.values()),
        )

    @classmethod
    def joined(cls, parts: Sequence[Results]) -> Results:
        """Put the results of successive parts of a batch together."""
        if len(parts) == 1:
            return parts[0]
        names = "rotation translation scale rms focal_length fisher_covariance residuals inliers"
        columns = {name: [getattr(part, name) for part in parts] for name in names.split()}
        arrays: dict[str, Any] = {
            name: None if each[0] is None else np.concatenate(each)
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


def results_of_solutions(
    problems: Problems,
    solutions: Solutions,
    options: FitOptions,
    *,
    sigmas: Sequence[Sigma] | None,
    symmetry: Symmetry | None,
    diagnosis: Diagnosis,
    seconds: float,
) -> Results:
    """Arrange the solutions of a batch; single results are made one at a time.

    ``sigmas``, one for each problem, take the place of the options' sigma; ``seconds`` is the time
    of one problem.
    """
    failed = np.zeros(len(problems), dtype=bool)
    failed[list(solutions.errors)] = True
    focals = np.broadcast_to(problems.calibrations[:, 0], len(problems))
    poses, residuals = solutions.poses[:, 0].copy(), solutions.residuals
    covariance = None
    if solutions.covariances is not None:
        covariance = full_covariances(solutions.covariances, options.known_axis)
    inliers = np.repeat(~failed, problems.counts)
    if failed.any():
        poses = np.where(failed[:, None], np.nan, poses)
        residuals = np.where(inliers[:, None], residuals, np.nan)
        if covariance is not None:
            covariance[failed] = np.nan
    if symmetry is not None and not (group := group_of(symmetry)).is_trivial:
        held = held_axes(options.stretched_axes)
        for b in np.flatnonzero(~failed).tolist():
            given = Alignment.from_packed(poses[b].copy())
            best = group.canonical(given, held=held)
            poses[b] = best.alignment.packed
            if covariance is not None:
                covariance[b] = carried(covariance[b], given, best, held)
    squares = np.append((residuals**2).sum(axis=1), 0.0)
    means = np.add.reduceat(squares, problems.offsets[:-1]) / np.maximum(problems.counts, 1)
    return Results(
        *_split(poses),
        rms=np.where(failed, np.nan, np.sqrt(means)),
        focal_length=np.where(failed, np.nan, focals),
        fisher_covariance=covariance,
        residuals=residuals,
        inliers=inliers,
        offsets=problems.offsets,
        errors=dict(solutions.errors),
        single=partial(_solved, problems, solutions, options, sigmas, symmetry, diagnosis, seconds),
    )


def _solved(
    problems: Problems,
    solutions: Solutions,
    options: FitOptions,
    sigmas: Sequence[Sigma] | None,
    symmetry: Symmetry | None,
    diagnosis: Diagnosis,
    seconds: float,
    b: int,
) -> Result:
    """The result of one problem of a batch, as `cadalign.fit` gives it."""
    of_problem: dict[str, Any] = {
        name: None if value is None else value[b : b + 1].copy()
        for name, value in solutions._asdict().items()
        if name not in ("residuals", "errors")
    }
    own = Solutions(**of_problem, residuals=solutions.residuals[problems.rows(b)].copy())
    if sigmas is not None:
        options = replace(options, sigma=sigmas[b])
    some = problems.part(b, b + 1)
    fitted = keypoints_of_solution(some, own, options, seconds)
    return result_of_keypoints(some.points_2d, fitted, diagnosis=diagnosis, symmetry=symmetry)


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


def _split(poses: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Rotations, translations and scales of packed poses (B, 15)."""
    return poses[:, :9].reshape(-1, 3, 3), poses[:, 9:12], poses[:, 12:]
