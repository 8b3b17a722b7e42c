"""Instance records of objects in photos."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cadalign.errors import CadalignError
from cadalign.estimation.result import Result
from cadalign.estimation.result_parts import Alternative
from cadalign.evaluation.instances.aligned import (
    AlignedAlternative,
    AlignedShape,
    Warp,
    box_alignment,
)
from cadalign.evaluation.instances.record import Estimate, record_of
from cadalign.evaluation.outcome import Outcome
from cadalign.evaluation.photos.methods import PhotoEstimate
from cadalign.evaluation.photos.sighting import Sighting
from cadalign.evaluation.runs.tables import Row
from cadalign.geometry.alignment import Alignment


def sighting_record(
    sighting: Sighting,
    outcomes: Sequence[Outcome],
    estimates: Sequence[PhotoEstimate | CadalignError],
) -> Row:
    """The record of an object, in terms of the data set's model."""
    return record_of(
        camera=sighting.camera,
        gt=sighting.target.gt,
        stretch=np.ones(3),
        bounds=sighting.bounds,
        points_3d=sighting.points_3d,
        points_2d=sighting.points_2d,
        semantic_ids=np.arange(len(sighting.names)),
        outcomes=outcomes,
        estimates=[_described(each, sighting) for each in estimates],
    )


def _described(estimate: PhotoEstimate | CadalignError, sighting: Sighting) -> Estimate:
    if isinstance(estimate, CadalignError):
        return estimate
    result = estimate.result
    if result is None:
        return estimate.alignment
    alternatives = []
    for other in result.alternatives:
        alignment = _of_box(other, sighting)
        alternatives.append(
            AlignedAlternative(alignment, other.relative_likelihood, _warp(result, other, sighting))
        )
    return AlignedShape(
        _of_box(result, sighting),
        result.std,
        result.rms,
        sighting.sigma,
        result.warnings,
        tuple(alternatives),
        _warp(result, result, sighting),
    )


def _of_box(found: Result | Alternative, sighting: Sighting) -> Alignment:
    """The alignment of the model's box with an estimated one."""
    return box_alignment(found.alignment, found.bounds, model_bounds=sighting.bounds)


def _warp(result: Result, found: Result | Alternative, sighting: Sighting) -> Warp:
    """The places of the model's keypoints on the estimated object, in the model's coordinates."""
    row_of = {str(name): row for row, name in enumerate(result.ids)}
    known = [row for row, name in enumerate(sighting.model.names) if name in row_of]
    rows = [row_of[sighting.model.names[row]] for row in known]
    places = _of_box(found, sighting).inverse(found.alignment.apply(found.points_3d[rows]))
    return Warp(sighting.model.xyz[known], places)
