"""Parametric bottles: turned profiles with a cap, a label and what is inside."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.sample.model import Draft, Place
from cadalign.datasets.sample.outlines import smooth_curve
from cadalign.datasets.sample.solids import Color, Solid, lathe

_AZIMUTHS = np.radians([135.0, 45.0, -45.0, -135.0])
# KeypointNet's order of four points around: (+x, -z), (+x, +z), (-x, +z), (-x, -z).


@dataclass(frozen=True)
class _Shape:
    """What makes a kind of bottle; lengths are shares of its height.

    ``shoulder`` is where the body ends, ``neck`` where the neck begins; ``curve`` shapes what lies
    between: less than 1 is full, more is slender. ``exponent`` 2 is round.
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
    ribs: int = 0
    waist: float = 0.0


_GREEN: tuple[Color, ...] = ((40, 74, 44), (58, 92, 40), (28, 56, 40))
_BROWN: tuple[Color, ...] = ((98, 54, 22), (116, 68, 26), (78, 42, 22))
_CLEAR: tuple[Color, ...] = ((168, 208, 226), (150, 200, 216), (186, 220, 214))
_AMBER: tuple[Color, ...] = ((186, 112, 36), (168, 92, 30), (200, 136, 60))
_PAINT: tuple[Color, ...] = ((206, 52, 44), (40, 96, 168), (236, 186, 52), (64, 140, 84))
_MILK: tuple[Color, ...] = ((238, 236, 226), (226, 232, 236), (240, 226, 214))

_SHAPES = (
    _Shape(0.125, 0.6, 0.72, 0.047, 0.55, "foil", (0.14, 0.46), _GREEN),  # Bordeaux wine
    _Shape(0.155, 0.68, 0.88, 0.058, 0.8, "screw", (0.38, 0.6), _CLEAR, ribs=7),  # water
    _Shape(0.15, 0.42, 0.74, 0.048, 1.35, "foil", (0.1, 0.34), _GREEN),  # Burgundy wine
    _Shape(0.134, 0.55, 0.78, 0.052, 1.0, "crown", (0.16, 0.44), _BROWN),  # beer
    _Shape(0.2, 0.56, 0.76, 0.062, 0.45, "stopper", (0.14, 0.42), _AMBER, exponent=6.0),  # spirit
    _Shape(0.155, 0.66, 0.87, 0.056, 0.9, "screw", (0.36, 0.54), _PAINT, waist=0.16),  # soda
    _Shape(0.25, 0.66, 0.83, 0.07, 0.5, "stopper", (0.2, 0.5), _CLEAR, exponent=2.4, depth=0.42),
    _Shape(0.178, 0.5, 0.78, 0.1, 1.2, "screw", (0.12, 0.36), _MILK),  # milk
    _Shape(0.15, 0.6, 0.74, 0.075, 0.6, "nozzle", (0.14, 0.5), _PAINT),  # sauce
    _Shape(0.2, 0.7, 0.78, 0.13, 0.5, "lid", (0.16, 0.56), _AMBER),  # medicine
    _Shape(0.165, 0.36, 0.74, 0.05, 1.1, "foil", (0.1, 0.3), _GREEN),  # champagne
    _Shape(0.19, 0.62, 0.8, 0.085, 0.55, "lid", (0.12, 0.48), _PAINT, exponent=3.2, depth=0.5),
)


@dataclass(frozen=True)
class BottleParameters:
    """Style and proportions of a bottle; lengths are shares of its height.

    ``shoulder``, ``neck``, ``radius`` and ``neck_radius`` are as drawn; what ``shape`` holds beside
    them is typical of the kind.
    """

    shape: _Shape
    radius: float
    shoulder: float
    neck: float
    neck_radius: float
    glass: Color
    cap_color: Color
    label_color: Color
    stripe_color: Color


def draw_bottle(rng: np.random.Generator, index: int) -> BottleParameters:
    """Draw a bottle; the kinds take turns with ``index``."""
    shape = _SHAPES[index % len(_SHAPES)]
    caps: tuple[Color, ...] = (
        (176, 36, 40),
        (32, 34, 40),
        (206, 170, 84),
        (36, 82, 150),
        (240, 240, 236),
    )
    labels: tuple[Color, ...] = ((238, 230, 206), (246, 246, 242), (222, 206, 160), (206, 222, 232))
    stripes: tuple[Color, ...] = (
        (152, 30, 38),
        (34, 66, 118),
        (40, 92, 60),
        (168, 128, 50),
        (48, 44, 46),
    )
    cap = caps[int(rng.integers(len(caps)))]
    return BottleParameters(
        shape=shape,
        radius=shape.radius * rng.uniform(0.9, 1.14),
        shoulder=shape.shoulder + rng.uniform(-0.03, 0.03),
        neck=shape.neck + rng.uniform(-0.02, 0.02),
        neck_radius=shape.neck_radius * rng.uniform(0.92, 1.1),
        glass=shape.glass[int(rng.integers(len(shape.glass)))],
        cap_color=(96, 66, 42) if shape.cap == "stopper" and rng.random() < 0.5 else cap,
        label_color=labels[int(rng.integers(len(labels)))],
        stripe_color=stripes[int(rng.integers(len(stripes)))],
    )


