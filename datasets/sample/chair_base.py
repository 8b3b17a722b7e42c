"""Legs and pedestals of sample chairs."""

from __future__ import annotations

import numpy as np

from cadalign.datasets.sample import solids as make
from cadalign.datasets.sample.chair_shape import ChairShape
from cadalign.datasets.sample.solids import Point, Solid

_DARK = (38, 38, 42)


def chair_base(p: ChairShape) -> list[Solid]:
    """Everything below the seat."""
    special = {"swivel": _swivel, "cantilever": _cantilever, "club": _club_feet}
    return special[p.base](p) if p.base in special else _legs(p)


def _legs(p: ChairShape) -> list[Solid]:
    """Four legs and the bars between them; under a shell the struts that carry it."""
    inset = {"straight": 0.6 * p.leg, "tapered": 0.8 * p.leg, "splayed": 0.11, "turned": 0.07}[
        p.base
    ]
    x, z = p.width / 2 - inset, p.depth / 2 - inset
    y = p.seat_height - (0.012 if p.back == "shell" else 0.4 * p.seat_thickness)
    tops = np.array([(x, y, -z), (x, y, z)])
    feet = np.array([(x, 0.0, z) for x, z in p.feet()])
    legs = make.both_sides(*(_leg(p, top, foot) for top, foot in zip(tops, feet, strict=True)))
    if p.base == "tapered":
        return legs
    if p.base == "splayed":
        y = p.seat_height - 0.07
        x, z = 0.75 * (p.width / 2 - 0.03), 0.75 * (p.depth / 2 - 0.03)
        return [*legs, *make.both_sides(make.rod((x, y, -z), (-x, y, z), 0.008, _DARK, sides=8))]
    share = 0.32 if p.base == "straight" else 0.4
    front, rear = feet + share * (tops - feet)
    front[1] = rear[1] = share * p.seat_height
    section, mirror = (0.02, 0.028), np.array([-1, 1, 1])
    sides = make.both_sides(make.beam(front, rear, section, p.frame))
    if p.base == "turned":
        middle = (front + rear) / 2 * (0, 1, 1) + front * (1, 0, 0)
        return [*legs, *sides, make.beam(middle * mirror, middle, section, p.frame)]
    front[1] += 0.06
    across = (make.beam(end * mirror, end, section, p.frame) for end in (rear, front))
    return [*legs, *sides, *across]


def _leg(p: ChairShape, upper: Point, lower: Point) -> Solid:
    if p.base == "straight":
        return make.beam(upper, lower, (p.leg, p.leg), p.frame)
    if p.base == "tapered":
        return make.beam(upper, lower, (1.15 * p.leg, 1.15 * p.leg), p.frame, taper=0.6)
    if p.base == "splayed":
        return make.rod(upper, lower, 0.5 * p.leg, p.frame, end_radius=0.3 * p.leg)
    scales = [0.75, 1.0, 0.7, 1.0, 1.15, 1.1, 0.7, 0.95, 0.6]
    outline = make.ellipse(p.leg, p.leg, count=12)
    return make.sweep(np.linspace(upper, lower, 9), outline, p.frame, scales=scales)


def _cantilever(p: ChairShape) -> list[Solid]:
    """A bent steel tube: along the floor, up in front, and back under the seat."""
    (x, front), (_, rear) = p.feet()
    radius, y = 0.014, p.seat_height - p.seat_thickness - 0.002
    knots = [
        (x, y, 0.45 * p.depth), (x, y, front + 0.07), (x, y - 0.015, front + 0.02),
        (x, y - 0.07, front), (x, 0.09, front), (x, 0.03, front + 0.02),
        (x, radius, front + 0.08), (x, radius, rear),
    ]  # fmt: skip
    outline = make.ellipse(2 * radius, 2 * radius, count=10)
    rails = make.both_sides(
        make.sweep(make.smooth_curve(knots, 36), outline, p.frame, side=(1, 0, 0))
    )
    ends = ((radius, rear - 0.012), (y, 0.4 * p.depth))
    return [*rails, *(make.rod((-x, low, z), (x, low, z), radius, p.frame) for low, z in ends)]


def _swivel(p: ChairShape) -> list[Solid]:
    top = p.seat_height - (0.035 if p.back == "shell" else 0.01)
    column = [
        (0, 0.06), (0.045, 0.06), (0.045, 0.13), (0.03, 0.15), (0.03, 0.24), (0.018, 0.245),
        (0.018, top - 0.07), (0.09, top - 0.04), (0.09, top), (0, top),
    ]  # fmt: skip
    solids = [make.lathe(column, p.frame, count=20)]
    section = make.rounded_rectangle(0.05, 0.036, radius=0.012, steps=2)
    for tip in p.spokes():
        path = np.array([0.0, 0.5, 1.0])[:, None] * tip + [(0, y, 0) for y in (0.115, 0.1, 0.075)]
        side = np.cross((0, 1, 0), tip)
        solids += [
            make.sweep(path, section, p.frame, scales=[1.0, 0.85, 0.6], side=side),
            make.ellipsoid(0.96 * tip + (0, 0.03, 0), (0.05, 0.06, 0.05), _DARK),
        ]
    return solids


def _club_feet(p: ChairShape) -> list[Solid]:
    profile = [(0, 0), (0.022, 0), (0.035, 0.12), (0, 0.12)]
    feet = [make.lathe(profile, p.frame, center=(x, 0, z), count=12) for x, z in p.feet()]
    low, high = 0.1, p.seat_height - 0.1
    center, size = (0, (low + high) / 2, 0), (p.width, high - low, p.depth)
    return [*make.both_sides(*feet), make.rounded_box(center, size, p.fabric, radius=0.02, steps=2)]
