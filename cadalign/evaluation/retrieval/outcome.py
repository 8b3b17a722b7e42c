"""What became of one query to a library: where the true model ranked, and how good the best was."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields
from typing import Any

from cadalign.errors import InputError
from cadalign.evaluation.accuracy.outcome import OK
from cadalign.evaluation.runs.work import Columns
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box
from cadalign.geometry.metrics import box_iou, rotation_error
from cadalign.retrieval.match import Match
from cadalign.retrieval.models import LibraryModel, ModelKey
from cadalign.retrieval.shape import shape_distance

LEAVE_IN = "leave-in"
"""The library holds the true model."""
LEAVE_OUT = "leave-out"
"""It doesn't."""
NO_VIEW = "no view"
"""The status of a model of which no view shows as many keypoints as are to be handed over."""
PROTOCOLS = (LEAVE_IN, LEAVE_OUT)


@dataclass(frozen=True)
class RetrievalOutcome:
    """One row of a result table.

    Parameters
    ----------
    category, model_id : str
        The true model.
    noise_px : float
        Standard deviation of the keypoints' noise [px].
    keypoints : int
        How many were handed over.
    protocol : str
        ``leave-in`` or ``leave-out``.
    method : str
    status : str
        ``ok``, ``failed``, or ``no view`` where there was nothing to ask.
    reason : str
        Why it is not ok; empty otherwise.
    alike : int
        How many models count as the true one, itself included.
    rank : int
        Of the first of these, 1 for the best match; None if it is not among the first 50, and in
        the leave-out protocol.
    matched_category, matched_id : str
        The best match.
    score : float
        Its probability.
    shared : int
        Keypoints that it shares with the image.
    rms_px : float
    shape_distance : float
        Of its keypoints from the true model's after stretch, as a share of their extent; None for
        another category.
    box_iou : float
        Of its box with the true model's, both posed and stretched; None for a model without volume.
    rotation_error_deg : float
        [degrees]

    The numbers of other than ok queries are None.
    """

    category: str
    model_id: str
    noise_px: float
    keypoints: int
    protocol: str
    method: str
    status: str
    reason: str = ""
    alike: int | None = None
    rank: int | None = None
    matched_category: str = ""
    matched_id: str = ""
    score: float | None = None
    shared: int | None = None
    rms_px: float | None = None
    shape_distance: float | None = None
    box_iou: float | None = None
    rotation_error_deg: float | None = None

    @classmethod
    def of_matches(
        cls,
        matches: Sequence[Match],
        *,
        best: LibraryModel,
        gt: LibraryModel,
        placed: Alignment,
        alike: Collection[ModelKey],
        **labels: Any,
    ) -> RetrievalOutcome:
        """Compare matches with the truth.

        Parameters
        ----------
        matches : sequence of Match
        best : LibraryModel
            The model of the first match.
        gt : LibraryModel
            The true model.
        placed : Alignment
            Its pose and stretch.
        alike : collection of (category, model id)
            The models that count as the true one.
        labels
            The fields that name the row.
        """
        first = matches[0]
        ranks = [
            place
            for place, match in enumerate(matches, start=1)
            if (match.category, match.model_id) in alike
        ]
        try:
            overlap = box_iou(est=first.box, gt=Box.from_model(gt.bounds, placed))
        except InputError:  # a flat model's box has no volume
            overlap = None
        return cls(
            status=OK,
            alike=len(alike),
            rank=ranks[0] if ranks else None,
            matched_category=first.category,
            matched_id=first.model_id,
            score=first.score,
            shared=first.shared,
            rms_px=first.rms,
            shape_distance=shape_distance(best, gt) if best.category == gt.category else None,
            box_iou=overlap,
            rotation_error_deg=rotation_error(est=first.alignment, gt=placed),
            **labels,
        )

    @classmethod
    def columns(cls) -> Columns:
        """Names and types of a result table's columns; the first six name the row."""
        kinds = {"str": str, "int": int, "float": float}
        return tuple((field.name, kinds[str(field.type).split(" ")[0]]) for field in fields(cls))

    def key(self) -> dict[str, Any]:
        """What names the row."""
        return {name: getattr(self, name) for name, _ in self.columns()[:6]}