def build_bottle(p: BottleParameters) -> Draft:
    """Build a bottle.

    Semantic ids are those of KeypointNet's bottles: 0 to 3 around the base, 4 to 7 around the
    shoulder, 8 the middle of the top, 9 to 12 around the top's rim, 13 to 16 around the beginning
    of the neck.
    """
    profile = _profile(p)
    cap, top, rim = _cap(p)
    solids = [_turned(p, profile, p.glass), *cap, *_label(p, profile)]
    places = [
        *_ring(p, 0, _radius_at(profile, 0.02), 0.02),
        *_ring(p, 4, _radius_at(profile, p.shoulder), p.shoulder),
        Place(8, (0.0, top + 0.1, 0.0)),
        *_ring(p, 9, rim, top - 0.004, of_cap=True),
        *_ring(p, 13, _radius_at(profile, p.neck), p.neck),
    ]
    groups = tuple(tuple(range(first, first + 4)) for first in (0, 4, 9, 13))
    round_body = p.shape.exponent == 2.0 and p.shape.depth == 1.0
    return Draft(
        solids=tuple(solids),
        places=tuple(places),
        mirrored=tuple((group[i], group[(i + 1) % 4]) for group in groups for i in range(4)),
        turned=groups if round_body else (),
        round=round_body,
    )


def _exponents(p: BottleParameters, profile: FloatArray) -> FloatArray:
    """How square the bottle is at each height: like its body below, round at the neck."""
    share = np.clip((p.neck - profile[:, 1]) / (p.neck - p.shoulder), 0, 1)
    return 2.0 + (p.shape.exponent - 2.0) * share**0.7


def _depths(p: BottleParameters, profile: FloatArray) -> FloatArray:
    share = np.clip((p.neck - profile[:, 1]) / (p.neck - p.shoulder), 0, 1)
    return 1.0 + (p.shape.depth - 1.0) * share


def _turned(p: BottleParameters, profile: FloatArray, color: Color, *, count: int = 40) -> Solid:
    exponents = _exponents(p, profile)
    return lathe(profile, color, count=count, exponent=exponents, depth=_depths(p, profile))


def _profile(p: BottleParameters) -> FloatArray:
    """Radius and height of the glass, from the middle of the bottom to the mouth."""
    r, edge = p.radius, 0.022
    corner = np.linspace(0, np.pi / 2, 5)
    foot = np.stack([r - edge + edge * np.sin(corner), edge - edge * np.cos(corner)], axis=1)
    rings = 36 if p.shape.ribs else 20 if p.shape.waist else 7
    body_y = np.linspace(edge, p.shoulder, rings)[1:]
    share = (body_y - edge) / (p.shoulder - edge)
    body_r = r * (1 - p.shape.waist * np.sin(np.pi * share) ** 4)
    if p.shape.ribs:
        body_r = body_r * (1 - 0.035 * (0.5 - 0.5 * np.cos(2 * np.pi * p.shape.ribs * share)))
        body_r[-1] = r
    t = np.linspace(0, 1, 15)[1:]
    # A smooth step from body to neck; the power moves it down (slender) or up (full).
    blend = 0.5 - 0.5 * np.cos(np.pi * t ** (1 / p.shape.curve))
    shoulder = np.stack(
        [r + (p.neck_radius - r) * blend, p.shoulder + (p.neck - p.shoulder) * t], 1
    )
    mouth = p.neck + 0.06 if p.shape.cap == "nozzle" else 0.96
    neck_y = np.linspace(p.neck, mouth, 4)[1:]
    neck = np.stack([np.full(3, 0.96 * p.neck_radius), neck_y], axis=1)
    body = np.stack([body_r, body_y], axis=1)
    closed = [[0.0, mouth]]
    return np.concatenate([[[0.0, 0.012], [0.7 * r, 0.006]], foot, body, shoulder, neck, closed])


def _radius_at(profile: FloatArray, height: float) -> float:
    outside = profile[2:-1]
    return float(np.interp(height, outside[:, 1], outside[:, 0]))


