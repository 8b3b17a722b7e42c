"""The aligned objects of a fit's file or of a run, with the observations that were fitted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from cadalign.errors import CadalignError, DataError, InputError, all_left_out, unknown
from cadalign.estimation.result import Result
from cadalign.estimation.results import Results
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import read_groups
from cadalign.export.aligned_object import FORMATS, AlignedObject, export_object
from cadalign.export.results import object_of
from cadalign.io.documents import in_file, parse_json, read_json
from cadalign.io.files import keeping
from cadalign.io.kinds import FIT
from cadalign.io.observation import Observation
from cadalign.render.overlay import mesh_of
from cadalign.shapes.model import ShapeModel


def read_exported(fit: Path, *, metres: float = 1.0) -> AlignedObject:
    """Read the result of `cadalign fit`, the file ``fit``, with the observation that it holds.

    ``metres`` is the length of one unit of the model [m]. Raises DataError if a file is missing or
    invalid.
    """
    data = read_json(fit, FIT)
    if not isinstance(data, Mapping) or not isinstance(data.get("observation"), Mapping):
        what = "the file holds no fit with the observation that was fitted"
        raise DataError(what, where=str(fit), fix="give the fit.json of `cadalign fit`")
    with in_file(fit):
        seen = Observation.from_dict(data["observation"], folder=fit.parent, needs_xyz=False)
        exported = exported_object(Result.from_dict(data), seen, metres=metres)
    return replace(exported, sources=(fit, *seen.files))


def exported_object(result: Result, seen: Observation, *, metres: float) -> AlignedObject:
    """The aligned object of a result and its observation; see `read_exported`."""
    if result.method == "align" and seen.shape is not None:
        model = ShapeModel.open(seen.shape)
        if tuple(model.ids) != result.ids:
            what = f"{len(model.ids)} keypoints that are not the fit's {len(result.ids)}"
            raise DataError(what, where=str(seen.shape), fix="fit the observation again")
        result = replace(result, model=model)
    name = "model" if seen.model is None else seen.model.stem
    images = [view.image for view in seen.views]
    return object_of(result, mesh=mesh_of(seen, result), images=images, name=name, metres=metres)


def export_run(
    run: Path, to: Path, *, format: str | None = None, metres: float = 1.0
) -> tuple[int, list[CadalignError]]:
    """Write a file of every alignment of a finished run to a folder, named by their rows.

    ``format`` is one of `cadalign.export.FORMATS`, by default the folder's name; ``metres``
    as for `read_exported`. Returns the number of objects, and why others are left out.

    Raises InputError if the format is not known, or no object of the run can be written; and
    DataError if the run cannot be read.
    """
    name = format or to.name
    if name not in FORMATS:
        raise unknown("format", name, FORMATS)
    Results.open(run)  # which refuses what is no finished run
    config = RunFolder(run).read_config() or {}
    inputs = [Path(str(each)) for each in config.get("inputs", ())]
    left_out: list[CadalignError] = []
    count = 0
    for table in read_groups(RunFolder(run).records, fix="do the run again"):
        for record in filter(lambda each: each["result"], table.to_pylist()):
            where = f"{run}, row {record['row']}"
            seen = Observation.from_dict(parse_json(record["observation"], where))
            result = Result.from_dict(parse_json(record["result"], where))
            try:
                with keeping([*inputs, *seen.files]):
                    exported = exported_object(result, seen, metres=metres)
                    export_object(to / f"{record['row']:06d}.{name}", exported, format=name)
                count += 1
            except CadalignError as error:
                place = error.where or where
                left_out.append(type(error)(error.what, where=place, fix=error.fix))
    if left_out and not count:
        raise all_left_out(left_out)
    if not count:
        raise InputError("no observation of the run is aligned", where=str(run))
    return count, left_out
