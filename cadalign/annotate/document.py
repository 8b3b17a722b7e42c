"""Annotation document of one object, and the history of its documents.

The document of the object's first photo holds those of its further photos. Documents are immutable;
every edit makes a new one, which the history keeps for undo and redo, also in the user's state
folder, so that it survives a restart. There documents repeat most of each other: the file lists
every pair and all else once, and each document by numbers of these.
"""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec
from platformdirs import user_state_path

from cadalign.annotate.evidence import MarkedEvidence
from cadalign.annotate.models import KeypointRegistry
from cadalign.annotate.photos import FocalChoice
from cadalign.datasets.models.model_keypoints import ModelKeypoint
from cadalign.errors import CadalignError, InputError
from cadalign.estimation.focal import FocalPrior
from cadalign.io.documents import Document, read_document

logger = logging.getLogger("cadalign")

SameEvidence = Callable[[MarkedEvidence, str | None], bool]
"""True if marks equal those of the document's photo, or of the further photo which is named."""
_LONGEST = 1000  # documents in memory
_UNKNOWN = FocalChoice(known=False)
_MOST = 200  # documents in the file, on each side of the current one

Pixel = tuple[float, float]


@dataclass(frozen=True)
class Pair:
    """One keypoint; either half may be placed first."""

    number: int  # unique in a document
    uv: Pixel | None = None  # the photo half [px]
    keypoint: int | None = None  # the model half: a semantic id
    sigma: float | None = None  # of ``uv`` [px], if the observation file gives one
    score: float | None = None  # in the observation file
    depth: float | None = None  # in the observation file [model units]

    @property
    def complete(self) -> bool:
        """True if both halves are placed."""
        return self.uv is not None and self.keypoint is not None


@dataclass(frozen=True)
class Priors:
    """Priors on stretch and focal length until the pairs say otherwise; None for none."""

    stretch: float | None = None  # standard deviation of the logarithm of each scale about 1
    focal: FocalPrior | None = None  # on a focal length that is estimated

    def fit_options(self, likely: FocalPrior) -> dict[str, Any]:
        """Options with which `cadalign fit` has them, where it takes the likely focal length's."""
        options: dict[str, Any] = {}
        if self.stretch is not None:
            options["stretch_sigma"] = self.stretch
        if self.focal != likely:
            options["focal_prior"] = None if self.focal is None else asdict(self.focal)
        return options


@dataclass(frozen=True)
class FurtherView:
    """The annotations of an object's further photo, of which ``photo`` is the file."""

    photo: str
    document: AnnotationDocument


