"""The alignments of a run in the formats of other tools."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cadalign.batch.exported import exported_object
from cadalign.batch.outputs import RECORD_COLUMNS
from cadalign.datasets.detections.coco import write_coco_keypoints
from cadalign.datasets.formats import write_photos
from cadalign.datasets.photos import bop_files
from cadalign.datasets.photos.dataset import PoseEstimate
from cadalign.datasets.photos.photo import Photo
from cadalign.datasets.sfm.colmap import require_name, write_colmap
from cadalign.datasets.sfm.correspondences import CameraView
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
from cadalign.export.aligned_object import FORMS, AlignedObject, ExportView, names_of, photos_of
from cadalign.export.camera_files import nerf_camera, write_nerf
from cadalign.export.formats import export_object, format_of
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.mesh import join
from cadalign.io.documents import parse_json, written_path
from cadalign.io.files import keeping, listed, made_folder, write_json
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
        By default the name of ``to`` where that is a format's, or else what its ending means:

        - ``json``: the observation of each, and its ``fit.json`` in a folder beside it;
        - ``overlay``: each model drawn over its photo, further views as ``000000_1.png``;
        - ``glb``: one file of each object, in a folder; or all in one, in the camera's frame;
        - ``coco``: keypoints and poses as COCO's annotations, photos of several folders by their
          paths in the one that holds them;
        - ``bop-results``: poses as BOP's CSV, each object's stretched mesh beside it; photos have
          the numbers that their names are, those without one, or with another's, the free ones;
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
    folder = RunFolder(run)
    require_run(folder)
    known = (DOCUMENTS, *RUN_FORMATS)
    fix = f"of a run, give one of {', '.join(known)}"
    if format is None and to.name not in known:
        try:
            format = format_of(to)
        except InputError as error:
            raise InputError(error.what, where=error.where, fix=fix) from None
    name = format or to.name
    if name not in known:
        raise InputError(f"the format {quote(name)} holds one fit", where="format", fix=fix)
    total = (folder.read_config() or {}).get("tasks", 0)
    for row in rows:
        if not 0 <= row < total:
            fix = f"give numbers from 0 to {total - 1}"
            raise InputError(f"the run has no observation {row}", where="rows", fix=fix)
    left_out: list[CadalignError] = []
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
    if fits:  # as of the objects of a scene
        fix = f"give the folder of one of the fits in it: {brief(', '.join(fits))}"
    raise DataError("neither a fit nor a run of fits", where=where, fix=fix)


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
            left_out.append(InputError(error.what, where=f"row {each.row}", fix=error.fix))
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
                write_image(folder / _png_name(each.row, number), drawn)
        except (InputError, DataError, RenderError) as error:
            left_out.append(error)
        else:
            count += 1
    return count


def _write_coco(path: Path, objects: Iterator[RunObject], left_out: list[CadalignError]) -> int:
    photos: dict[Path | str, Photo] = {}
    count = 0
    for photo in _photos(objects):
        key = photo.image if isinstance(photo.image, Path) else photo.name
        known = photos.setdefault(key, photo)
        if known is not photo:
            photos[key] = replace(known, objects=known.objects + photo.objects)
        count += 1
    names = names_of(photos)
    named = [replace(photo, name=names.get(key, photo.name)) for key, photo in photos.items()]
    write_coco_keypoints(_made_file(path, "keypoints.json"), named)
    return count


def _photos(objects: Iterator[RunObject]) -> Iterator[Photo]:
    """The photos of objects, each object named after its row."""
    for each in objects:
        for number, photo in enumerate(photos_of(each.exported, category=each.category)):
            named = (replace(found, object_id=str(each.row)) for found in photo.objects)
            name = photo.name if photo.image is not None else _png_name(each.row, number)
            yield replace(photo, name=name, objects=tuple(named))


def _write_bop_results(
    path: Path, objects: Iterator[RunObject], left_out: list[CadalignError]
) -> int:
    """Poses of the stretched meshes, which stand beside them as ``obj_<row + 1>.ply``."""
    file = _made_file(path, "results.csv")
    poses, photos, entries = [], list[Path | str](), {}
    for each in objects:
        exported, model = each.exported, each.row + 1
        scale = exported.views[0].cam_from_model.scale * exported.metres / _MILLIMETRES
        if exported.mesh is not None:
            entries[model] = bop_files.write_model(
                file.parent, exported.mesh.stretched(scale), model
            )
        elif np.abs(scale - 1).max() > _SAME:
            what = "BOP's poses have no stretch, and there is no mesh to stretch instead"
            left_out.append(InputError(what, where=f"row {each.row}"))
            continue
        for number, view in enumerate(exported.views):
            rigid = _rigid(view.cam_from_model, exported.metres / _MILLIMETRES)
            poses.append(PoseEstimate(_SCENE, "", str(model), rigid))
            photos.append(_photo(view, _png_name(each.row, number)))
    if entries:
        bop_files.write_models_info(file.parent, entries)
    if poses:
        numbers = bop_files.photo_numbers(photos)
        numbered = zip(poses, photos, strict=True)
        found = [replace(pose, image=str(numbers[photo])) for pose, photo in numbered]
        bop_files.write_bop_results(file, found)
    return len({each.model_id for each in poses})


def _rigid(pose: Alignment, unit: float) -> Alignment:
    """A pose without its stretch, lengths in another unit."""
    return Alignment(pose.rotation, pose.translation * unit, np.ones(3))


def _photo(view: ExportView, name: str) -> Path | str:
    """The file of a view's photo; the name of the view where it has none."""
    return view.image if isinstance(view.image, Path) else name


