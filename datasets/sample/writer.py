"""The sample data set: its models, and writing them in KeypointNet's layout."""

from __future__ import annotations

import colorsys
import hashlib
import json
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.arrays import is_whole
from cadalign.datasets.models.shapenet import SYNSETS
from cadalign.datasets.sample.household import bottle, chair
from cadalign.datasets.sample.model import Draft, SampleKeypoint, SampleModel, finish
from cadalign.datasets.sample.vehicles import car, vessel
from cadalign.errors import DataError, InputError
from cadalign.io.files import as_path, writing
from cadalign.io.meshes.files import write_ply_mesh

_Maker = Callable[[np.random.Generator, int], Draft]
MAKERS: dict[str, _Maker] = {"chair": chair, "bottle": bottle, "car": car, "vessel": vessel}
"""By category: draws and builds the model with a number; the styles take turns with the number."""
_SPLITS = ("train", "train", "train", "train", "val", "test")  # take turns by number
_MARKER = "sample_dataset.json"
_LARGEST_OFFSET = 0.08


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
    names = _check_arguments(per_category, categories, seed)

    def make(category: str, index: int) -> SampleModel:
        rng = np.random.default_rng([seed, int(SYNSETS[category]), index])
        # Real models are not centred either; x stays, so that x = 0 remains the mirror plane.
        offset = rng.uniform(-_LARGEST_OFFSET, _LARGEST_OFFSET, size=3) * (0, 1, 1)
        if category == "bottle":
            offset[2] = 0.0
        draft, model_id = MAKERS[category](rng, index), f"sample_{category}_{index:03d}"
        return finish(draft, category=category, model_id=model_id, offset=offset)

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
    names = _check_arguments(per_category, categories, seed)
    _check_replaceable(target)
    origin = {"categories": names, "per_category": int(per_category), "seed": int(seed)}
    with suppress(OSError):
        if keep and (target / _MARKER).read_text(encoding="utf-8") == _marker(target, origin):
            return target
    with writing(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        # Not a plain folder name beside it: two runs at once must not share one.
        with tempfile.TemporaryDirectory(
            prefix=f".{target.name}.", suffix=".partial", dir=target.parent
        ) as folder:
            data = Path(folder, "data")
            data.mkdir()
            _write(data, names, per_category, seed)
            (data / _MARKER).write_text(_marker(data, origin), encoding="utf-8")
            if target.exists():
                target.rename(Path(folder, "replaced"))
            data.rename(target)
    return target


def _check_arguments(
    per_category: int, categories: Sequence[str] | None, seed: int
) -> tuple[str, ...]:
    for name, value, least in (("per_category", per_category, 1), ("seed", seed, 0)):
        if not is_whole(value) or value < least:
            what = f"must be an integer >= {least}, not {value!r}"
            raise InputError(what, where=name, fix=f"give {least} or more")
    if categories is None:
        return tuple(MAKERS)
    if isinstance(categories, str):
        what = "a single text, not a sequence"
        raise InputError(what, where="categories", fix=f"give [{categories!r}]")
    unknown = [name for name in categories if name not in MAKERS]
    if unknown or not categories or len(set(categories)) < len(categories):
        what = f"unknown category {unknown[0]!r}" if unknown else f"{list(categories)!r}"
        fix = f"give some of {', '.join(MAKERS)}, each once"
        raise InputError(what, where="categories", fix=fix)
    return tuple(categories)


def _write(root: Path, names: Sequence[str], per_category: int, seed: int) -> None:
    splits: dict[str, list[str]] = {name: [] for name in _SPLITS}
    annotations: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
    for model in sample_models(per_category=per_category, categories=names, seed=seed):
        synset, records = SYNSETS[model.category], annotations[model.category]
        write_ply_mesh(root / "ShapeNetCore.v2.ply" / synset / f"{model.model_id}.ply", model.mesh)
        splits[_SPLITS[len(records) % len(_SPLITS)]].append(f"{synset}-{model.model_id}\n")
        records.append(_annotation(model))
    (root / "annotations").mkdir()
    for name, records in annotations.items():
        text = json.dumps(records, separators=(",", ":"))
        (root / "annotations" / f"{name}.json").write_text(text, encoding="utf-8")
    (root / "splits").mkdir()
    for split, lines in splits.items():
        path = root / "splits" / f"{split}.txt"
        path.write_text("".join(lines), encoding="utf-8", newline="\n")


def _annotation(model: SampleModel) -> dict[str, Any]:
    row = {keypoint.semantic_id: i for i, keypoint in enumerate(model.keypoints)}
    mirrored = [{"kp_indexes": [row[number] for number in pair]} for pair in model.mirrored]
    turned = []
    for group in model.turned:
        rows = [row[semantic_id] for semantic_id in group]
        circle = _circle(model, rows) if model.round else {}
        turned.append({"kp_indexes": rows, "is_circle": model.round, "circle": circle})
    return {
        "class_id": SYNSETS[model.category],
        "model_id": model.model_id,
        "keypoints": [_keypoint_entry(keypoint) for keypoint in model.keypoints],
        "symmetries": {"reflection": mirrored, "rotation": turned},
    }


def _keypoint_entry(keypoint: SampleKeypoint) -> dict[str, Any]:
    # Steps of the golden ratio around the colour circle never come back to a colour.
    rgb = colorsys.hsv_to_rgb(keypoint.semantic_id * 0.6180339887498949 % 1.0, 0.85, 0.95)
    return {
        "xyz": keypoint.xyz.tolist(),
        "rgb": [round(255 * value) for value in rgb],
        "semantic_id": keypoint.semantic_id,
        "pcd_info": {"point_index": keypoint.vertex_index},
        "mesh_info": {"face_index": keypoint.face_index, "face_uv": keypoint.barycentric.tolist()},
    }


def _circle(model: SampleModel, rows: Sequence[int]) -> dict[str, Any]:
    points = np.array([model.keypoints[row].xyz for row in rows])
    # The axis is that of the model, not the mean of a few points on a polygon.
    center = model.mesh.bounds.mean(axis=0)
    center[1] = points[:, 1].mean()
    radius = float(np.linalg.norm(points - center, axis=1).mean())
    return {"center": center.tolist(), "radius": radius, "normal": [0.0, 1.0, 0.0]}


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
    is_sample = (target / _MARKER).is_file()
    for path in sorted(path for path in target.rglob("*") if not path.is_dir()):
        place = path.relative_to(target)
        known = place.as_posix() in ours or place.match("ShapeNetCore.v2.ply/*/sample_*.ply")
        if not (is_sample and known):
            what = f"holds files that are not of a sample data set, such as {path.name}"
            raise DataError(what, where=str(target), fix="give a new or an empty folder")