@dataclass(frozen=True)
class AnnotationDocument:
    """All annotations of one object in one photo; ``next_number`` is the number of the next pair.

    Prior on the stretch, known lengths and name are the object's: those of its further photos'
    documents do not count.
    """

    pairs: tuple[Pair, ...] = ()
    focal: FocalChoice = _UNKNOWN
    priors: Priors = Priors()
    next_number: int = 1
    evidence: MarkedEvidence = field(default_factory=MarkedEvidence)
    name: str = ""  # of the object, if the user gave one
    is_deleted: bool = False
    further_views: tuple[FurtherView, ...] = ()

    @property
    def is_empty(self) -> bool:
        """True if nothing is marked."""
        return not (self.pairs or self.further_views) and self.evidence == MarkedEvidence()

    @property
    def is_gone(self) -> bool:
        """True if the object was deleted, and nothing was marked since."""
        return self.is_deleted and self.is_empty

    def view(self, photo: str) -> AnnotationDocument | None:
        """The document of a further photo, with what is the object's; None if there is none."""
        own = next((view.document for view in self.further_views if view.photo == photo), None)
        if own is None:
            return None
        return replace(
            own,
            priors=replace(own.priors, stretch=self.priors.stretch),
            evidence=self.evidence.shared_with(own.evidence),
            name=self.name,
        )

    def with_view(self, photo: str, document: AnnotationDocument) -> AnnotationDocument:
        """The document with that of a further photo, which is added if it has none."""
        views = {view.photo: view for view in self.further_views}
        views[photo] = FurtherView(photo, document)
        return replace(
            self,
            further_views=tuple(views.values()),
            priors=replace(self.priors, stretch=document.priors.stretch),
            evidence=document.evidence.shared_with(self.evidence),
            name=document.name,
        )

    def without_view(self, photo: str) -> AnnotationDocument:
        """The document without that of a further photo."""
        left = tuple(view for view in self.further_views if view.photo != photo)
        return replace(self, further_views=left)

    @property
    def complete_pairs(self) -> tuple[Pair, ...]:
        """Pairs with both halves placed."""
        return tuple(pair for pair in self.pairs if pair.complete)

    @property
    def keypoints(self) -> frozenset[int]:
        """Semantic ids in use."""
        return frozenset(pair.keypoint for pair in self.pairs if pair.keypoint is not None)

    def pair(self, number: int) -> Pair:
        """Find a pair by its number; raises InputError if there is none."""
        for pair in self.pairs:
            if pair.number == number:
                return pair
        raise InputError(f"there is no pair {number}", where="pair", fix="reload the page")

    def append(self, pair: Pair) -> AnnotationDocument:
        """Append a pair, whose number is `next_number`."""
        return replace(self, pairs=(*self.pairs, pair), next_number=self.next_number + 1)

    def place_uv(self, uv: Pixel, preferred: int | None = None) -> tuple[AnnotationDocument, int]:
        """Place the photo half of a pair that lacks it, by preference of the pair of that number.

        If none lacks it, a new pair is begun. The second value is the pair's number.
        """
        pair = self._lacking("uv", preferred)
        return self._with(replace(pair, uv=uv)), pair.number

    def place_keypoint(
        self, keypoint: int, preferred: int | None = None
    ) -> tuple[AnnotationDocument, int]:
        """Place the model half of a pair, as `place_uv`; it must not be placed already."""
        self._refuse_second(keypoint)
        pair = self._lacking("keypoint", preferred)
        return self._with(replace(pair, keypoint=keypoint)), pair.number

    def move(self, number: int, uv: Pixel) -> AnnotationDocument:
        """Move the photo half of a pair."""
        return self._with(replace(self.pair(number), uv=uv))

    def release_keypoint(self, number: int) -> AnnotationDocument:
        """Remove the model half of a pair, so that another can be placed."""
        pair = self.pair(number)
        if pair.uv is None:
            return self.delete(number)
        return self._with(replace(pair, keypoint=None))

    def exchange_keypoint(self, number: int, keypoint: int) -> AnnotationDocument:
        """Replace the model half of a pair, of which it keeps the photo half."""
        self._refuse_second(keypoint, number)
        return self._with(replace(self.pair(number), keypoint=keypoint))

    def delete(self, number: int) -> AnnotationDocument:
        """Delete a pair."""
        gone = self.pair(number)
        return replace(self, pairs=tuple(pair for pair in self.pairs if pair is not gone))

    def _refuse_second(self, keypoint: int, own: int | None = None) -> None:
        for pair in self.pairs:
            if pair.keypoint == keypoint and pair.number != own:
                raise InputError(
                    f"this keypoint is already used by pair {pair.number}",
                    where="keypoint",
                    fix="move or delete that pair: a keypoint occurs once in a photo",
                )

    def _lacking(self, half: str, preferred: int | None) -> Pair:
        """The preferred pair if it lacks this half, otherwise the first that does, or a new one."""
        lacking = [pair for pair in self.pairs if getattr(pair, half) is None]
        wanted = [pair for pair in lacking if pair.number == preferred]
        return (wanted + lacking + [Pair(self.next_number)])[0]

    def _with(self, changed: Pair) -> AnnotationDocument:
        if changed.number == self.next_number:
            return self.append(changed)
        pairs = tuple(changed if pair.number == changed.number else pair for pair in self.pairs)
        return replace(self, pairs=pairs)


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
    mark = hashlib.sha256(os.fsencode(observation.resolve())).hexdigest()[:32]
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
    same_evidence: SameEvidence,
) -> History:
    """The history that led to a document; an empty one if there is none of that document.

    Model points of undone pairs are added to the registry. Marks with all their strokes and edges
    are taken from the history where they are the same as the document's.
    """
    try:
        file = read_document(path, _File)
        documents = file.documents()
        at = _find(document, documents, file.before, same_evidence)
    except (OSError, CadalignError, msgspec.ValidationError, LookupError):
        return History(document)
    if at is None or not _add_points(file.points, registry):
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


def _add_points(points: Sequence[ModelKeypoint], registry: KeypointRegistry) -> bool:
    """Register model points; False, and none is, if one lies elsewhere than that of its id."""
    new = [point for point in points if point.semantic_id not in registry]
    if any(point not in new and not registry.has(point) for point in points):
        return False
    for point in new:
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
