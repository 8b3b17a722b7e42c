"""Parametric bottles with a cap and a label."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.sample.model import Draft, Kind, table
from cadalign.datasets.sample.parts import lathe, palette

_EDGE = 0.022  # radius of the rounded edge of the bottom
# Shares of the height. The neck begins at ``neck``; ``curve`` shapes what is between it and the
# body's end, the shoulder: less than 1 is full, more is slender. ``exponent`` and ``depth``, the
# extent along z relative to x, are those of the body's superellipse. A label is from low to high.
_BOTTLES = table("""
    kind      radius shoulder neck neck_radius curve exponent depth waist low high glass cap
    Bordeaux  .125   .6       .72  .047        .55   2        1     0     .14 .46  green foil
    water     .155   .68      .88  .058        .8    2        1     0     .38 .6   clear screw
    Burgundy  .15    .42      .74  .048        1.35  2        1     0     .1  .34  green foil
    beer      .134   .55      .78  .052        1.0   2        1     0     .16 .44  brown crown
    spirit    .2     .56      .76  .062        .45   6        1     0     .14 .42  amber stopper
    soda      .155   .66      .87  .056        .9    2        1     .16   .36 .54  paint screw
    perfume   .25    .66      .83  .07         .5    2.4      .42   0     .2  .5   clear stopper
    milk      .178   .5       .78  .1          1.2   2        1     0     .12 .36  milk  screw
    sauce     .15    .6       .74  .075        .6    2        1     0     .14 .5   paint nozzle
    medicine  .2     .7       .78  .13         .5    2        1     0     .16 .56  amber lid
    champagne .165   .36      .74  .05         1.1   2        1     0     .1  .3   green foil
    shampoo   .19    .62      .8   .085        .55   3.2      .5    0     .12 .48  paint lid
""")
_GLASS = {
    "green": palette("284a2c 1c3828"),
    "brown": palette("623616"),
    "clear": palette("a8d0e2"),
    "amber": palette("ba7024 c8883c"),
    "milk": palette("eeece2 e2e8ec"),
    "paint": palette("ce342c 2860a8 ecba34 408c54"),
}
# Radius, relative to the neck's, and height from the cap's lower end to the rim of its top.
_CAPS = {
    "foil": [(1.03, 0.82), (1.03, 0.93), (1.13, 0.934), (1.13, 0.962), (1.05, 0.97)],
    "crown": [(1.28, 0.942), (1.2, 0.958), (1.02, 0.972)],
    "stopper": [(0.8, 0.93), (0.8, 0.97), (1.24, 0.985), (1.32, 1.005), (1.24, 1.028), (1, 1.042)],
    "nozzle": [(1.1, 0.76), (1.1, 0.83), (0.75, 0.85), (0.28, 1.0), (0.22, 1.005)],
    "screw": [(1.16, 0.905), (1.16, 0.977), (1.1, 0.985)],
    "lid": [(1.12, 0.85), (1.12, 0.977), (1.06, 0.985)],
}
_CAP_COLORS = palette("b02428 202228 ceaa54 245296 f0f0ec")
_LABELS = palette("eee6ce f6f6f2 decea0 cedee8")
_STRIPES = palette("981e26 224276 285c3c a88032 302c2e")


def bottle(rng: np.random.Generator, index: int) -> Draft:
    """Draw and build a bottle.

    Semantic ids are those of KeypointNet's bottles: 0 to 3 around the base, 4 to 7 around the
    shoulder, 8 the middle of the top, 9 to 12 around the top's rim, 13 to 16 around the beginning
    of the neck.
    """
    color, kind = rng.choice(_CAP_COLORS), _BOTTLES[index % len(_BOTTLES)]
    b = kind.varied(rng, radius=(0.9, 1.14))
    b.shoulder += rng.uniform(-0.03, 0.03)
    b.neck += rng.uniform(-0.02, 0.02)
    b.neck_radius *= rng.uniform(0.92, 1.1)
    cap = np.array(_CAPS[b.cap]) * (b.neck_radius, 1)
    cap[:, 1] = np.maximum(cap[:, 1], b.neck + 0.025)
    knots = [_EDGE, b.shoulder, b.neck, max(cap[0, 1], b.neck + 0.06) + 0.01]
    heights = np.interp(np.arange(-4, 33), [0, 15, 29, 32], knots)
    heights[:4] = _EDGE * (1 - np.cos(np.linspace(0, np.pi / 2, 5)))[:4]
    paper = np.linspace(b.low, min(b.high, b.shoulder - 0.04), 9)
    draft = Draft(round=(b.exponent, b.depth) == (2, 1))
    draft.add(
        lathe(_profile(b, heights), rng.choice(_GLASS[b.glass]), count=40),
        lathe(cap, color, count=40),
        lathe(_profile(b, paper, 1.012), rng.choice(_LABELS), count=40),
        lathe(_profile(b, paper[5:8], 1.02), rng.choice(_STRIPES), count=40),
    )
    rim, top = cap[-1]
    draft.places[8] = (0.0, top + 0.1, 0.0)
    for first, y in ((0, 0.02), (4, b.shoulder), (9, top - 0.004), (13, b.neck)):
        radius, _, depth, exponent = (rim, y, 1, 2) if first == 9 else _profile(b, y)
        x, z = radius * 2 ** (-1 / exponent), depth * radius * 2 ** (-1 / exponent)
        around = (first, first + 1, first + 2, first + 3)
        corners = ((x, y, -z), (x, y, z), (-x, y, z), (-x, y, -z))  # KeypointNet's order
        draft.places |= zip(around, corners, strict=True)
        draft.mirrored += [(around[i - 1], around[i]) for i in range(4)]
        draft.turned += [around] if draft.round else []
    return draft


def _profile(b: Kind, y: float | FloatArray, grow: float = 1.0) -> FloatArray:
    """Radii, heights, depths and exponents (k, 4) of sections at heights; round at the neck."""
    body = np.clip((y - _EDGE) / (b.shoulder - _EDGE), 0, 1)
    above = np.clip((y - b.shoulder) / (b.neck - b.shoulder), 0, 1)
    # A smooth step from body to neck; the power moves it down (slender) or up (full).
    step = 0.5 - 0.5 * np.cos(np.pi * above ** (1 / b.curve))
    foot = np.sqrt(_EDGE**2 - np.clip(_EDGE - y, 0, _EDGE) ** 2) - _EDGE
    radius = b.radius * (1 - b.waist * np.sin(np.pi * body) ** 4) + foot
    radius = radius + (b.neck_radius - b.radius) * step
    depth, exponent = 1 + (b.depth - 1) * (1 - above), 2 + (b.exponent - 2) * (1 - above) ** 0.7
    return np.stack([grow * radius, y, depth, exponent], axis=-1)
