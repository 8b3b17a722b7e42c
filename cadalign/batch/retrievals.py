"""Retrieval for many observations as a run; a row of the table holds the best match.

docs/how_to/many_photos.md describes the further columns.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

from cadalign.batch.runs import Estimate, FitRunOptions
from cadalign.batch.spec import SPEC as FIT_SPEC
from cadalign.datasets.model_keypoints import ModelKeypoints
from cadalign.evaluation.runs.work import Columns
from cadalign.io.observation import Observation
from cadalign.retrieval.query import ObservationRetrieval


@dataclass(frozen=True, kw_only=True)
class RetrieveRunOptions(FitRunOptions):
    """Options of a run that retrieves the models of many observations; see `FitRunOptions`."""

    experiment: ClassVar[str] = "retrieve"
    command: ClassVar[str] = "retrieve"
    columns: ClassVar[Columns] = (
        *(("match_category", str), ("match_id", str), ("match_score", float)),
        *(("match_log_likelihood", float), ("none_probability", float)),
        *(("missing", int), ("matches", str)),
    )
    threads: ClassVar[int] = -1  # the search releases the interpreter lock

    estimate: ObservationRetrieval  # type: ignore[assignment]

    @property
    def files(self) -> tuple[Path | None, ...]:
        named = self.changes.camera, self.detector.model
        own = self.estimate
        return *named, own.library, own.shape, own.keypoint_names

    def keypoints(self) -> ModelKeypoints:
        return self.estimate.open_files()[0].keypoints

    def estimate_of(self, seen: Observation, where: str) -> Estimate:
        seen = self.estimate.resolve_ids(seen, where)
        matches = self.estimate.retrieve(seen, where, workers=1)
        best = matches[0]
        cells = {
            "match_category": best.category,
            "match_id": best.model_id,
            "match_score": best.score,
            "match_log_likelihood": best.log_likelihood,
            "none_probability": best.none_probability,
            "missing": len(best.missing_ids),
            "matches": "; ".join(f"{m.category} {m.model_id} {m.score:.4g}" for m in matches),
        }
        return best.observation(seen), best.result, cells


SPEC = replace(
    FIT_SPEC,
    options=RetrieveRunOptions,
    topic="retrieved models",
    about="Red is the best match: its box and model, posed and stretched.",
)
