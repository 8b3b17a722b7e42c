"""The CAD models of a session, each with its keypoints."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

from cadalign.annotate.keypoint_registry import KeypointRegistry
from cadalign.annotate.model import ClickableModel
from cadalign.annotate.wireframe import Wireframe
from cadalign.datasets.models.model_keypoints import ModelKeypoint
from cadalign.errors import InputError


class OpenedModel:
    """A model that can be clicked on, its keypoints, and the file they are written to.

    Parameters
    ----------
    path : Path
        Of the mesh.
    cad : ClickableModel
    registry : KeypointRegistry
    keypoints_path : Path
    """

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


class Models:
    """The models that objects can have, by number; each is opened when it is first needed.

    Parameters
    ----------
    paths : sequence of Path
        The first one, and further ones.
    opened : callable
        Opens the model of a path; it gets the models that are open already.
    """

    def __init__(
        self,
        paths: Sequence[Path],
        opened: Callable[[Path, Sequence[OpenedModel]], OpenedModel],
    ) -> None:
        self.paths: list[Path] = []
        self._open = opened
        self._models: dict[int, OpenedModel] = {}
        for path in paths:
            self.number_of(path)

    def __getitem__(self, number: int) -> OpenedModel:
        if not 0 <= number < len(self.paths):
            raise InputError(
                f"there is no model {number}", where="model", fix="choose one of the list"
            )
        if number not in self._models:
            self._models[number] = self._open(self.paths[number], self.opened)
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


def _told_apart(path: Path, paths: Sequence[Path]) -> str:
    parts = path.resolve().parts
    others = [other.resolve().parts for other in paths if other is not path]
    for count in range(1, len(parts)):
        if all(parts[-count:] != other[-count:] for other in others):
            return os.path.join(*parts[-count:])
    return path.name
