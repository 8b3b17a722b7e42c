"""Parametric bottles: turned profiles with a cap and a label."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.datasets.sample.model import Draft
from cadalign.datasets.sample.solids import Color, Point, Solid, lathe, smooth_curve

_AZIMUTHS = np.radians([135.0, 45.0, -45.0, -135.0])
# KeypointNet's order of four points around: (+x, -z), (+x, +z), (-x, +z), (-x, -z).
_ROUND = (2.0, 1.0)
_Profile = list[tuple[float, float]]


@dataclass(frozen=True)
class _Kind:
    """A kind of bottle; lengths are shares of its height.

    ``shoulder`` is the end of the body, ``neck`` the beginning of the neck; ``curve`` shapes the
    part between them: less than 1 is full, more is slender. ``shape`` is
    the superellipse's exponent and the extent along z relative to x.
    """

    radius: float
    shoulder: float
    neck: float
    neck_radius: float
    curve: float
    cap: str
    label: tuple[float, float]
    glass: tuple[Color, ...]
    shape: tuple[float, float] = _ROUND
    ribs: int = 0
    waist: float = 0.0


_GREEN: tuple[Color, ...] = ((40, 74, 44), (58, 92, 40), (28, 56, 40))
_BROWN: tuple[Color, ...] = ((98, 54, 22), (116, 68, 26), (78, 42, 22))
_CLEAR: tuple[Color, ...] = ((168, 208, 226), (150, 200, 216), (186, 220, 214))
_AMBER: tuple[Color, ...] = ((186, 112, 36), (168, 92, 30), (200, 136, 60))
_PAINT: tuple[Color, ...] = ((206, 52, 44), (40, 96, 168), (236, 186, 52), (64, 140, 84))
_MILK: tuple[Color, ...] = ((238, 236, 226), (226, 232, 236), (240, 226, 214))

_KINDS = (
    _Kind(0.125, 0.6, 0.72, 0.047, 0.55, "foil", (0.14, 0.46), _GREEN),  # Bordeaux wine
    _Kind(0.155, 0.68, 0.88, 0.058, 0.8, "screw", (0.38, 0.6), _CLEAR, ribs=7),  # water
    _Kind(0.15, 0.42, 0.74, 0.048, 1.35, "foil", (0.1, 0.34), _GREEN),  # Burgundy wine
    _Kind(0.134, 0.55, 0.78, 0.052, 1.0, "crown", (0.16, 0.44), _BROWN),  # beer
    _Kind(0.2, 0.56, 0.76, 0.062, 0.45, "stopper", (0.14, 0.42), _AMBER, shape=(6.0, 1)),  # spirit
    _Kind(0.155, 0.66, 0.87, 0.056, 0.9, "screw", (0.36, 0.54), _PAINT, waist=0.16),  # soda
    _Kind(0.25, 0.66, 0.83, 0.07, 0.5, "stopper", (0.2, 0.5), _CLEAR, shape=(2.4, 0.42)),
    _Kind(0.178, 0.5, 0.78, 0.1, 1.2, "screw", (0.12, 0.36), _MILK),  # milk
    _Kind(0.15, 0.6, 0.74, 0.075, 0.6, "nozzle", (0.14, 0.5), _PAINT),  # sauce
    _Kind(0.2, 0.7, 0.78, 0.13, 0.5, "lid", (0.16, 0.56), _AMBER),  # medicine
    _Kind(0.165, 0.36, 0.74, 0.05, 1.1, "foil", (0.1, 0.3), _GREEN),  # champagne
    _Kind(0.19, 0.62, 0.8, 0.085, 0.55, "lid", (0.12, 0.48), _PAINT, shape=(3.2, 0.5)),
)
_CAPS: tuple[Color, ...] = (
    (176, 36, 40), (32, 34, 40), (206, 170, 84), (36, 82, 150), (240, 240, 236),
)  # fmt: skip
_CORK = (96, 66, 42)
_LABELS: tuple[Color, ...] = (
    (238, 230, 206), (246, 246, 242), (222, 206, 160), (206, 222, 232),
)  # fmt: skip
_STRIPES: tuple[Color, ...] = (
    (152, 30, 38), (34, 66, 118), (40, 92, 60), (168, 128, 50), (48, 44, 46),
)  # fmt: skip


@dataclass(frozen=True)
class _Bottle:
    """A bottle: its kind with the lengths as drawn, and the colours of its parts."""

    kind: _Kind
    glass: Color
    cap: Color
    label: Color
    stripe: Color

    def shape(self, height: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """The superellipse's exponents and extents along z at heights, round at the neck."""
        kind, (exponent, depth) = self.kind, self.kind.shape
        share = (kind.neck - np.asarray(height)) / (kind.neck - kind.shoulder)
        below = np.asarray(np.clip(share, 0, 1))
        return 2.0 + (exponent - 2.0) * below**0.7, 1.0 + (depth - 1.0) * below

    def turned(self, profile: FloatArray, color: Color) -> Solid:
        """A profile turned around the bottle's axis, as round as the bottle is at each height."""
        exponent, depth = self.shape(profile[:, 1])
        return lathe(profile, color, count=40, exponent=exponent, depth=depth)


