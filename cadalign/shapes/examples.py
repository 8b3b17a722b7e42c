"""Training data of a shape model: models of a category with labelled keypoints."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import permutations, product
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from cadalign.arrays import FloatArray, as_points, read_only
from cadalign.errors import DataError, InputError, quote, require_kind
from cadalign.geometry.alignment import extent
from cadalign.io.files import as_path, require_utf8
from cadalign.shapes.parts import (
    BOX_ROWS,
    KeypointId,
    TrainingShapes,
    check_box,
    check_ids,
    check_text,
)

logger = logging.getLogger("cadalign")

LEAST_MODELS = 4
_LEAST_TO_MEASURE = 4  # keypoints for a size; fewer may be near each other
_LARGEST_RATIO = 20.0  # of models' sizes in one unit; an inch is 25 mm
_LEAST_TO_TURN = 5  # keypoints for a comparison of axes
_TURNED_RATIO = 0.4  # distance from the other models with other axes, over the distance without
_ALIKE = 0.1  # distance from the other models, over the radius, at which axes are right
# All permutations of three axes with signs, (48, 3, 3), the identity first.
_AXES = np.array(
    sorted(
        (
            np.eye(3)[list(rows)] * signs
            for rows in permutations(range(3))
            for signs in product((1, -1), repeat=3)
        ),
        key=lambda turn: -float(np.trace(turn)),
    )
)
_FARTHEST = 0.1  # allowed gap between all keypoints and the box, over the box's diagonal


@dataclass(frozen=True, eq=False)
class Example:
    """A training model of a shape model.

    Raises
    ------
    InputError
        If shapes don't match, a value is NaN or infinite, an id occurs twice, ids are both numbers
        and names, the bounds are not in order, or no keypoint is near them.
    """

    model_id: str
    """Unique name of the model."""
    ids: Sequence[KeypointId]
    """(n,) int or str, semantic ids or names of the keypoints."""
    points_3d: FloatArray
    """(n, 3), keypoints [model units]."""
    bounds: FloatArray | None = None
    """(2, 3), least and greatest corner of the bounding box [model units]."""
    mesh_path: Path | None = None
    """Mesh file."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "model_id", check_text(self.model_id, "model_id"))
        where = f"model {self.model_id}"
        points = as_points(self.points_3d, name=f"{where}, points_3d", dimension=3)
        ids = check_ids(self.ids, f"{where}, ids")
        if len(ids) != len(points):
            what = f"{len(ids)} ids for {len(points)} keypoints"
            raise InputError(what, where=f"{where}, ids")
        object.__setattr__(self, "ids", ids)
        object.__setattr__(self, "points_3d", read_only(points))
        if self.bounds is not None:
            bounds = check_box(self.bounds, f"{where}, bounds")
            least, greatest = extent(points)
            gap = np.maximum(least - bounds[1], bounds[0] - greatest).max()
            if gap > _FARTHEST * np.linalg.norm(bounds[1] - bounds[0]):
                what = f"no keypoint lies in the box from {bounds[0].tolist()} to "
                what += str(bounds[1].tolist())
                fix = "give the box in the keypoints' axes and unit"
                raise InputError(what, where=f"{where}, bounds", fix=fix)
            object.__setattr__(self, "bounds", read_only(bounds))
        if self.mesh_path is not None:
            path = as_path(self.mesh_path, f"{where}, mesh_path").absolute()
            require_utf8(path)
            object.__setattr__(self, "mesh_path", path)


class Dataset(Protocol):
    """A data set of annotated models, such as `cadalign.datasets.KeypointNet`."""

    def subset(self, *, categories: Iterable[str] | None, split: str | None) -> Dataset: ...
    def __getitem__(self, key: str, /) -> Any: ...


def examples_of(models: Sequence[Any], *, meshes: bool) -> list[Example]:
    """Convert `cadalign.datasets.AnnotatedModel`s to examples.

    ``meshes`` reads the boxes from the meshes if at least half of the models have one.
    """
    with_mesh = sum(model.mesh_path is not None for model in models)
    measured = meshes and with_mesh > 0 and 2 * with_mesh >= len(models)
    examples = []
    for model in models:
        bounds = None
        if measured and model.mesh_path is not None:
            try:
                bounds = model.load_mesh(check=False).bounds
            except DataError as error:
                logger.warning("the bounding box of a model is unknown: %s", error)
        path = None if model.mesh_path is None else model.mesh_path.absolute()
        ids = [int(label) for label in model.keypoints.ids]
        examples.append(Example(model.model_id, ids, model.keypoints.xyz, bounds, path))
    return examples


def tabulate(
    examples: Sequence[Example], category: str
) -> tuple[tuple[KeypointId, ...], FloatArray, TrainingShapes]:
    """Check training models and stack them; returns ids, rows and training shapes.

    The ids are those of all models, sorted. Rows (N, m + 2, 3) are keypoints and box corners, NaN
    if missing. If fewer than half of the models have bounds, the extents of the keypoints are used.
    For the errors raised see `ShapeModel.learn`.
    """
    for number, each in enumerate(examples):
        fix = "`cadalign shape learn` takes the folder of a data set"
        require_kind(each, Example, f"models[{number}]", fix=fix)
    if len(examples) < LEAST_MODELS:
        what, where = f"{len(examples)} are too few to learn a shape from", f"models of {category}"
        raise InputError(what, where=where, fix=f"give at least {LEAST_MODELS}")
    _check_names(examples)
    _check_shared(examples)
    _warn_of_units(examples)
    ids, points = stack_keypoints(examples)
    _warn_of_axes(examples, points)
    boxes = np.full((len(examples), BOX_ROWS, 3), np.nan)
    measured = 2 * sum(each.bounds is not None for each in examples) >= len(examples)
    for box, each in zip(boxes, examples, strict=True):
        if not measured:
            box[:] = extent(each.points_3d)
        elif each.bounds is not None:
            box[:] = each.bounds
    shapes = TrainingShapes(
        tuple(each.model_id for each in examples),
        points.astype(np.float32),
        tuple(each.mesh_path for each in examples),
    )
    return ids, np.concatenate([points, boxes], axis=1), shapes


