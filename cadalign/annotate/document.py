"""Marks of an annotation, and the history of them for undo and redo.

Documents are immutable; every edit makes a new one, which the history keeps.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any

from cadalign.annotate.evidence import MarkedEvidence
from cadalign.annotate.photos import FocalChoice
from cadalign.errors import InputError
from cadalign.io.focal import FocalPrior

_LONGEST = 1000  # documents in memory
_UNKNOWN = FocalChoice(known=False)

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
class AnnotationDocument:
    """All marks of an object in a photo; ``next_number`` is the number of the next pair."""

    pairs: tuple[Pair, ...] = ()
    focal: FocalChoice = _UNKNOWN
    priors: Priors = Priors()
    next_number: int = 1
    evidence: MarkedEvidence = field(default_factory=MarkedEvidence)

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
        self._step = step

    def undo(self) -> bool:
        """Go back by one change; returns False if there is none."""
        return self._go(self.before, self.after)

    def redo(self) -> bool:
        """Redo the last undone change; returns False if there is none."""
        return self._go(self.after, self.before)

    def _go(self, source: list[AnnotationDocument], target: list[AnnotationDocument]) -> bool:
        self._step = None
        if not source:
            return False
        target.append(self.document)
        self.document = source.pop()
        return True
