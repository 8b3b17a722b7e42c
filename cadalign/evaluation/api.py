"""Whole evaluations in one call: what the command line does, with tables as DataFrames."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cadalign.errors import InputError
from cadalign.evaluation.accuracy.methods import LIMIT, check_methods
from cadalign.evaluation.keypointnet.experiment import KeypointNetExperiment
from cadalign.evaluation.keypointnet.tasks import AUTO, VISIBILITIES, KeypointTasks
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.run import Progress, execute, workers_of
from cadalign.evaluation.simulation.experiment import (
    SWEEPS,
    SweepExperiment,
    SweepKind,
    SweepTasks,
    check_values,
)

if TYPE_CHECKING:
    import pandas as pd

DEFAULT_METHODS = ("optimal", "aepnp", "aepnp-paper", "epnp", LIMIT)
RENDERS = ("none", "overlay")
_Report = Callable[[Progress], object]
# Part of a run's configuration: another size would cut a half-done run into other chunks.
_CHUNK = 64
_CHUNK_DRAWN = 8
_CHUNK_TIMED = 20


@dataclass(frozen=True)
class KeypointNetOptions:
    """How to evaluate on KeypointNet; see `evaluate`."""

    categories: tuple[str, ...] | None = None
    split: str | None = None
    noise_px: float = 1.0
    min_visible: int = 6
    views_per_model: int = 1
    methods: tuple[str, ...] = DEFAULT_METHODS
    visibility: str = AUTO
    render: str = "none"
    seed: int = 0
    max_models: int | None = None

    def __post_init__(self) -> None:
        check_methods(self.methods)
        if not 0 <= self.noise_px < float("inf"):
            raise InputError(f"{self.noise_px} is not a noise level", where="noise_px")
        for name, least in (("min_visible", 1), ("views_per_model", 1), ("seed", 0)):
            if getattr(self, name) < least:
                raise InputError(f"{getattr(self, name)} is less than {least}", where=name)
        if self.max_models is not None and self.max_models < 1:
            raise InputError(f"{self.max_models} is not positive", where="max_models")
        for name, known in (("visibility", VISIBILITIES), ("render", RENDERS)):
            if getattr(self, name) not in known:
                raise InputError(
                    f"unknown value {getattr(self, name)!r}",
                    where=name,
                    fix=f"known are {', '.join(known)}",
                )


def evaluate(
    root: str | os.PathLike[str],
    *,
    categories: Iterable[str] | None = None,
    split: str | None = None,
    noise_px: float = 1.0,
    min_visible: int = 6,
    views_per_model: int = 1,
    methods: Iterable[str] = DEFAULT_METHODS,
    visibility: str = AUTO,
    seed: int = 0,
    workers: int = -1,
    dask: str | None = None,
    out: str | os.PathLike[str] | None = None,
) -> pd.DataFrame:
    """Evaluate methods on views of a KeypointNet dataset's models.

    Each view shows the model as it is; methods get its visible keypoints, with noise, and the model
    stretched by factors from 0.5 to 2 along y and z.

    Parameters
    ----------
    root : str or path-like
        A folder in KeypointNet's layout.
    categories : iterable of str, optional
        By default all.
    split : str, optional
        One of the dataset's splits; by default all models.
    noise_px : float
        Standard deviation of the keypoints' noise [px].
    min_visible : int
        How many keypoints a view must show.
    views_per_model : int
    methods : iterable of str
        Names of `cadalign.fit`'s methods, variants of them, and ``limit``.
    visibility : {"auto", "rays", "hull"}
        Keypoints are seen that rays cast at the mesh reach (``rays``), or by a rule that needs no
        mesh (``hull``, see ``evaluation/instances/hull.py``). ``auto`` takes rays where there is
        a mesh.
    seed : int
    workers : int
        Processes; -1 for one for each core, 0 for none.
    dask : str, optional
        The address of a Dask scheduler, whose workers are used instead.
    out : str or path-like, optional
        A run's folder, to keep; a run that was killed there goes on.

    Returns
    -------
    pandas.DataFrame
        A row for every view and method; see ``evaluation/accuracy/outcome.py``. Failed ones have
        the status ``failed`` and a reason.

    Raises
    ------
    InputError
        If an option is invalid or a category or split unknown.
    DataError
        If there is no dataset, or the folder holds another run.

    Examples
    --------
    >>> table = evaluate("keypointnet", split="test")  # doctest: +SKIP
    >>> table.groupby("method").rotation_error_deg.median()  # doctest: +SKIP
    """
    options = KeypointNetOptions(
        categories=None if categories is None else tuple(categories),
        split=split,
        noise_px=noise_px,
        min_visible=min_visible,
        views_per_model=views_per_model,
        methods=tuple(methods),
        visibility=visibility,
        seed=seed,
    )
    with _folder(out) as folder:
        run_keypointnet(Path(root), options, folder, workers=workers, dask=dask)
        return _frame(folder)


def simulate(
    sweep: str,
    *,
    methods: Iterable[str] | None = None,
    values: Iterable[float] | None = None,
    runs: int | None = None,
    points: int | None = None,
    noise_px: float | None = None,
    seed: int = 0,
    workers: int = -1,
    dask: str | None = None,
    out: str | os.PathLike[str] | None = None,
) -> pd.DataFrame:
    """Repeat the AEPnP paper's simulation.

    Parameters
    ----------
    sweep : {"noise", "points", "outliers", "runtime"}
        What is varied.
    methods, values, runs, points, noise_px : optional
        In place of the sweep's own; see `cadalign.evaluation.simulation.experiment.SWEEPS`.
    seed, workers, dask, out
        As for `evaluate`.

    Returns
    -------
    pandas.DataFrame
        A row for every problem and method.

    Raises
    ------
    InputError
        If the sweep, a method or a value is unknown or invalid.

    Examples
    --------
    >>> table = simulate("points", values=[8], runs=3, methods=["aepnp"], workers=0)
    >>> table.status.tolist()
    ['ok', 'ok', 'ok']
    """
    kind = sweep_of(
        sweep, methods=methods, values=values, runs=runs, points=points, noise_px=noise_px
    )
    with _folder(out) as folder:
        run_sweep(kind, folder, seed=seed, workers=workers, dask=dask)
        frame = _frame(folder)
        if kind.is_timed:
            import pandas as pd

            frame["seconds"] = pd.read_parquet(folder.timings)["seconds"]
        return frame


def sweep_of(
    name: str,
    *,
    methods: Iterable[str] | None = None,
    values: Iterable[float] | None = None,
    runs: int | None = None,
    points: int | None = None,
    noise_px: float | None = None,
) -> SweepKind:
    """A sweep with some of its settings replaced, checked; see `simulate`."""
    if name not in SWEEPS:
        raise InputError(
            f"unknown sweep {name!r}", where="sweep", fix=f"known are {', '.join(SWEEPS)}"
        )
    given: dict[str, Any] = {
        "methods": None if methods is None else check_methods(methods),
        "values": None if values is None else tuple(float(value) for value in values),
        "runs": runs,
        "points": points,
        "noise_px": noise_px,
    }
    return check_values(
        replace(SWEEPS[name], **{key: value for key, value in given.items() if value is not None})
    )


def run_sweep(
    kind: SweepKind,
    folder: RunFolder,
    *,
    seed: int = 0,
    workers: int = -1,
    dask: str | None = None,
    on_progress: _Report = lambda progress: None,
) -> None:
    """Do a sweep in a run's folder, or what is left of it."""
    execute(
        SweepExperiment(kind, seed),
        SweepTasks(kind.values, kind.runs),
        folder,
        config={"experiment": "simulate", "seed": seed, "sweep": asdict(kind)},
        chunk_size=_CHUNK_TIMED if kind.is_timed else _CHUNK,
        workers=workers_of(workers, dask=dask),
        on_progress=on_progress,
    )


