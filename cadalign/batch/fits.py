"""Many observations aligned as a run."""

from __future__ import annotations

import filecmp
import os
import tempfile
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import fields, is_dataclass, replace
from itertools import chain, starmap
from pathlib import Path
from typing import Any, get_args, get_type_hints

import msgspec
import numpy as np

from cadalign.arrays import is_number
from cadalign.batch.experiment import FitRunOptions, ManyOptions, plan_run
from cadalign.batch.observation_fit import ObservationFit
from cadalign.batch.outputs import write_csv
from cadalign.errors import DataError, InputError, require_kind, unknown
from cadalign.estimation.options import FitOptions
from cadalign.estimation.results import Results
from cadalign.evaluation.runs.engine import OnProgress, execute, workers_of
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.io.documents import convert
from cadalign.io.files import as_path, write_whole
from cadalign.io.observation import DetectorOptions, Observation, ObservationChanges

_FEW = 200  # observations, which are aligned sooner than processes start
_SPOOL = "observations.jsonl"

Observed = str | os.PathLike[str] | Iterable[str | os.PathLike[str]] | Iterable[Observation]


def fit_many(
    observations: Observed,
    *,
    out: str | os.PathLike[str] | None = None,
    workers: int | None = None,
    dask: str | None = None,
    pictures: int = 0,
    on_progress: OnProgress = lambda progress: None,
    **options: Any,
) -> Results:
    """Align many observations, as a run that goes on where it was killed.

    Parameters
    ----------
    observations : path, or iterable of path or of Observation
        Observation files, folders of such, JSON lines, and detectors' files (COCO's JSON or CSV);
        or observations, for example of a generator, which are first written to
        ``observations.jsonl`` in the run's folder.
    out : path-like, optional
        The run's folder: ``results.parquet`` and ``results.csv``, and what `Results.open` needs.
        Started again with the same arguments, a run that was killed goes on, and a finished one is
        read. Without it nothing is kept.
    workers : int, optional
        Processes; -1 for one for each core, 0 for none. By default -1, for few observations 0.
    dask : str, optional
        Address of a Dask scheduler, whose workers are used instead.
    pictures : int
        Number of observations whose photos are kept for `cadalign.report.write_report`, the first
        ones.
    on_progress : callable
        Is told of every chunk that is done.
    **options
        Fields of `cadalign.batch.observation_fit.ObservationFit`, such as ``similar``,
        ``robust``, ``shape``; of `FitOptions`, such as ``method``, ``loss``, ``stretch``; of
        `cadalign.batch.DetectorOptions`, such as ``model``, ``images``; and ``camera``, the file of
        a camera for all. A number as ``focal`` is the focal length [px] of all images. What an
        observation stores holds where an option is at its default or None: unlike those of
        `cadalign.fit`, ``sigma=None`` and ``focal_prior=None`` mean the observation's, or the
        default; ``sigma="none"`` estimates it, ``focal_prior="none"`` takes no prior.

    Returns
    -------
    Results
        In the order of the observations; the error takes the place of a result that there is not.

    Raises
    ------
    InputError
        If an option is invalid or not known.
    DataError
        If an input cannot be read, or the folder holds another run or cannot be written to.

    Examples
    --------
    >>> import numpy as np
    >>> from cadalign import Camera, Observation
    >>> corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    >>> camera = Camera(640, 480, 900, 900, 319.5, 239.5)
    >>> seen = (
    ...     Observation(corners, camera.project(corners + [0.1, 0.2, depth]), camera)
    ...     for depth in (5.0, 6.0)
    ... )
    >>> results = fit_many(seen, method="aepnp")
    >>> results.translation[:, 2].round(3).tolist()
    [5.0, 6.0]
    """
    with ExitStack() as stack:
        is_kept = out is not None
        if out is None:
            out = stack.enter_context(tempfile.TemporaryDirectory(prefix="cadalign-"))
        folder = RunFolder(as_path(out, "out"))
        chosen = replace(options_of(options), inputs=_inputs(observations, folder))
        chosen = replace(chosen, pictures=_as_declared(pictures, ManyOptions, "pictures"))
        run_many(chosen, folder, workers=workers, dask=dask, on_progress=on_progress)
        results = Results.open(folder.path)
        if not is_kept:
            list(results)  # reads each, before the folder goes away
        return results


