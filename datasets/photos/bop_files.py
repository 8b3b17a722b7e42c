"""BOP's files: poses as ``scene_gt.json`` and as result CSV, and models with ``models_info.json``.

The format is that of bop_toolkit's ``docs/bop_datasets_format.md`` and of the BOP challenge's
results: rotations row by row, lengths in millimetres, integer pixels at pixel centres. Poses have
no stretch.
"""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from cadalign.arrays import FloatArray
from cadalign.datasets.photos.dataset import PoseEstimate
from cadalign.datasets.photos.photo import CadModel, existing
from cadalign.errors import CadalignError, DataError, InputError, brief, quote
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.rotations import nearest_rotation
from cadalign.geometry.symmetry import Symmetry, SymmetryAxis
from cadalign.io.documents import (
    Finite,
    ForeignDocument,
    Point3,
    Positive,
    convert,
    in_file,
    read_json,
    within,
)
from cadalign.io.files import (
    read_text,
)

TRUTH = "scene_gt.json"
RESULT_COLUMNS = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")
_UNKNOWN_TIME = -1.0
_MAX_ID = 10**9
_MODELS_INFO = "models_info.json"
_MODEL_FOLDERS = ("models", "models_eval", "models_cad")
# Model folders may lie beside the scene's tables or up to three folders above them.
_LEVELS = 3
_HULL_POINTS = 2000  # of more the diameter is computed from every k-th
Nine = Annotated[list[Finite], Meta(min_length=9, max_length=9)]
_Sixteen = Annotated[list[Finite], Meta(min_length=16, max_length=16)]


class ScenePose(ForeignDocument):
    """The pose of one object in ``scene_gt.json`` [mm]."""

    cam_R_m2c: Nine
    cam_t_m2c: Point3
    obj_id: Annotated[int, Meta(ge=0, le=_MAX_ID)]

    def alignment(self) -> Alignment:
        """The pose; a rotation of few digits becomes the nearest one."""
        return _alignment(np.array(self.cam_R_m2c), np.array(self.cam_t_m2c))


# Poses -----------------------------------------------------------------------------------------


Estimates = tuple[tuple[PoseEstimate, ...], tuple[DataError, ...]]
"""The poses in a result file, and why some of its records could not be read."""


def object_name(number: int) -> str:
    """The name of a model's files, as ``obj_000001``."""
    return f"obj_{number:06d}"


def read_bop_results(path: Path) -> Estimates:
    """Read a CSV file of results of the BOP challenge; lines that cannot be read are told of.

    Raises DataError if the file cannot be read, or is not such a file.
    """
    rows = list(csv.reader(io.StringIO(read_text(path))))
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
    return _unless_all_bad(poses, problems)


def read_scene_gt(path: Path) -> Estimates:
    """Read a file in the form of ``scene_gt.json``; poses that cannot be read are told of.

    The scene's id is the name of the file's folder, where that is a number.

    Raises DataError if the file cannot be read, or is not such a file.
    """
    table = read_json(path)
    if not (isinstance(table, dict) and all(isinstance(each, list) for each in table.values())):
        what = "is not a table of lists of poses by the images' numbers"
        raise DataError(what, where=str(path), fix=f"give a file such as BOP's {TRUTH}")
    scene = str(int(path.parent.name)) if path.parent.name.isdecimal() else ""
    poses, problems = [], []
    for image, row, entry in (
        (i, *each) for i, found in table.items() for each in enumerate(found)
    ):
        try:
            with in_file(path):
                if not image.isdecimal():
                    what = f"{quote(image)} is not the number of an image"
                    raise InputError(what, where=image)
                place = f"{image}[{row}]"
                pose: ScenePose = convert(entry, ScenePose, place)
                with within(place):
                    own = object_name(pose.obj_id), pose.alignment()
                poses.append(PoseEstimate(scene, str(int(image)), *own))
        except DataError as error:
            problems.append(error)
    return _unless_all_bad(poses, problems)


def _unless_all_bad(poses: list[PoseEstimate], problems: list[DataError]) -> Estimates:
    if problems and not poses:
        raise problems[0]
    return tuple(poses), tuple(problems)


