"""Marks of an object in a photo, and their history for undo and redo.

Marks are immutable: every edit makes new marks, and the history keeps them. The observation file
stores the current marks.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

from cadalign.annotate.model import MarkedModel
from cadalign.annotate.photos import ObjectMask
from cadalign.datasets.model_keypoints import ModelKeypoint
from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera

_LONGEST = 1000  # history, in marks

Pixel = tuple[float, float]


@dataclass(frozen=True)
class Pair:
    """One keypoint; either half may be placed first."""

    number: int  # unique among the marks
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
class Marks:
    """All marks of an object in a photo.

    If the camera has no focal length, it is estimated. The pairs are of keypoints of ``model``.
    ``photo`` says whether the photo itself is evidence, ``start`` is the start of the search while
    there are few pairs.
    """

    camera: Camera
    model: MarkedModel
    pairs: tuple[Pair, ...] = ()
    next_number: int = 1
    mask: ObjectMask | None = None
    photo: bool = False
    start: Alignment | None = None

    @property
    def complete_pairs(self) -> tuple[Pair, ...]:
        """Pairs with both halves placed."""
        return tuple(pair for pair in self.pairs if pair.complete)

    @property
    def keypoints(self) -> frozenset[int]:
        """Semantic ids in use."""
        return frozenset(pair.keypoint for pair in self.pairs if pair.keypoint is not None)

    def points_of(self, pairs: Iterable[Pair]) -> list[ModelKeypoint]:
        """The model points of pairs that have one."""
        registry = self.model.registry
        return [registry[pair.keypoint] for pair in pairs if pair.keypoint is not None]

    def pair(self, number: int) -> Pair:
        """Find a pair by its number; raises InputError if there is none."""
        for pair in self.pairs:
            if pair.number == number:
                return pair
        raise InputError(f"there is no pair {number}", where="pair", fix="reload the page")

    def append(self, pair: Pair) -> Marks:
        """Append a pair, whose number is `next_number`."""
        return replace(self, pairs=(*self.pairs, pair), next_number=self.next_number + 1)

    def place_uv(self, uv: Pixel, preferred: int | None = None) -> tuple[Marks, int]:
        """Place the photo half of the preferred pair, another pair that lacks it, or a new pair.

        Returns the marks and the number of the pair.
        """
        pair = self._incomplete_pair("uv", preferred)
        return self._replace_pair(replace(pair, uv=uv)), pair.number

    def place_keypoint(self, keypoint: int, preferred: int | None = None) -> tuple[Marks, int]:
        """Place the model half of a pair, as `place_uv`; raises InputError if it is in use."""
        self._refuse_second(keypoint)
        pair = self._incomplete_pair("keypoint", preferred)
        return self._replace_pair(replace(pair, keypoint=keypoint)), pair.number

    def move(self, number: int, uv: Pixel) -> Marks:
        """Move the photo half of a pair."""
        return self._replace_pair(replace(self.pair(number), uv=uv))

    def release_keypoint(self, number: int) -> Marks:
        """Remove the model half of a pair, so that another can be placed."""
        pair = self.pair(number)
        if pair.uv is None:
            return self.delete(number)
        return self._replace_pair(replace(pair, keypoint=None))

    def exchange_keypoint(self, number: int, keypoint: int) -> Marks:
        """Replace the model half of a pair, and keep the photo half."""
        self._refuse_second(keypoint)
        return self._replace_pair(replace(self.pair(number), keypoint=keypoint))

    def delete(self, number: int) -> Marks:
        """Delete a pair."""
        gone = self.pair(number)
        return replace(self, pairs=tuple(pair for pair in self.pairs if pair is not gone))

    def _refuse_second(self, keypoint: int) -> None:
        for pair in self.pairs:
            if pair.keypoint == keypoint:
                raise InputError(
                    f"this keypoint is already used by pair {pair.number}",
                    where="keypoint",
                    fix="move or delete that pair: a keypoint occurs once in a photo",
                )

    def _incomplete_pair(self, half: str, preferred: int | None) -> Pair:
        """Return the preferred pair if it lacks this half, or the first such, or a new pair."""
        lacking = [pair for pair in self.pairs if getattr(pair, half) is None]
        wanted = [pair for pair in lacking if pair.number == preferred]
        return (wanted + lacking + [Pair(self.next_number)])[0]

    def _replace_pair(self, changed: Pair) -> Marks:
        if changed.number == self.next_number:
            return self.append(changed)
        pairs = tuple(changed if pair.number == changed.number else pair for pair in self.pairs)
        return replace(self, pairs=pairs)


@dataclass(eq=False)
class History:
    """The current marks, earlier ones, and undone ones."""

    marks: Marks
    before: list[Marks] = field(default_factory=list)  # for undo, the next one last
    after: list[Marks] = field(default_factory=list)  # for redo, the next one last

    def record(self, marks: Marks) -> None:
        """Set the current marks."""
        self.before.append(self.marks)
        del self.before[:-_LONGEST]
        self.after.clear()
        self.marks = marks

    def undo(self) -> bool:
        """Go back by one change; returns False if there is none."""
        return self._go(self.before, self.after)

    def redo(self) -> bool:
        """Redo the last undone change; returns False if there is none."""
        return self._go(self.after, self.before)

    def _go(self, source: list[Marks], target: list[Marks]) -> bool:
        if not source:
            return False
        target.append(self.marks)
        self.marks = source.pop()
        return True