def run_many(
    options: ManyOptions,
    folder: RunFolder,
    *,
    workers: int | None,
    dask: str | None,
    on_progress: OnProgress = lambda progress: None,
) -> None:
    """Do the run that the options describe, or what is left of it; see `fit_many`.

    By default processes do it, but few observations.
    """
    plan = plan_run(options, folder)
    if workers is None:
        workers = 0 if len(plan.tasks) < _FEW else -1
    pool = workers_of(workers, dask, threads=options.threads)
    execute(plan, folder, workers=pool, on_progress=on_progress)
    write_csv(folder)


def options_of(given: dict[str, Any]) -> FitRunOptions:
    """The options of a run by their names, without inputs; see `fit_many`."""
    kinds: tuple[Any, ...] = (ObservationFit, FitOptions, DetectorOptions, ObservationChanges)
    owners = {each.name: kind for kind in reversed(kinds) for each in fields(kind)}
    parts: dict[Any, dict[str, Any]] = {kind: {} for kind in kinds}
    for name, value in given.items():
        if name not in owners or name == "fitting":
            raise unknown("option", name, owners, where=name)
        if value is not None:
            is_length = name == "focal" and is_number(value)
            owner = ObservationChanges if is_length else owners[name]
            parts[owner][name] = _as_declared(value, owner, name)
    if "ransac" in parts[ObservationFit]:
        parts[ObservationFit].setdefault("robust", True)
    return FitRunOptions(
        inputs=(),
        estimate=ObservationFit(**parts[ObservationFit], fitting=FitOptions(**parts[FitOptions])),
        changes=ObservationChanges(**parts[ObservationChanges]),
        detector=DetectorOptions(**parts[DetectorOptions]),
    )


def _as_declared(value: Any, kind: type, name: str) -> Any:
    """A value of the type that the option's dataclass declares, of which paths may be texts.

    Raises InputError if it is of another one.
    """
    declared = get_type_hints(kind, include_extras=True)[name]
    if Path in get_args(declared):
        return as_path(value, name)
    if kind is FitOptions or is_dataclass(value):  # which check their values themselves
        return value
    try:
        return convert(value, declared, name)
    except DataError as error:
        raise InputError(error.what, where=error.where, fix=error.fix) from None


def _inputs(observations: Observed, folder: RunFolder) -> tuple[Path, ...]:
    """The inputs of a run; observations are written to a file of its folder."""
    if isinstance(observations, str | os.PathLike):
        return (as_path(observations, "observations"),)
    try:
        source = iter(observations)
    except TypeError:
        what = f"expected paths or Observations, got {type(observations).__name__}"
        raise InputError(what, where="observations", fix="give a list of them") from None
    first = next(source, None)
    if first is None:
        raise InputError("there are none", where="observations")
    if not isinstance(first, Observation):
        return tuple(as_path(each, "observations") for each in (first, *source))
    folder.make()
    path = folder.path / _SPOOL

    def write(unfinished: Path) -> None:
        with unfinished.open("wb") as file:
            file.writelines(starmap(_line, enumerate(chain([first], source))))
        if path.exists() and not filecmp.cmp(path, unfinished, shallow=False):
            folder.refuse_others(_SPOOL)
            raise folder.another(f"{_SPOOL} holds other observations")

    with folder.locked():
        write_whole(path, write)
    return (path,)


def _line(number: int, observation: Any) -> bytes:
    require_kind(observation, Observation, f"observations[{number}]")
    data = observation.to_dict()
    return msgspec.json.encode(data, enc_hook=np.generic.item) + b"\n"  # names may be NumPy's