def _pose_of_row(row: list[str]) -> PoseEstimate:
    if len(row) != len(RESULT_COLUMNS):
        raise InputError(f"{len(row)} cells, expected {len(RESULT_COLUMNS)}")
    cells = dict(zip(RESULT_COLUMNS, (cell.strip() for cell in row), strict=True))
    scene, image, number = (_number(cells[name], name) for name in RESULT_COLUMNS[:3])
    score, seconds = _floats(cells["score"], 1, "score")[0], _floats(cells["time"], 1, "time")[0]
    pose = _alignment(_floats(cells["R"], 9, "R"), _floats(cells["t"], 3, "t"))
    time = None if seconds < 0 else float(seconds)
    return PoseEstimate(str(scene), str(image), object_name(number), pose, float(score), time)


def _floats(text: str, count: int, name: str) -> FloatArray:
    try:
        values = np.array(text.split(), dtype=float)
    except ValueError:
        values = np.empty(0)
    if len(values) != count or not np.isfinite(values).all():
        raise InputError(f"{name} {quote(text)} is not {count} finite numbers")
    return values


def _alignment(rotation: FloatArray, translation: FloatArray) -> Alignment:
    turn = nearest_rotation(rotation.reshape(3, 3).astype(float))
    return Alignment(turn, translation, np.ones(3), is_valid=True)


def _number(text: str, where: str) -> int:
    if not (text.isdecimal() and int(text) <= _MAX_ID):
        what = f"{where} {quote(text)} is not a whole number from 0 to {_MAX_ID}"
        raise InputError(what, where=where, fix="BOP's files number scenes, images and models")
    return int(text)


class _Axis(ForeignDocument):
    axis: Point3
    offset: Point3 = (0.0, 0.0, 0.0)


class ModelInfo(ForeignDocument):
    """One model's entry: bounding box, diameter and symmetries [mm]."""

    diameter: Positive | None = None
    min_x: Finite | None = None
    min_y: Finite | None = None
    min_z: Finite | None = None
    size_x: Finite | None = None
    size_y: Finite | None = None
    size_z: Finite | None = None
    symmetries_discrete: list[_Sixteen] = msgspec.field(default_factory=list)
    symmetries_continuous: list[_Axis] = msgspec.field(default_factory=list)

    def symmetry(self) -> Symmetry:
        """The symmetries; discrete ones are 4 x 4 matrices, row by row."""
        motions = np.reshape(self.symmetries_discrete, (-1, 4, 4)).astype(float)
        axes = [
            SymmetryAxis(np.array(each.axis), np.array(each.offset))
            for each in self.symmetries_continuous
        ]
        return Symmetry(motions, tuple(axes))

    def bounds(self) -> FloatArray | None:
        """The bounding box's corners, (2, 3) float; None where it is not given."""
        low = (self.min_x, self.min_y, self.min_z)
        size = (self.size_x, self.size_y, self.size_z)
        if None in low or None in size:
            return None
        corner = np.array(low, dtype=float)
        return np.array([corner, corner + np.array(size, dtype=float)])


class BopModels:
    """The CAD models of a data set: a folder of ``obj_000001.ply`` and ``models_info.json``.

    Raises DataError if ``models_info.json`` cannot be read.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._path = folder, folder / _MODELS_INFO
        self._info: dict[str, Any] = {}
        with in_file(self._path):
            if self._path.is_file():
                self._info = convert(read_json(self._path), dict[str, Any])
        self._known: dict[int, tuple[CadModel, Symmetry]] = {}

    @classmethod
    def find(cls, scene: Path) -> BopModels | None:
        """Find the models of a scene: beside it, or in one of the three folders above it."""
        places = (scene, *scene.parents[:_LEVELS])
        folders = (place / name for place in places for name in _MODEL_FOLDERS)
        folder = next(filter(Path.is_dir, folders), None)
        return None if folder is None else cls(folder)

    def model(self, obj_id: int) -> tuple[CadModel, Symmetry]:
        """The CAD model of an id, its mesh None where the file is missing, and its symmetries.

        Raises DataError if a motion is not rigid, or an axis has no direction.
        """
        if obj_id not in self._known:
            name, place = object_name(obj_id), str(obj_id)
            with in_file(self._path):
                info: ModelInfo = convert(self._info.get(place, {}), ModelInfo, place)
                with within(place):
                    symmetry = info.symmetry()
            mesh = existing(self._folder / f"{name}.ply")
            model = CadModel(name, mesh, bounds=info.bounds(), diameter=info.diameter)
            self._known[obj_id] = model, symmetry
        return self._known[obj_id]
