"""The sample data set: its models, and writing them in KeypointNet's layout."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.arrays import is_whole
from cadalign.datasets.models.shapenet import SYNSETS
from cadalign.datasets.sample.household import bottle, chair
from cadalign.datasets.sample.model import SampleModel, finish
from cadalign.datasets.sample.vehicles import car, vessel
from cadalign.errors import DataError, InputError, unknown
from cadalign.io.files import as_path, dense_json, writing_folder
from cadalign.io.meshes.files import write_ply_mesh

MAKERS = {"chair": chair, "bottle": bottle, "car": car, "vessel": vessel}
"""By category: draws and builds the model with a number; the styles take turns with the number."""
_SPLITS = ("train", "train", "train", "train", "val", "test")  # take turns by number
_MARKER = "sample_dataset.json"


def sample_models(
    *, per_category: int = 12, categories: Sequence[str] | None = None, seed: int = 0
) -> Iterator[SampleModel]:
    """Make the models of the sample data set, one after the other.

    Each depends on the seed, its category and its number alone: asking for more models, or for
    fewer categories, does not change any of them.

    Parameters
    ----------
    per_category : int
        Models of each category, at least 1.
    categories : sequence of str, optional
        Some of chair, bottle, car, vessel; by default all.
    seed : int
        Not negative.

    Yields
    ------
    SampleModel
        The mesh and its keypoints; KeypointNet's axes, diagonal 1, the front at -z.

    Raises
    ------
    InputError
        If a number is out of range or a category is unknown or named twice.

    Examples
    --------
    >>> model = next(sample_models(categories=["bottle"], per_category=1))
    >>> model.model_id, len(model.keypoints)
    ('sample_bottle_000', 17)
    """
    names = _checked(per_category, categories, seed)

    def make(category: str, index: int) -> SampleModel:
        rng = np.random.default_rng([seed, int(SYNSETS[category]), index])
        # Real models are not centred either; but planes and axes of symmetry stay at 0.
        offset = rng.uniform(-0.08, 0.08, size=3) * (0, 1, category != "bottle")
        draft = MAKERS[category](rng, index)
        return finish(draft, category, f"sample_{category}_{index:03d}", offset)

    return (make(category, index) for category in names for index in range(per_category))


def write_sample_dataset(
    root: str | os.PathLike[str],
    *,
    per_category: int = 12,
    categories: Sequence[str] | None = None,
    seed: int = 0,
    keep: bool = False,
) -> Path:
    """Write the sample data set in KeypointNet's layout.

    That is ``annotations/<category>.json``, ``ShapeNetCore.v2.ply/<synset>/<model id>.ply`` and
    ``splits/{train,val,test}.txt``. The same arguments give the same bytes. Everything is written
    beside ``root`` first and then renamed, so that an interrupted run leaves no half a data set.

    Parameters
    ----------
    root : path
        The folder to make. It may exist if it is empty or holds an earlier sample data set and
        nothing else: that is replaced.
    per_category, categories, seed
        As of `sample_models`.
    keep : bool
        Leave the data set as it is where this version has written it with the same arguments, and
        none of its files has gone or changed its size.

    Returns
    -------
    Path
        ``root``.

    Raises
    ------
    InputError
        If a number is out of range or a category is unknown or named twice.
    DataError
        If ``root`` is a file or holds anything else, or cannot be written.
    """
    target = as_path(root, "root")
    names = _checked(per_category, categories, seed)
    _check_replaceable(target)
    origin = {"categories": names, "per_category": int(per_category), "seed": int(seed)}
    with suppress(OSError):
        if keep and (target / _MARKER).read_text(encoding="utf-8") == _marker(target, origin):
            return target
    splits: dict[str, list[str]] = {name: [] for name in _SPLITS}
    annotations: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
    with writing_folder(target) as data:
        for model in sample_models(per_category=per_category, categories=names, seed=seed):
            synset, records = SYNSETS[model.category], annotations[model.category]
            path = data / "ShapeNetCore.v2.ply" / synset / f"{model.model_id}.ply"
            write_ply_mesh(path, model.mesh)
            splits[_SPLITS[len(records) % len(_SPLITS)]].append(f"{synset}-{model.model_id}\n")
            records.append(_annotation(model))
        texts = {f"annotations/{name}.json": dense_json(annotations[name]) for name in names}
        texts |= {f"splits/{split}.txt": "".join(lines) for split, lines in splits.items()}
        for place, text in texts.items():
            (data / place).parent.mkdir(exist_ok=True)
            (data / place).write_text(text, encoding="utf-8", newline="\n")
        (data / _MARKER).write_text(_marker(data, origin), encoding="utf-8")
    return target


def _checked(per_category: int, categories: Sequence[str] | None, seed: int) -> tuple[str, ...]:
    for name, value, least in (("per_category", per_category, 1), ("seed", seed, 0)):
        if not is_whole(value) or value < least:
            what = f"must be an integer >= {least}, not {value!r}"
            raise InputError(what, where=name, fix=f"give {least} or more")
    names = tuple(MAKERS if categories is None else categories)
    if isinstance(categories, str) or not names or len(set(names)) < len(names):
        fix = f"give a list of some of {', '.join(MAKERS)}, each once"
        raise InputError(f"cannot be {categories!r}", where="categories", fix=fix)
    for name in names:
        if name not in MAKERS:
            raise unknown("category", name, MAKERS, where="categories")
    return names


def _annotation(model: SampleModel) -> dict[str, Any]:
    """A model's entry; symmetries name keypoints by their rows."""
    row = {keypoint.semantic_id: i for i, keypoint in enumerate(model.keypoints)}
    reflection = [{"kp_indexes": [row[number] for number in pair]} for pair in model.mirrored]
    rotation: list[dict[str, Any]] = []
    for group in model.turned:
        rows, circle = [row[number] for number in group], {}
        if model.round:
            # The axis is that of the model, not the mean of points on a polygon.
            xyz = np.array([model.keypoints[i].xyz for i in rows])
            center = np.where([1, 0, 1], model.mesh.bounds.mean(axis=0), xyz.mean(axis=0))
            radius = float(np.linalg.norm(xyz - center, axis=1).mean())
            circle = {"center": center.tolist(), "radius": radius, "normal": [0.0, 1.0, 0.0]}
        rotation.append({"kp_indexes": rows, "is_circle": model.round, "circle": circle})
    keypoints = [
        {
            "xyz": each.xyz.tolist(),
            "semantic_id": each.semantic_id,
            "mesh_info": {"face_index": each.face_index, "face_uv": each.barycentric.tolist()},
        }
        for each in model.keypoints
    ]
    symmetries = {"reflection": reflection, "rotation": rotation}
    names = {"class_id": SYNSETS[model.category], "model_id": model.model_id}
    return names | {"keypoints": keypoints, "symmetries": symmetries}


