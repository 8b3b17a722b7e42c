"""The alignments of a run in the formats of other tools."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from cadalign.batch.exported import exported_object
from cadalign.batch.outputs import RECORD_COLUMNS
from cadalign.errors import CadalignError, DataError, InputError, all_left_out, brief, quote
from cadalign.estimation.result import Result
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import read_groups
from cadalign.export.aligned_object import AlignedObject
from cadalign.export.formats import export_object
from cadalign.io.documents import parse_json
from cadalign.io.files import keeping, listed, made_folder, write_json
from cadalign.io.images import write_image
from cadalign.io.observation import Observation
from cadalign.render import Scene, overlay_model
from cadalign.render.drawing.model_overlay import photo_of

_FIX = "do the run again"


def export_run(
    run: Path, to: Path, *, format: str | None = None, metres: float = 1.0
) -> tuple[int, list[CadalignError]]:
    """Write the alignments of a finished run to a folder, named by their rows.

    ``format`` is by default the folder's name: ``json``, the observation of each, and its
    ``fit.json`` in a folder beside it; ``overlay``, each model drawn over its photo, further views
    as ``000000_1.png``; ``glb``, one file of each object. ``metres`` is the length of one unit of
    the model [m]. Returns the number of objects, and why others are left out.

    Raises InputError if the format is not known, or no object of the run can be written; and
    DataError if the run cannot be read.
    """
    folder = RunFolder(run)
    require_run(folder)
    writers: dict[str, Callable[[Path, AlignedObject], None]] = {
        "overlay": _write_overlays,
        "glb": _write_glb,
    }
    known = ("json", *writers)
    name = format or to.name
    if name not in known:
        fix = f"of a run, give one of {', '.join(known)}"
        raise InputError(f"the format {quote(name)} holds one fit", where="format", fix=fix)
    config = folder.read_config() or {}
    left_out: list[CadalignError] = []
    count = 0
    for row, seen, result in _results(folder):
        path, where = to / f"{row:06d}", Path(f"{run}, row {row}")
        inputs = [Path(str(each)) for each in config.get("inputs", ())]
        try:
            with keeping([*inputs, *seen.files]):
                made_folder(to)
                if name == "json":
                    _write_documents(path, seen, result)
                else:
                    writers[name](path, exported_object(result, seen, where, metres=metres))
            count += 1
        except CadalignError as error:
            left_out.append(type(error)(error.what, where=error.where or str(where), fix=error.fix))
    if not count:
        if left_out:
            raise all_left_out(left_out)
        raise InputError("no observation of the run is aligned", where=str(run))
    return count, left_out


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


def _results(folder: RunFolder) -> Iterator[tuple[int, Observation, Result]]:
    """The results of a finished run by row, with their observations, one at a time."""
    for table in read_groups(folder.records, fix=_FIX):
        if not {name for name, _ in RECORD_COLUMNS} <= set(table.column_names):
            raise DataError("not a run of fits", where=str(folder.path))
        for record in table.to_pylist():
            if record["result"]:
                where = f"{folder.path}, row {record['row']}"
                seen = Observation.from_dict(parse_json(record["observation"], where))
                yield record["row"], seen, Result.from_dict(parse_json(record["result"], where))


def _write_documents(path: Path, seen: Observation, result: Result) -> None:
    """Write an observation and its fit.json, as `cadalign fit` of the single file does."""
    file = path.with_suffix(".json")
    seen.save(file)
    fit = made_folder(path.with_name(f"{path.name}_fit"))
    write_json(fit / "fit.json", result.to_dict() | {"observation": f"../{file.name}"})


def _write_glb(path: Path, exported: AlignedObject) -> None:
    export_object(path.with_suffix(".glb"), exported)


def _write_overlays(path: Path, exported: AlignedObject) -> None:
    """Draw a model over its photos, grey where there is none."""
    scene = Scene(exported.mesh)
    for number, view in enumerate(exported.views):
        photo = photo_of(view.image, view.camera)
        drawn = overlay_model(photo, view.camera, scene, view.cam_from_model)
        name = f"{path.name}_{number}.png" if number else f"{path.name}.png"
        write_image(path.with_name(name), drawn)
