"""Alignment, standard deviations and next-best keypoint as text for the page."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cadalign.annotate.alignment import LiveAlignment
from cadalign.annotate.suggestion import NextBest, Unmarked
from cadalign.estimation.result import FitResult
from cadalign.estimation.uncertainty.advice import LENGTH_SIGMA, TURN_DEG, Advice

UNKNOWNS = (
    *["the rotation"] * 3,
    *("the position sideways", "the height", "the distance"),
    *("the stretch along y", "the stretch along z", "the focal length"),
)
"""Names of the unknowns of a covariance, for a sentence."""
_ROTATIONS = 3
UNCERTAIN = 1.0  # relative standard deviation beyond which a number is not shown
LEFT_OPEN = 0.8
"""Share of a prior's standard deviation beyond which the pairs tell nothing."""
_UNCERTAIN_DEG = 60.0
UNDETERMINED = "not determined", "these pairs leave it open"


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
        facts.append(rotation_fact(result.std.rotation_deg))
    facts += [_distance(result), _focal(result)]
    if 2 * len(result.residuals) > 6 + len(result.stretched_axes):
        note = "scaled to the residuals" if live.sigma > 1 else "for clicks of 1 px"
        if result.options is not None and result.options.scale_prior_sigma is not None:
            note = f"for points off by {short(live.sigma)} px"
        note = f"rms; the standard deviations above are {note}"
        facts.append(Fact("Pairs agree to", f"{short(result.rms)} px", note))
    return tuple(facts)


def notes_of(live: LiveAlignment) -> tuple[str, ...]:
    """Assumptions, alternative alignments and warnings."""
    result = live.cautious
    if result is None:
        return ()
    notes = [live.message] if live.message else []
    others = len(result.alternatives)
    if others:
        notes.append(
            f"{others} other alignment{'s explain' if others > 1 else ' explains'} these pairs as "
            "well: one more pair tells them apart"
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
    if advice.worst > UNCERTAIN:
        return "something stays undetermined"
    if advice.worst == math.radians(advice.rotation_deg):
        return f"rotation to ± {short(advice.rotation_deg)}°"
    percent = f"± {short(100 * advice.worst)} %"
    if advice.worst == advice.position:
        return f"position to {percent}"
    return f"stretch along {'xyz'[advice.stretch.index(advice.worst)]} to {percent}"


def _stretch(result: FitResult, axis: str) -> Fact:
    value = float(result.alignment.scale["xyz".index(axis)])
    label = f"Stretch along {axis}"
    std = result.std
    relative = 0.0 if std is None else std.scale["xyz".index(axis)]
    if relative > UNCERTAIN:
        return Fact(label, *UNDETERMINED)
    prior = None if result.options is None else result.options.scale_prior_sigma
    if prior is not None and relative > LEFT_OPEN * prior:
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


def rotation_fact(deviation: float) -> Fact:
    """Standard deviation of the rotation [degrees]."""
    if deviation > _UNCERTAIN_DEG:
        return Fact("Rotation", *UNDETERMINED)
    return Fact("Rotation", f"known to ± {short(deviation)}°", "")


def _distance(result: FitResult) -> Fact:
    translation = result.alignment.translation
    distance = float(np.linalg.norm(translation))
    covariance = result.posterior_covariance
    if covariance is None or not distance > 0:
        return Fact("Distance", f"{distance:.3g} model units", "")
    along = translation / distance
    std = math.sqrt(max(float(along @ covariance[3:6, 3:6] @ along), 0.0))
    if std > UNCERTAIN * distance:
        return Fact("Distance", *UNDETERMINED)
    return Fact("Distance", f"{distance:.3g} ± {short(std)}", "model units")


def _focal(result: FitResult) -> Fact:
    focal, covariance = result.camera.fx, result.posterior_covariance
    if covariance is None or len(covariance) < 9:
        return Fact("Focal length", f"{focal:.0f} px", "taken as known")
    relative = math.sqrt(max(float(covariance[8, 8]), 0.0))
    if relative > UNCERTAIN:
        return Fact("Focal length", *UNDETERMINED)
    return Fact("Focal length", f"{focal:.0f} ± {short(focal * relative)} px", "estimated")


def short(value: float) -> str:
    """Two digits, without an exponent."""
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"
