"""Legs, pedestals and armrests of sample chairs."""

from __future__ import annotations

import numpy as np

from cadalign.datasets.sample.chair_style import ChairParameters, back_half_width, back_point
from cadalign.datasets.sample.outlines import ellipse, rounded_rectangle, smooth_curve
from cadalign.datasets.sample.solids import (
    Solid,
    beam,
    both_sides,
    ellipsoid,
    lathe,
    rod,
    rounded_box,
    sweep,
)

SPOKE_DEGREES = (144.0, 72.0, 0.0, -72.0, -144.0)
"""Directions of a swivel base's five spokes, from +z towards +x."""

Foot = tuple[float, float]
_DARK = (38, 38, 42)


def chair_base(p: ChairParameters) -> list[Solid]:
    """Everything below the seat."""
    if p.base == "swivel":
        return _swivel(p)
    if p.base == "cantilever":
        return _cantilever(p)
    if p.base == "club":
        return _club_feet(p)
    return [*_legs(p), *_stretchers(p)]


def feet(p: ChairParameters) -> tuple[Foot, Foot]:
    """Where the right front and right rear leg stand: their middle, (x, z) each [metres]."""
    x, z = p.width / 2, p.depth / 2
    if p.base == "cantilever":
        return (x - 0.015, -z + 0.03), (x - 0.015, z)
    if p.base == "club":
        return (x - 0.06, -z + 0.06), (x - 0.06, z - 0.06)
    spread = {"straight": -0.6 * p.leg, "tapered": 0.0, "splayed": 0.03, "turned": 0.03}[p.base]
    return (x + spread, -z - spread), (x + spread, z + spread)


def spoke_reach(p: ChairParameters) -> float:
    """Length of a swivel base's spokes [metres]."""
    return 0.58 * p.width


def arm_line(p: ChairParameters) -> tuple[float, float, float, float]:
    """The right armrest: its middle x, the y of its top, and the z of its two ends [metres]."""
    if p.base == "club":
        return p.width / 2 + 0.0, p.seat_height + 0.2, -p.depth / 2 + 0.02, p.depth / 2 - 0.14
    height = 0.2 if p.base == "swivel" else 0.22
    _, _, z = back_point(p, height)
    rear = 0.3 * p.depth if p.base == "swivel" else z
    return p.width / 2 + 0.01, p.seat_height + height, -0.32 * p.depth, rear


def chair_arms(p: ChairParameters) -> list[Solid]:
    """Two armrests and what carries them."""
    x, y, front, rear = arm_line(p)
    if p.base == "club":
        size = (0.13, y - 0.1, rear - front + 0.1)
        center = (x, 0.1 + size[1] / 2, (front + rear) / 2 + 0.03)
        return both_sides(rounded_box(center, size, p.fabric, radius=0.06, steps=4))
    wooden = p.base != "swivel" and p.base != "cantilever"
    color = p.frame if wooden else _DARK
    pad = rounded_box(
        (x, y - 0.012, (front + rear) / 2), (0.05, 0.024, rear - front), color,
        radius=0.01, corner_radius=0.022, steps=3,
    )  # fmt: skip
    low = p.seat_height - 0.6 * p.seat_thickness
    inner = p.width / 2 - 0.012
    if p.base == "swivel":
        stem = rounded_rectangle(0.016, 0.05, radius=0.006, steps=1)
        knots = [(0.5 * inner, low, 0.02), (x - 0.005, low + 0.01, 0.02), (x, y - 0.02, 0.02)]
        return both_sides(pad, sweep(smooth_curve(knots, 9), stem, p.frame, side=(0, 0, 1)))
    if p.base == "turned":
        post = sweep(
            np.linspace((inner, low, front + 0.06), (x, y - 0.01, front + 0.03), 5),
            ellipse(0.026, 0.026, count=10), p.frame, scales=[0.8, 1.2, 0.8, 1.15, 0.8],
        )  # fmt: skip
    else:
        post = beam(
            (inner, low, front + 0.04), (x, y - 0.01, front + 0.04), (0.026, 0.034), p.frame
        )
    if p.base == "turned":
        joint = back_half_width(p, 0.45)
        tail = rod((x, y - 0.012, rear - 0.05), (joint, y - 0.012, rear + 0.01), 0.014, p.frame)
        return both_sides(pad, post, tail)
    return both_sides(pad, post)


def _legs(p: ChairParameters) -> list[Solid]:
    pairs = zip(_leg_tops(p), feet(p), strict=True)
    return both_sides(*(_leg(p, upper, (x, 0.0, z)) for upper, (x, z) in pairs))


def _leg_tops(p: ChairParameters) -> list[tuple[float, float, float]]:
    """Where the right front and right rear leg meet the seat."""
    insets = {"straight": 0.6 * p.leg, "tapered": 0.8 * p.leg, "splayed": 0.11, "turned": 0.07}
    inset = insets[p.base]
    y = p.seat_height - (0.012 if p.back == "shell" else 0.4 * p.seat_thickness)
    return [(p.width / 2 - inset, y, sign * (p.depth / 2 - inset)) for sign in (-1, 1)]


