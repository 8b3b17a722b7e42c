"""The CAD models of a session and their keypoints: given, clicked on, proposed by a detector."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cadalign.annotate.library import ModelChoice
from cadalign.annotate.lines import Wireframe
from cadalign.annotate.model import ClickableModel
from cadalign.annotate.names import keypoints_file
from cadalign.annotate.object_shape import ObjectShape
from cadalign.annotate.photos import PhotoFile
from cadalign.arrays import FloatArray
from cadalign.datasets.detections.image_keypoints import ImageKeypoints
from cadalign.datasets.detections.keypoint_files import read_image_keypoints
from cadalign.datasets.models.model_keypoints import ModelKeypoint, ModelKeypoints
from cadalign.errors import DataError, InputError
from cadalign.io.meshes.load import load_mesh

SAME_PLACE = 1e-6
"""Largest distance of two points that count as one [diagonals]."""
_LONGEST_NAME = 80


class KeypointRegistry:
    """Keypoints by semantic id; points can be added and renamed, but not moved or removed.

    The attribute ``given`` holds the semantic ids of those given with the model. New points don't
    get ids that are ``reserved``.
    """

    def __init__(
        self, given: Iterable[ModelKeypoint] = (), *, reserved: Iterable[int] = ()
    ) -> None:
        self._points: dict[int, ModelKeypoint] = {}
        self._last_reserved = max(reserved, default=0)
        # Points with an id come first, so that new ids differ from theirs.
        ordered = sorted(given, key=lambda point: point.semantic_id is None)
        self.given = frozenset(self.add(point) for point in ordered)

    def __getitem__(self, semantic_id: int) -> ModelKeypoint:
        try:
            return self._points[semantic_id]
        except KeyError:
            raise InputError(
                f"there is no keypoint {semantic_id}", where="keypoint", fix="reload the page"
            ) from None

    def __iter__(self) -> Iterator[tuple[int, ModelKeypoint]]:
        return iter(self._points.items())

    def __len__(self) -> int:
        return len(self._points)

    def __contains__(self, semantic_id: object) -> bool:
        return semantic_id in self._points

    def xyz(self, ids: Iterable[int]) -> FloatArray:
        """Positions (k, 3) of some keypoints [model units]."""
        return np.array([self[number].xyz for number in ids], dtype=float).reshape(-1, 3)

    def add(self, point: ModelKeypoint) -> int:
        """Add a point and return its semantic id; missing ids and names are assigned."""
        number = point.semantic_id
        if number is None:
            number = 1 + max(self._last_reserved, *self._points, 0)
        name = self._free_name(point.name or f"point {number}")
        self._points[number] = replace(point, semantic_id=number, name=name)
        return number

    def add_as(self, semantic_id: int, point: ModelKeypoint) -> int:
        """Add a point under an id; raises InputError if another has it."""
        if semantic_id in self:
            raise InputError(
                f"the model has its keypoint {semantic_id} already",
                where="label",
                fix="click on that one",
            )
        return self.add(replace(point, semantic_id=semantic_id))

    def merge(self, points: Iterable[ModelKeypoint], *, tolerance: float) -> None:
        """Add points of an earlier session, which then count as given.

        A point with the id and, within the tolerance [model units], the position of a registered
        one renames that one.
        """
        for point in points:
            number = point.semantic_id
            if number is not None and number in self:
                if np.linalg.norm(np.subtract(self[number].xyz, point.xyz)) <= tolerance:
                    del self._points[number]  # or its own name would be taken
                    self.add(point)
                    continue
                point = replace(point, semantic_id=None)
            self.given |= {self.add(point)}

    def find(self, xyz: Iterable[float], *, tolerance: float) -> int | None:
        """Find the id of the keypoint at a position, within the tolerance [model units]."""
        if not self._points:
            return None
        numbers = list(self._points)
        gaps = np.linalg.norm(self.xyz(numbers) - np.array(list(xyz)), axis=1)
        nearest = int(np.argmin(gaps))
        return numbers[nearest] if gaps[nearest] <= tolerance else None

    def rename(self, semantic_id: int, name: str) -> None:
        """Rename a keypoint; raises InputError if the name is empty, too long or taken."""
        name = " ".join(name.split())
        if not name or len(name) > _LONGEST_NAME:
            raise InputError(
                f"the name {name[:_LONGEST_NAME]!r} is empty or too long",
                where="name",
                fix=f"give 1 to {_LONGEST_NAME} characters",
            )
        point = self[semantic_id]
        if name != point.name and name in self._names:
            raise InputError(
                f"another keypoint is called {name!r}", where="name", fix="choose another name"
            )
        self._points[semantic_id] = replace(point, name=name)

    @property
    def _names(self) -> set[str]:
        return {point.name for point in self._points.values()}

    def _free_name(self, name: str) -> str:
        """The name, with a number appended if it is taken."""
        taken, free, number = self._names, name, 2
        while free in taken:
            free, number = f"{name} ({number})", number + 1
        return free


@dataclass(frozen=True)
class Proposal:
    """A keypoint of the model, where a detector or the other frames put it [px], and how sure."""

    keypoint: int
    uv: tuple[float, float]
    score: float | None = None
    sigma: float | None = None  # standard deviation of a prediction [px]


def read_proposals(
    path: Path, photos: Sequence[PhotoFile], registry: KeypointRegistry
) -> list[tuple[Proposal, ...]]:
    """Read COCO's keypoints or a detector's for each photo, by its file name.

    Where a photo has several objects, the surest counts. Keypoints are found by name, else by their
    semantic id; in a file with neither by their order, if there are as many as the model has.

    Raises DataError if no photo or no keypoint of the model is in the file.
    """
    found = read_image_keypoints(path)
    by_photo = []
    for photo in photos:
        names = (photo.path.name, photo.path.stem)
        own = [each for each in found if each.image and Path(each.image).name in names]
        if not own and len(photos) == 1:
            own = found
        own.sort(key=lambda each: -(each.score or 0.0))
        by_photo.append(_proposals(own[0], photo, registry) if own else ())
    if not any(by_photo):
        raise DataError(
            "has no keypoint of the model in any of the photos",
            where=str(path),
            fix="its images and keypoints must be called as the photos and the model's keypoints",
        )
    return by_photo


def _proposals(
    found: ImageKeypoints, photo: PhotoFile, registry: KeypointRegistry
) -> tuple[Proposal, ...]:
    by_name = {point.name: number for number, point in registry}
    count = len(found.points_2d)
    wanted: list[int | None]
    if found.names is not None:
        wanted = [by_name.get(name) for name in found.names]
    elif found.ids is not None:
        wanted = [number if number in registry else None for number in found.ids]
    else:
        numbers = sorted(number for number, _ in registry)
        wanted = list(numbers) if len(numbers) == count else [None] * count
    scores = [None] * count if found.scores is None else found.scores.tolist()
    proposals = []
    for keypoint, (u, v), score in zip(wanted, found.points_2d.tolist(), scores, strict=True):
        inside = -0.5 <= u <= photo.width - 0.5 and -0.5 <= v <= photo.height - 0.5
        if keypoint is not None and inside and score != 0:
            proposals.append(Proposal(keypoint, (u, v), score))
    return tuple(proposals)


@dataclass(eq=False)
class OpenedModel:
    """A model that can be clicked on, its keypoints, and the file they are written to."""

    path: Path
    cad: ClickableModel
    registry: KeypointRegistry
    keypoints_path: Path

    def __post_init__(self) -> None:
        self.wireframe = Wireframe.of_model(self.cad)
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

    Keypoints are written into ``folder``; ``keypoints`` are the first model's, where they are not
    beside it. The ids of a shape's keypoints are reserved; a library gives its models' keypoints.
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
            self._reserved |= choice.ids
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
