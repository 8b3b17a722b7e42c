"""The alignments of a run in the formats of other tools."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cadalign.batch.exported import exported_object
from cadalign.batch.outputs import RECORD_COLUMNS
from cadalign.errors import (
    CadalignError,
    DataError,
    InputError,
    RenderError,
    all_left_out,
    brief,
    quote,
)
from cadalign.estimation.result import Result
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import read_groups
from cadalign.export.aligned_object import AlignedObject, ExportView
from cadalign.export.formats import export_object, format_of
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.mesh import join
from cadalign.io.documents import parse_json
from cadalign.io.files import keeping, listed, made_folder, write_json
from cadalign.io.images import write_image
from cadalign.io.observation import Observation
from cadalign.render import Scene, overlay_model
from cadalign.render.scene import LIGHT_GREY

RUN_FORMATS = ("json", "overlay", "glb")
"""The formats of whole runs."""
_FIX = "do the run again"
_NOT_MOVED = Alignment(np.eye(3), np.zeros(3), np.ones(3))
_Stored = tuple[Path, int, Observation, Result]
_Numbered = tuple[int, AlignedObject]


@dataclass(frozen=True)
class Exported:
    """Written files: the number of objects, and why others were left out."""

    path: Path
    objects: int
    left_out: tuple[CadalignError, ...]


def export_run(
    run: Path,
    to: Path,
    *,
    format: str | None = None,
    metres: float = 1.0,
    rows: Collection[int] = (),
) -> Exported:
    """Write the alignments of a finished run for another tool.

    Parameters
    ----------
    run : Path
        The run's folder.
    to : Path
        The file or folder to write.
    format : str, optional
        By default the name of ``to`` where that is a format's, or else what its ending means:

        - ``json``: the observation of each, and its ``fit.json`` in a folder beside it;
        - ``overlay``: each model drawn over its photo, further views as ``000000_1.png``;
        - ``glb``: one file of each object, in a folder; or all in one, in the camera's frame;
    metres : float
        Length of one unit of the model [m].
    rows : collection of int
        Numbers of the observations to write; by default all.

    Raises
    ------
    InputError
        If the format is not known, or the run has no object that it can hold.
    DataError
        If the run cannot be read, or the files cannot be written.
    """
    folder = RunFolder(run)
    require_run(folder)
    fix = f"of a run, give one of {', '.join(RUN_FORMATS)}"
    if format is None and to.name not in RUN_FORMATS:
        try:
            format = format_of(to)
        except InputError as error:
            raise InputError(error.what, where=error.where, fix=fix) from None
    name = format or to.name
    if name not in RUN_FORMATS:
        raise InputError(f"the format {quote(name)} holds one fit", where="format", fix=fix)
    total = (folder.read_config() or {}).get("tasks", 0)
    for row in rows:
        if not 0 <= row < total:
            fix = f"give numbers from 0 to {total - 1}"
            raise InputError(f"the run has no observation {row}", where="rows", fix=fix)
    left_out: list[CadalignError] = []
    results = _run_results(folder, rows)
    made_folder(to.parent)
    with keeping(folder.path.iterdir()):
        objects = _run_objects(results, metres, left_out)
        if name == "json":
            count = _write_documents(to, results)
        elif name == "glb":
            count = _write_glb(to, objects, left_out)
        else:
            count = _write_overlays(to, objects, left_out)
    if not count:
        if left_out:
            raise all_left_out(left_out)
        raise InputError("no observation of the run is aligned", where=str(run))
    return Exported(to, count, tuple(left_out))


def require_run(folder: RunFolder) -> None:
    """Raise a DataError for a folder that is no finished run."""
    if folder.is_finished:
        return
    where = str(folder.path)
    if folder.read_config() is not None:
        fix = "start the command that made it again: it goes on"
        raise DataError("not a finished run of fits", where=where, fix=fix)
    fits = [path.parent.name for path in listed(folder.path, "*/fit.json")]
    fix = "give a fit.json, its folder, or the folder of a run"
    if fits:
        fix = f"give the folder of one of the fits in it: {brief(', '.join(fits))}"
    raise DataError("neither a fit nor a run of fits", where=where, fix=fix)


def _run_results(folder: RunFolder, rows: Collection[int]) -> Iterator[_Stored]:
    """The results of a finished run with their observations, one at a time; all without ``rows``.

    Each comes with its name in messages and its number.
    """
    for where, row, seen, result in _records(folder):
        if result and (not rows or row in rows):
            yield where, row, seen, Result.from_dict(json.loads(result))


def _records(folder: RunFolder) -> Iterator[tuple[Path, int, Observation, str]]:
    """As `_run_results`, of all observations that could be read, with the results' text."""
    for table in read_groups(folder.records, fix=_FIX):
        if not {name for name, _ in RECORD_COLUMNS} <= set(table.column_names):
            raise DataError("not a run of fits", where=str(folder.path))
        for record in table.to_pylist():
            row = record["row"]
            if record["observation"]:
                where = Path(f"{folder.path}, row {row}")
                seen = Observation.from_dict(parse_json(record["observation"], str(where)))
                yield where, row, seen, record["result"]


def _run_objects(
    results: Iterator[_Stored], metres: float, left_out: list[CadalignError]
) -> Iterator[_Numbered]:
    """The aligned objects of results; those that lack something are left out."""
    for where, row, seen, result in results:
        try:
            yield row, exported_object(result, seen, where, metres=metres)
        except CadalignError as error:
            left_out.append(error)


def _write_documents(folder: Path, results: Iterator[_Stored]) -> int:
    """Write each observation and its fit.json, as `cadalign fit` of the single file does."""
    count = 0
    for _, row, seen, result in results:
        path, fit = folder / f"{row:06d}.json", made_folder(folder / f"{row:06d}_fit")
        seen.save(path)
        write_json(fit / "fit.json", result.to_dict() | {"observation": f"../{path.name}"})
        count += 1
    return count


def _write_glb(path: Path, objects: Iterator[_Numbered], left_out: list[CadalignError]) -> int:
    """One file of all objects in the camera's frame, or in a folder one of each, by its row."""
    placed, view, count = [], None, 0
    is_one = path.suffix.lower() == ".glb"
    for row, exported in objects:
        try:
            if is_one:
                placed.append(exported.placed_mesh("camera").stretched(exported.metres))
                view = view or ExportView(exported.views[0].camera, _NOT_MOVED)
            else:
                export_object(path / f"{row:06d}.glb", exported)
            count += 1
        except InputError as error:
            left_out.append(InputError(error.what, where=f"row {row}", fix=error.fix))
    if view is not None:
        export_object(path, AlignedObject((view,), mesh=join(placed, str(path)), name="objects"))
    return count


def _write_overlays(
    folder: Path,
    objects: Iterator[_Numbered],
    left_out: list[CadalignError],
) -> int:
    """Draw each model over its photos, grey where there is none."""
    made_folder(folder)
    count = 0
    for row, exported in objects:
        try:
            if exported.mesh is None:
                raise InputError("no mesh of the object is known", where=f"row {row}")
            scene = Scene(exported.mesh)
            for number, view in enumerate(exported.views):
                camera, photo = view.camera, view.read_image()
                if photo is None:
                    size = (camera.height, camera.width, 3)
                    photo = np.full(size, LIGHT_GREY, dtype=np.uint8)
                drawn = overlay_model(photo, camera, scene, view.cam_from_model)
                name = f"{row:06d}_{number}.png" if number else f"{row:06d}.png"
                write_image(folder / name, drawn)
        except (InputError, DataError, RenderError) as error:
            left_out.append(error)
        else:
            count += 1
    return count
