"""Parametric bottles: turned profiles with a cap and a label."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.datasets.sample.model import Color, Draft, Point, Solid, lathe, palette, pick

_EDGE = 0.022  # radius of the rounded edge of the bottom


@dataclass(frozen=True)
class _Bottle:
    """Proportions of a bottle, as shares of its height, its cap, and the colours of its glass.

    ``shoulder`` is the end of the body, ``neck`` the beginning of the neck; ``curve`` shapes the
    part between them: less than 1 is full, more is slender. ``exponent`` and ``depth``, the extent
    along z relative to x, are those of the body's superellipse.
    """

    radius: float
    shoulder: float
    neck: float
    neck_radius: float
    curve: float
    cap: str
    label: tuple[float, float]
    glass: tuple[Color, ...]
    exponent: float = 2.0
    depth: float = 1.0
    waist: float = 0.0

    def radius_at(self, height: npt.ArrayLike) -> FloatArray:
        y = np.asarray(height)
        body = np.clip((y - _EDGE) / (self.shoulder - _EDGE), 0, 1)
        above = np.clip((y - self.shoulder) / (self.neck - self.shoulder), 0, 1)
        # A smooth step from body to neck; the power moves it down (slender) or up (full).
        step = 0.5 - 0.5 * np.cos(np.pi * above ** (1 / self.curve))
        under = np.clip(_EDGE - y, 0, _EDGE)
        radius = self.radius * (1 - self.waist * np.sin(np.pi * body) ** 4)
        radius = radius - _EDGE + np.sqrt(_EDGE**2 - under**2)
        return np.asarray(radius + (self.neck_radius - self.radius) * step)

    def section(self, height: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """The superellipse's depths and exponents at heights, round at the neck."""
        below = np.clip((self.neck - np.asarray(height)) / (self.neck - self.shoulder), 0, 1)
        return 1 + (self.depth - 1) * below, 2 + (self.exponent - 2) * below**0.7

    def turned(self, heights: FloatArray, color: Color, *, grow: float = 1.0) -> Solid:
        profile = np.stack([grow * self.radius_at(heights), heights], axis=1)
        depth, exponent = self.section(heights)
        return lathe(profile, color, count=40, depth=depth, exponent=exponent)

    def ring(self, first: int, height: float, radius: float | None = None) -> dict[int, Point]:
        """Four places around the axis, by semantic id; on the glass, or on a round cap."""
        depth, exponent = (1.0, 2.0) if radius else map(float, self.section(height))
        # KeypointNet's order of four points around: (+x, -z), (+x, +z), (-x, +z), (-x, -z).
        x = (radius or float(self.radius_at(height))) * 2 ** (-1 / exponent)
        corners = (x, -x * depth), (x, x * depth), (-x, x * depth), (-x, -x * depth)
        return {first + i: (right, height, rear) for i, (right, rear) in enumerate(corners)}


