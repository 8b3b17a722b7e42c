"""The tasks of the KeypointNet experiment: one for each view of each model."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Protocol

import numpy as np

from cadalign.arrays import IntArray
from cadalign.datasets import AnnotatedModel, KeypointNet
from cadalign.errors import CadalignError, DataError
from cadalign.evaluation.instances.hull import KeypointHull
from cadalign.evaluation.instances.instance import RAYS
from cadalign.evaluation.instances.symmetry import InstanceSymmetry, symmetry_group
from cadalign.evaluation.runs.tables import Row

AUTO = "auto"
"""Rays where there is a mesh, the hull's rule elsewhere."""


@dataclass(frozen=True, eq=False)
class KeypointTask:
    """One view of one model.

    Parameters
    ----------
    hull : KeypointHull
        Keypoints (k, 3), and what views without a mesh need to know of them.
    model : AnnotatedModel, optional
        The model with its mesh; None where it is evaluated on its keypoints alone.
    problem : str
        Reason why the model cannot be evaluated; empty otherwise.
    """

    category: str
    model_id: str
    view: int
    hull: KeypointHull
    semantic_ids: IntArray
    symmetry: InstanceSymmetry
    model: AnnotatedModel | None
    problem: str = ""

    @property
    def names(self) -> Row:
        """The cells that name its rows, but for the method."""
        return {"category": self.category, "model_id": self.model_id, "view": self.view}

    @classmethod
    def of_model(
        cls, dataset: KeypointNet, category: str, model_id: str, *, visibility: str
    ) -> KeypointTask:
        """The first view of a dataset's model; a malformed one gives a task with a problem."""
        try:
            model = dataset[category, model_id]
        except CadalignError as error:
            return cls(
                category=category,
                model_id=model_id,
                view=0,
                hull=KeypointHull(np.empty((0, 3))),
                semantic_ids=np.empty(0, dtype=np.int64),
                symmetry=InstanceSymmetry(np.zeros(3), np.eye(3)[None]),
                model=None,
                problem=str(error),
            )
        return cls(
            category=category,
            model_id=model_id,
            view=0,
            hull=KeypointHull(model.keypoints.xyz),
            semantic_ids=model.keypoints.semantic_ids,
            symmetry=symmetry_group(model.keypoints.xyz, model.symmetries),
            model=_with_mesh(model, visibility),
        )


class TaskOptions(Protocol):
    """Options that say which tasks there are."""

    @property
    def visibility(self) -> str:
        """Rule by which keypoints count as seen."""

    @property
    def views_per_model(self) -> int:
        """Number of views of each model."""

    @property
    def max_models(self) -> int | None:
        """Largest number of models of each category."""


class KeypointTasks(Sequence[KeypointTask]):
    """All views of all models of a dataset in the order of their names, made when asked for."""

    def __init__(self, dataset: KeypointNet, options: TaskOptions) -> None:
        self._dataset, self._visibility = dataset, options.visibility
        self._views = options.views_per_model
        self._keys = [
            key
            for category in dataset.categories
            for key in sorted(dataset.ids(category))[: options.max_models]
        ]
        if not self._keys:
            raise DataError("there are no models to evaluate", where=str(dataset.root))
        self._describe = lru_cache(maxsize=4)(self._describe_model)

    def __len__(self) -> int:
        return len(self._keys) * self._views

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        place, view = divmod(range(len(self))[index], self._views)
        first = self._describe(place)
        return first if view == 0 else replace(first, view=view)

    def fingerprint(self) -> str:
        """Hash of the annotations: a run must not go on with others."""
        digest = hashlib.sha256()
        for category, model_id in self._keys:
            digest.update(f"{category}\0{model_id}\0".encode())
            try:
                model = self._dataset[category, model_id]
            except CadalignError as error:
                digest.update(str(error).encode())
                continue
            digest.update(model.keypoints.xyz.tobytes())
            rotations = [rotation.keypoints for rotation in model.symmetries.rotations]
            digest.update(repr((model.symmetries.reflections, rotations)).encode())
            digest.update(b"mesh" if _with_mesh(model, self._visibility) else b"")
        return digest.hexdigest()[:16]

    def _describe_model(self, place: int) -> KeypointTask:
        return KeypointTask.of_model(self._dataset, *self._keys[place], visibility=self._visibility)


def _with_mesh(model: AnnotatedModel, visibility: str) -> AnnotatedModel | None:
    """The model if its mesh is to be used; `load_scene` says what is wrong where there is none."""
    use_mesh = visibility == RAYS or (visibility == AUTO and model.mesh_path is not None)
    return model if use_mesh else None