def bottle(rng: np.random.Generator, index: int) -> Draft:
    """Draw and build a bottle.

    Semantic ids are those of KeypointNet's bottles: 0 to 3 around the base, 4 to 7 around the
    shoulder, 8 the middle of the top, 9 to 12 around the top's rim, 13 to 16 around the beginning
    of the neck.
    """
    drawn = _draw(rng, index)
    kind, profile = drawn.kind, _profile(drawn.kind)
    cap, top, rim = _cap(drawn)
    places = {8: (0.0, top + 0.1, 0.0)}
    rings = ((0, 0.02), (4, kind.shoulder), (13, kind.neck))
    for first, height in rings:
        exponent, depth = map(float, drawn.shape(height))
        places |= _ring(first, _radius_at(profile, height), height, exponent, depth)
    places |= _ring(9, rim, top - 0.004, *_ROUND)
    groups = tuple(tuple(range(first, first + 4)) for first in (0, 4, 9, 13))
    is_round = kind.shape == _ROUND
    return Draft(
        solids=(drawn.turned(profile, drawn.glass), *cap, *_label(drawn, profile)),
        places=places,
        mirrored=tuple((group[i], group[(i + 1) % 4]) for group in groups for i in range(4)),
        turned=groups if is_round else (),
        round=is_round,
    )


def _draw(rng: np.random.Generator, index: int) -> _Bottle:
    kind = _KINDS[index % len(_KINDS)]
    cap = _CAPS[int(rng.integers(len(_CAPS)))]
    kind = replace(
        kind,
        radius=kind.radius * rng.uniform(0.9, 1.14),
        shoulder=kind.shoulder + rng.uniform(-0.03, 0.03),
        neck=kind.neck + rng.uniform(-0.02, 0.02),
        neck_radius=kind.neck_radius * rng.uniform(0.92, 1.1),
    )
    return _Bottle(
        kind=kind,
        glass=kind.glass[int(rng.integers(len(kind.glass)))],
        cap=_CORK if kind.cap == "stopper" and rng.random() < 0.5 else cap,
        label=_LABELS[int(rng.integers(len(_LABELS)))],
        stripe=_STRIPES[int(rng.integers(len(_STRIPES)))],
    )


def _profile(kind: _Kind) -> FloatArray:
    """Radius and height of the glass, from the middle of the bottom to the mouth."""
    r, edge = kind.radius, 0.022
    corner = np.linspace(0, np.pi / 2, 5)
    foot = np.stack([r - edge + edge * np.sin(corner), edge - edge * np.cos(corner)], axis=1)
    rings = 36 if kind.ribs else 20 if kind.waist else 7
    body_y = np.linspace(edge, kind.shoulder, rings)[1:]
    share = (body_y - edge) / (kind.shoulder - edge)
    body_r = r * (1 - kind.waist * np.sin(np.pi * share) ** 4)
    if kind.ribs:
        body_r = body_r * (1 - 0.035 * (0.5 - 0.5 * np.cos(2 * np.pi * kind.ribs * share)))
        body_r[-1] = r
    t = np.linspace(0, 1, 15)[1:]
    # A smooth step from body to neck; the power moves it down (slender) or up (full).
    blend = 0.5 - 0.5 * np.cos(np.pi * t ** (1 / kind.curve))
    shoulder_r = r + (kind.neck_radius - r) * blend
    shoulder = np.stack([shoulder_r, kind.shoulder + (kind.neck - kind.shoulder) * t], axis=1)
    mouth = kind.neck + 0.06 if kind.cap == "nozzle" else 0.96
    neck_y = np.linspace(kind.neck, mouth, 4)[1:]
    neck = np.stack([np.full(3, 0.96 * kind.neck_radius), neck_y], axis=1)
    body = np.stack([body_r, body_y], axis=1)
    bottom, closed = [[0.0, 0.012], [0.7 * r, 0.006]], [[0.0, mouth]]
    return np.concatenate([bottom, foot, body, shoulder, neck, closed])


