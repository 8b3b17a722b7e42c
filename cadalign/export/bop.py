"""BOP's files of poses, written and read: result CSV files and ``scene_gt.json``.

The format is that of bop_toolkit's ``docs/bop_datasets_format.md`` and of the BOP challenge's
results: rotations row by row, translations in millimetres, integer pixels at pixel centres.

These files have no place for a stretch. So the model that they speak of is the stretched mesh, in
millimetres, which is written beside them as ``models/obj_000001.ply``, its box and diameter in
``models/models_info.json``. Poses alone are written for a model without stretch and mesh.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import pdist

from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError, DataError, InputError, brief, quote
from cadalign.export.aligned_object import AlignedObject
from cadalign.export.estimates import Estimates, PoseEstimate
from cadalign.export.mesh_files import write_mesh_as_ply
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.rotations import nearest_rotation
from cadalign.io.documents import Finite, ForeignDocument, Point3, convert, in_file, read_json
from cadalign.io.files import read_text, write_json, write_text, writing

RESULT_COLUMNS = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")
TRUTH_FILE = "scene_gt.json"
_CAMERA_FILE = "scene_camera.json"
_MODELS = "models"
_INFO = "models_info.json"
_UNKNOWN_TIME = -1.0
_MM = 1000.0
_MAX_ID = 10**9
_HULL_POINTS = 2000  # of more the diameter is computed from every k-th

_Nine = Annotated[list[Finite], Meta(min_length=9, max_length=9)]


class _Pose(ForeignDocument):
    cam_R_m2c: _Nine
    cam_t_m2c: Point3
    obj_id: Annotated[int, Meta(ge=0, le=_MAX_ID)]


def write_bop_results(path: Path, poses: Iterable[PoseEstimate]) -> None:
    """Write poses as the CSV file of results that the BOP challenge takes.

    Parameters
    ----------
    path : Path
    poses : iterable of PoseEstimate
        Their ids are numbers; models may be called ``obj_000001``. Translations are millimetres.

    Raises
    ------
    InputError
        If an id is not a number, or a pose has a stretch.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(RESULT_COLUMNS)
    for number, each in enumerate(poses):
        rotation, translation = _rigid(each, number)
        writer.writerow(
            [
                _number(each.scene or "0", f"poses[{number}].scene"),
                _number(each.image, f"poses[{number}].image"),
                _object_number(each.model_id, f"poses[{number}].model_id"),
                f"{each.score:.17g}",
                _blank_separated(rotation),
                _blank_separated(translation),
                f"{_UNKNOWN_TIME if each.seconds is None else each.seconds:.17g}",
            ]
        )
    write_text(path, text.getvalue())


def write_scene_gt(path: Path, poses: Iterable[PoseEstimate]) -> None:
    """Write poses of one scene as ``scene_gt.json``; see `write_bop_results`."""
    table: dict[str, list[dict[str, Any]]] = {}
    for number, each in enumerate(poses):
        rotation, translation = _rigid(each, number)
        entry = {
            "cam_R_m2c": rotation.tolist(),
            "cam_t_m2c": translation.tolist(),
            "obj_id": _object_number(each.model_id, f"poses[{number}].model_id"),
        }
        image = str(_number(each.image, f"poses[{number}].image"))
        table.setdefault(image, []).append(entry)
    write_json(path, dict(sorted(table.items(), key=lambda item: int(item[0]))))


def read_bop_results(path: Path) -> Estimates:
    """Read a CSV file of results of the BOP challenge; lines that cannot be read are told of.

    Raises
    ------
    DataError
        If the file cannot be read, or is not such a file.
    """
    text = read_text(path)
    rows = list(csv.reader(io.StringIO(text)))
    if not rows or tuple(cell.strip() for cell in rows[0]) != RESULT_COLUMNS:
        what = f"the first line is not {','.join(RESULT_COLUMNS)}"
        fix = "give a CSV file of results as the BOP challenge takes it"
        raise DataError(what, where=str(path), fix=fix)
    poses, problems = [], []
    for line, row in enumerate(rows[1:], start=2):
        if not any(cell.strip() for cell in row):
            continue
        try:
            poses.append(_pose_of_row(row))
        except (CadalignError, ValueError) as error:
            what = error.what if isinstance(error, CadalignError) else brief(error)
            problems.append(DataError(what, where=f"{path}, line {line}"))
    if problems and not poses:
        raise problems[0]
    return Estimates(path, tuple(poses), tuple(problems))