def _marker(root: Path, origin: dict[str, Any]) -> str:
    """Text of the file that tells how a data set was made: by what code, and of what size."""
    sources = (path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py")))
    files = (path for path in root.rglob("*") if path.is_file() and path.name != _MARKER)
    code, size = hashlib.sha256(b"".join(sources)), sum(path.stat().st_size for path in files)
    made_by = {"made_by": "cadalign.datasets.sample", "code": code.hexdigest()}
    return json.dumps({**made_by, **origin, "bytes": size}) + "\n"


def _check_replaceable(target: Path) -> None:
    """Refuse to overwrite anything but an earlier sample data set."""
    if target.exists() and not target.is_dir():
        raise DataError("is a file", where=str(target), fix="give a folder")
    ours = {_MARKER, *(f"splits/{split}.txt" for split in _SPLITS)}
    ours |= {f"annotations/{category}.json" for category in MAKERS}
    for path in sorted(path for path in target.rglob("*") if not path.is_dir()):
        place = path.relative_to(target)
        known = place.as_posix() in ours or place.match("ShapeNetCore.v2.ply/*/sample_*.ply")
        if not known or not (target / _MARKER).is_file():
            what = f"holds files that are not of a sample data set, such as {path.name}"
            raise DataError(what, where=str(target), fix="give a new or an empty folder")
