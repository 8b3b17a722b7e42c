"""The alignments of a run in the formats of other tools."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cadalign.batch.exported import exported_object
from cadalign.batch.table import RECORD_COLUMNS
from cadalign.datasets.detections.coco import write_coco_keypoints
from cadalign.datasets.photos import bop_files
from cadalign.datasets.photos.dataset import PoseEstimate
from cadalign.datasets.photos.formats import write_photos
from cadalign.datasets.photos.photo import Photo
from cadalign.datasets.sfm.colmap import write_colmap
from cadalign.datasets.sfm.correspondences import CameraView
from cadalign.errors import CadalignError, DataError, InputError, RenderError, quote
from cadalign.estimation.result import Result
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import read_groups
from cadalign.export.aligned_object import FORMS, AlignedObject, ExportView, photos_of
from cadalign.export.camera_files import write_nerf
from cadalign.export.formats import export_object, format_of
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.mesh import join
from cadalign.io.documents import parse_json
from cadalign.io.files import keeping, made_folder, write_json
from cadalign.io.images import write_image
from cadalign.io.observation import Observation
from cadalign.render import OverlayStyle, Scene, overlay_model
from cadalign.render.scene import LIGHT_GREY

_MILLIMETRES = 1e-3
_SAME = 1e-9  # of the model's size
_FIX = "do the run again"
_SCENE = "1"
_NOT_MOVED = Alignment(np.eye(3), np.zeros(3), np.ones(3))
_Stored = tuple[Path, int, Observation, Result]


class RunObject(NamedTuple):
    """An aligned object of a run, with its row and category."""

    row: int
    category: str
    exported: AlignedObject


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
    style: OverlayStyle | None = None,
) -> Exported:
    """Write the alignments of a finished run for another tool.

    Parameters
    ----------
    run : Path
        The run's folder.
    to : Path
        The file or folder to write.
    format : str, optional
        By default the name ``to`` itself where that is a format's, or else what its ending means:

        - ``json``: the observation of each, and its ``fit.json`` in a folder beside it;
        - ``overlay``: each model drawn over its photo, further views as ``000000_1.png``;
        - ``glb``: one file of each object, in a folder; or all in one, in the camera's frame;
        - ``coco``: keypoints and poses as COCO's annotations;
        - ``bop-results``: poses as BOP's CSV, each object's stretched mesh beside it;
        - ``colmap``, ``nerfstudio``: the cameras in the frame of the object that each sees;
        - ``bop``, ``kitti``, ``pix3d``, ``scan2cad``, ``objectron``: a data set with its photos.
    metres : float
        Length of one unit of the model [m].
    rows : collection of int
        Numbers of the observations to write; by default all.
    style : OverlayStyle, optional
        Style of ``overlay``.

    Raises
    ------
    InputError
        If the format is not known, or the run has no object that it can hold.
    DataError
        If the run cannot be read, or the files cannot be written.
    """
    known = (DOCUMENTS, *RUN_FORMATS)
    name = format or (str(to) if str(to) in known else format_of(to))
    if name not in known:
        fix = f"of a run, give one of {', '.join(known)}"
        raise InputError(f"the format {quote(name)} holds one fit", where="format", fix=fix)
    left_out: list[CadalignError] = []
    folder = RunFolder(run)
    results = _run_results(folder, rows)
    made_folder(to.parent)
    with keeping(_inputs(folder)):
        if name == DOCUMENTS:
            count = _write_documents(to, results)
        else:
            objects = _run_objects(results, metres, left_out)
            write = RUN_FORMATS[name] if style is None else partial(_write_overlays, style=style)
            count = write(to, objects, left_out)
    if not count:
        if left_out:
            raise left_out[0]
        raise InputError("no observation of the run is aligned", where=str(run))
    return Exported(to, count, tuple(left_out))


def _made_file(path: Path, name: str) -> Path:
    """The file ``path``, or ``name`` in a folder ``path``; makes the folder that it is in."""
    file = path if path.suffix.lower() == Path(name).suffix else path / name
    made_folder(file.parent)
    return file


def _inputs(folder: RunFolder) -> Iterator[Path]:
    """The files of a run, and those that its observations lie in and name."""
    yield from folder.path.glob("*.*")
    for _, _, seen, _ in _records(folder):
        yield from seen.files
    for table in read_groups(folder.results, fix=_FIX):
        for source in table["source"].to_pylist():
            # The file, or "<file>, line 3" and "<file>: annotations[3]"
            yield from map(Path, (source, source.partition(", ")[0], source.partition(": ")[0]))


def _run_results(folder: RunFolder, rows: Collection[int]) -> Iterator[_Stored]:
    """The results of a finished run with their observations, one at a time; all without ``rows``.

    Each comes with its name in messages and its number.
    """
    for where, row, seen, result in _records(folder):
        if result and (not rows or row in rows):
            yield where, row, seen, Result.from_json(result)


def _records(folder: RunFolder) -> Iterator[tuple[Path, int, Observation, str]]:
    """As `_run_results`, of all observations that could be read, with the results' text."""
    if not folder.is_finished:
        fix = "start the command that made it again: it goes on"
        raise DataError("not a finished run of fits", where=str(folder.path), fix=fix)
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
) -> Iterator[RunObject]:
    """The aligned objects of results; those that lack something are left out."""
    for where, row, seen, result in results:
        try:
            exported = exported_object(result, seen, where, metres=metres)
        except CadalignError as error:
            left_out.append(error)
        else:
            category = seen.shape.stem if seen.shape is not None else exported.name
            yield RunObject(row, category, exported)


