"""Annotation document of one photo: pairs of a photo point and a keypoint of the model.

Documents are immutable; every edit makes a new one, which undo keeps.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from cadalign.errors import InputError

Pixel = tuple[float, float]


@dataclass(frozen=True)
class Pair:
    """One keypoint; either half may be placed first.

    Parameters
    ----------
    number : int
        Identifier, unique in a document.
    uv : (float, float), optional
        The photo half [px].
    keypoint : int, optional
        The model half: a semantic id.
    sigma : float, optional
        Standard deviation of ``uv`` [px], if the observation file gives one.
    confidence : float, optional
        Confidence in the observation file.
    """

    number: int
    uv: Pixel | None = None
    keypoint: int | None = None
    sigma: float | None = None
    confidence: float | None = None

    @property
    def complete(self) -> bool:
        """True if both halves are placed."""
        return self.uv is not None and self.keypoint is not None


@dataclass(frozen=True)
class FocalChoice:
    """The user's choice of a known or estimated focal length.

    Parameters
    ----------
    known : bool
        False to estimate it from the pairs.
    pixels : float, optional
        Typed focal length [px]; None for that of the camera.
    """

    known: bool
    pixels: float | None = None


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

    def place_uv(self, uv: Pixel, preferred: int | None = None) -> tuple[Document, int]:
        """Place the photo half of a pair that lacks it, or of a new one.

        Parameters
        ----------
        uv : (float, float)
            [px]
        preferred : int, optional
            Number of the pair to complete, if it lacks this half.

        Returns
        -------
        Document
        int
            The pair's number.
        """
        lacking = [pair.number for pair in self.pairs if pair.uv is None]
        return self._fill(lacking, preferred, Pair(self.next_number, uv=uv))

    def place_keypoint(self, keypoint: int, preferred: int | None = None) -> tuple[Document, int]:
        """Place the model half of a pair that lacks it, or of a new one; as `place_uv`.

        Raises
        ------
        InputError
            If the keypoint is already placed in the photo.
        """
        for position, pair in enumerate(self.pairs, start=1):
            if pair.keypoint == keypoint:
                raise InputError(
                    f"this keypoint is already used by pair {position}",
                    where="keypoint",
                    fix="move or delete that pair: a keypoint occurs once in a photo",
                )
        lacking = [pair.number for pair in self.pairs if pair.keypoint is None]
        return self._fill(lacking, preferred, Pair(self.next_number, keypoint=keypoint))

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

    def _fill(self, lacking: list[int], preferred: int | None, half: Pair) -> tuple[Document, int]:
        """Merge half a pair into one that lacks it, or append it."""
        if not lacking:
            return replace(
                self, pairs=(*self.pairs, half), next_number=self.next_number + 1
            ), half.number
        number = preferred if preferred in lacking else lacking[0]
        pair = self.pair(number)
        merged = replace(
            pair,
            uv=half.uv if pair.uv is None else pair.uv,
            keypoint=half.keypoint if pair.keypoint is None else pair.keypoint,
        )
        return self._with(merged), number

    def _with(self, changed: Pair) -> Document:
        pairs = tuple(changed if pair.number == changed.number else pair for pair in self.pairs)
        return replace(self, pairs=pairs)
