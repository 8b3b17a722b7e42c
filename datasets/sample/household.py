"""Parametric chairs in several styles, and bottles with a cap and a label."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.datasets.sample.model import (
    Color,
    Draft,
    Point,
    beam,
    both_sides,
    box,
    ellipsoid,
    lathe,
    mirrored_places,
    palette,
    pick,
    varied,
)
from cadalign.geometry.mesh import Mesh

# Chairs -------------------------------------------------------------------------------------------

# Base, back, and arms or none.
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
_WOODS = palette("966236 ba8650 603c26 cea470 7a4628 462e22")
_METALS = palette("a8acb2 34363a 787c82")
_FABRICS = palette("ac342e 2c5484 46764e d4a03c 784a78 42464e c4baa8 28787e")
(_DARK,) = palette("26262a")
_SPOKE_IDS = (10, 11, 12, 13, 14)
# Ranges of a chair's width, depth, seat, thickness, tall, tilt and leg.
_LEAST, _MOST = (0.4, 0.4, 0.42, 0.028, 0.38, 5, 0.032), (0.52, 0.5, 0.5, 0.05, 0.58, 13, 0.046)


@dataclass(frozen=True)
class _Chair:
    """Proportions of a chair [metres, degrees]; ``seat`` is the height of its seat."""

    width: float
    depth: float
    seat: float
    thickness: float
    tall: float
    tilt: float
    leg: float

    def back(self, share: float, x: float = 0.0, hollow: float = 0.0) -> Point:
        """A point of the back at a share of its height."""
        slope, along = np.radians(self.tilt), share * self.tall
        z = self.depth / 2 - 0.025 + along * np.sin(slope) + hollow
        return x, float(self.seat + along * np.cos(slope)), float(z)


def chair(rng: np.random.Generator, index: int) -> Draft:
    """Draw and build a chair.

    Semantic ids are those of KeypointNet's chairs: 0, 1 top corners of the back; 2, 3 rear and
    4, 5 front corners of the seat; 6 to 9 ends of the armrests; 10 to 14 tips of a swivel base;
    17 to 20 feet. Three more are this data set's own: 21, 22 the sides of the back and 23 the
    middle of its top.
    """
    base, back, has_arms = _STYLES[index % len(_STYLES)]
    c = _Chair(*rng.uniform(_LEAST, _MOST).tolist())
    bars, cushioned = int(rng.integers(3, 6)), bool(rng.random() < 0.6)
    frame, fabric = pick(rng, _METALS if base == "swivel" else _WOODS), pick(rng, _FABRICS)
    half = c.width / 2
    pairs = {
        (0, 1): c.back(1.0, half - 0.5 * c.leg),
        (2, 3): (half, c.seat, 0.43 * c.depth),
        (4, 5): (half, c.seat, -c.depth / 2),
        (21, 22): c.back(0.84, half + 0.08),
    }
    places = {23: c.back(1.2)}
    r, g, b = (round(value + 0.2 * (255 - value)) for value in frame)
    color = fabric if base == "swivel" else (r, g, b)
    size = (c.width, c.thickness, c.depth)
    parts = [box((0, c.seat - c.thickness / 2, 0), size, color, radius=0.4 * c.thickness)]
    if cushioned or back == "panel":
        size = (c.width - 0.03, 0.045, c.depth - 0.05)
        parts.append(box((0, c.seat + 0.012, -0.01), size, fabric, radius=0.02, steps=4))
    parts += _panel(c, frame, fabric) if back == "panel" else _bars(c, frame, back, bars)
    if has_arms:
        x, y, rear = c.back(0.22 / c.tall, half + 0.01)
        front = -0.32 * c.depth
        pad, color = (0.05, 0.024, rear - front), _DARK if base == "swivel" else frame
        post = [
            (half - 0.012, c.seat - 0.6 * c.thickness, front + 0.04),
            (x, y - 0.01, front + 0.04),
        ]
        parts += both_sides(
            box((x, y - 0.012, (front + rear) / 2), pad, color, radius=0.01),
            beam(post, (0.026, 0.034), frame),
        )
        pairs |= {(6, 8): (x + 0.025, y, front), (7, 9): (x + 0.025, y, rear)}
    parts += _swivel(c, frame, places) if base == "swivel" else _legs(c, frame, base, pairs)
    turned = (_SPOKE_IDS,) if base == "swivel" else ()
    return Draft(parts, mirrored_places(pairs) | places, tuple(pairs), turned)


def _panel(c: _Chair, frame: Color, fabric: Color) -> list[Mesh]:
    """An upholstered board with rounded edges before two posts."""
    half = c.width / 2 - 0.5 * c.leg
    scales = [(0.92, 0.35), (0.97, 0.75), (1, 1), (1, 1), (0.97, 0.75), (0.92, 0.35)]
    path = [c.back(share) for share in (0.28, 0.285, 0.31, 0.97, 0.995, 1.0)]
    post = [c.back(share, half - 0.5 * c.leg, 0.018) for share in (-0.1, 0.8)]
    return [
        beam(path, (2 * half, 0.05), fabric, scales=scales, radius=0.02),
        *both_sides(beam(post, (0.028, 0.022), frame)),
    ]


def _bars(c: _Chair, frame: Color, kind: str, count: int) -> list[Mesh]:
    """Two posts with slats or the rungs of a ladder between them, hollowed."""
    half = c.width / 2 - 0.8 * c.leg
    xs = np.linspace(-half, half, 9)

    def at(share: float, x: float) -> Point:
        return c.back(share, x, 0.025 * (1 - (x / half) ** 2))

    post, rungs = [c.back(-0.06, half), c.back(1.0, half)], [(0.93, 0.07), (0.2, 0.04)]
    if kind == "ladder":
        rungs = [(share, 0.06) for share in np.linspace(0.28, 0.9, count)]
    slats = np.linspace(-half, half, count + 2)[1 : 1 if kind == "ladder" else -1]
    return [
        *both_sides(beam(post, (0.8 * c.leg, c.leg), frame, scales=(1, 0.85))),
        *(beam([at(0.2, x), at(0.93, x)], (0.75 * half / count, 0.014), frame) for x in slats),
        *(beam([at(share, x) for x in xs], (0.022, tall), frame) for share, tall in rungs),
    ]


def _legs(c: _Chair, frame: Color, base: str, pairs: dict[tuple[int, int], Point]) -> list[Mesh]:
    """Four legs, their feet added to ``pairs``, and bars between straight ones."""
    out, inset, scales = _LEGS[base]
    x, z = c.width / 2 + out, c.depth / 2 + out
    top, parts = (c.width / 2 - inset, c.seat - 0.4 * c.thickness, c.depth / 2 - inset), []
    for ids, sign in (((17, 20), -1), ((18, 19), 1)):
        path = [np.multiply(top, (1, 1, sign)), (x, 0, sign * z)]
        parts += both_sides(beam(path, (c.leg, c.leg), frame, scales=scales))
        pairs[ids] = (x + c.leg, 0.01, sign * (z + c.leg))
    if base == "straight":
        parts += both_sides(beam([(x, 0.16, -z), (x, 0.16, z)], (0.02, 0.028), frame))
        parts.append(beam([(-x, 0.16, 0), (x, 0.16, 0)], (0.02, 0.028), frame))
    return parts


def _swivel(c: _Chair, frame: Color, places: dict[int, Point]) -> list[Mesh]:
    """A column on five spokes with castors, their tips added to ``places``."""
    top, foot = c.seat - 0.01, [(0.045, 0.06), (0.045, 0.13), (0.03, 0.15), (0.03, 0.24)]
    column = [*foot, (0.018, 0.245), (0.018, top - 0.07), (0.09, top - 0.04), (0.09, top)]
    parts = [lathe(column, frame, count=20)]
    for number, degrees in zip(_SPOKE_IDS, (144, 72, 0, -72, -144), strict=True):
        angle = np.radians(degrees)  # from +z towards +x
        x, z = float(0.58 * c.width * np.sin(angle)), float(0.58 * c.width * np.cos(angle))
        path = [(0, 0.115, 0), (x, 0.075, z)]
        parts += [
            beam(path, (0.05, 0.036), frame, scales=(1, 0.6), side=(z, 0, -x)),
            ellipsoid((0.96 * x, 0.03, 0.96 * z), (0.05, 0.06, 0.05), _DARK, count=16),
        ]
        places[number] = (x, 0.09, z)
    return parts


# Bottles ------------------------------------------------------------------------------------------

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

    def turned(self, heights: FloatArray, color: Color, *, grow: float = 1.0) -> Mesh:
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
_BOTTLES = (
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
    kind, color = _BOTTLES[index % len(_BOTTLES)], pick(rng, _CAP_COLORS)
    b = varied(kind, rng, radius=(0.9, 1.14))
    shoulder, neck = b.shoulder + rng.uniform(-0.03, 0.03), b.neck + rng.uniform(-0.02, 0.02)
    b = varied(replace(b, shoulder=shoulder, neck=neck), rng, neck_radius=(0.92, 1.1))
    glass, label, stripe = (pick(rng, colors) for colors in (b.glass, _LABELS, _STRIPES))
    cap = np.array(_CAPS[b.cap]) * (b.neck_radius, 1)
    cap[:, 1] = np.maximum(cap[:, 1], b.neck + 0.025)
    rim, top = cap[-1].tolist()
    foot = _EDGE * (1 - np.cos(np.linspace(0, np.pi / 2, 5)))
    knots = [_EDGE, b.shoulder, b.neck, max(cap[0, 1], b.neck + 0.06) + 0.01]
    heights = np.interp(np.arange(33), [0, 15, 29, 32], knots)
    paper = np.linspace(b.label[0], min(b.label[1], b.shoulder - 0.04), 9)
    parts = [
        b.turned(np.concatenate([foot, heights[1:]]), glass),
        lathe(cap, color, count=40),
        b.turned(paper, label, grow=1.012),
        b.turned(paper[5:8], stripe, grow=1.02),
    ]
    places = {8: (0.0, top + 0.1, 0.0)} | b.ring(9, top - 0.004, rim)
    for first, height in ((0, 0.02), (4, b.shoulder), (13, b.neck)):
        places |= b.ring(first, height)
    groups = tuple(tuple(range(first, first + 4)) for first in (0, 4, 9, 13))
    mirrored = tuple((group[i], group[(i + 1) % 4]) for group in groups for i in range(4))
    is_round = (b.exponent, b.depth) == (2.0, 1.0)
    return Draft(parts, places, mirrored, groups if is_round else (), is_round)