_GREEN, _BROWN, _CLEAR = palette("284a2c 1c3828"), palette("623616"), palette("a8d0e2")
_AMBER, _MILK = palette("ba7024 c8883c"), palette("eeece2 e2e8ec")
_PAINT = palette("ce342c 2860a8 ecba34 408c54")
_CAP_COLORS = palette("b02428 202228 ceaa54 245296 f0f0ec")
_LABELS = palette("eee6ce f6f6f2 decea0 cedee8")
_STRIPES = palette("981e26 224276 285c3c a88032 302c2e")
_KINDS = (
    _Bottle(0.125, 0.6, 0.72, 0.047, 0.55, "foil", (0.14, 0.46), _GREEN),  # Bordeaux wine
    _Bottle(0.155, 0.68, 0.88, 0.058, 0.8, "screw", (0.38, 0.6), _CLEAR),  # water
    _Bottle(0.15, 0.42, 0.74, 0.048, 1.35, "foil", (0.1, 0.34), _GREEN),  # Burgundy wine
    _Bottle(0.134, 0.55, 0.78, 0.052, 1.0, "crown", (0.16, 0.44), _BROWN),  # beer
    _Bottle(0.2, 0.56, 0.76, 0.062, 0.45, "stopper", (0.14, 0.42), _AMBER, 6.0),  # spirit
    _Bottle(0.155, 0.66, 0.87, 0.056, 0.9, "screw", (0.36, 0.54), _PAINT, waist=0.16),  # soda
    _Bottle(0.25, 0.66, 0.83, 0.07, 0.5, "stopper", (0.2, 0.5), _CLEAR, 2.4, 0.42),
    _Bottle(0.178, 0.5, 0.78, 0.1, 1.2, "screw", (0.12, 0.36), _MILK),  # milk
    _Bottle(0.15, 0.6, 0.74, 0.075, 0.6, "nozzle", (0.14, 0.5), _PAINT),  # sauce
    _Bottle(0.2, 0.7, 0.78, 0.13, 0.5, "lid", (0.16, 0.56), _AMBER),  # medicine
    _Bottle(0.165, 0.36, 0.74, 0.05, 1.1, "foil", (0.1, 0.3), _GREEN),  # champagne
    _Bottle(0.19, 0.62, 0.8, 0.085, 0.55, "lid", (0.12, 0.48), _PAINT, 3.2, 0.5),
)
# Radius, relative to the neck's, and height from the cap's lower end to the rim of its top.
_CAPS = {
    "foil": [(1.03, 0.82), (1.03, 0.93), (1.13, 0.934), (1.13, 0.962), (1.05, 0.97)],
    "crown": [(1.28, 0.942), (1.2, 0.958), (1.02, 0.972)],
    "stopper": [(0.8, 0.93), (0.8, 0.97), (1.24, 0.985), (1.32, 1.005), (1.24, 1.028), (1, 1.042)],
    "nozzle": [(1.1, 0.76), (1.1, 0.83), (0.75, 0.85), (0.28, 1.0), (0.22, 1.005)],
    "screw": [(1.16, 0.905), (1.16, 0.977), (1.1, 0.985)],
    "lid": [(1.12, 0.85), (1.12, 0.977), (1.06, 0.985)],
}


def bottle(rng: np.random.Generator, index: int) -> Draft:
    """Draw and build a bottle.

    Semantic ids are those of KeypointNet's bottles: 0 to 3 around the base, 4 to 7 around the
    shoulder, 8 the middle of the top, 9 to 12 around the top's rim, 13 to 16 around the beginning
    of the neck.
    """
    kind, color = _KINDS[index % len(_KINDS)], pick(rng, _CAP_COLORS)
    b = replace(
        kind,
        radius=kind.radius * rng.uniform(0.9, 1.14),
        shoulder=kind.shoulder + rng.uniform(-0.03, 0.03),
        neck=kind.neck + rng.uniform(-0.02, 0.02),
        neck_radius=kind.neck_radius * rng.uniform(0.92, 1.1),
    )
    glass, label, stripe = (pick(rng, colors) for colors in (b.glass, _LABELS, _STRIPES))
    cap = np.array(_CAPS[b.cap]) * (b.neck_radius, 1)
    cap[:, 1] = np.maximum(cap[:, 1], b.neck + 0.025)
    rim, top = cap[-1].tolist()
    foot = _EDGE * (1 - np.cos(np.linspace(0, np.pi / 2, 5)))
    body, shoulder = np.linspace(_EDGE, b.shoulder, 16), np.linspace(b.shoulder, b.neck, 15)
    neck = np.linspace(b.neck, max(cap[0, 1], b.neck + 0.06) + 0.01, 4)
    heights = np.concatenate([foot, body[1:], shoulder[1:], neck[1:]])
    paper = np.linspace(b.label[0], min(b.label[1], b.shoulder - 0.04), 9)
    solids = [
        b.turned(heights, glass),
        lathe(cap, color, count=40),
        b.turned(paper, label, grow=1.012),
        b.turned(paper[5:8], stripe, grow=1.02),
    ]
    groups = tuple(tuple(range(first, first + 4)) for first in (0, 4, 9, 13))
    is_round = (b.exponent, b.depth) == (2.0, 1.0)
    return Draft(
        solids,
        b.ring(0, 0.02) | b.ring(4, b.shoulder) | b.ring(13, b.neck)
        | b.ring(9, top - 0.004, rim) | {8: (0.0, top + 0.1, 0.0)},
        mirrored=tuple((group[i], group[(i + 1) % 4]) for group in groups for i in range(4)),
        turned=groups if is_round else (),
        round=is_round,
    )  # fmt: skip
