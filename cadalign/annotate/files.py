"""What annotating writes: an observation for each photo, and the model's keypoints.

Beside the observation `photo.json` there may be

- `photo_fit/fit.json`, the alignment as `cadalign fit` finds and writes it,
- `photo.unfinished.json`, pairs of which only one half is placed.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.annotate.document import Document, Pair
from cadalign.annotate.keypoint_book import KeypointBook
from cadalign.arrays import FloatArray
from cadalign.datasets.models.model_keypoints import SUFFIX, ModelKeypoint, ModelKeypoints
from cadalign.errors import DataError, InputError
from cadalign.fitting.result import FitResult
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.io.documents import Document as JsonDocument
from cadalign.io.documents import (
    Index,
    PathText,
    Point2,
    convert,
    in_file,
    path_from,
    read_document,
    read_json,
)
from cadalign.io.files import write_json
from cadalign.io.observation import Observation

_UNFINISHED = "cadalign unfinished pairs"
SAME_PLACE = 1e-6
"""How far apart two points may lie that are one [diagonals]."""


class _Half(JsonDocument):
    """A pair of which one half is placed: the pixel or the keypoint's number."""

    uv: Point2 | None = None
    semantic_id: Index | None = None

    def __post_init__(self) -> None:
        if self.uv is None and self.semantic_id is None:
            raise InputError("neither uv nor semantic_id")


class _Unfinished(JsonDocument):
    """The file of halves of pairs."""

    pairs: list[_Half]
    format: str = ""


@dataclass(frozen=True)
class Sheet:
    """The files of one photo.

    Parameters
    ----------
    observation : Path
        The observation file; it need not exist yet.
    image, model : Path
        What it names.
    """

    observation: Path
    image: Path
    model: Path

    @property
    def unfinished(self) -> Path:
        """Where halves of pairs are kept."""
        return self.observation.with_name(f"{self.observation.stem}.unfinished.json")

    @property
    def fit(self) -> Path:
        """Where the alignment is written, as `cadalign fit` does."""
        return self.observation.with_name(f"{self.observation.stem}_fit") / "fit.json"

    def read(
        self, empty: Document, book: KeypointBook, diagonal: float
    ) -> tuple[Document, Camera | None]:
        """Read what was annotated before.

        Parameters
        ----------
        empty : Document
            What to begin with.
        book : KeypointBook
            Gets the model points that it does not have yet.
        diagonal : float
            Of the model's box [model units].

        Returns
        -------
        Document
        Camera or None
            The file's, if there is a file.

        Raises
        ------
        DataError
            If a file is there but is none of ours, or belongs to another model.
        """
        document, camera = empty, None
        if self.observation.exists():
            observation = self._load()
            camera = observation.camera
            document = _with_pairs(document, observation, book, diagonal)
        if self.unfinished.exists():
            document = _with_halves(document, self.unfinished, book)
        return document, camera

    def write(self, document: Document, book: KeypointBook, camera: Camera) -> None:
        """Write the photo's observation and halves of pairs, each whole or not at all.

        Raises
        ------
        DataError
            If one cannot be written.
        """
        pairs = document.complete_pairs
        keypoints = [pair.keypoint for pair in pairs if pair.keypoint is not None]
        observation = Observation(
            points_3d=book.xyz(keypoints),
            points_2d=np.array([pair.uv for pair in pairs], dtype=float).reshape(-1, 2),
            camera=camera,
            sigma=sigmas_of(pairs),
            semantic_ids=np.array(keypoints, dtype=np.int64),
            names=tuple(book[keypoint].name for keypoint in keypoints),
            confidences=_filled([pair.confidence for pair in pairs]),
            image=self.image,
            model=self.model,
        )
        observation.save(self.observation)
        halves = [pair for pair in document.pairs if not pair.complete]
        if halves:
            write_json(self.unfinished, _written(halves))
        else:
            self.unfinished.unlink(missing_ok=True)

    def write_fit(self, result: FitResult | None) -> None:
        """Write the alignment; where there is none, take away its file.

        Raises
        ------
        DataError
            If it cannot be written.
        """
        if result is None:
            self.fit.unlink(missing_ok=True)
            return
        try:
            self.fit.parent.mkdir(exist_ok=True)
        except OSError as error:
            raise DataError(f"cannot be made ({error.strerror})", where=str(self.fit)) from None
        write_json(self.fit, result.to_dict())

    def _load(self) -> Observation:
        data = read_json(self.observation)
        if isinstance(data, dict) and data.get("keypoints") == [] and "camera" in data:
            # All pairs were deleted; the camera is kept.
            with in_file(self.observation):
                camera = Camera.from_dict(data["camera"])
                named: str | None = convert(data.get("model"), PathText | None, where="model")
            if named is not None:  # the halves of pairs are that model's
                path = path_from(named, self.observation.parent)
                refuse_other_model(path, self.model, where=self.observation)
            return Observation(np.empty((0, 3)), np.empty((0, 2)), camera)
        observation = Observation.load(self.observation)
        refuse_other_model(observation.model, self.model, where=self.observation)
        return observation


def sigmas_of(pairs: Iterable[Pair]) -> FloatArray | None:
    """Standard deviations (n,) of complete pairs, if any has one: 1 px for the others."""
    return _filled([pair.sigma for pair in pairs])


