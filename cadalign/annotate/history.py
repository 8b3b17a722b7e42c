"""Undo history of an object, kept in the user's state folder so that it survives a restart.

Documents repeat most of each other: the file lists every pair and all else once, and each document
by numbers of these.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec
import numpy as np
from platformdirs import user_state_path

from cadalign.annotate.document import AnnotationDocument, FurtherView, Pair
from cadalign.annotate.evidence import MarkedEvidence
from cadalign.annotate.models import KeypointRegistry
from cadalign.datasets.models.model_keypoints import ModelKeypoint
from cadalign.errors import CadalignError
from cadalign.io.documents import Document, read_document

logger = logging.getLogger("cadalign")

SameEvidence = Callable[[MarkedEvidence, str | None], bool]
"""True if marks equal those of the document's photo, or of the further photo which is named."""
_LONGEST = 1000  # documents in memory
_MOST = 200  # documents in the file, on each side of the current one


@dataclass(eq=False)
class History:
    """Documents of an object: the current one, earlier ones, and undone ones."""

    document: AnnotationDocument
    before: list[AnnotationDocument] = field(default_factory=list)  # for undo, the next one last
    after: list[AnnotationDocument] = field(default_factory=list)  # for redo, the next one last
    revision: int = 0  # grows with every change, those by undo and redo included
    _step: object = None

    def record(self, document: AnnotationDocument, *, step: object = None) -> None:
        """Go on to another document.

        Consecutive changes with the same ``step`` are undone together, such as the positions of a
        point while it is dragged.
        """
        if step is None or step != self._step or not self.before:
            self.before.append(self.document)
            del self.before[:-_LONGEST]
        self.after.clear()
        self.document = document
        self.revision += 1
        self._step = step

    def undo(self) -> bool:
        """Go back by one change; returns False if there is none."""
        return self._go(self.before, self.after)

    def redo(self) -> bool:
        """Redo the last undone change; returns False if there is none."""
        return self._go(self.after, self.before)

    def changed(self, change: Callable[[AnnotationDocument], AnnotationDocument]) -> History:
        """The history with a change made to each of its documents."""
        before, after = ([change(each) for each in side] for side in (self.before, self.after))
        return History(change(self.document), before, after, self.revision + 1)

    def _go(self, source: list[AnnotationDocument], target: list[AnnotationDocument]) -> bool:
        self._step = None
        if not source:
            return False
        target.append(self.document)
        self.document = source.pop()
        self.revision += 1
        return True


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

    def documents(self) -> list[AnnotationDocument]:
        return [
            replace(
                self.rests[step.rest],
                pairs=tuple(self.pairs[number] for number in step.pairs),
                next_number=step.next_number,
            )
            for step in self.steps
        ]


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
    of_views = [
        pair for rest in rests for view in rest.further_views for pair in view.document.pairs
    ]
    keypoints = {pair.keypoint for pair in (*pairs, *of_views) if pair.keypoint is not None}
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
    same_evidence: SameEvidence,
) -> History:
    """The history that led to a document; an empty one if there is none of that document.

    Model points of undone pairs are added to the registry. ``tolerance`` is the largest distance of
    two points that count as one [model units]. Marks with all their strokes and edges are taken
    from the history where they are the same as the document's.
    """
    try:
        file = read_document(path, _File)
        documents = file.documents()
        at = _find(document, documents, file.before, same_evidence)
    except (OSError, CadalignError, msgspec.ValidationError, LookupError):
        return History(document)
    if at is None or not _add_points(file.points, registry, tolerance):
        return History(document)
    kept = _with_marks(documents[at], document, same_evidence)
    return History(kept, before=documents[:at], after=documents[:at:-1])


def _find(
    document: AnnotationDocument,
    documents: Sequence[AnnotationDocument],
    near: int,
    same_evidence: SameEvidence,
) -> int | None:
    """The number of the document with the same pairs and, if possible, the same marks.

    A process that was killed, or could not save, left the observation one step behind.
    """
    places = [
        number
        for number in (near, near - 1, near + 1)
        if 0 <= number < len(documents) and _agree(documents[number], document)
    ]
    same = [number for number in places if same_evidence(documents[number].evidence, None)]
    return next(iter(same + places), None)


def _add_points(
    points: Sequence[ModelKeypoint], registry: KeypointRegistry, tolerance: float
) -> bool:
    """Register model points; False, and none is, if one lies elsewhere than that of its id."""
    known = [point for point in points if (point.semantic_id or 0) in registry]
    for point in known:
        own = registry[point.semantic_id or 0]
        if np.linalg.norm(np.subtract(own.xyz, point.xyz)) > tolerance:
            return False
    for point in points:
        if point.semantic_id not in registry:
            registry.add(point)
    return True


def _with_marks(
    current: AnnotationDocument, document: AnnotationDocument, same_evidence: SameEvidence
) -> AnnotationDocument:
    """A document with pair numbers and drawings of the history's."""

    def kept(
        one: AnnotationDocument, other: AnnotationDocument, photo: str | None
    ) -> AnnotationDocument:
        evidence = one.evidence if same_evidence(one.evidence, photo) else other.evidence
        return replace(other, pairs=one.pairs, next_number=one.next_number, evidence=evidence)

    views = []
    for view in document.further_views:
        before = current.view(view.photo)
        own = view.document if before is None else kept(before, view.document, view.photo)
        views.append(FurtherView(view.photo, own))
    whole = replace(kept(current, document, None), further_views=tuple(views))
    # Without complete pairs the observation says nothing of priors.
    return whole if whole.complete_pairs else replace(whole, priors=current.priors)


def _agree(one: AnnotationDocument, other: AnnotationDocument) -> bool:
    """True if two documents have the same pairs, whatever their order and numbers."""

    def content(document: AnnotationDocument) -> list[str]:
        return sorted(repr(replace(pair, number=0)) for pair in document.pairs)

    views = {view.photo: content(view.document) for view in one.further_views}
    others = {view.photo: content(view.document) for view in other.further_views}
    return content(one) == content(other) and views == others
