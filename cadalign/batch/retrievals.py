"""Retrieval for many observations as a run: the tables are those of each one's best match.

docs/how_to/many_photos.md describes the further columns.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

from cadalign.arrays import worker_count
from cadalign.batch.experiment import Estimated, ManyOptions, plan_run
from cadalign.batch.spec import SPEC as FIT_SPEC
from cadalign.batch.spec import summarize_by
from cadalign.datasets.model_keypoints import ModelKeypoints
from cadalign.evaluation.metrics import Metric
from cadalign.evaluation.runs.work import Columns
from cadalign.evaluation.summary import median
from cadalign.io.observation import Observation
from cadalign.retrieval.query import ObservationRetrieval

SCORE = Metric("match_score", "score", "%", 0, better="high", factor=100.0, log=False)
NONE = Metric("none_probability", "none of these", "%", 0, factor=100.0, log=False)
_SHOWN = (SCORE, NONE)


@dataclass(frozen=True, kw_only=True)
class RetrieveRunOptions(ManyOptions):
    """A run that retrieves the models of many observations; see `ManyOptions`."""

    experiment: ClassVar[str] = "retrieve"
    command: ClassVar[str] = "retrieve"
    columns: ClassVar[Columns] = (
        *(("match_category", str), ("match_id", str), ("match_score", float)),
        *(("match_log_likelihood", float), ("none_probability", float)),
        ("missing", int),
        *(("top_categories", list[str]), ("top_ids", list[str]), ("top_scores", list[float])),
    )

    estimate: ObservationRetrieval

    @property
    def threads(self) -> int:
        """The search lets go of the interpreter lock: a run without workers takes all cores."""
        return worker_count(-1)

    @property
    def learned(self) -> Path | None:
        return self.estimate.shape

    def own_keypoints(self) -> ModelKeypoints:
        return self.estimate.opened()[0].keypoints

    def read(self, data: Any, where: str, *, folder: Path) -> Observation:
        return self.estimate.read(data, where, folder=folder, changes=self.changes)

    def estimate_of(self, seen: Observation, where: str) -> Estimated:
        seen = self.estimate.with_ids(seen, where)
        matches = self.estimate.retrieve(seen, where, workers=1)
        best = matches[0]
        cells = {
            "match_category": best.category,
            "match_id": best.model_id,
            "match_score": best.score,
            "match_log_likelihood": best.log_likelihood,
            "none_probability": best.none_probability,
            "missing": len(best.missing_ids),
            "top_categories": [match.category for match in matches],
            "top_ids": [match.model_id for match in matches],
            "top_scores": [match.score for match in matches],
        }
        return best.observation(seen), best.result, cells

    def check_files(self) -> None:
        self.estimate.opened()


SPEC = replace(
    FIT_SPEC,
    options=RetrieveRunOptions,
    plan=plan_run,
    columns=(*FIT_SPEC.columns[:3], *_SHOWN, *FIT_SPEC.columns[3:]),
    summarize=summarize_by({metric.key: median(metric.key) for metric in _SHOWN}, by=()),
    metrics=(*_SHOWN, *FIT_SPEC.metrics),
    topic="retrieved models",
    about="Red is the best match: its box and model, posed and stretched.",
)