def _leg(
    p: ChairParameters, upper: tuple[float, float, float], lower: tuple[float, float, float]
) -> Solid:
    if p.base == "straight":
        return beam(upper, lower, (p.leg, p.leg), p.frame)
    if p.base == "tapered":
        return beam(upper, lower, (1.15 * p.leg, 1.15 * p.leg), p.frame, taper=0.6)
    if p.base == "splayed":
        return rod(upper, lower, 0.5 * p.leg, p.frame, end_radius=0.3 * p.leg)
    path = np.linspace(upper, lower, 9)
    scales = [0.75, 1.0, 0.7, 1.0, 1.15, 1.1, 0.7, 0.95, 0.6]
    return sweep(path, ellipse(p.leg, p.leg, count=12), p.frame, scales=scales)


def _stretchers(p: ChairParameters) -> list[Solid]:
    """Bars between the legs; under a shell the struts that carry it."""
    if p.base == "tapered":
        return []
    if p.base == "splayed":
        y = p.seat_height - 0.07
        x, z = 0.75 * (p.width / 2 - 0.03), 0.75 * (p.depth / 2 - 0.03)
        return both_sides(rod((x, y, -z), (-x, y, z), 0.008, _DARK, sides=8))
    share = 0.68 if p.base == "straight" else 0.6
    y = (1 - share) * p.seat_height
    (xf, zf), (xr, zr) = (
        (x + (1 - share) * (upper[0] - x), z + (1 - share) * (upper[2] - z))
        for (x, z), upper in zip(feet(p), _leg_tops(p), strict=True)
    )
    section = (0.02, 0.028)
    sides = both_sides(beam((xf, y, zf), (xr, y, zr), section, p.frame))
    if p.base == "turned":
        middle = (zf + zr) / 2
        return [*sides, beam((-xf, y, middle), (xf, y, middle), section, p.frame)]
    rear = beam((-xr, y, zr), (xr, y, zr), section, p.frame)
    return [*sides, rear, beam((-xf, y + 0.06, zf), (xf, y + 0.06, zf), section, p.frame)]


def _cantilever(p: ChairParameters) -> list[Solid]:
    """A bent steel tube: along the floor, up in front, and back under the seat."""
    (x, front), (_, rear) = feet(p)
    radius = 0.014
    y = p.seat_height - p.seat_thickness - 0.002
    side = [
        (x, y, 0.45 * p.depth),
        (x, y, front + 0.07),
        (x, y - 0.015, front + 0.02),
        (x, y - 0.07, front),
        (x, 0.09, front),
        (x, 0.03, front + 0.02),
        (x, radius, front + 0.08),
        (x, radius, rear),
    ]
    outline = ellipse(2 * radius, 2 * radius, count=10)
    rails = both_sides(sweep(smooth_curve(side, 36), outline, p.frame, side=(1, 0, 0)))
    across = [
        rod((-x, radius, rear - 0.012), (x, radius, rear - 0.012), radius, p.frame),
        rod((-x, y, 0.4 * p.depth), (x, y, 0.4 * p.depth), radius, p.frame),
    ]
    return [*rails, *across]


def _swivel(p: ChairParameters) -> list[Solid]:
    top = p.seat_height - (0.035 if p.back == "shell" else 0.01)
    column = lathe(
        [(0, 0.06), (0.045, 0.06), (0.045, 0.13), (0.03, 0.15), (0.03, 0.24), (0.018, 0.245),
         (0.018, top - 0.07), (0.09, top - 0.04), (0.09, top), (0, top)],
        p.frame, count=20,
    )  # fmt: skip
    solids = [column]
    reach = spoke_reach(p)
    for degrees in SPOKE_DEGREES:
        a = np.radians(degrees)
        outward = np.array([np.sin(a), 0, np.cos(a)])
        path = np.array([0.0, 0.5, 1.0])[:, None] * reach * outward
        path[:, 1] = (0.115, 0.1, 0.075)
        section = rounded_rectangle(0.05, 0.036, radius=0.012, steps=2)
        side = np.array([np.cos(a), 0, -np.sin(a)])
        solids.append(sweep(path, section, p.frame, scales=[1.0, 0.85, 0.6], side=side))
        solids.append(ellipsoid(0.96 * reach * outward + (0, 0.03, 0), (0.05, 0.06, 0.05), _DARK))
    return solids


def _club_feet(p: ChairParameters) -> list[Solid]:
    solids = []
    for x, z in feet(p):
        profile = [(0, 0), (0.022, 0), (0.035, 0.12), (0, 0.12)]
        solids.append(lathe(profile, p.frame, center=(x, 0, z), count=12))
    bottom, top = 0.1, p.seat_height - 0.1
    size = (p.width, top - bottom, p.depth)
    skirt = rounded_box((0, (bottom + top) / 2, 0), size, p.fabric, radius=0.02, steps=2)
    return [*both_sides(*solids), skirt]
