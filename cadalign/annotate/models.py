"""The CAD model of a session, the shape of its objects, and their keypoints."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cadalign.annotate.lines import Wireframe
from cadalign.annotate.model import ClickableModel
from cadalign.annotate.names import LastContent, keypoints_file
from cadalign.annotate.options import SessionOptions
from cadalign.arrays import BoolArray, FloatArray
from cadalign.datasets.models.model_keypoints import ModelKeypoint, ModelKeypoints
from cadalign.errors import DataError, InputError
from cadalign.estimation.model import Model
from cadalign.geometry.mesh import Mesh
from cadalign.io.files import require_utf8
from cadalign.io.meshes.files import load_mesh
from cadalign.shapes.model import ShapeModel
from cadalign.shapes.parts import KeypointId

if TYPE_CHECKING:
    from cadalign.annotate.document import Pair

logger = logging.getLogger("cadalign")

_SAME_PLACE = 1e-6  # largest distance of two points that count as one [diagonals]
_LONGEST_NAME = 80


class KeypointRegistry:
    """Keypoints by semantic id; points can be added and renamed, but not moved or removed.

    The attribute ``given`` holds the semantic ids of those given with the model. New points don't
    get ids that are ``reserved``. Points at most ``tolerance`` apart count as one [model units].
    """

    def __init__(
        self,
        given: Iterable[ModelKeypoint] = (),
        *,
        reserved: Iterable[int] = (),
        tolerance: float = 0.0,
    ) -> None:
        self._tolerance = tolerance
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

    def merge(self, points: Iterable[ModelKeypoint]) -> None:
        """Add points of an earlier session, which then count as given.

        A point with the id and the position of a registered one renames that one.
        """
        for point in points:
            number = point.semantic_id
            if number is not None and number in self:
                if self.has(point):
                    del self._points[number]  # or its own name would be taken
                    self.add(point)
                    continue
                point = replace(point, semantic_id=None)
            self.given |= {self.add(point)}

    def has(self, point: ModelKeypoint) -> bool:
        """True if the keypoint of the point's id lies where the point does."""
        own = None if point.semantic_id is None else self._points.get(point.semantic_id)
        return own is not None and bool(
            np.linalg.norm(np.subtract(own.xyz, point.xyz)) <= self._tolerance
        )

    def placed(self, point: ModelKeypoint, *, tolerance: float | None = None) -> int:
        """The id of the keypoint at a point, which is added if there is none."""
        known = self.find(point.xyz, tolerance=tolerance)
        return self.add(point) if known is None else known

    def find(self, xyz: Iterable[float], *, tolerance: float | None = None) -> int | None:
        """Find the id of the nearest keypoint within the tolerance, by default the registry's."""
        if not self._points:
            return None
        tolerance = self._tolerance if tolerance is None else tolerance
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
        taken, free, number = self._names, name, 2
        while free in taken:
            free, number = f"{name} ({number})", number + 1
        return free


@dataclass(frozen=True, eq=False)
class ObjectShape:
    """Objects' shape: a category's learned one with its file, a similar model's, or the model's.

    ``sigma`` is the ``shape_sigma`` of `cadalign.Model`, for a similar one.
    """

    learned: ShapeModel | None = None
    path: Path | None = None
    sigma: float | None = None

    @classmethod
    def open(cls, options: SessionOptions) -> ObjectShape:
        """Read the shape that the options name. Raises a CadalignError."""
        path, sigma = options.shape, options.shape_sigma
        if path is not None and sigma is not None:
            raise InputError(
                "--shape has learned how far objects of the category differ",
                where="--shape-sigma",
                fix="give one of the two options",
            )
        if path is not None:
            return cls(ShapeModel.open(path), path)
        if sigma is not None and not 0 < sigma < np.inf:
            raise InputError(
                f"{sigma:g} is not a standard deviation",
                where="--shape-sigma",
                fix="give a positive number",
            )
        return cls(sigma=sigma)

    @property
    def is_estimated(self) -> bool:
        """True if objects have a shape of their own, not that of the stretched model."""
        return self.learned is not None or self.sigma is not None

    @property
    def ids(self) -> tuple[KeypointId, ...]:
        """Ids or names of the learned keypoints; empty for a similar model."""
        return () if self.learned is None else self.learned.ids

    @property
    def reserved(self) -> tuple[int, ...]:
        """Semantic ids that points placed on the model must not get by chance."""
        return tuple(label for label in self.ids if isinstance(label, int))

    @property
    def is_named(self) -> bool:
        """True if the learned keypoints are known by their names."""
        return bool(self.ids) and isinstance(self.ids[0], str)

    @property
    def average(self) -> str:
        """The noun that the object is compared with in a sentence."""
        return "the model" if self.learned is None else f"the average {self.learned.category}"

    @property
    def has_mesh(self) -> bool:
        """True if masks say something of the shape; a similar model has its mesh."""
        if self.learned is None:
            return True
        training = self.learned.training
        return training is not None and bool(training.rows_with_mesh)

    def id_of(self, point: ModelKeypoint) -> KeypointId | None:
        """The id of a model's point in the estimate; None for one that was not learned."""
        if self.learned is None:
            return point.semantic_id
        label: KeypointId | None = point.name if self.is_named else point.semantic_id
        return label if label in self.ids else None

    def known(self, points: Sequence[ModelKeypoint]) -> BoolArray:
        """The points (n,) of which pairs count."""
        return np.array([self.id_of(point) is not None for point in points], dtype=bool)

    def model_with(
        self, points: Iterable[ModelKeypoint], mesh: Mesh, *, up_axis: str | None = "y"
    ) -> Model | ShapeModel:
        """The model to align, similar to these points.

        Those that no pair shows do not change the estimate: it is that of `cadalign fit`.
        """
        if self.learned is not None:
            return self.learned
        known = list(points)
        return Model(
            points_3d=[point.xyz for point in known],
            ids=[point.semantic_id for point in known],
            mesh=mesh,
            shape_sigma=self.sigma,
            up_axis=up_axis,
        )

    def length_sigmas(self, model: Model | ShapeModel) -> FloatArray:
        """Standard deviations (3,) of the logarithms of the box's lengths before any pair."""
        if isinstance(model, ShapeModel):
            lengths = np.ptp(model.mean[-2:], axis=0)
            squares = np.zeros(3)
            for part in model.components:
                mode = part.modes[:, -1] - part.modes[:, -2]
                own = (mode**2).sum(axis=0) + 2 * part.residual_sigma**2
                squares += part.weight * (own + (np.ptp(part.mean[-2:], axis=0) - lengths) ** 2)
        else:
            lengths = np.ptp(np.asarray(model.bounds), axis=0)
            options = model.fit_options()
            free = np.isin(list("xyz"), list(options.stretched_axes))
            prior = options.stretch_sigma or 0.0
            squares = 2 * float(self.sigma or 0.0) ** 2 + np.where(free, prior * lengths, 0.0) ** 2
        safe = np.where(lengths > 0, lengths, np.inf)
        return np.asarray(np.sqrt(squares) / safe)