def _radius_at(profile: FloatArray, height: float) -> float:
    outside = profile[2:-1]
    return float(np.interp(height, outside[:, 1], outside[:, 0]))


def _cap(bottle: _Bottle) -> tuple[list[Solid], float, float]:
    """The closure of a bottle, the height of its top, and its radius there."""
    kind, r, neck = bottle.kind.cap, bottle.kind.neck_radius, bottle.kind.neck
    lip: _Profile = []
    if kind == "foil":
        low, top, rim = neck + 0.4 * (0.96 - neck), 0.97, 1.05
        profile = [(0, low), (1, low), (1.03, low + 0.004), (1.03, 0.93), (1.13, 0.934),
                   (1.13, 0.962), (rim, top), (0, top)]  # fmt: skip
    elif kind == "crown":
        top, rim = 0.972, 1.02
        profile = [(0, 0.942), (1.28, 0.942), (1.2, 0.958), (rim, top), (0, 0.974)]
        lip = [(0, 0.925), (1.08, 0.925), (1.08, 0.943), (0, 0.943)]
    elif kind == "stopper":
        top, rim = 1.042, 1.0
        knob = smooth_curve([(0.8, 0.965), (1.25, 0.985), (1.3, 1.02), (1.0, 1.04)], 12)
        profile = [(0, 0.93), (0.8, 0.93), *map(tuple, knob.tolist()), (0, top)]
        lip = [(0, 0.93), (1.15, 0.93), (1.15, 0.962), (0, 0.962)]
    elif kind == "nozzle":
        top, rim, low = 1.005, 0.22, neck + 0.02
        profile = [(0, low), (1.1, low), (1.1, neck + 0.09), (0.75, neck + 0.11), (0.28, 1.0),
                   (rim, top), (0, top)]  # fmt: skip
    else:
        low, grow = (0.85, 1.12) if kind == "lid" else (0.905, 1.16)
        solids = _screw_cap(r * grow, max(low, neck + 0.015), 0.985, bottle.cap)
        return solids, 0.985, 0.95 * r * grow
    parts = ((profile, bottle.cap), (lip, bottle.glass))
    return [lathe(np.array(p) * (r, 1), color, count=40) for p, color in parts if p], top, rim * r


def _screw_cap(radius: float, low: float, high: float, color: Color) -> list[Solid]:
    """A cap with grooves around it, and the ring it breaks from."""
    count = 80
    profile = [(0, low), (radius, low), (radius, high - 0.008), (0.95 * radius, high), (0, high)]
    cap = lathe(profile, color, count=count)
    x, _, z = cap.vertices.T
    turn = np.round(np.arctan2(x, z) / (2 * np.pi) * count)
    grooved = (np.hypot(x, z) > 0.97 * radius) & (turn % 2 == 1)
    shrink = np.where(grooved[:, None], (0.95, 1, 0.95), 1.0)
    band = [(0, low - 0.018), (radius, low - 0.018), (radius, low - 0.006), (0, low - 0.006)]
    return [cap.with_vertices(cap.vertices * shrink), lathe(band, color, count=40)]


def _label(bottle: _Bottle, profile: FloatArray) -> list[Solid]:
    """A band of paper around the body, with two stripes."""
    low, high = bottle.kind.label
    tall = min(high, bottle.kind.shoulder - 0.04) - low
    bands = (
        (0, 1, 1.012, bottle.label),
        (0.62, 0.86, 1.02, bottle.stripe),
        (0.1, 0.15, 1.02, bottle.stripe),
    )
    solids = []
    for start, end, grow, color in bands:
        heights = np.linspace(low + start * tall, low + end * tall, 7)
        radii = [
            bottle.kind.radius if bottle.kind.ribs else _radius_at(profile, y) for y in heights
        ]
        outline = np.stack([grow * np.array(radii), heights], axis=1)
        closed = np.concatenate([outline[:1] * (0.9, 1), outline, outline[-1:] * (0.9, 1)])
        solids.append(bottle.turned(closed, color))
    return solids


def _ring(
    first: int, radius: float, height: float, exponent: float, depth: float
) -> dict[int, Point]:
    """Four places around the axis at one height, by semantic id."""
    x, z = np.sin(_AZIMUTHS), np.cos(_AZIMUTHS)
    reach = radius / (np.abs(x) ** exponent + np.abs(z) ** exponent) ** (1 / exponent)
    xz = np.stack([reach * x, reach * z * depth], axis=1).tolist()
    return {first + i: (x, height, z) for i, (x, z) in enumerate(xz)}