def run_keypointnet(
    root: Path,
    options: KeypointNetOptions,
    folder: RunFolder,
    *,
    workers: int = -1,
    dask: str | None = None,
    on_progress: _Report = lambda progress: None,
) -> None:
    """Evaluate on KeypointNet in a run's folder, or what is left of it."""
    from cadalign.datasets import KeypointNet

    dataset = KeypointNet(root).subset(categories=options.categories, split=options.split)
    drawn = options.render == "overlay"
    tasks = KeypointTasks(
        dataset,
        views=options.views_per_model,
        visibility=options.visibility,
        max_models=options.max_models,
    )
    drawn_in = None
    if drawn:
        drawn_in = RunFolder(folder.path.absolute())
        drawn_in.make_for_pictures()
    execute(
        KeypointNetExperiment(
            methods=options.methods,
            noise_px=options.noise_px,
            min_visible=options.min_visible,
            seed=options.seed,
            drawn_in=drawn_in,
        ),
        tasks,
        folder,
        config={
            "experiment": "keypointnet",
            "root": str(root.absolute()),
            "annotations": tasks.fingerprint(),
            **asdict(options),
        },
        chunk_size=_CHUNK_DRAWN if drawn else _CHUNK,
        workers=workers_of(workers, dask=dask),
        on_progress=on_progress,
    )


@contextmanager
def _folder(out: str | os.PathLike[str] | None) -> Iterator[RunFolder]:
    """The folder that is given, or one that is removed afterwards."""
    if out is not None:
        yield RunFolder(Path(out))
        return
    with tempfile.TemporaryDirectory(prefix="cadalign-") as path:
        yield RunFolder(Path(path))


def _frame(folder: RunFolder) -> pd.DataFrame:
    import pandas as pd

    return pd.read_parquet(folder.results)
