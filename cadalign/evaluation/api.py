"""Whole experiments in one call: as on the command line, with tables as DataFrames."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Collection, Sequence
from contextlib import ExitStack
from dataclasses import MISSING, fields
from typing import TYPE_CHECKING, Any

from cadalign.errors import InputError, unknown
from cadalign.evaluation.methods import check_names
from cadalign.evaluation.options import ExperimentOptions, absolute_paths, tuples
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
    """Evaluate methods on a dataset.

    Parameters
    ----------
    root : str or path-like, optional
        The dataset, for experiments that have one: a folder in KeypointNet's layout
        (``keypointnet``, ``retrieval``, ``unseen``), a data set of photos
        (``photos``), or a COLMAP or blind-PnP model (``correspondences``).
    experiment : {"keypointnet", "correspondences", "retrieval", "unseen", "photos",
        "simulate", "demo"}
        Name of the experiment.
    workers : int, optional
        Processes; -1 for one for each core (the default), 0 for none.
    dask : str, optional
        Address of a Dask scheduler, whose workers are used instead.
    out : str or path-like, optional
        A run's folder, to keep; a run that was killed there goes on.
    **options
        Options of the experiment, the same as on the command line: ``noise_px=2.0`` is
        ``--noise-px 2``. The options of ``keypointnet`` are the fields of
        `cadalign.evaluation.experiments.keypointnet.KeypointNetOptions`: ``categories``, ``split``,
        ``noise_px``, ``min_visible``, ``views_per_model``, ``max_models``, ``methods``,
        ``visibility``, ``render``, ``metrics``, ``seed``. Among ``methods`` and
        ``metrics`` may be functions of one's own, as callables or as texts ``module:function``.
        Worker processes import them; others need ``workers=0``.

    Returns
    -------
    pandas.DataFrame
        A row for every task and method, and the seconds that it took. Failed ones have the status
        ``failed`` and a reason.

    Raises
    ------
    InputError
        If an option is invalid, or the experiment, a category or a split unknown.
    DataError
        If there is no dataset, or the folder holds another run.

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
    _check_given(kind, experiment, source, options)
    chosen = kind(*source, **tuples(options))
    with ExitStack() as stack:
        if out is None:
            out = stack.enter_context(tempfile.TemporaryDirectory(prefix="cadalign-"))
        folder = RunFolder(as_path(out, "out"))
        run(chosen, folder, workers=workers, dask=dask)
        done = Run.open(folder.path)
        frame: pd.DataFrame = done.results.to_pandas()
        return frame.assign(seconds=done.cells["seconds"])


def _check_given(
    kind: type[ExperimentOptions], experiment: str, source: Sequence[object], given: Collection[str]
) -> None:
    """Check that all options of an experiment that it needs are given, and no others."""
    own = {each.name: each for each in fields(kind) if each.init}
    for name in given:
        if name not in own:
            raise unknown(f"option of {experiment}", name, sorted(own), where=f"evaluate({name}=)")
    placed = [each for each in own.values() if not each.kw_only]
    if len(source) > len(placed):
        raise InputError(f"{experiment} has no dataset", where="root", fix="leave it out")
    for each in placed[len(source) :]:
        if each.name not in given and each.default is MISSING:
            fix = f"{experiment} cannot do without"
            raise InputError("is not given", where=each.name, fix=fix)


def run(
    options: ExperimentOptions,
    folder: RunFolder,
    *,
    workers: int | None,
    dask: str | None,
    on_progress: OnProgress = lambda progress: None,
) -> None:
    """Do the run that the options describe in a folder, or what is left of it.

    ``workers`` and ``dask`` are those of `evaluate`; ``on_progress`` is told of every chunk.
    """
    plan, pool = prepared(options, folder, workers=workers, dask=dask)
    execute(plan, folder, workers=pool, on_progress=on_progress)


def prepared(
    options: ExperimentOptions, folder: RunFolder, *, workers: int | None, dask: str | None
) -> tuple[Plan[Any], Workers]:
    """The plan and the workers of `run`."""
    if dask is not None:
        options, folder = absolute_paths(options), absolute_paths(folder)
    count = options.default_workers if workers is None else workers
    pool = workers_of(count, dask)
    spec = spec_named(options.experiment)
    taken = [column.key for column in spec.columns]
    check_names(getattr(options, "metrics", ()), taken, "metrics")
    return spec.plan(options, folder), pool
