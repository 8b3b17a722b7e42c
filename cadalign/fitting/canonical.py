"""Canonical results of `fit` and `fit_batch`: one of all alignments equal under a symmetry."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.fitting.batch import BatchResult
from cadalign.fitting.options import FitOptions
from cadalign.fitting.result import Alternative, FitResult
from cadalign.fitting.symmetric import held_axes, is_same, step_to
from cadalign.fitting.uncertainty import unknown_axes
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.symmetry import Symmetry
from cadalign.geometry.symmetry_group import Equal, group_of


class CanonicalFit(NamedTuple):
    """A canonical result, and what led to it and to each of its alternatives."""

    result: FitResult
    best: Equal
    others: tuple[Equal, ...]


def canonical_fit(result: FitResult, symmetry: Symmetry) -> CanonicalFit:
    """A fit's result with the canonical alignment, and alternatives that are truly others."""
    group = group_of(symmetry)
    held = held_axes(result.stretched_axes)
    best = group.canonical(result.alignment, held=held)
    covariance = result.covariance
    if covariance is not None:
        covariance = _carried(covariance, result.alignment, best, result.known_axis)
    canonical = [(group.canonical(each.alignment, held=held), each) for each in result.alternatives]
    others = [
        (equal, each)
        for equal, each in canonical
        if group.is_trivial or not is_same(group, best.alignment, equal.alignment, covariance)
    ]
    found = replace(
        result,
        alignment=best.alignment,
        points_3d=best.relabelled(result.points_3d),
        covariance=covariance,
        alternatives=tuple(
            Alternative(equal.alignment, each.relative_likelihood, each.camera)
            for equal, each in others
        ),
        symmetry=symmetry,
    )
    return CanonicalFit(found, best, tuple(equal for equal, _ in others))


def canonical_batch(batch: BatchResult, symmetry: Symmetry, options: FitOptions) -> BatchResult:
    """The results of a batch with canonical alignments, each as `canonical_fit` has it."""
    group = group_of(symmetry)
    if group.is_trivial:
        return batch
    rotation, translation = batch.rotation.copy(), batch.translation.copy()
    scale = batch.scale.copy()
    covariance = None if batch.covariance is None else batch.covariance.copy()
    held = held_axes(options.stretched_axes)
    for b in np.flatnonzero(batch.solved).tolist():
        given = batch.alignment(b)
        best = group.canonical(given, held=held)
        rotation[b], translation[b] = best.alignment.rotation, best.alignment.translation
        scale[b] = best.alignment.scale
        if covariance is not None:
            covariance[b] = _carried(covariance[b], given, best, options.known_axis)
    return replace(
        batch, rotation=rotation, translation=translation, scale=scale, covariance=covariance
    )


def _carried(covariance: FloatArray, given: Alignment, best: Equal, known_axis: str) -> FloatArray:
    """The covariance (8, 8) or (9, 9) of an equal alignment."""
    places = [*range(6), *(6 + axis for axis in unknown_axes(known_axis))]
    step = np.eye(len(covariance))
    step[:8, :8] = step_to(best, given)[np.ix_(places, places)]
    return np.asarray(step @ covariance @ step.T)
