"""Run an experiment in one call and return its result table as a DataFrame."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Collection, Sequence
from contextlib import ExitStack
from dataclasses import MISSING, fields
from typing import TYPE_CHECKING, Any

from cadalign.errors import InputError, unknown_name
from cadalign.evaluation.methods import check_names
from cadalign.evaluation.options import ExperimentOptions, absolute_paths, as_tuples
from cadalign.evaluation.registry import spec_named
from cadalign.evaluation.runs.engine import OnProgress, Workers, execute, workers_of
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import Run
from cadalign.evaluation.runs.work import Plan
from cadalign.io.files import as_path

if TYPE_CHECKING:
    import pandas as pd


def evaluate(
    root: str | os.PathLike[str] | None = None,
    experiment: str = "keypointnet",
    *,
    workers: int | None = None,
    dask: str | None = None,
    out: str | os.PathLike[str] | None = None,
    **options: Any,
) -> pd.DataFrame:
    """Run an experiment: evaluate methods on a dataset.

    Parameters
    ----------
    root : str or path-like, optional
        The dataset: a folder in KeypointNet's layout (``keypointnet``, ``retrieval``,
        ``unseen``, ``demo``), a data set of photos (``photos``), or a COLMAP model or a
        blind-PnP data set (``correspondences``). ``simulate`` has none.
    experiment : str
        `keypointnet`, `correspondences`, `retrieval`, `unseen`, `photos`, `simulate` or `demo`.
    workers : int, optional
        Number of worker processes; -1 for one per core (the default), 0 for this process alone.
    dask : str, optional
        Address of a Dask scheduler; its workers replace the processes.
    out : str or path-like, optional
        Folder for the run's files, temporary by default. A run that was interrupted there
        continues.
    **options
        Options of the experiment, the same as on the command line: ``noise_px=2.0`` is
        ``--noise-px 2``. The options of ``keypointnet`` are the fields of
        `cadalign.evaluation.experiments.keypointnet.KeypointNetOptions`: ``categories``, ``split``,
        ``noise_px``, ``min_visible``, ``views_per_model``, ``max_models``, ``methods``,
        ``visibility``, ``render``, ``metrics``, ``seed``. ``methods`` and ``metrics`` also take
        your own functions, as callables or as ``module:function``. Worker processes import
        them; a function that cannot be imported needs ``workers=0``.

    Returns
    -------
    pandas.DataFrame
        One row per task and method: errors, ``seconds``, and ``status``. A failure has the status
        ``failed`` and a ``reason``.

    Raises
    ------
    InputError
        If an option is invalid, or an experiment, a category or a split is unknown.
    DataError
        If the dataset is missing, or the folder holds another run.

    Examples
    --------
    >>> table = evaluate("keypointnet", split="test")  # doctest: +SKIP
    >>> table.groupby("method").rotation_error_deg.median()  # doctest: +SKIP
    >>> table = evaluate("colmap_model", "correspondences", draws=5)  # doctest: +SKIP
    >>> how = {"sweep": "points", "values": [8], "runs": 3, "methods": ["aepnp"]}
    >>> evaluate(experiment="simulate", **how, workers=0).status.tolist()
    ['ok', 'ok', 'ok']
    """
    source = () if root is None else (as_path(root, "root"),)
    for name in {"methods", "metrics"}.intersection(options):
        if isinstance(options[name], str) or callable(options[name]):
            options[name] = (options[name],)
    kind = spec_named(experiment).options
    _check_options(kind, experiment, source, options)
    chosen = kind(*source, **as_tuples(options))
    with ExitStack() as stack:
        if out is None:
            out = stack.enter_context(tempfile.TemporaryDirectory(prefix="cadalign-"))
        folder = RunFolder(as_path(out, "out"))
        run(chosen, folder, workers=workers, dask=dask)
        done = Run.open(folder.path)
        frame: pd.DataFrame = done.results.to_pandas()
        return frame.assign(seconds=done.cells["seconds"])


def _check_options(
    kind: type[ExperimentOptions], experiment: str, source: Sequence[object], given: Collection[str]
) -> None:
    """Raise InputError for an unknown option, or a missing one without a default."""
    own = {each.name: each for each in fields(kind) if each.init}
    for name in given:
        if name not in own:
            raise unknown_name(
                f"option of {experiment}", name, sorted(own), where=f"evaluate({name}=)"
            )
    placed = [each for each in own.values() if not each.kw_only]
    if len(source) > len(placed):
        raise InputError(f"{experiment} has no dataset", where="root", fix="leave it out")
    for each in placed[len(source) :]:
        if each.name not in given and each.default is MISSING:
            raise InputError("is missing", where=each.name, fix=f"{experiment} needs it")


def run(
    options: ExperimentOptions,
    folder: RunFolder,
    *,
    workers: int | None,
    dask: str | None,
    on_progress: OnProgress = lambda progress: None,
) -> None:
    """Run an experiment in a folder; an interrupted run continues.

    ``workers`` and ``dask`` are options of `evaluate`. ``on_progress`` is called after every chunk.
    """
    plan, pool = prepare(options, folder, workers=workers, dask=dask)
    execute(plan, folder, workers=pool, on_progress=on_progress)


def prepare(
    options: ExperimentOptions, folder: RunFolder, *, workers: int | None, dask: str | None
) -> tuple[Plan[Any], Workers]:
    """Return the plan and the workers of `run`."""
    if dask is not None:
        options, folder = absolute_paths(options), absolute_paths(folder)
    count = options.default_workers if workers is None else workers
    pool = workers_of(count, dask)
    spec = spec_named(options.experiment)
    taken = [column.key for column in spec.columns]
    check_names(getattr(options, "metrics", ()), taken, "metrics")
    return spec.plan(options, folder), pool