def read_scene_gt(path: Path) -> Estimates:
    """Read a file in the form of ``scene_gt.json``; poses that cannot be read are told of.

    The scene's id is the name of the file's folder, where that is a number.

    Raises
    ------
    DataError
        If the file cannot be read, or is not such a file.
    """
    table = read_json(path)
    is_table = isinstance(table, dict) and all(isinstance(each, list) for each in table.values())
    if not is_table:
        what = "is not a table of lists of poses by the images' numbers"
        raise DataError(what, where=str(path), fix=f"give a file such as BOP's {TRUTH_FILE}")
    scene = str(int(path.parent.name)) if path.parent.name.isdecimal() else ""
    poses, problems = [], []
    for image, row, entry in _entries(table):
        try:
            with in_file(path):
                poses.append(_pose_of_entry(entry, scene, image, f"{image}[{row}]"))
        except CadalignError as error:
            problems.append(DataError(error.what, where=error.where, fix=error.fix))
    if problems and not poses:
        raise problems[0]
    return Estimates(path, tuple(poses), tuple(problems))


def bop_poses(
    exported: AlignedObject, *, scene_id: int, image_id: int | None, object_id: int
) -> tuple[PoseEstimate, ...]:
    """The poses of an object in its photos, in millimetres, of its stretched mesh.

    A photo's number is that of its file's name, where that is one, or else its view's; the given
    one is that of the first view.
    """
    poses = []
    for number, view in enumerate(exported.views):
        pose = view.cam_from_model
        shift = pose.translation * exported.metres * _MM
        stem = Path(view.image_name).stem
        image = stem if stem.isdecimal() else str(number)
        if image_id is not None:
            image = str(image_id + number)
        poses.append(
            PoseEstimate(
                scene=str(scene_id),
                image=str(int(image)),
                model_id=str(object_id),
                cam_from_model=Alignment(pose.rotation, shift, np.ones(3)),
            )
        )
    return tuple(poses)


def write_bop_model(folder: Path, exported: AlignedObject, *, object_id: int) -> None:
    """Write the stretched mesh [mm] and its entry in ``models_info.json`` into ``models``.

    Entries of other models in the file are kept.

    Raises
    ------
    InputError
        If the model is stretched and there is no mesh.
    DataError
        If the file with the other models cannot be read.
    """
    scale = exported.views[0].cam_from_model.scale
    if exported.mesh is None:
        if np.abs(scale * exported.metres * _MM - 1).max() > 1e-9:
            what = "BOP's poses have no stretch, and there is no mesh to stretch instead"
            raise InputError(what, where="mesh", fix="give it: an observation's `model`")
        return
    mesh = exported.mesh.stretched(scale * exported.metres * _MM)
    models = folder / _MODELS
    with writing(models):
        models.mkdir(parents=True, exist_ok=True)
    info = models / _INFO
    table = read_json(info) if info.exists() else {}
    if not isinstance(table, dict):
        raise DataError("is not a table of models", where=str(info))
    write_mesh_as_ply(models / f"obj_{object_id:06d}.ply", mesh)
    write_json(info, {**table, str(object_id): _model_info(mesh)})


def write_bop_cameras(path: Path, exported: AlignedObject, images: Iterable[str]) -> None:
    """Write ``scene_camera.json`` of the photos.

    Raises
    ------
    InputError
        If a camera has lens distortion, which the format lacks.
    """
    table = {}
    for number, (image, view) in enumerate(zip(images, exported.views, strict=True)):
        if any(view.camera.distortion):
            fix = "undistort the photo and fit again, or export the result CSV alone"
            what = "BOP's camera files have no place for lens distortion"
            raise InputError(what, where=f"views[{number}].camera", fix=fix)
        table[image] = {"cam_K": view.camera.matrix.ravel().tolist(), "depth_scale": 1.0}
    write_json(path, table)


def write_bop_scene(
    folder: Path, exported: AlignedObject, *, scene_id: int, image_id: int | None, object_id: int
) -> None:
    """Write a scene's folder: ``scene_gt.json``, ``scene_camera.json`` and ``models``."""
    poses = bop_poses(exported, scene_id=scene_id, image_id=image_id, object_id=object_id)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    write_bop_cameras(folder / _CAMERA_FILE, exported, [each.image for each in poses])
    write_bop_model(folder, exported, object_id=object_id)
    write_scene_gt(folder / TRUTH_FILE, poses)


