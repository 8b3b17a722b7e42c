"""Alignment, standard deviations and next-best keypoint as text for the page."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cadalign.annotate.alignment import LiveAlignment
from cadalign.annotate.object_shape import ObjectShape
from cadalign.annotate.shape_alignment import LiveShape
from cadalign.annotate.suggestion import NextBest, Unmarked
from cadalign.estimation.result import Result
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
_LEFT_OPEN = 0.8  # share of a prior's standard deviation beyond which the pairs tell nothing
_UNCERTAIN_DEG = 60.0
_UNDETERMINED = "not determined", "these pairs leave it open"


@dataclass(frozen=True)
class Fact:
    """One row of the result: label, value, and a remark on the value."""

    label: str
    value: str
    note: str


def facts_of(live: LiveAlignment) -> tuple[Fact, ...]:
    """Stretch, pose and residuals, with standard deviations scaled to the residuals."""
    result = live.cautious
    if result is None:
        return ()
    facts = [_stretch(result, axis) for axis in result.stretched_axes]
    if result.std is not None:
        facts.append(_rotation(result.std.rotation_deg))
    facts += [_distance(result, None), _focal(result)]
    if 2 * len(result.residuals) > 6 + len(result.stretched_axes):
        note = "scaled to the residuals" if live.sigma > 1 else "for clicks of 1 px"
        if result.options is not None and result.options.scale_prior_sigma is not None:
            note = f"for points off by {short(live.sigma)} px"
        note = f"rms; the standard deviations above are {note}"
        facts.append(Fact("Pairs agree to", f"{short(result.rms)} px", note))
    return tuple(facts)


def facts_of_shape(live: LiveShape, shape: ObjectShape | None) -> tuple[Fact, ...]:
    """Lengths, pose and residuals, with standard deviations."""
    result, camera = live.shown, live.camera
    if result is None or camera is None:
        return ()
    facts = [_length(result, axis, float(live.prior_lengths[axis]), shape) for axis in range(3)]
    if result.std is not None:
        facts.append(_rotation(result.std.rotation_deg))
    facts.append(_distance(result, shape))
    if result.focal == "known":
        note = "assumed" if live.provisional else "as given"
        facts.append(Fact("Focal length", f"{camera.fx:.0f} px", note))
    elif camera == result.camera:
        facts.append(_focal(result))
    else:  # that of another lens, whose deviation is not in the covariance
        facts.append(Fact("Focal length", f"{camera.fx:.0f} px", "estimated"))
    if live.counts.sum() > 3:
        off = f"points off by {short(live.sigma)} px" if live.sigma > 1 else "clicks of 1 px"
        note = f"rms; the standard deviations above are for {off}"
        facts.append(Fact("Pairs agree to", f"{short(result.rms)} px", note))
    return tuple(facts)


def notes_of(live: LiveAlignment | LiveShape, shape: ObjectShape | None = None) -> tuple[str, ...]:
    """Assumptions, pairs that do not count, alternative alignments and warnings."""
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
            f"{'as well' if shape is None else 'nearly as well'}: one more pair tells them apart"
        )
    return (*notes, *(warning.replace("+-", "± ") for warning in result.warnings))


def next_best_text(next_best: NextBest | Unmarked, name: str) -> str:
    """Name of the next-best keypoint, and what is gained by it."""
    if isinstance(next_best, Unmarked):
        deviation = short(next_best.deviation)
        return f"{name}: so far known to ± {deviation} px; it would tell most about pose and shape"
    factor, unit = (100, " %") if next_best.unknown >= _ROTATIONS else (math.degrees(1), "°")
    before, after = (short(factor * std) + unit for std in (next_best.before, next_best.after))
    unknown = UNKNOWNS[next_best.unknown]
    return f"{name}: it would determine {unknown} to ± {after} instead of {before}"


def evidence_text(advice: Advice, keypoint: str) -> str:
    """One piece of evidence; of keypoints the one of that name."""
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


def _stretch(result: Result, axis: str) -> Fact:
    value = float(result.alignment.scale["xyz".index(axis)])
    label = f"Stretch along {axis}"
    std = result.std
    relative = 0.0 if std is None else std.scale["xyz".index(axis)]
    if relative > _UNCERTAIN:
        return Fact(label, *_UNDETERMINED)
    prior = None if result.options is None else result.options.scale_prior_sigma
    if prior is not None and relative > _LEFT_OPEN * prior:
        note = f"the pairs leave it open: about 1 by the prior of ± {100 * prior:.0f} %"
        return Fact(label, "not determined", note)
    percent = 100 * (value - 1)
    if abs(percent) < 0.5:
        note = "as long as the model"
    else:
        note = f"{abs(percent):.0f} % {'longer' if percent > 0 else 'shorter'} than the model"
    uncertainty = f" ± {short(value * relative)}" if std is not None else ""
    if relative > 0 and abs(percent) < 100 * relative:
        note = "the model's length lies within the standard deviation"
    return Fact(label, f"{value:.3g}{uncertainty}", note)


def _rotation(deviation: float) -> Fact:
    """Standard deviation of the rotation [degrees]."""
    if deviation > _UNCERTAIN_DEG:
        return Fact("Rotation", *_UNDETERMINED)
    return Fact("Rotation", f"known to ± {short(deviation)}°", "")


def _distance(result: Result, shape: ObjectShape | None) -> Fact:
    translation, covariance = result.alignment.translation, result.covariance
    distance = float(np.linalg.norm(translation))
    learned = None if shape is None else shape.learned
    units = {"m": "", "diagonal": "diagonals of the object's box"}
    note = "model units" if learned is None else units.get(learned.unit, learned.unit)
    if covariance is None or not distance > 0:
        return Fact("Distance", f"{distance:.3g} {note}", "")
    along = translation / distance
    deviation = math.sqrt(max(float(along @ covariance[3:6, 3:6] @ along), 0.0))
    if deviation > _UNCERTAIN * distance:
        return Fact("Distance", *_UNDETERMINED)
    return Fact("Distance", f"{distance:.3g} ± {short(deviation)}{_unit(shape)}", note)


def _length(result: Result, axis: int, prior: float, shape: ObjectShape | None) -> Fact:
    label, std = f"Length along {'xyz'[axis]}", result.std
    relative = 0.0 if std is None else std.scale[axis]
    length = float(np.ptp(result.bounds, axis=0)[axis] * result.alignment.scale[axis])
    if not length > 0 or relative > _UNCERTAIN:
        return Fact(label, *_UNDETERMINED)
    average = "the model" if shape is None else shape.average
    if relative == 0:
        return Fact(label, f"{length:.3g}{_unit(shape)}", f"{average}'s, taken as known")
    value = f"{length:.3g} ± {short(length * relative)}{_unit(shape)}"
    if prior and relative > _LEFT_OPEN * prior:
        spread = f"{average}'s and its spread"
        return Fact(label, value, f"the pairs leave it open: {spread}")
    percent = 100 * (float(result.stretch[axis]) - 1)
    if abs(percent) < 100 * relative:
        return Fact(label, value, f"{average}'s lies within the standard deviation")
    than = "longer" if percent > 0 else "shorter"
    return Fact(label, value, f"{abs(percent):.0f} % {than} than {average}'s")


def _focal(result: Result) -> Fact:
    focal, std = result.camera.fx, result.std
    if std is None or result.focal == "known":
        return Fact("Focal length", f"{focal:.0f} px", "taken as known")
    relative = std.focal
    if relative > _UNCERTAIN:
        return Fact("Focal length", *_UNDETERMINED)
    return Fact("Focal length", f"{focal:.0f} ± {short(focal * relative)} px", "estimated")


def _unit(shape: ObjectShape | None) -> str:
    """Unit of lengths, after a number; empty for the model's own."""
    learned = None if shape is None else shape.learned
    return " m" if learned is not None and learned.unit == "m" else ""


def short(value: float) -> str:
    """Two digits, without an exponent."""
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"
