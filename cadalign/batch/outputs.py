"""Outputs of runs over many observations: tables, and pictures for the page.

The table is written as ``results.parquet`` and ``results.csv``; docs/how_to/many_photos.md
describes its columns. Rows have the order of the observations. For several views, pose and camera
belong to the first.
"""

from __future__ import annotations

from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq

from cadalign.errors import CadalignError
from cadalign.estimation.result import Result
from cadalign.evaluation.benchmark import write_picture
from cadalign.evaluation.instances.pictures import write_pictures, write_preview
from cadalign.evaluation.instances.record import record_stem
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import DONE_ANEW, read_groups
from cadalign.evaluation.runs.work import AbortError, Columns, Row
from cadalign.export.results import RESULT_COLUMNS, row_of
from cadalign.geometry.mesh import Mesh
from cadalign.io.files import write_whole
from cadalign.io.images import read_image
from cadalign.io.observation import Observation
from cadalign.render.overlay import mesh_of

COLUMNS: Columns = (
    *(("row", int), ("source", str), ("image", str), ("object", str), ("model", str)),
    *RESULT_COLUMNS,
)
RECORD_COLUMNS: Columns = (("row", int), ("observation", str), ("result", str))
"""The result as JSON, for pages and `cadalign.Results.open`; the observation if it failed."""
WARNING_COLUMNS = {"warning_kinds": "with warnings", "uncertain": "uncertain"}
"""Columns that list the warnings of a row, with their labels."""
# Several times faster than the standard library. Non-finite numbers become null.
_ENCODER = msgspec.json.Encoder(enc_hook=np.generic.item)


def json_of(data: Any) -> bytes:
    """Encode plain data as one line of JSON; NumPy scalars are allowed."""
    return _ENCODER.encode(data)


def name_cells(row: int, source: str, observation: Observation | None) -> Row:
    """Return the cells that name an observation; it is None if it cannot be read."""
    image = model = name = ""
    if observation is not None:
        image = "" if observation.image is None else str(observation.image)
        known = observation.shape or observation.model
        model = "" if known is None else str(known)
        name = observation.object_name or ""
    return {"row": row, "source": source, "image": image, "object": name, "model": model}


def result_row(result: Result) -> Row:
    """Return the cells and the record of a result, without its time, which differs between runs."""
    data = result.to_dict()
    data["stats"]["seconds"] = 0.0
    return row_of(result) | {"observation": "", "result": json_of(data).decode()}


def write_csv(folder: RunFolder) -> None:
    """Write ``results.csv`` of a finished run, a few rows at a time."""

    def write(unfinished: Any) -> None:
        with pa_csv.CSVWriter(unfinished, pq.read_schema(folder.results)) as writer:
            for table in read_groups(folder.results, fix=DONE_ANEW):
                writer.write_table(table)

    write_whole(folder.path / "results.csv", write)


def warnings_text(table: pa.Table) -> str:
    """Count the rows with warnings and the rows with uncertain quantities, by kind."""
    parts = []
    for column, label in WARNING_COLUMNS.items():
        rows = [{*cell.split("; ")} for cell in table[column].to_pylist() if cell]
        of_each = Counter(sorted(name for row in rows for name in row)).most_common()
        if rows:
            listed = ", ".join(f"{name} {count:,}" for name, count in of_each)
            parts.append(f"{len(rows):,} {label}: {listed}")
    return "; ".join(parts)


NAME_COLUMNS = ("row", "source", "image", "object", "model", "match_category", "match_id")
"""Columns that `page_names` reads; only a retrieval has the last two."""


def page_names(row: Row) -> Row:
    """Name an observation on the page; the number of its row makes the name unique."""
    parts = Path(row["image"] or row["source"]).name, row["object"], f"row {row['row']}"
    model = Path(row["model"]).stem.removesuffix(".keypoints") or "no model"
    category = row.get("match_category") or model
    return {"category": category, "model_id": ", ".join(filter(None, parts)), "view": 0}


def draw_fit(
    folder: RunFolder, row: Row, seen: Observation, result: Result | None
) -> tuple[str, ...]:
    """Write the pictures of an observation, aligned or not; returns messages about failures.

    Raises AbortError if a picture cannot be written, as on a full disk.
    """
    camera, names = seen.camera if result is None else result.camera, page_names(row)
    stem = record_stem(names["category"], names["model_id"])

    def draw_photo() -> None:
        if seen.image is not None:
            drawn: dict[str, Any] = {"observed": seen.points_2d}
            if result is not None:
                points = result.alignment.apply(result.points_3d)
                drawn |= {"est_box": result.box, "skeleton": points[result.lines]}
            how = partial(write_pictures, **drawn)
            write_picture(how, folder, stem, read_image(seen.image, camera), camera)

    def draw_model() -> None:
        mesh = None if result is None else mesh_of(seen, result)
        if mesh is None and result is not None and len(result.lines):
            # The preview of triangles without area is lines.
            mesh = Mesh(result.points_3d, result.lines[:, [0, 1, 1]])
        if mesh is not None:
            write_picture(write_preview, folder.previews / f"{stem}.json", mesh)

    troubles = []
    drawn = {"the photo is not shown": draw_photo, "the model is shown as a box": draw_model}
    for trouble, draw in drawn.items():
        try:
            draw()
        except AbortError:
            raise
        except CadalignError as error:
            troubles.append(f"{trouble}: {error}")
    return tuple(troubles)