def _cap(p: BottleParameters) -> tuple[list[Solid], float, float]:
    """What closes the bottle, the height of its top, and its radius there."""
    r = p.neck_radius
    color, kind = p.cap_color, p.shape.cap
    if kind == "foil":
        low = p.neck + 0.4 * (0.96 - p.neck)
        profile = [(0, low), (r * 1.0, low), (r * 1.03, low + 0.004), (r * 1.03, 0.93),
                   (r * 1.13, 0.934), (r * 1.13, 0.962), (r * 1.05, 0.97), (0, 0.97)]  # fmt: skip
        return [lathe(profile, color, count=40)], 0.97, 1.05 * r
    if kind == "crown":
        skirt = [(0, 0.942), (r * 1.28, 0.942), (r * 1.2, 0.958), (r * 1.02, 0.972), (0, 0.974)]
        lip = [(0, 0.925), (r * 1.08, 0.925), (r * 1.08, 0.943), (0, 0.943)]
        return [lathe(skirt, color, count=40), lathe(lip, p.glass, count=40)], 0.972, 1.02 * r
    if kind == "stopper":
        knob = smooth_curve(
            [(0.8 * r, 0.965), (1.25 * r, 0.985), (1.3 * r, 1.02), (1.0 * r, 1.04)], 12
        )
        outline = np.concatenate([[[0, 0.93], [0.8 * r, 0.93]], knob, [[0, 1.042]]])
        lip = [(0, 0.93), (r * 1.15, 0.93), (r * 1.15, 0.962), (0, 0.962)]
        return [lathe(outline, color, count=40), lathe(lip, p.glass, count=40)], 1.042, 1.0 * r
    if kind == "nozzle":
        profile = [
            (0, p.neck + 0.02),
            (1.1 * r, p.neck + 0.02),
            (1.1 * r, p.neck + 0.09),
            (0.75 * r, p.neck + 0.11),
            (0.28 * r, 1.0),
            (0.22 * r, 1.005),
            (0, 1.005),
        ]
        return [lathe(profile, color, count=40)], 1.005, 0.22 * r
    low, grow = (0.85, 1.12) if kind == "lid" else (0.905, 1.16)
    low = max(low, p.neck + 0.015)
    return _screw_cap(r * grow, low, 0.985, color), 0.985, 0.95 * r * grow


def _screw_cap(radius: float, low: float, high: float, color: Color) -> list[Solid]:
    """A cap with grooves around it, and the ring it breaks from."""
    count = 80
    profile = [(0, low), (radius, low), (radius, high - 0.008), (0.95 * radius, high), (0, high)]
    cap = lathe(profile, color, count=count)
    ring = np.hypot(cap.vertices[:, 0], cap.vertices[:, 2])
    turn = np.round(np.arctan2(cap.vertices[:, 0], cap.vertices[:, 2]) / (2 * np.pi) * count)
    grooved = (ring > 0.97 * radius) & (turn % 2 == 1)
    shrink = np.where(grooved, 0.95, 1.0)
    ridged = Solid.from_triangles(
        cap.vertices * np.stack([shrink, np.ones(len(ring)), shrink], 1), cap.faces, color
    )
    band = [(0, low - 0.018), (radius, low - 0.018), (radius, low - 0.006), (0, low - 0.006)]
    return [ridged, lathe(band, color, count=40)]


def _label(p: BottleParameters, profile: FloatArray) -> list[Solid]:
    """A band of paper around the body, with two stripes."""
    low, high = p.shape.label
    high = min(high, p.shoulder - 0.04)
    tall = high - low
    return [
        _band(p, profile, low, high, 1.012, p.label_color),
        _band(p, profile, low + 0.62 * tall, low + 0.86 * tall, 1.02, p.stripe_color),
        _band(p, profile, low + 0.1 * tall, low + 0.15 * tall, 1.02, p.stripe_color),
    ]


def _band(
    p: BottleParameters, profile: FloatArray, low: float, high: float, grow: float, color: Color
) -> Solid:
    heights = np.linspace(low, high, 7)
    radius = grow * np.array([_radius_at(profile, y) for y in heights])
    if p.shape.ribs:
        radius[:] = grow * p.radius
    outline = np.stack([radius, heights], axis=1)
    lower, upper = outline[:1] * (0.9, 1), outline[-1:] * (0.9, 1)
    return _turned(p, np.concatenate([lower, outline, upper]), color)


def _ring(
    p: BottleParameters, first: int, radius: float, height: float, *, of_cap: bool = False
) -> list[Place]:
    """Four places around the axis at one height."""
    level = np.array([[radius, height]])
    exponent = 2.0 if of_cap else float(_exponents(p, level)[0])
    depth = 1.0 if of_cap else float(_depths(p, level)[0])
    places = []
    for i, azimuth in enumerate(_AZIMUTHS):
        x, z = np.sin(azimuth), np.cos(azimuth)
        reach = radius / float(abs(x) ** exponent + abs(z) ** exponent) ** (1 / exponent)
        places.append(Place(first + i, (reach * x, height, reach * z * depth)))
    return places
