"""Annotation document of one object: pairs of a photo point and a keypoint of the model.

The document of the object's first photo holds those of its further photos. Documents are immutable;
every edit makes a new one, which the history keeps for undo and redo.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any

from cadalign.annotate.evidence import MarkedEvidence
from cadalign.errors import InputError
from cadalign.estimation.focal import FocalPrior

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
class FocalChoice:
    """The user's choice of a known focal length, or of one estimated from the pairs."""

    known: bool
    pixels: float | None = None  # as typed [px]; None for the camera's


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
    focal: FocalChoice = FocalChoice(known=False)
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
        for view in self.further_views:
            if view.photo == photo:
                own = view.document
                return replace(
                    own,
                    priors=replace(own.priors, stretch=self.priors.stretch),
                    evidence=self.evidence.shared_with(own.evidence),
                    name=self.name,
                )
        return None

    def with_view(self, photo: str, document: AnnotationDocument) -> AnnotationDocument:
        """The document with that of a further photo, which is added if it has none."""
        others = [view.photo for view in self.further_views]
        views = [
            FurtherView(photo, document) if view.photo == photo else view
            for view in self.further_views
        ]
        if photo not in others:
            views.append(FurtherView(photo, document))
        return replace(
            self,
            further_views=tuple(views),
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
