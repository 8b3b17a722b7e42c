"""Annotation document of one photo: pairs of a photo point and a keypoint of the model.

Documents are immutable; every edit makes a new one, which undo keeps.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from cadalign.errors import InputError

Pixel = tuple[float, float]


@dataclass(frozen=True)
class Pair:
    """One keypoint; either half may be placed first."""

    number: int  # unique in a document
    uv: Pixel | None = None  # the photo half [px]
    keypoint: int | None = None  # the model half: a semantic id
    sigma: float | None = None  # of ``uv`` [px], if the observation file gives one
    confidence: float | None = None  # in the observation file

    @property
    def complete(self) -> bool:
        """True if both halves are placed."""
        return self.uv is not None and self.keypoint is not None


@dataclass(frozen=True)
class FocalChoice:
    """The user's choice of a known focal length, or of one estimated from the pairs."""

    known: bool
    pixels: float | None = None  # as typed [px]; None for the camera's


@dataclass(frozen=True)
class Document:
    """All annotations of one photo; ``next_number`` is the number of the next pair.

    Examples
    --------
    >>> empty = Document(focal=FocalChoice(known=True))
    >>> placed, pair = empty.place_uv((3.0, 4.0))
    >>> placed, pair = placed.place_keypoint(7, pair)
    >>> placed.complete_pairs
    (Pair(number=1, uv=(3.0, 4.0), keypoint=7, sigma=None, confidence=None),)
    """

    pairs: tuple[Pair, ...] = ()
    focal: FocalChoice = field(default_factory=lambda: FocalChoice(known=False))
    next_number: int = 1

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

    def append(self, pair: Pair) -> Document:
        """Append a pair, whose number is `next_number`."""
        return replace(self, pairs=(*self.pairs, pair), next_number=self.next_number + 1)

    def place_uv(self, uv: Pixel, preferred: int | None = None) -> tuple[Document, int]:
        """Place the photo half of a pair that lacks it, by preference of the pair of that number.

        If none lacks it, a new pair is begun. The second value is the pair's number.
        """
        pair = self._lacking("uv", preferred)
        return self._with(replace(pair, uv=uv)), pair.number

    def place_keypoint(self, keypoint: int, preferred: int | None = None) -> tuple[Document, int]:
        """Place the model half of a pair, as `place_uv`; it must not be placed already."""
        for position, pair in enumerate(self.pairs, start=1):
            if pair.keypoint == keypoint:
                raise InputError(
                    f"this keypoint is already used by pair {position}",
                    where="keypoint",
                    fix="move or delete that pair: a keypoint occurs once in a photo",
                )
        pair = self._lacking("keypoint", preferred)
        return self._with(replace(pair, keypoint=keypoint)), pair.number

    def move(self, number: int, uv: Pixel) -> Document:
        """Move the photo half of a pair."""
        return self._with(replace(self.pair(number), uv=uv))

    def release_keypoint(self, number: int) -> Document:
        """Remove the model half of a pair, so that another can be placed."""
        pair = self.pair(number)
        if pair.uv is None:
            return self.delete(number)
        return self._with(replace(pair, keypoint=None))

    def delete(self, number: int) -> Document:
        """Delete a pair."""
        gone = self.pair(number)
        return replace(self, pairs=tuple(pair for pair in self.pairs if pair is not gone))

    def choose_focal(self, focal: FocalChoice) -> Document:
        """Choose a known or an estimated focal length."""
        return replace(self, focal=focal)

    def _lacking(self, half: str, preferred: int | None) -> Pair:
        lacking = [pair for pair in self.pairs if getattr(pair, half) is None]
        wanted = [pair for pair in lacking if pair.number == preferred]
        return (wanted + lacking + [Pair(self.next_number)])[0]

    def _with(self, changed: Pair) -> Document:
        if changed.number == self.next_number:
            return self.append(changed)
        pairs = tuple(changed if pair.number == changed.number else pair for pair in self.pairs)
        return replace(self, pairs=pairs)