def object_name(number: int) -> str:
    """The name of a model's files, as ``obj_000001``."""
    return f"obj_{number:06d}"


def _model_info(mesh: Mesh) -> dict[str, float]:
    low, high = mesh.bounds
    corners = {f"min_{axis}": value for axis, value in zip("xyz", low.tolist(), strict=True)}
    sizes = {
        f"size_{axis}": value for axis, value in zip("xyz", (high - low).tolist(), strict=True)
    }
    return {"diameter": _diameter(mesh), **corners, **sizes}


def _diameter(mesh: Mesh) -> float:
    """The largest distance of two vertices."""
    points = mesh.vertices[mesh.is_used]
    try:
        points = points[ConvexHull(points).vertices]
    except (QhullError, ValueError):  # a flat mesh
        points = np.unique(points, axis=0)
    points = points[:: max(1, -(-len(points) // _HULL_POINTS))]
    return float(pdist(points).max(initial=0.0))


def _entries(table: dict[str, list[Any]]) -> Iterator[tuple[str, int, Any]]:
    for image, entries in table.items():
        for row, entry in enumerate(entries):
            yield image, row, entry


def _pose_of_entry(entry: Any, scene: str, image: str, where: str) -> PoseEstimate:
    if not image.isdecimal():
        raise InputError(f"{quote(image)} is not the number of an image", where=image)
    pose: _Pose = convert(entry, _Pose, where)
    alignment = _alignment(np.array(pose.cam_R_m2c), np.array(pose.cam_t_m2c), where)
    return PoseEstimate(scene, str(int(image)), object_name(pose.obj_id), alignment)


def _pose_of_row(row: list[str]) -> PoseEstimate:
    if len(row) != len(RESULT_COLUMNS):
        raise InputError(f"{len(row)} cells, expected {len(RESULT_COLUMNS)}")
    cells = dict(zip(RESULT_COLUMNS, (cell.strip() for cell in row), strict=True))
    ids = [_number(cells[name], name) for name in ("scene_id", "im_id", "obj_id")]
    score, seconds = _floats(cells["score"], 1, "score")[0], _floats(cells["time"], 1, "time")[0]
    alignment = _alignment(_floats(cells["R"], 9, "R"), _floats(cells["t"], 3, "t"), "R")
    return PoseEstimate(
        scene=str(ids[0]),
        image=str(ids[1]),
        model_id=object_name(ids[2]),
        cam_from_model=alignment,
        score=float(score),
        seconds=None if seconds < 0 else float(seconds),
    )


def _floats(text: str, count: int, name: str) -> FloatArray:
    try:
        values = np.array(text.split(), dtype=float)
    except ValueError:
        values = np.empty(0)
    if len(values) != count or not np.isfinite(values).all():
        raise InputError(f"{name} {quote(text)} is not {count} finite numbers")
    return values


def _alignment(rotation: FloatArray, translation: FloatArray, where: str) -> Alignment:
    matrix = rotation.reshape(3, 3)
    try:
        exact = Alignment(matrix, translation, np.ones(3))
    except InputError:  # a file of few digits
        try:
            return Alignment(nearest_rotation(matrix), translation, np.ones(3))
        except InputError as error:
            raise InputError(error.what, where=where) from None
    return exact


def _rigid(each: PoseEstimate, number: int) -> tuple[FloatArray, FloatArray]:
    pose = each.cam_from_model
    if np.abs(pose.scale - 1).max() > 1e-12:
        what = (
            f"the pose has the stretch {pose.scale.tolist()}, which BOP's files have no place for"
        )
        fix = "stretch the mesh, write that, and give the pose with scale 1"
        raise InputError(what, where=f"poses[{number}]", fix=fix)
    return pose.rotation.ravel(), pose.translation


def _blank_separated(values: FloatArray) -> str:
    return " ".join(f"{value:.17g}" for value in values)


def _number(text: str, where: str) -> int:
    if not (text.isdecimal() and int(text) <= _MAX_ID):
        what = f"{where} {quote(text)} is not a whole number from 0 to {_MAX_ID}"
        raise InputError(what, where=where, fix="BOP's files number scenes, images and models")
    return int(text)


def _object_number(name: str, where: str) -> int:
    return _number(name.removeprefix("obj_"), where)
