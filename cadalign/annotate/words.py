"""An alignment and its standard deviations in plain words."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cadalign.annotate.advice import Advice, unknown_name
from cadalign.annotate.alignment import LiveAlignment
from cadalign.fitting.result import FitResult

_ROTATIONS = 3
_UNCERTAIN = 1.0  # relative deviation beyond which a number says nothing


@dataclass(frozen=True)
class Fact:
    """One line of what is known.

    Parameters
    ----------
    label, value : str
    note : str
        What that means.
    """

    label: str
    value: str
    note: str = ""


def facts_of(live: LiveAlignment) -> tuple[Fact, ...]:
    """Stretch, pose and agreement, with deviations that go by the residuals."""
    result = live.cautious
    if result is None:
        return ()
    facts = [_stretch(result, axis) for axis in result.stretched_axes]
    std = result.std
    if std is not None:
        facts.append(Fact("Rotation", f"known to ± {_short(std.rotation_deg)}°"))
    facts.append(_distance(result))
    if live.camera is not None:
        facts.append(_focal(result, live.camera.fx))
    count = len(result.residuals)
    if 2 * count > 6 + len(result.stretched_axes):
        note = "the deviations above go by it" if live.sigma > 1 else "the deviations assume 1 px"
        facts.append(Fact("Pairs agree to", f"{_short(result.rms)} px", f"rms; {note}"))
    return tuple(facts)


def notes_of(live: LiveAlignment) -> tuple[str, ...]:
    """What is to be known beside the facts: other alignments, and what is not determined."""
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


def advice_text(advice: Advice, name: str) -> str:
    """What the next keypoint is and what it would do."""
    shown = _deviations if advice.unknown >= _ROTATIONS else _angles
    before, after = shown(advice.before, advice.after)
    return f"{name}: it would tell {unknown_name(advice.unknown)} to ± {after} instead of {before}"


def _stretch(result: FitResult, axis: str) -> Fact:
    value = float(result.alignment.scale["xyz".index(axis)])
    label = f"Stretch along {axis}"
    std = result.std
    relative = 0.0 if std is None else std.scale["xyz".index(axis)]
    if relative > _UNCERTAIN:
        return Fact(label, "not determined", "these pairs leave it open")
    percent = 100 * (value - 1)
    if abs(percent) < 0.5:
        note = "as long as the model"
    else:
        note = f"{abs(percent):.0f} % {'longer' if percent > 0 else 'shorter'} than the model"
    deviation = f" ± {_short(value * relative)}" if std is not None else ""
    if relative > 0 and abs(percent) < 100 * relative:
        note = "the model's length lies within the deviation"
    return Fact(label, f"{value:.3g}{deviation}", note)


def _distance(result: FitResult) -> Fact:
    translation = result.alignment.translation
    distance = float(np.linalg.norm(translation))
    if result.covariance is None or not distance > 0:
        return Fact("Distance", f"{distance:.3g} model units")
    along = translation / distance
    deviation = math.sqrt(max(float(along @ result.covariance[3:6, 3:6] @ along), 0.0))
    return Fact("Distance", f"{distance:.3g} ± {_short(deviation)}", "model units")


def _focal(result: FitResult, focal: float) -> Fact:
    covariance = result.covariance
    if covariance is None or len(covariance) < 9:
        return Fact("Focal length", f"{focal:.0f} px", "taken as known")
    relative = math.sqrt(max(float(covariance[8, 8]), 0.0))
    if relative > _UNCERTAIN:
        return Fact("Focal length", "not determined", "these pairs leave it open")
    return Fact("Focal length", f"{focal:.0f} ± {_short(focal * relative)} px", "estimated")


def _angles(before: float, after: float) -> tuple[str, str]:
    return f"{_short(math.degrees(before))}°", f"{_short(math.degrees(after))}°"


def _deviations(before: float, after: float) -> tuple[str, str]:
    return f"{_short(100 * before)} %", f"{_short(100 * after)} %"


def _short(value: float) -> str:
    """Two digits, without an exponent."""
    if value >= 10:
        return f"{value:.0f}"
    return f"{value:.2g}"
