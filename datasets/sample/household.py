"""Parametric chairs, with several kinds of legs and backs, and bottles with a cap and a label."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.sample.model import Draft, Kind, beam, box, lathe, palette, table

# Base, back, and armrests or none.
_STYLES = (
    ("straight", "slats", False), ("swivel", "panel", True), ("splayed", "panel", False),
    ("straight", "ladder", True), ("tapered", "panel", True), ("splayed", "slats", False),
    ("straight", "panel", True), ("tapered", "panel", False), ("swivel", "panel", False),
    ("splayed", "slats", True), ("tapered", "ladder", False), ("tapered", "slats", True),
)  # fmt: skip
# How far the feet stand out and the legs' tops lie inside [metres]; thickness of top and foot.
_LEGS = {
    "straight": (-0.023, 0.023, (1.0, 1.0)),
    "tapered": (0.0, 0.03, (1.15, 0.7)),
    "splayed": (0.03, 0.1, (1.1, 0.6)),
}
# Ranges of the seat's width, depth, height, thickness, of the back's length, tilt, of a leg's size.
_LEAST, _MOST = (0.4, 0.4, 0.42, 0.028, 0.38, 5, 0.032), (0.52, 0.5, 0.5, 0.05, 0.58, 13, 0.046)
_WOODS = palette("966236 ba8650 603c26 cea470 7a4628 462e22")
_METALS = palette("a8acb2 34363a 787c82")
_FABRICS = palette("ac342e 2c5484 46764e d4a03c 784a78 42464e c4baa8 28787e")
(_DARK,) = palette("26262a")


def chair(rng: np.random.Generator, index: int) -> Draft:
    """Draw and build a chair.

    Semantic ids are those of KeypointNet's chairs: 0, 1 top corners of the back; 2, 3 rear and
    4, 5 front corners of the seat; 6 to 9 ends of the armrests; 10 to 14 tips of a swivel base;
    17 to 20 feet. Three more are this data set's own: 21, 22 the sides of the back and 23 the
    middle of its top.
    """
    base, back, has_arms = _STYLES[index % len(_STYLES)]
    width, depth, seat, thickness, tall, tilt, leg = rng.uniform(_LEAST, _MOST).tolist()
    bars, is_cushioned, is_wooden = rng.integers(3, 6), rng.random() < 0.6, base != "swivel"
    frame, fabric = rng.choice(_WOODS if is_wooden else _METALS), rng.choice(_FABRICS)
    draft, half = Draft(), width / 2
    color = np.round(frame + 0.2 * (255 - frame)) if is_wooden else fabric
    middle, size = (0.0, seat - thickness / 2, 0.0), (width, thickness, depth)
    draft.add(box(middle, size, color, radius=0.4 * thickness))
    if is_cushioned or back == "panel":
        middle, size = (0.0, seat + 0.012, -0.01), (width - 0.03, 0.045, depth - 0.05)
        draft.add(box(middle, size, fabric, radius=0.02, steps=4))
    draft.mark_pair(2, 3, (half, seat, 0.43 * depth))
    draft.mark_pair(4, 5, (half, seat, -depth / 2))

    def at(share: float, x: float, hollow: float = 0.0) -> tuple[float, float, float]:
        """A point of the back at a share of its height."""
        slope, along = np.radians(tilt), share * tall
        z = depth / 2 - 0.025 + along * np.sin(slope) + hollow
        return x, seat + along * np.cos(slope), z

    if back == "panel":  # an upholstered board with rounded edges before two posts
        scales = [(0.92, 0.35), (0.97, 0.75), (1, 1), (1, 1), (0.97, 0.75), (0.92, 0.35)]
        path = [at(share, 0.0) for share in (0.28, 0.285, 0.31, 0.97, 0.995, 1.0)]
        draft.add(beam(path, (width - leg, 0.05), fabric, scales=scales, radius=0.02))
        post = [at(share, half - leg, 0.018) for share in (-0.1, 0.8)]
        draft.add_pair(beam(post, (0.028, 0.022), frame))
    else:  # two posts with slats or the rungs of a ladder between them, hollowed
        side, rungs = half - 0.8 * leg, [(0.93, 0.07), (0.2, 0.04)]
        post = [at(share, side) for share in (-0.06, 1.0)]
        draft.add_pair(beam(post, (0.8 * leg, leg), frame, scales=(1, 0.85)))
        if back == "ladder":
            rungs = [(share, 0.06) for share in np.linspace(0.28, 0.9, bars)]
        else:
            for x in np.linspace(-side, side, bars + 2)[1:-1]:
                path = [at(share, x, 0.025 * (1 - (x / side) ** 2)) for share in (0.2, 0.93)]
                draft.add(beam(path, (0.75 * side / bars, 0.014), frame))
        for share, high in rungs:
            xs = np.linspace(-side, side, 9)
            path = [at(share, x, 0.025 * (1 - (x / side) ** 2)) for x in xs]
            draft.add(beam(path, (0.022, high), frame))
    draft.mark_pair(0, 1, at(1.0, half - 0.5 * leg))
    draft.mark_pair(21, 22, at(0.84, half + 0.08))
    draft.places[23] = at(1.2, 0.0)

    if has_arms:  # each on a post in front
        (x, y, rear), front = at(0.22 / tall, half + 0.01), -0.32 * depth
        middle, size = (x, y - 0.012, (front + rear) / 2), (0.05, 0.024, rear - front)
        path = [(half - 0.012, seat - 0.6 * thickness, front + 0.04), (x, y - 0.01, front + 0.04)]
        draft.add_pair(box(middle, size, frame if is_wooden else _DARK, radius=0.01))
        draft.add_pair(beam(path, (0.026, 0.034), frame))
        draft.mark_pair(6, 8, (x + 0.025, y, front))
        draft.mark_pair(7, 9, (x + 0.025, y, rear))
    if is_wooden:  # four legs, and bars between straight ones
        out, inset, taper = _LEGS[base]
        x, z, top = half + out, depth / 2 + out, seat - 0.4 * thickness
        for right, left, sign in ((17, 20, -1), (18, 19, 1)):
            path = [(half - inset, top, sign * (depth / 2 - inset)), (x, 0, sign * z)]
            draft.add_pair(beam(path, (leg, leg), frame, scales=taper))
            draft.mark_pair(right, left, (x + leg, 0.01, sign * (z + leg)))
        if base == "straight":
            draft.add_pair(beam([(x, 0.16, -z), (x, 0.16, z)], (0.02, 0.028), frame))
            draft.add(beam([(-x, 0.16, 0), (x, 0.16, 0)], (0.02, 0.028), frame))
        return draft

    column = [(0.045, 0.06), (0.045, 0.13), (0.03, 0.15), (0.03, 0.24), (0.018, 0.245)]
    plate = [(0.018, seat - 0.08), (0.09, seat - 0.05), (0.09, seat - 0.01)]
    draft.add(lathe(column + plate, frame, count=20))
    draft.turned.append((10, 11, 12, 13, 14))
    for number, degrees in zip(*draft.turned, (144, 72, 0, -72, -144), strict=True):
        angle = np.radians(degrees)  # from +z towards +x
        x, z = 0.58 * width * np.sin(angle), 0.58 * width * np.cos(angle)
        spoke, castor = [(0, 0.115, 0), (x, 0.075, z)], (0.96 * x, 0.03, 0.96 * z)
        draft.add(beam(spoke, (0.05, 0.036), frame, scales=(1, 0.6), side=(z, 0, -x)))
        draft.add(box(castor, (0.05, 0.06, 0.05), _DARK, radius=0.03, steps=3))
        draft.places[number] = (x, 0.09, z)
    return draft


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
