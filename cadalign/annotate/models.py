"""The CAD models of a session, each with its keypoints."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from cadalign.annotate.keypoints import KeypointRegistry
from cadalign.annotate.library import ModelChoice
from cadalign.annotate.model import ClickableModel
from cadalign.annotate.names import keypoints_file
from cadalign.annotate.object_shape import ObjectShape
from cadalign.annotate.wireframe import Wireframe
from cadalign.datasets.models.model_keypoints import ModelKeypoint, ModelKeypoints
from cadalign.errors import DataError, InputError
from cadalign.io.meshes.load import load_mesh

SAME_PLACE = 1e-6
"""Largest distance of two points that count as one [diagonals]."""


class OpenedModel:
    """A model that can be clicked on, its keypoints, and the file they are written to."""

    def __init__(
        self, path: Path, cad: ClickableModel, registry: KeypointRegistry, keypoints_path: Path
    ) -> None:
        self.path = path
        self.cad = cad
        self.registry = registry
        self.keypoints_path = keypoints_path
        self.wireframe = Wireframe.of_model(cad)
        self._mirrored: dict[int, ModelKeypoint | None] = {}

    def mirrored(self, keypoint: int) -> ModelKeypoint | None:
        """The mirror image of a keypoint; found once, since keypoints don't move."""
        if keypoint not in self._mirrored:
            self._mirrored[keypoint] = self.cad.mirrored(self.registry[keypoint].xyz)
        return self._mirrored[keypoint]

    def prepare(self, *, has_shape: bool) -> None:
        """Compute what takes seconds on millions of faces, which the first click would wait for."""
        _ = self.cad.scene.caster, self.cad.samples
        _ = self.cad.snap_points, self.cad.mirror_planes
        if not has_shape:
            _ = self.cad.light_scene.caster

    def write_keypoints(self, used: frozenset[int]) -> None:
        """Write the given keypoints and those in use; raises DataError on failure."""
        registry = self.registry
        kept = (point for number, point in registry if number in registry.given | used)
        ModelKeypoints(tuple(kept), self.path).save(self.keypoints_path)


class Models:
    """The models that objects can have, by number; each is opened when it is first needed.

    Parameters
    ----------
    paths : sequence of Path
        The first one, and further ones.
    folder : Path
        Where the keypoints are written.
    keypoints : Path, optional
        The first model's keypoints, where they are not beside it.
    shape : ObjectShape, optional
        Of which the keypoints' ids are reserved.
    choice : ModelChoice, optional
        A library, whose models' keypoints are given by it.
    """

    def __init__(
        self,
        paths: Sequence[Path],
        folder: Path,
        *,
        keypoints: Path | None = None,
        shape: ObjectShape | None = None,
        choice: ModelChoice | None = None,
    ) -> None:
        self.paths: list[Path] = []
        self._folder = folder
        self._keypoints = keypoints
        self._choice = choice
        self._reserved = frozenset(() if shape is None else shape.reserved)
        if choice is not None:
            self._reserved |= choice.semantic_ids
        self._models: dict[int, OpenedModel] = {}
        for path in paths:
            self.number_of(path)

    def __getitem__(self, number: int) -> OpenedModel:
        if not 0 <= number < len(self.paths):
            raise InputError(
                f"there is no model {number}", where="model", fix="choose one of the list"
            )
        if number not in self._models:
            self._models[number] = self._open(self.paths[number])
        return self._models[number]

    def __len__(self) -> int:
        return len(self.paths)

    @property
    def opened(self) -> tuple[OpenedModel, ...]:
        """The models that are open."""
        return tuple(self._models.values())

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the models' files, with as much of their folders as tells them apart."""
        return tuple(_told_apart(path, self.paths) for path in self.paths)

    def number_of(self, path: Path) -> int:
        """The number of the model of a file, which is added if it is not among them."""
        wanted = path.resolve()
        for number, known in enumerate(self.paths):
            if known.resolve() == wanted:
                return number
        self.paths.append(path)
        return len(self.paths) - 1

    def of(self, path: Path) -> OpenedModel:
        """The model of a file, opened."""
        return self[self.number_of(path)]

    def _open(self, path: Path) -> OpenedModel:
        """Read a model, its given keypoints, and those of earlier sessions."""
        cad = ClickableModel(load_mesh(path))
        own, beside = self._keypoints_path(path), keypoints_file(path, path.parent)
        source = beside if self._models or self._keypoints is None else self._keypoints
        mesh = cad.scene.mesh
        given = () if self._choice is None else self._choice.keypoints_of(path)
        if source != own and (source != beside or source.exists()):
            given = ModelKeypoints.load(source, mesh=mesh, model=path).keypoints
        registry = KeypointRegistry(given, reserved=self._reserved)
        if own.exists():
            earlier = ModelKeypoints.load(own, mesh=mesh, model=path)
            refuse_other_model(earlier.model, path, where=own)
            registry.merge(earlier.keypoints, tolerance=SAME_PLACE * cad.diagonal)
        return OpenedModel(path, cad, registry, own)

    def _keypoints_path(self, path: Path) -> Path:
        """The model's file of keypoints; with folders in its name where another model has it."""
        if not self._models and self._choice is None:
            return keypoints_file(path, self._folder)
        taken = {model.keypoints_path for model in self.opened}
        candidates = [
            keypoints_file(path, self._folder, parents=count)
            for count in range(len(path.resolve().parts) - 1)
        ]
        free = (each for each in candidates if each not in taken and not _is_others(each, path))
        return next(free, candidates[-1])


def refuse_other_model(named: Path | None, model: Path, *, where: Path) -> None:
    """Refuse a file that names another model than the annotated one; raises DataError."""
    if named is None or named.resolve() == model.resolve():
        return
    # In some datasets all meshes have the same file name and differ by their folders.
    same = named.name == model.name
    other, ours = (named.resolve(), model.resolve()) if same else (named.name, model.name)
    raise DataError(
        f"belongs to the model {other}, not {ours}",
        where=str(where),
        fix="give another --observation or --out",
    )


def _is_others(path: Path, model: Path) -> bool:
    """True for a keypoints file of another model."""
    if not path.exists():
        return False
    named = ModelKeypoints.load(path).model
    return named is not None and named.resolve() != model.resolve()


def _told_apart(path: Path, paths: Sequence[Path]) -> str:
    parts = path.resolve().parts
    others = [other.resolve().parts for other in paths if other is not path]
    for count in range(1, len(parts)):
        if all(parts[-count:] != other[-count:] for other in others):
            return os.path.join(*parts[-count:])
    return path.name
