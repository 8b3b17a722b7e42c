"""Outputs of runs over many observations: their table, and pictures for the page.

The table is ``results.parquet``, and ``results.csv`` without the columns that are lists;
docs/how_to/many_photos.md describes the columns. Rows are in the order of the observations. Pose
and camera of several views are the first's.
"""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq

from cadalign.datasets.models.shapenet import name_of_synset
from cadalign.errors import CadalignError, RenderError
from cadalign.estimation.result import Result
from cadalign.evaluation.benchmark import write_picture
from cadalign.evaluation.instances.pictures import write_pictures, write_preview
from cadalign.evaluation.instances.record import record_stem
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import DONE_ANEW, read_groups
from cadalign.evaluation.runs.work import OK, Columns, Row
from cadalign.geometry.alignment import Box
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.rotations import quat_wxyz_from_rotation
from cadalign.io.files import write_whole
from cadalign.io.images import read_image
from cadalign.io.meshes.files import load_mesh
from cadalign.io.observation import Observation
from cadalign.render.drawing.model_overlay import mesh_of

_AXES = "xyz"
_LISTS: Columns = (
    *(("covariance", list[float]), ("residuals", list[float]), ("is_inlier", list[bool])),
)
COLUMNS: Columns = (
    *(("row", int), ("source", str), ("image", str), ("object", str), ("model", str)),
    *(("status", str), ("reason", str), ("method", str)),
    *(("views", int), ("keypoints", int), ("inliers", int)),
    *((f"q{axis}", float) for axis in "wxyz"),
    *((f"t{axis}", float) for axis in _AXES),
    *((f"scale_{axis}", float) for axis in _AXES),
    *(("focal_length", float), ("sigma", float), ("rotation_std_deg", float)),
    *((f"t{axis}_std", float) for axis in _AXES),
    *((f"scale_{axis}_std", float) for axis in _AXES),
    *(("focal_length_std", float), ("rms_px", float), ("cost", float)),
    *(("alternatives", int), ("warning_count", int), ("warning_kinds", str), ("warnings", str)),
    *_LISTS,
)
RECORD_COLUMNS: Columns = (("row", int), ("observation", str), ("result", str))
"""Observation and result as JSON: all that pages, exports and `cadalign.Results.open` need."""


def naming_row(row: int, source: str, observation: Observation | None) -> Row:
    """The cells that name an observation, None where it cannot be read."""
    image = model = name = ""
    if observation is not None:
        image = "" if observation.image is None else str(observation.image)
        known = observation.shape or observation.model
        model = "" if known is None else str(known)
        name = observation.object_name or ""
    return {"row": row, "source": source, "image": image, "object": name, "model": model}


def result_row(result: Result) -> Row:
    """The cells of a result."""
    pose, std, warnings = result.alignment, result.std, result.warnings
    sigma: Any = result.sigma
    if sigma is None and result.options is not None:
        sigma = result.options.sigma
    row: Row = {
        "status": OK,
        "reason": "",
        "method": result.method,
        "views": len(result.views),
        "keypoints": len(result.inliers),
        "inliers": int(result.inliers.sum()),
        "focal_length": result.camera.fx,
        "sigma": None if sigma is None or np.ndim(sigma) else float(sigma),
        "rms_px": result.rms,
        "cost": result.cost,
        "alternatives": len(result.alternatives),
        "warning_count": len(warnings),
        "warning_kinds": "; ".join(each.kind for each in warnings),
        "warnings": "; ".join(each.text for each in warnings),
        "residuals": result.residuals.ravel().tolist(),
        "is_inlier": result.inliers.tolist(),
    }
    by_axis: dict[str, Any] = {"t{}": pose.translation, "scale_{}": pose.scale}
    if std is not None:
        by_axis |= {"t{}_std": std.translation, "scale_{}_std": std.scale}
        row |= {"rotation_std_deg": std.rotation_deg, "focal_length_std": std.focal}
    for name, values in by_axis.items():
        row |= {name.format(axis): float(each) for axis, each in zip(_AXES, values, strict=True)}
    quaternion = quat_wxyz_from_rotation(pose.rotation).tolist()
    row |= {f"q{axis}": value for axis, value in zip("wxyz", quaternion, strict=True)}
    if result.covariance is not None:
        row["covariance"] = result.covariance.ravel().tolist()
    return row


def write_csv(folder: RunFolder) -> None:
    """Write ``results.csv`` of a finished run, holding few rows at a time."""
    schema = without_lists(pq.read_schema(folder.results).empty_table()).schema

    def write(unfinished: Any) -> None:
        with pa_csv.CSVWriter(unfinished, schema) as writer:
            for table in read_groups(folder.results, fix=DONE_ANEW):
                writer.write_table(without_lists(table))

    write_whole(folder.path / "results.csv", write)


def read_rows(folder: RunFolder) -> list[Row]:
    """The rows of a finished run, without the columns that are lists."""
    groups = read_groups(folder.results, fix=DONE_ANEW)
    return [row for table in groups for row in without_lists(table).to_pylist()]


def without_lists(table: pa.Table) -> pa.Table:
    """A table without the columns that hold several values in a cell."""
    return table.select([each.name for each in table.schema if not pa.types.is_list(each.type)])


NAMING = ("row", "source", "image", "object", "model", "match_category", "match_id")
"""Columns that `page_names` looks at; only a retrieval has the last ones."""


def page_names(row: Row) -> Row:
    """Names of an observation on the page, unique by its number in the run, and of its model."""
    known = row["image"] or row["source"]
    parts = (Path(known).name, row["object"], f"row {row['row']}")
    category, model = row.get("match_category"), row.get("match_id")
    if not category or not model:
        category, model = _names_of(Path(row["model"]))
    name = ", ".join(filter(None, parts))
    return {"category": category, "model_id": name, "view": 0, "model_name": model}


def _names_of(model: Path) -> tuple[str, str]:
    """Category and name of a model's or a shape's file: in ShapeNet's layout the folders'."""
    for part, below in pairwise(model.parts):
        category = name_of_synset(part)
        if category != part:
            return category, Path(below).stem
    name = model.stem.removesuffix(".keypoints") or "no model"
    return name, name


def draw_fit(
    folder: RunFolder, row: Row, seen: Observation, result: Result | None
) -> tuple[str, ...]:
    """Write the pictures of an observation, aligned or not; says what could not be drawn.

    Raises AbortError if a picture cannot be written, as on a full disk.
    """
    camera = seen.camera if result is None else result.camera
    names = page_names(row)
    stem = record_stem(names["category"], names["model_id"])
    troubles = []
    photo = mesh = None
    try:
        photo = None if seen.image is None else read_image(seen.image, camera)
    except CadalignError as error:
        troubles.append(f"the photo is not shown: {error}")
    try:
        mesh = None if result is None else _mesh(seen, result)
    except CadalignError as error:
        troubles.append(f"the model is shown as a box: {error}")
    box = None if result is None else Box.from_model(result.bounds, result.alignment)
    try:
        if photo is not None:
            how = partial(write_pictures, observed=seen.points_2d, est_box=box)
            write_picture(how, folder, stem, photo, camera)
        if mesh is not None:
            write_picture(write_preview, folder.previews / f"{stem}.json", mesh)
    except RenderError as error:
        troubles.append(f"not drawn: {error}")
    return tuple(troubles)


def _mesh(seen: Observation, result: Result) -> Mesh | None:
    if result.model is not None:
        return mesh_of(seen, result)
    return None if seen.model is None else load_mesh(seen.model)
