"""Result, standard deviations and next-best keypoint as text for the page."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cadalign.annotate.estimate import LiveAlignment
from cadalign.annotate.object_shape import ObjectShape
from cadalign.annotate.suggestion import NextBest, Suggestion, Unmarked
from cadalign.estimation.uncertainty.advice import LENGTH_SIGMA, TURN_DEG, Advice

UNKNOWNS = (
    *["the rotation"] * 3,
    *("the position sideways", "the height", "the distance"),
    *(f"the stretch along {axis}" for axis in "xyz"),
    "the focal length",
)
"""Names of the unknowns of a covariance, for a sentence."""
_ROTATIONS = 3
_UNCERTAIN = 1.0  # relative standard deviation beyond which a number is not shown
_LEFT_OPEN = 0.8  # share of a prior's standard deviation beyond which the pairs say nothing
_UNCERTAIN_DEG = 60.0
_UNDETERMINED = "not determined", "these pairs leave it open"


@dataclass(frozen=True)
class Fact:
    """One row of the result: label, value, and a remark on the value."""

    label: str
    value: str
    note: str


def facts_of(live: LiveAlignment, shape: ObjectShape | None = None) -> tuple[Fact, ...]:
    """Stretch or lengths, pose and residuals, with standard deviations."""
    result = live.result
    if result is None:
        return ()
    in_lengths = shape is not None or "x" in result.stretched_axes
    axes = "xyz" if in_lengths else result.stretched_axes
    facts = [_extent(live, axis, shape, in_lengths=in_lengths) for axis in axes]
    if result.std is not None:
        facts.append(_rotation(result.std.rotation_deg))
    facts += [_distance(live, shape), _focal(live)]
    if 2 * live.counts.sum() > 6 + len(result.stretched_axes):
        off = f"points off by {short(live.sigma)} px" if live.sigma > 1 else "clicks of 1 px"
        note = f"rms; the standard deviations above are for {off}"
        facts.append(Fact("Pairs agree to", f"{short(result.rms)} px", note))
    return tuple(facts)


def notes_of(live: LiveAlignment, shape: ObjectShape | None = None) -> tuple[str, ...]:
    """Assumptions, pairs that do not count, alternative alignments and warnings."""
    result = live.result
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
    if others and len(live.counts):  # those of a mask alone are shown
        notes.append(
            f"{others} other alignment{'s explain' if others > 1 else ' explains'} these pairs "
            f"{'as well' if shape is None else 'nearly as well'}: one more pair tells them apart"
        )
    notes += live.contradictions
    return (*notes, *(warning.replace("+-", "± ") for warning in result.warnings))


def next_best_text(next_best: NextBest | Unmarked, name: str) -> str:
    """Name of the next-best keypoint, and what is gained by it."""
    if isinstance(next_best, Unmarked):
        sigma = short(next_best.sigma)
        return f"{name}: so far known to ± {sigma} px; it would tell most about pose and shape"
    factor, unit = (100, " %") if next_best.unknown >= _ROTATIONS else (math.degrees(1), "°")
    before, after = (short(factor * std) + unit for std in (next_best.before, next_best.after))
    unknown = UNKNOWNS[next_best.unknown]
    return f"{name}: it would determine {unknown} to ± {after} instead of {before}"


def name_of(suggestion: Suggestion) -> str:
    """Name of a suggested point."""
    return suggestion.point.name or "The marked corner"


def evidence_text(advice: Advice, keypoint: str) -> str:
    """One piece of evidence; a keypoint by its name."""
    if advice.kind == "keypoint":
        return keypoint
    if advice.kind == "view":
        return f"A second photo of these points, from {TURN_DEG:.0f}° aside"
    if advice.kind == "mask":
        return "A mask of the object"
    return f"{str(advice.detail).capitalize()}, measured to {100 * LENGTH_SIGMA:.0f} %"


def how_text(advice: Advice, observation: str) -> str:
    """Advice on adding a piece of evidence to the observation file of the name; none for pairs."""
    by = {
        "mask": "Start with --mask mask.png, an image of the photo's size that is not 0 on the "
        'object; or write "mask": "mask.png"',
        "view": "Start with a folder of photos, or with --further-photos right.jpg, and add the "
        "photo by 'Objects…' (T), which writes it",
        "lengths": "Start with --size width 0.45 height 0.91 sigma 0.01, in model units; or write "
        '"size": {"width": 0.45, "height": 0.91, "sigma": 0.01}',
    }
    return f"{by[advice.kind]} into {observation}." if advice.kind in by else ""


def left_text(advice: Advice) -> str:
    """The largest standard deviation that is left with a piece of evidence."""
    if advice.worst > _UNCERTAIN:
        return "something stays undetermined"
    if advice.worst == math.radians(advice.rotation_deg):
        return f"rotation to ± {short(advice.rotation_deg)}°"
    percent = f"± {short(100 * advice.worst)} %"
    if advice.worst == advice.position:
        return f"position to {percent}"
    return f"stretch along {'xyz'[advice.stretch.index(advice.worst)]} to {percent}"


def _extent(live: LiveAlignment, axis: str, shape: ObjectShape | None, *, in_lengths: bool) -> Fact:
    """Length of the object along an axis, or its stretch."""
    result, row = live.result, "xyz".index(axis)
    assert result is not None
    stretch, relative = float(result.stretch[row]), 0.0
    if result.std is not None:
        relative = result.std.scale[row]
    label, value, unit = f"Stretch along {axis}", stretch, ""
    if in_lengths:
        label, unit = f"Length along {axis}", _unit(shape)
        value = float(np.ptp(result.bounds, axis=0)[row] * result.alignment.scale[row])
    if not value > 0 or relative > _UNCERTAIN:
        return Fact(label, *_UNDETERMINED)
    average = "the model" if shape is None else shape.average
    if relative == 0:
        return Fact(label, f"{value:.3g}{unit}", f"{average}'s, taken as known")
    text = f"{value:.3g} ± {short(value * relative)}{unit}"
    prior = float(live.prior_lengths[row])
    if prior and relative > _LEFT_OPEN * prior:
        if in_lengths:
            return Fact(label, text, f"the pairs leave it open: {average}'s and its spread")
        note = f"the pairs leave it open: about 1 by the prior of ± {100 * prior:.0f} %"
        return Fact(label, "not determined", note)
    percent = 100 * (stretch - 1)
    if abs(percent) < 100 * relative:
        return Fact(label, text, f"{average}'s length lies within the standard deviation")
    if abs(percent) < 0.5:
        return Fact(label, text, f"as long as {average}")
    than = "longer" if percent > 0 else "shorter"
    return Fact(label, text, f"{abs(percent):.0f} % {than} than {average}")


def _rotation(sigma: float) -> Fact:
    """Standard deviation of the rotation [degrees]."""
    if sigma > _UNCERTAIN_DEG:
        return Fact("Rotation", *_UNDETERMINED)
    return Fact("Rotation", f"known to ± {short(sigma)}°", "")


def _distance(live: LiveAlignment, shape: ObjectShape | None) -> Fact:
    assert live.result is not None
    translation, covariance = live.result.alignment.translation, live.result.covariance
    distance = float(np.linalg.norm(translation))
    learned = None if shape is None else shape.learned
    units = {"m": "", "diagonal": "diagonals of the object's box"}
    note = "model units" if learned is None else units.get(learned.unit, learned.unit)
    if covariance is None or not distance > 0:
        return Fact("Distance", f"{distance:.3g} {note}", "")
    along = translation / distance
    sigma = math.sqrt(max(float(along @ covariance[3:6, 3:6] @ along), 0.0))
    if sigma > _UNCERTAIN * distance:
        return Fact("Distance", *_UNDETERMINED)
    return Fact("Distance", f"{distance:.3g} ± {short(sigma)}{_unit(shape)}", note)


def _focal(live: LiveAlignment) -> Fact:
    result, focal = live.result, live.camera.fx
    assert result is not None
    if result.std is None or result.focal == "known":
        note = "assumed" if "focal length" in live.message else "taken as known"
        return Fact("Focal length", f"{focal:.0f} px", note)
    if live.camera != result.camera:  # another lens, which is not in the covariance
        return Fact("Focal length", f"{focal:.0f} px", "estimated")
    relative = result.std.focal
    if relative > _UNCERTAIN:
        return Fact("Focal length", *_UNDETERMINED)
    others = live.others_focal
    note = "estimated"
    if others is not None:
        percent = short(100 * others.relative_sigma)
        note += f" with the photo's other objects, which say {others.focal:.0f} px ± {percent} %"
    return Fact("Focal length", f"{focal:.0f} ± {short(focal * relative)} px", note)


def _unit(shape: ObjectShape | None) -> str:
    """Unit of lengths, after a number; empty for the model's own."""
    learned = None if shape is None else shape.learned
    return " m" if learned is not None and learned.unit == "m" else ""


def short(value: float) -> str:
    """Two digits, without an exponent."""
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"
