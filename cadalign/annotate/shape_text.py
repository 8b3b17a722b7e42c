"""Alignment of an object's own shape, and its standard deviations, as text for the page."""

from __future__ import annotations

import math

import numpy as np

from cadalign.annotate.object_shape import ObjectShape
from cadalign.annotate.result_text import (
    LEFT_OPEN,
    UNCERTAIN,
    UNDETERMINED,
    Fact,
    rotation_fact,
    short,
)
from cadalign.annotate.shape_alignment import LiveShape
from cadalign.estimation.align_result import AlignResult


def facts_of_shape(live: LiveShape, shape: ObjectShape | None) -> tuple[Fact, ...]:
    """Lengths, pose and residuals, with standard deviations."""
    result, camera = live.shown, live.camera
    if result is None or camera is None:
        return ()
    facts = [_length(result, axis, float(live.prior_lengths[axis]), shape) for axis in range(3)]
    facts += [rotation_fact(result.std.rotation_deg), _distance(result, shape)]
    facts.append(
        Fact("Focal length", f"{camera.fx:.0f} px", "assumed" if live.provisional else "as given")
    )
    if live.counts.sum() > 3:
        off = f"points off by {short(live.sigma)} px" if live.sigma > 1 else "clicks of 1 px"
        note = f"rms; the standard deviations above are for {off}"
        facts.append(Fact("Pairs agree to", f"{short(result.rms)} px", note))
    return tuple(facts)


def notes_of_shape(live: LiveShape, shape: ObjectShape | None) -> tuple[str, ...]:
    """Assumptions, pairs that do not count, alternative estimates and warnings."""
    result = live.shown
    if result is None:
        return ()
    notes = [live.message] if live.message else []
    carried = int((~live.counts).sum())
    if carried and shape is not None and shape.learned is not None:
        notes.append(
            f"{carried} pair{'s do' if carried > 1 else ' does'} not count: the shape of "
            f"{shape.learned.category} has no such keypoint. Shown is where the warped model puts "
            "it."
        )
    others = len(result.alternatives)
    if others:
        notes.append(
            f"{others} other alignment{'s explain' if others > 1 else ' explains'} these pairs "
            "nearly as well: one more pair tells them apart"
        )
    return (*notes, *(warning.replace("+-", "± ") for warning in result.warnings))


def _length(result: AlignResult, axis: int, prior: float, shape: ObjectShape | None) -> Fact:
    label, relative = f"Length along {'xyz'[axis]}", result.std.scale[axis]
    length = float(np.ptp(result.bounds, axis=0)[axis] * result.alignment.scale[axis])
    if not length > 0 or relative > UNCERTAIN:
        return Fact(label, *UNDETERMINED)
    average = "the model" if shape is None else shape.average
    if relative == 0:
        return Fact(label, f"{length:.3g}{_unit(shape)}", f"{average}'s, taken as known")
    value = f"{length:.3g} ± {short(length * relative)}{_unit(shape)}"
    if prior and relative > LEFT_OPEN * prior:
        spread = f"{average}'s and its spread"
        return Fact(label, value, f"the pairs leave it open: {spread}")
    percent = 100 * (float(result.stretch[axis]) - 1)
    if abs(percent) < 100 * relative:
        return Fact(label, value, f"{average}'s lies within the standard deviation")
    than = "longer" if percent > 0 else "shorter"
    return Fact(label, value, f"{abs(percent):.0f} % {than} than {average}'s")


def _distance(result: AlignResult, shape: ObjectShape | None) -> Fact:
    translation = result.alignment.translation
    distance = float(np.linalg.norm(translation))
    if not distance > 0:
        return Fact("Distance", *UNDETERMINED)
    along = translation / distance
    deviation = math.sqrt(max(float(along @ result.covariance[3:6, 3:6] @ along), 0.0))
    if deviation > UNCERTAIN * distance:
        return Fact("Distance", *UNDETERMINED)
    value = f"{distance:.3g} ± {short(deviation)}{_unit(shape)}"
    learned = None if shape is None else shape.learned
    units = {"m": "", "diagonal": "diagonals of the object's box"}
    note = "model units" if learned is None else units.get(learned.unit, learned.unit)
    return Fact("Distance", value, note)


def _unit(shape: ObjectShape | None) -> str:
    """Unit of lengths, after a number; empty for the model's own."""
    learned = None if shape is None else shape.learned
    return " m" if learned is not None and learned.unit == "m" else ""