def _write_documents(folder: Path, results: Iterator[_Stored]) -> int:
    """Write each observation and its fit.json, as `cadalign fit` of the single file does."""
    count = 0
    for _, row, seen, result in results:
        path, fit = folder / f"{row:06d}.json", made_folder(folder / f"{row:06d}_fit")
        seen.save(path)
        write_json(fit / "fit.json", result.to_dict() | {"observation": f"../{path.name}"})
        count += 1
    return count


def _write_glb(path: Path, objects: Iterator[RunObject], left_out: list[CadalignError]) -> int:
    """One file of all objects in the camera's frame, or in a folder one of each, by its row."""
    placed, view, count = [], None, 0
    is_one = path.suffix.lower() == ".glb"
    for each in objects:
        try:
            if is_one:
                mesh = each.exported.placed_mesh("camera")
                placed.append(mesh.stretched(each.exported.metres))
                view = view or ExportView(each.exported.views[0].camera, _NOT_MOVED)
            else:
                export_object(path / f"{each.row:06d}.glb", each.exported)
            count += 1
        except InputError as error:
            left_out.append(error)
    if view is not None:
        export_object(path, AlignedObject((view,), mesh=join(placed, str(path)), name="objects"))
    return count


def _write_overlays(
    folder: Path,
    objects: Iterator[RunObject],
    left_out: list[CadalignError],
    *,
    style: OverlayStyle | None = None,
) -> int:
    """Draw each model over its photos, grey where there is none."""
    made_folder(folder)
    count = 0
    for each in objects:
        try:
            if each.exported.mesh is None:
                raise InputError("no mesh of the object is known", where=f"row {each.row}")
            scene = Scene(each.exported.mesh)
            for number, view in enumerate(each.exported.views):
                camera, photo = view.camera, view.read_image()
                if photo is None:
                    size = (camera.height, camera.width, 3)
                    photo = np.full(size, LIGHT_GREY, dtype=np.uint8)
                drawn = overlay_model(photo, camera, scene, view.cam_from_model, style=style)
                ending = f"_{number}" if number else ""
                write_image(folder / f"{each.row:06d}{ending}.png", drawn)
        except (InputError, DataError, RenderError) as error:
            left_out.append(error)
        else:
            count += 1
    return count


