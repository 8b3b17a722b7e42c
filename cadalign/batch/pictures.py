"""Pictures of aligned observations for the page: the photo, the object in it, its mesh."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np

from cadalign.datasets.models.shapenet import name_of_synset
from cadalign.errors import CadalignError, DataError, RenderError
from cadalign.estimation.result import Result
from cadalign.evaluation.instances.pictures import cut_out, shown_photo, write_preview, write_webp
from cadalign.evaluation.instances.record import record_stem
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.work import AbortError, Row
from cadalign.geometry.box import Box
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.pixels import rescaled_pixels
from cadalign.io.images import ByteImage, read_image
from cadalign.io.meshes.files import load_mesh
from cadalign.io.observation import Observation
from cadalign.render.drawing.model_overlay import mesh_of
from cadalign.render.drawing.overlay import draw_overlay

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

    ``pictures`` gets the photo, ``thumbs`` the part around the object with its box, ``previews`` a
    preview of the model's mesh, warped to the estimated shape. Raises AbortError if a picture
    cannot be written, as on a full disk.
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
    try:
        if photo is not None:
            small, shrunk = shown_photo(photo, camera)
            write_webp(folder.pictures / f"{stem}.webp", small)
            write_webp(folder.thumbs / f"{stem}.webp", _thumb(small, shrunk, seen, result))
        if mesh is not None:
            write_preview(folder.previews / f"{stem}.json", mesh)
    except (DataError, OSError) as error:
        raise AbortError(
            f"a picture cannot be written: {error}",
            fix="free some space, and start the same command again: the run goes on",
        ) from None
    except RenderError as error:
        troubles.append(f"not drawn: {error}")
    return tuple(troubles)


def _mesh(seen: Observation, result: Result) -> Mesh | None:
    if result.model is not None:
        return mesh_of(seen, result)
    return None if seen.model is None else load_mesh(seen.model)


def _thumb(photo: ByteImage, camera: Camera, seen: Observation, result: Result | None) -> ByteImage:
    box = None if result is None else Box.from_model(result.bounds, result.alignment)
    observed = rescaled_pixels(seen.points_2d, camera.width / seen.camera.width)
    drawn = draw_overlay(photo, camera, est_box=box, observed=observed, axes=False, legend=False)
    ends = np.empty((0, 2)) if box is None else camera.project_where_ahead(box.corners)
    points = np.concatenate([observed, ends])
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        points = np.array([[0, 0], [camera.width, camera.height]], dtype=float)
    return cut_out(drawn, camera, points)[0]