def stack_keypoints(examples: Sequence[Example]) -> tuple[tuple[KeypointId, ...], FloatArray]:
    """Return all ids, sorted, and the models' keypoints (N, m, 3), NaN if missing."""
    ids = tuple(sorted({label for each in examples for label in each.ids}))
    column = {label: row for row, label in enumerate(ids)}
    points = np.full((len(examples), len(ids), 3), np.nan)
    for row, each in zip(points, examples, strict=True):
        row[[column[label] for label in each.ids]] = each.points_3d
    return ids, points


def _check_names(examples: Sequence[Example]) -> None:
    words = {int: "numbers", str: "names"}
    first, *_ = kinds = [words[type(each.ids[0])] for each in examples]
    seen: set[str] = set()
    for each, kind in zip(examples, kinds, strict=True):
        if kind != first:
            what = f"keypoint ids are {kind}, but {first} in model {examples[0].model_id}"
            where, fix = f"model {each.model_id}", "use one kind in all models"
            raise InputError(what, where=where, fix=fix)
        if each.model_id in seen:
            raise InputError("occurs twice", where=f"model {quote(each.model_id)}")
        seen.add(each.model_id)
    if not any(np.ptp(each.points_3d, axis=0).any() for each in examples):
        raise InputError("in every model all keypoints coincide", where="models")


def _check_shared(examples: Sequence[Example]) -> None:
    """Refuse groups of models without a common keypoint, whose shapes cannot be compared."""
    groups: list[tuple[Example, set[KeypointId]]] = []
    for each in examples:
        joined = [group for group in groups if not group[1].isdisjoint(each.ids)]
        first = joined[0][0] if joined else each
        groups = [group for group in groups if group[1].isdisjoint(each.ids)]
        groups.append((first, set(each.ids).union(*(ids for _, ids in joined))))
    if len(groups) > 1:
        one, other = (quote(first.model_id) for first, _ in groups[:2])
        what = f"{len(groups)} groups share no keypoint, for example those of {one} and {other}"
        fix = "give the same keypoint the same id in all models"
        raise InputError(what, where="models", fix=fix)


def _warn_of_units(examples: Sequence[Example]) -> None:
    """Warn of models whose size suggests another unit."""
    whole = [each for each in examples if len(each.ids) >= _LEAST_TO_MEASURE]
    sizes = np.array([np.linalg.norm(np.ptp(each.points_3d, axis=0)) for each in whole])
    typical = float(np.median(sizes)) if whole else 0.0
    is_large, is_small = sizes > _LARGEST_RATIO * typical, sizes < typical / _LARGEST_RATIO
    rows = np.flatnonzero((sizes > 0) & (is_large | is_small))
    if typical and len(rows):
        why = f"reach over {sizes[rows[0]]:.3g} instead of {typical:.3g}; give all in one unit"
        _warn("of another size", len(rows), examples, whole[rows[0]], why)


def find_other_axes(rows: FloatArray) -> dict[int, FloatArray]:
    """Find models that fit the others only with exchanged or reversed axes.

    ``rows`` are keypoints (N, m, 3), NaN if missing. Returns the axes (3, 3) that fit, by row.
    """
    count = np.isfinite(rows[..., 0]).sum(axis=1)
    some = np.flatnonzero(count >= _LEAST_TO_TURN)
    if not len(some):
        return {}
    normal = np.array([_unit(each) for each in rows[some]])
    is_seen = np.isfinite(normal[..., 0])
    place = np.full(rows.shape[1:], np.nan)
    place[is_seen.any(axis=0)] = np.nanmedian(normal[:, is_seen.any(axis=0)], axis=0)
    turned: dict[int, FloatArray] = {}
    for row, points, has in zip(some, normal, is_seen, strict=True):
        own, others = points[has], _unit(place[has])
        distances = np.sqrt(((own @ _AXES - others) ** 2).sum(axis=2).mean(axis=1))
        best = int(distances.argmin())
        if distances[0] > _ALIKE and distances[best] < _TURNED_RATIO * distances[0]:
            turned[int(row)] = _AXES[best].T
    return turned


def _warn_of_axes(examples: Sequence[Example], rows: FloatArray) -> None:
    if turned := find_other_axes(rows):
        odd, turn = next(iter(turned.items()))
        axes = [f"{'-' * int(row.sum() < 0)}{'xyz'[int(np.abs(row).argmax())]}" for row in turn]
        why = f"fit with ({', '.join(axes)}) as (x, y, z)"
        why += ", mirrored" if np.linalg.det(turn) < 0 else ""
        why += "; give all the same axes"
        _warn("with other axes", len(turned), examples, examples[odd], why)


def _warn(what: str, count: int, examples: Sequence[Example], odd: Example, why: str) -> None:
    text = "models %s than the others: %d of %d, such as %s, whose keypoints %s"
    logger.warning(text, what, count, len(examples), quote(odd.model_id), why)


def _unit(points: FloatArray) -> FloatArray:
    """Normalise points (n, 3), NaN if missing, to mean 0 and mean squared distance 1."""
    centred = points - np.nanmean(points, axis=0)
    radius = np.sqrt(np.nanmean((centred**2).sum(axis=1)))
    return np.asarray(centred / radius if radius > 0 else centred)