def _write_coco(path: Path, objects: Iterator[RunObject], left_out: list[CadalignError]) -> int:
    photos: dict[tuple[str, object], Photo] = {}
    count = 0
    for photo in _photos(objects):
        known = photos.setdefault((photo.name, photo.image), photo)
        if known is not photo:
            more = replace(known, objects=known.objects + photo.objects)
            photos[photo.name, photo.image] = more
        count += 1
    write_coco_keypoints(_made_file(path, "keypoints.json"), list(photos.values()))
    return count


def _photos(objects: Iterator[RunObject]) -> Iterator[Photo]:
    """The photos of objects, each object named after its row."""
    for each in objects:
        for photo in photos_of(each.exported, category=each.category):
            named = (replace(found, object_id=str(each.row)) for found in photo.objects)
            name = photo.name if photo.image is not None else f"{each.row:06d}.png"
            yield replace(photo, name=name, objects=tuple(named))


def _write_bop_results(
    path: Path, objects: Iterator[RunObject], left_out: list[CadalignError]
) -> int:
    """Poses of the stretched meshes, which stand beside them as ``obj_<row + 1>.ply``."""
    file = _made_file(path, "results.csv")
    poses, entries, numbers = [], {}, dict[str, int]()
    for each in objects:
        exported, number = each.exported, each.row + 1
        scale = exported.views[0].cam_from_model.scale * exported.metres / _MILLIMETRES
        if exported.mesh is not None:
            entries[number] = bop_files.write_model(
                file.parent, exported.mesh.stretched(scale), number
            )
        elif np.abs(scale - 1).max() > _SAME:
            what = "BOP's poses have no stretch, and there is no mesh to stretch instead"
            left_out.append(InputError(what, where=f"row {each.row}"))
            continue
        for view in exported.views:
            stem = Path(view.image_name or "").stem
            image = int(stem) if stem.isdecimal() else numbers.setdefault(stem, len(numbers))
            rigid = _rigid(view.cam_from_model, exported.metres / _MILLIMETRES)
            poses.append(PoseEstimate(_SCENE, str(image), str(number), rigid))
    if entries:
        bop_files.write_models_info(file.parent, entries)
    if poses:
        bop_files.write_bop_results(file, poses)
    return len({each.model_id for each in poses})


def _rigid(pose: Alignment, unit: float) -> Alignment:
    """A pose without its stretch, lengths in another unit."""
    return Alignment(pose.rotation, pose.translation * unit, np.ones(3))


def _write_cameras(
    path: Path,
    objects: Iterator[RunObject],
    left_out: list[CadalignError],
    *,
    write: Callable[[Path, Sequence[CameraView]], None],
) -> int:
    """Write the cameras in the frame of the object that each sees [m], with names of their own."""
    found, names = [], set[str]()
    for each in objects:
        for number, view in enumerate(each.exported.views):
            name = view.image_name or f"{each.row:06d}_{number}.png"
            if name in names:
                name = f"{each.row:06d}_{number}_{name}"
            names.add(name)
            placed = _rigid(view.cam_from_model, each.exported.metres)
            found.append(CameraView(view.camera, placed, name))
    if found:
        write(path, found)
    return len(found)


def _write_nerf(path: Path, cameras: Sequence[CameraView]) -> None:
    write_nerf(_made_file(path, "transforms.json"), cameras)


def _write_data_set(
    path: Path, objects: Iterator[RunObject], left_out: list[CadalignError], *, form: str
) -> int:
    photos = list(_photos(objects))
    problems = write_photos(path, photos, form) if photos else ()
    left_out.extend(problems)
    return len(photos) - len(problems)


DOCUMENTS = "json"
"""The format that needs no mesh, nor anything else that a file must be read for."""
RUN_FORMATS: dict[str, Callable[[Path, Iterator[RunObject], list[CadalignError]], int]] = {
    "overlay": _write_overlays,
    "glb": _write_glb,
    "coco": _write_coco,
    "colmap": partial(_write_cameras, write=write_colmap),
    "nerfstudio": partial(_write_cameras, write=_write_nerf),
    "bop-results": _write_bop_results,
    **{form: partial(_write_data_set, form=form) for form in FORMS},
}
"""The other formats by name."""
