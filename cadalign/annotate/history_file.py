"""Undo history of an object, kept in the user's state folder so that it survives a restart.

Documents repeat most of each other: the file lists every pair and all else once, and each document
by numbers of these.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
from platformdirs import user_state_path

from cadalign.annotate.document import AnnotationDocument, FurtherView, History, Pair
from cadalign.annotate.evidence import MarkedEvidence
from cadalign.annotate.keypoint_registry import KeypointRegistry
from cadalign.datasets.models.model_keypoints import ModelKeypoint
from cadalign.errors import CadalignError
from cadalign.io.documents import Document, read_document

logger = logging.getLogger("cadalign")

_MOST = 200  # documents that are kept


class _Step(Document):
    """One document: its pairs by their numbers in the file, and the number of its other fields."""

    pairs: list[int]
    next_number: int
    rest: int


class _File(Document):
    pairs: list[Pair]
    rests: list[AnnotationDocument]  # without pairs
    steps: list[_Step]
    before: int
    points: list[ModelKeypoint]


def history_path(observation: Path) -> Path:
    """File of the history of an observation."""
    mark = hashlib.sha256(str(observation.resolve()).encode()).hexdigest()[:32]
    return user_state_path("cadalign", appauthor=False) / "annotate" / f"{mark}.json"


def write_history(path: Path, history: History, registry: KeypointRegistry) -> None:
    """Write the last documents; a failure is logged, since nothing of the annotation is lost."""
    before, after = history.before[-_MOST:], history.after[-_MOST:]
    pairs: dict[Pair, int] = {}
    rests: dict[AnnotationDocument, int] = {}
    steps = []
    for document in (*before, history.document, *reversed(after)):
        rest = rests.setdefault(replace(document, pairs=(), next_number=1), len(rests))
        numbers = [pairs.setdefault(pair, len(pairs)) for pair in document.pairs]
        steps.append(_Step(numbers, document.next_number, rest))
    views = [view.document for rest in rests for view in rest.further_views]
    all_pairs = [*pairs, *(pair for view in views for pair in view.pairs)]
    keypoints = {pair.keypoint for pair in all_pairs if pair.keypoint is not None}
    points = [registry[keypoint] for keypoint in sorted(keypoints)]
    data = msgspec.json.encode(_File(list(pairs), list(rests), steps, len(before), points))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Replaced as a whole, but not forced to the disk, which every click would wait for.
        unfinished = path.with_suffix(".unfinished")
        unfinished.write_bytes(data)
        unfinished.replace(path)
    except OSError as error:
        logger.debug("the undo history is not kept: %s", error)


def read_history(
    path: Path,
    document: AnnotationDocument,
    registry: KeypointRegistry,
    *,
    tolerance: float,
    same_evidence: Callable[[MarkedEvidence, str | None], bool],
) -> History:
    """The history that led to a document; an empty one if there is none of that document.

    Model points of undone pairs are added to the registry. ``tolerance`` is the largest distance of
    two points that count as one [model units]. Evidence is taken from the history where it is the
    ``same_evidence`` as the document's, or as that of the further photo which is named.
    """
    try:
        return _read(path, document, registry, tolerance, same_evidence)
    except (OSError, CadalignError, msgspec.ValidationError, LookupError):
        return History(document)


def _read(
    path: Path,
    document: AnnotationDocument,
    registry: KeypointRegistry,
    tolerance: float,
    same_evidence: Callable[[MarkedEvidence, str | None], bool],
) -> History:
    file = read_document(path, _File)
    documents = [
        replace(
            file.rests[step.rest],
            pairs=tuple(file.pairs[number] for number in step.pairs),
            next_number=step.next_number,
        )
        for step in file.steps
    ]
    places = _places_of(document, documents, near=file.before)
    known = [place for place in places if same_evidence(documents[place].evidence, None)]
    at = next(iter(known + places), None)
    if at is None:
        return History(document)
    current = documents[at]
    for point in file.points:
        number = point.semantic_id or 0
        if number not in registry:
            continue
        if np.linalg.norm(np.subtract(registry[number].xyz, point.xyz)) > tolerance:
            return History(document)
    for point in file.points:
        if point.semantic_id not in registry:
            registry.add(point)
    kept = _kept(current, document, None, same_evidence)
    if not kept.complete_pairs:  # of which the observation tells no priors
        kept = replace(kept, priors=current.priors)
    for view in document.further_views:
        before = current.view(view.photo)
        if before is not None:
            own = _kept(before, view.document, view.photo, same_evidence)
            kept = replace(
                kept,
                further_views=tuple(
                    FurtherView(view.photo, own) if each.photo == view.photo else each
                    for each in kept.further_views
                ),
            )
    return History(kept, before=documents[:at], after=documents[:at:-1])


def _places_of(
    document: AnnotationDocument, documents: Sequence[AnnotationDocument], *, near: int
) -> list[int]:
    """The numbers of documents with the same pairs as another: ``near``, or beside it.

    A process that was killed, or could not save, left the other files one step behind.
    """
    return [
        number
        for number in (near, near - 1, near + 1)
        if 0 <= number < len(documents) and _agree(documents[number], document)
    ]


def _kept(
    current: AnnotationDocument,
    document: AnnotationDocument,
    photo: str | None,
    same_evidence: Callable[[MarkedEvidence, str | None], bool],
) -> AnnotationDocument:
    """The document of one photo with the numbers, and with what was drawn, of the history."""
    kept = replace(document, pairs=current.pairs, next_number=current.next_number)
    if same_evidence(current.evidence, photo):
        return replace(kept, evidence=current.evidence)
    return kept


def _agree(one: AnnotationDocument, other: AnnotationDocument) -> bool:
    """True if two documents have the same pairs, whatever their order and numbers."""

    def content(document: AnnotationDocument) -> list[str]:
        return sorted(repr(replace(pair, number=0)) for pair in document.pairs)

    views = {view.photo: view.document for view in one.further_views}
    if content(one) != content(other) or len(views) != len(other.further_views):
        return False
    return all(
        view.photo in views and content(views[view.photo]) == content(view.document)
        for view in other.further_views
    )
