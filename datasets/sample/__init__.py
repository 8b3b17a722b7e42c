"""The sample data set: parametric chairs, bottles, cars and vessels in KeypointNet's layout."""

from __future__ import annotations

import os
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from cadalign.arrays import require_counts
from cadalign.datasets.sample.kinds import bottle, car, chair, vessel
from cadalign.datasets.sample.parts import has_area
from cadalign.datasets.shapenet import SYNSETS
from cadalign.errors import DataError, unknown_name
from cadalign.geometry.mesh import Mesh, join
from cadalign.io.documents import read_json
from cadalign.io.files import as_path, create_folder, dense_json, guard_writing
from cadalign.io.meshes.files import write_mesh

MAKERS = {"chair": chair, "bottle": bottle, "car": car, "vessel": vessel}
"""Builders of a model by category; the style cycles with the model's index."""
_SPLITS = ("train", "train", "train", "train", "val", "test")  # cycle with the index
_MARKER = "sample_dataset.json"


def write_sample_dataset(
    root: str | os.PathLike[str],
    *,
    per_category: int = 12,
    categories: Sequence[str] | None = None,
) -> Path:
    """Write the sample data set in KeypointNet's layout.

    The files are ``annotations/<category>.json``, ``ShapeNetCore.v2.ply/<synset>/<model id>.ply``
    and ``splits/{train,val,test}.txt``. A model depends only on its category and index, and the
    same arguments give the same bytes. The folder is written beside ``root`` and then renamed, so
    an interrupted run leaves no incomplete data set.

    Parameters
    ----------
    root : path
        The folder to create. An existing folder must be empty or hold the same data set, which
        is kept.
    per_category : int
        Number of models per category, at least 1.
    categories : sequence of str, optional
        Any of chair, bottle, car, vessel; by default all.

    Returns
    -------
    Path
        ``root``.

    Raises
    ------
    InputError
        If the number is out of range or a category is unknown.
    DataError
        If ``root`` has other content or cannot be written.
    """
    require_counts(per_category=per_category)
    target, names = as_path(root, "root"), list(dict.fromkeys(categories or MAKERS))
    for name in names:
        if name not in MAKERS:
            raise unknown_name("category", name, MAKERS, where="categories")
    made_of = {"categories": names, "per_category": int(per_category)}
    if target.is_file() or (target.is_dir() and any(target.iterdir())):
        if (target / _MARKER).is_file() and read_json(target / _MARKER) == made_of:
            return target
        what = "is neither empty nor a sample data set of the same models"
        raise DataError(what, where=str(target), fix="give a new or an empty folder")
    splits: dict[str, str] = dict.fromkeys(_SPLITS, "")
    annotations: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
    create_folder(target.parent)
    with guard_writing(target), TemporaryDirectory(prefix=".", dir=target.parent) as scratch:
        data = Path(scratch, target.name)
        for name, index in product(names, range(per_category)):
            mesh, entry = make_model(name, index)
            annotations[name].append(entry)
            synset, model_id = entry["class_id"], entry["model_id"]
            splits[_SPLITS[index % len(_SPLITS)]] += f"{synset}-{model_id}\n"
            ply = data / "ShapeNetCore.v2.ply" / synset / f"{model_id}.ply"
            write_mesh(ply, mesh, kind="ply")
        texts = {f"annotations/{name}.json": dense_json(annotations[name]) for name in names}
        texts |= {f"splits/{split}.txt": text for split, text in splits.items()}
        texts[_MARKER] = dense_json(made_of)
        for place, text in texts.items():
            (data / place).parent.mkdir(exist_ok=True)
            (data / place).write_text(text, encoding="utf-8", newline="\n")
        data.replace(target)
    return target


def make_model(category: str, index: int) -> tuple[Mesh, dict[str, Any]]:
    """Build a model; returns its mesh and its entry in KeypointNet's annotations.

    The front is at -z, the bounding box has a diagonal of 1, and coordinates are exact in single
    precision.
    """
    rng = np.random.default_rng([0, int(SYNSETS[category]), index])
    # Real models are off-centre, too. Planes and axes of symmetry stay at 0.
    offset = rng.uniform(-0.08, 0.08, size=3) * (0, 1, category != "bottle")
    draft, model_id = MAKERS[category](rng, index), f"sample_{category}_{index:03d}"
    whole = join(draft.parts, f"{category} {model_id}")
    center, diagonal = whole.bounds.mean(axis=0), np.linalg.norm(np.ptp(whole.bounds, axis=0))
    # The file has single precision; the mesh and the keypoints must agree with it.
    scaled = ((whole.vertices - center) / diagonal + offset).astype(np.float32).astype(np.float64)
    faces = whole.faces[has_area(scaled[whole.faces])]  # rounding can flatten faces
    mesh = Mesh(scaled, faces, vertex_colors=whole.vertex_colors, source=whole.source)
    ids = sorted(draft.places)
    places = (np.array([draft.places[number] for number in ids]) - center) / diagonal + offset
    on_faces, weights = mesh.closest(places)
    xyz = mesh.surface_points(on_faces, weights)
    columns = (ids, xyz.tolist(), on_faces.tolist(), weights.tolist())
    keypoints = [
        {"xyz": at, "semantic_id": number, "mesh_info": {"face_index": face, "face_uv": uv}}
        for number, at, face, uv in zip(*columns, strict=True)
    ]
    reflection = [{"kp_indexes": list(map(ids.index, pair))} for pair in draft.mirror_pairs]
    rotation: list[dict[str, Any]] = []
    for group in draft.rotation_groups:
        rows, circle = list(map(ids.index, group)), {}
        if draft.is_round:
            # The model's axis; the mean of the keypoints deviates from it.
            middle = np.where([1, 0, 1], mesh.bounds.mean(axis=0), xyz[rows].mean(axis=0))
            radius = float(np.linalg.norm(xyz[rows] - middle, axis=1).mean())
            circle = {"center": middle.tolist(), "radius": radius, "normal": [0.0, 1.0, 0.0]}
        rotation.append({"kp_indexes": rows, "is_circle": draft.is_round, "circle": circle})
    entry = {"class_id": SYNSETS[category], "model_id": model_id, "keypoints": keypoints}
    return mesh, entry | {"symmetries": {"reflection": reflection, "rotation": rotation}}