def _png_name(row: int, number: int) -> str:
    """The name of the picture of an object's view."""
    return f"{row:06d}_{number}.png" if number else f"{row:06d}.png"


def _cameras(objects: Iterator[RunObject]) -> list[tuple[CameraView, Path | str]]:
    """The cameras in the frame of the object that each sees [m], and their photos."""
    found = []
    for each in objects:
        for number, view in enumerate(each.exported.views):
            placed = _rigid(view.cam_from_model, each.exported.metres)
            name = f"{each.row:06d}_{number}.png"
            found.append((CameraView(view.camera, placed, name), _photo(view, name)))
    return found


def _accepted(
    cameras: list[tuple[CameraView, Path | str]],
    require: Callable[[CameraView, Path | str], object],
    left_out: list[CadalignError],
) -> list[tuple[CameraView, Path | str]]:
    """The cameras that ``require`` does not refuse by an InputError; others are left out."""
    accepted = []
    for view, photo in cameras:
        try:
            require(view, photo)
        except InputError as error:
            left_out.append(error)
        else:
            accepted.append((view, photo))
    return accepted


def _write_colmap(path: Path, objects: Iterator[RunObject], left_out: list[CadalignError]) -> int:
    """Write the cameras with names of their own: a photo's first one has that of the photo."""
    cameras, views = _cameras(objects), {}
    names = names_of(photo for _, photo in cameras)

    def require(view: CameraView, photo: Path | str) -> None:
        require_name(names.get(photo, view.name), str(photo))

    for view, photo in _accepted(cameras, require, left_out):
        name = names.get(photo, view.name)
        if name in views:
            name = f"{Path(view.name).stem}_{name}"
        views[name] = replace(view, name=name)
    if views:
        write_colmap(path, list(views.values()))
    return len(views)


def _write_nerf(path: Path, objects: Iterator[RunObject], left_out: list[CadalignError]) -> int:
    """Write the cameras with the paths of their photos."""
    found = _accepted(
        _cameras(objects), lambda view, photo: nerf_camera(view.camera, str(photo)), left_out
    )
    if found:
        file = _made_file(path, "transforms.json")
        folder = file.parent.absolute()
        views = [
            replace(view, name=written_path(photo.absolute(), folder=folder))
            if isinstance(photo, Path)
            else view
            for view, photo in found
        ]
        write_nerf(file, views)
    return len(found)


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
    "colmap": _write_colmap,
    "nerfstudio": _write_nerf,
    "bop-results": _write_bop_results,
    **{form: partial(_write_data_set, form=form) for form in FORMS},
}
"""The other formats by name."""