@dataclass(eq=False)
class OpenedModel:
    """A model that can be clicked on, its keypoints, and the file they are written to."""

    path: Path
    cad: ClickableModel
    registry: KeypointRegistry
    keypoints_path: Path
    content: LastContent  # of that file

    def __post_init__(self) -> None:
        self.wireframe = Wireframe.of_model(self.cad)

    def points_of(self, pairs: Iterable[Pair]) -> list[ModelKeypoint]:
        """The model points of pairs that have one."""
        return [self.registry[pair.keypoint] for pair in pairs if pair.keypoint is not None]

    def prepare(self) -> None:
        """Compute what takes seconds on millions of faces, which the first click would wait for."""
        _ = self.cad.scene.caster, self.cad.snap_points

    def write_keypoints(self, used: frozenset[int]) -> None:
        """Write the given keypoints and those in use; raises DataError on failure."""
        registry = self.registry
        self.content.refuse_changed(self.keypoints_path)
        kept = (point for number, point in registry if number in registry.given | used)
        ModelKeypoints(tuple(kept), self.path).save(self.keypoints_path)
        self.content.note(self.keypoints_path)


def open_model(
    path: Path, folder: Path, *, keypoints: Path | None = None, shape: ObjectShape
) -> OpenedModel:
    """Open a model, whose keypoints are written into a folder.

    ``keypoints`` are those given with it, where they are not beside it. New ones don't get the ids
    of the shape's.
    """
    require_utf8(path)
    cad = ClickableModel(load_mesh(path))
    own, beside = keypoints_file(path, folder), keypoints_file(path, path.parent)
    source = keypoints or beside
    given: tuple[ModelKeypoint, ...] = ()
    if source != own and (source != beside or source.exists()):
        given = ModelKeypoints.load(source, model=path).keypoints
    content = LastContent()
    content.note(own)
    tolerance = _SAME_PLACE * cad.diagonal
    registry = KeypointRegistry(given, reserved=shape.reserved, tolerance=tolerance)
    if own.exists():
        earlier = ModelKeypoints.load(own, model=path)
        refuse_other_model(earlier.model, path, where=own)
        registry.merge(earlier.keypoints)
    return OpenedModel(path, cad, registry, own, content)


def refuse_other_model(named: Path | None, model: Path, *, where: Path) -> None:
    """Refuse a file that names another model than the annotated one; raises DataError.

    One that is gone is taken for this one, which was renamed or moved, with a warning.
    """
    if named is None or named.resolve() == model.resolve():
        return
    if not named.exists():
        logger.warning("%s: its model %s is gone: %s takes its place", where, named, model)
        return
    # In some datasets all meshes have the same file name and differ by their folders.
    same = named.name == model.name
    other, ours = (named.resolve(), model.resolve()) if same else (named.name, model.name)
    raise DataError(
        f"belongs to the model {other}, not {ours}",
        where=str(where),
        fix="give another --observation or --out",
    )