def refuse_other_model(named: Path | None, model: Path, *, where: Path) -> None:
    """Refuse a file that names another model than the one that is annotated.

    Raises
    ------
    DataError
        If it does. A file that names none may be of any model.
    """
    if named is None or named.resolve() == model.resolve():
        return
    # Whole datasets call every mesh the same; only the folders tell these apart.
    same = named.name == model.name
    other, ours = (named.resolve(), model.resolve()) if same else (named.name, model.name)
    raise DataError(
        f"belongs to the model {other}, not {ours}",
        where=str(where),
        fix="give another --observation or --out",
    )


def read_own_keypoints(path: Path, model: Path, mesh: Mesh) -> tuple[ModelKeypoint, ...]:
    """Read the keypoints that an earlier session wrote, or that lie where it would write them.

    Raises
    ------
    DataError
        If they are another model's, or for the reasons of `read_given_keypoints`.
    """
    if isinstance(read_json(path), dict):
        own = ModelKeypoints.load(path, mesh=mesh)
        refuse_other_model(own.model, model, where=path)
        return own.keypoints
    return read_given_keypoints(path, model, mesh)


def read_given_keypoints(path: Path, model: Path, mesh: Mesh) -> tuple[ModelKeypoint, ...]:
    """Read the keypoints that come with a model.

    Parameters
    ----------
    path : Path
        A file of model keypoints, or KeypointNet's annotations of the model's category: of these
        the model's are taken, whose id occurs in its file's path.
    model : Path
        The mesh file.
    mesh : Mesh

    Raises
    ------
    DataError
        If it is neither, or has no keypoints of this model.
    """
    return ModelKeypoints.load(path, mesh=mesh, model=model).keypoints


def keypoints_file(model: Path, folder: Path) -> Path:
    """Where the keypoints of a model are written in a folder."""
    return folder / f"{model.stem}{SUFFIX}"


def write_keypoints(path: Path, book: KeypointBook, used: frozenset[int], model: Path) -> None:
    """Write the model's keypoints: those that were given, and those in use.

    Raises
    ------
    DataError
        If the file cannot be written.
    """
    kept = tuple(point for number, point in book if number in book.given or number in used)
    ModelKeypoints(kept, model).save(path)


def _filled(values: list[float | None]) -> FloatArray | None:
    """The values, 1 where one is missing; None where all are."""
    if all(value is None for value in values):
        return None
    return np.array([1.0 if value is None else value for value in values])


def _with_pairs(
    document: Document, observation: Observation, book: KeypointBook, diagonal: float
) -> Document:
    for row, (xyz, uv) in enumerate(
        zip(observation.points_3d.tolist(), observation.points_2d.tolist(), strict=True)
    ):
        x, y, z = xyz
        ids, names = observation.semantic_ids, observation.names
        point = ModelKeypoint(
            name="" if names is None else names[row],
            xyz=(x, y, z),
            semantic_id=None if ids is None else int(ids[row]),
        )
        keypoint = _keypoint_of(point, book, SAME_PLACE * diagonal, document.keypoints)
        pair = Pair(
            document.next_number,
            uv=(uv[0], uv[1]),
            keypoint=keypoint,
            sigma=_entry(observation.sigma, row),
            confidence=_entry(observation.confidences, row),
        )
        document = replace(
            document, pairs=(*document.pairs, pair), next_number=document.next_number + 1
        )
    return document


def _entry(values: FloatArray | None, row: int) -> float | None:
    return None if values is None else float(values[row])


def _keypoint_of(
    point: ModelKeypoint, book: KeypointBook, tolerance: float, taken: frozenset[int]
) -> int:
    """The keypoint that a pair of an observation file means; added where the book has none."""
    wanted = point.semantic_id
    if wanted is not None and wanted in book and wanted not in taken:
        gap = np.linalg.norm(np.subtract(book[wanted].xyz, point.xyz))
        if gap <= tolerance:
            return wanted
    found = book.find(point.xyz, tolerance=tolerance)
    if found is not None and found not in taken:
        return found
    free = wanted is not None and wanted >= 0 and wanted not in book
    return book.add(point if free else replace(point, semantic_id=None))


def _with_halves(document: Document, path: Path, book: KeypointBook) -> Document:
    data = read_document(path, _Unfinished)
    if data.format != _UNFINISHED:
        raise DataError(
            f"not a file of {_UNFINISHED}", where=str(path), fix="delete it to go on without"
        )
    for half in data.pairs:
        pair = Pair(document.next_number, uv=half.uv)
        if half.uv is None:
            if half.semantic_id not in book or half.semantic_id in document.keypoints:
                continue  # its other half was saved, or the file of keypoints is gone
            pair = replace(pair, keypoint=half.semantic_id)
        document = replace(
            document, pairs=(*document.pairs, pair), next_number=document.next_number + 1
        )
    return document


def _written(halves: list[Pair]) -> dict[str, Any]:
    entries: list[dict[str, Any]] = [
        {"semantic_id": pair.keypoint} if pair.uv is None else {"uv": list(pair.uv)}
        for pair in halves
    ]
    return {"format": _UNFINISHED, "pairs": entries}
