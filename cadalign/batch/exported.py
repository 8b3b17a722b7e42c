"""The aligned objects of a fit's file or of a run, with the observations that were fitted."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from cadalign.batch.observed import own_ids
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
from cadalign.render.drawing.model_overlay import mesh_of
from cadalign.shapes.model import ShapeModel

_FOLDER_ENDING = "_fit"


def read_exported(
    fit: Path,
    *,
    observation: Path | None = None,
    shape: Path | None = None,
    metres: float = 1.0,
) -> AlignedObject:
    """Read the result of `cadalign fit`, the file ``fit``, and what it was fitted to.

    By default the ``observation`` and the learned ``shape`` are those that the fit's file states,
    the observation otherwise ``photo.json`` beside the fit's folder ``photo_fit``.
    Raises DataError if a file is missing or invalid, or the observation is not the one that was
    fitted.
    """
    data = read_json(fit, FIT)
    if not isinstance(data, Mapping):
        raise DataError("is not a fit's result", where=str(fit), fix="give a fit.json")
    path = observation or _observation_of(fit, data)
    seen = Observation.load(path, needs_xyz=False)
    with in_file(fit):
        result = Result.from_dict(data)
    shape = shape or _stored(fit, data, "shape")
    exported = exported_object(result, seen, path, shape=shape, metres=metres)
    sources = fit, path, *seen.files, *([] if shape is None else [shape])
    return replace(exported, sources=sources)


def exported_object(
    result: Result, seen: Observation, path: Path, *, shape: Path | None = None, **how: Any
) -> AlignedObject:
    """The aligned object of a result and its observation, which errors call ``path``."""
    _require_same(len(result.views), len(seen.views), path, "views")
    for view, image in zip(result.views, seen.views, strict=True):
        _require_same(len(view.residuals), len(image.points_2d), path, "keypoints")
    if result.method != "align":
        own = _labels(seen)  # a fit of pairs knows rows, of which a photo may lack some
        views = tuple(replace(view, ids=own) for view in result.views)
        result = replace(result, ids=own, views=views)
    else:
        model = _shape(result, seen, shape)
        pairs = zip(result.views, own_ids(seen.views), strict=True)
        if model is None and any(tuple(view.ids) != own for view, own in pairs):
            what, fix = "its keypoints are not the fit's", "give the observation that was fitted"
            raise DataError(what, where=str(path), fix=fix)
        result = replace(result, model=model)
    mesh = mesh_of(seen, result)
    name = "model" if seen.model is None else seen.model.stem
    images = [view.image for view in seen.views]
    return object_of(result, mesh=mesh, images=images, name=name, **how)


def export_run(
    run: Path, to: Path, *, format: str | None = None, metres: float = 1.0
) -> tuple[int, list[CadalignError]]:
    """Write a file of every alignment of a finished run to a folder, named by their rows.

    ``format`` is one of `cadalign.export.FORMATS`, by default the folder's name; ``metres``
    the length of one unit of the model [m]. Returns the number of objects, and why others are left
    out.

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
        for record in table.to_pylist():
            if not record["result"]:
                continue
            where = f"{run}, row {record['row']}"
            seen = Observation.from_dict(parse_json(record["observation"], where))
            result = Result.from_dict(parse_json(record["result"], where))
            try:
                with keeping([*inputs, *seen.files]):
                    exported = exported_object(result, seen, Path(where), metres=metres)
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


def _labels(seen: Observation) -> tuple[Hashable, ...]:
    """Names of the only view's keypoints, or what else tells them apart."""
    names = seen.names
    return names if names is not None and len(set(names)) == len(names) else own_ids([seen])[0]


def _stored(fit: Path, data: Mapping[str, Any], name: str) -> Path | None:
    """A path that the fit's file states relative to itself; None where there is no such file."""
    text = data.get(name)
    path = fit.parent / text if isinstance(text, str) and text else None
    return path if path is not None and path.is_file() else None


def _observation_of(fit: Path, data: Mapping[str, Any]) -> Path:
    """The observation that a fit's file states, or else the one beside the fit's folder."""
    stated = _stored(fit, data, "observation")
    if stated is not None:
        return stated
    folder = fit.resolve().parent
    beside = folder.with_name(f"{folder.name.removesuffix(_FOLDER_ENDING)}.json")
    if folder.name.endswith(_FOLDER_ENDING) and beside.is_file():
        return beside
    raise InputError(
        f"{fit} does not tell which observation it is the fit of",
        where="observation",
        fix="give the observation file that was fitted",
    )


def _shape(aligned: Result, seen: Observation, shape: Path | None) -> ShapeModel | None:
    """The learned shape that was fitted, None where the model's own keypoints were."""
    path = shape or seen.shape
    if path is None:
        return None
    opened = ShapeModel.open(path)
    if tuple(opened.ids) != aligned.ids:
        if shape is None:  # the file's shape was left out by a flag
            return None
        what = f"{len(opened.ids)} keypoints that are not the fit's {len(aligned.ids)}"
        raise DataError(what, where=str(path), fix="give the shape that was fitted")
    return opened


def _require_same(count: int, expected: int, path: Path, what: str) -> None:
    if count != expected:
        raise DataError(
            f"{expected} {what}, but the fit has {count}",
            where=str(path),
            fix="give the observation that was fitted, as it was then",
        )
