"""Parametric chairs: seats, backs, arms and legs in several styles."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cadalign.datasets.sample import solids as make
from cadalign.datasets.sample.chair_shape import ChairShape, lighter
from cadalign.datasets.sample.model import Draft, mirrored_places
from cadalign.datasets.sample.solids import Point, Solid

_SPOKE_IDS = (10, 11, 12, 13, 14)
_DARK = (38, 38, 42)


def chair(rng: np.random.Generator, index: int) -> Draft:
    """Draw and build a chair.

    Semantic ids are those of KeypointNet's chairs: 0, 1 top corners of the back; 2, 3 rear and
    4, 5 front corners of the seat; 6 to 9 ends of the armrests; 10 to 14 tips of a swivel base;
    17 to 20 feet. Three more are this data set's own: 21, 22 the sides of the back and 23 the
    middle of its top.
    """
    p = ChairShape.draw(rng, index)
    _, top, rear = p.back_point(p.back_height)
    _, side, side_z = p.back_point(0.84 * p.back_height)
    half, front = p.width / 2, -p.depth / 2
    pairs = {
        (0, 1): (p.back_half_width(1.0), top, rear),
        (2, 3): (half, p.seat_height, 0.43 * p.depth),
        (4, 5): (half, p.seat_height, front),
    }
    if p.back == "shell":
        edge = p.shell()[:, -1].tolist()
        pairs |= {(0, 1): tuple(edge[-1]), (2, 3): tuple(edge[11]), (4, 5): tuple(edge[1])}
    if p.base == "club":  # the corners of the cushion; those of the seat are hidden by the arms
        pairs[2, 3] = (half - 0.08, p.seat_height + 0.09, 0.5 * p.depth - 0.2)
        pairs[4, 5] = (half - 0.08, p.seat_height + 0.05, front)
    if p.arms:
        x, y, arm_front, arm_rear = p.arm_line()
        outer = x + (0.065 if p.base == "club" else 0.025)
        pairs |= {(6, 8): (outer, y, arm_front), (7, 9): (outer, y, arm_rear)}
    pairs[21, 22] = (p.back_half_width(0.84) + 0.1, side, side_z)
    if p.base != "swivel":
        (x_front, z_front), (x_rear, z_rear) = p.feet()
        pairs[17, 20] = (x_front + p.leg, 0.01, z_front - p.leg)
        pairs[18, 19] = (x_rear + p.leg, 0.01, z_rear + p.leg)
    places = mirrored_places(pairs) | {23: (0.0, top + 0.1, rear + 0.02)}
    if p.base == "swivel":
        tips = (p.spokes() + (0, 0.09, 0)).tolist()
        places |= {number: tuple(tip) for number, tip in zip(_SPOKE_IDS, tips, strict=True)}
    arms = _arms(p) if p.arms else []
    return Draft(
        solids=(*_seat(p), *_base(p), *_BACKS[p.back](p), *arms),
        places=places,
        mirrored=tuple(pairs),
        turned=(_SPOKE_IDS,) if p.base == "swivel" else (),
    )


def _seat(p: ChairShape) -> list[Solid]:
    if p.back == "shell":
        return []  # the shell is seat and back in one
    y, width, depth = p.seat_height, p.width, p.depth
    center, size = (0, y - p.seat_thickness / 2, 0), (width, p.seat_thickness, depth)
    if p.base == "club":
        soft = (0, y + 0.03, -0.03), (width - 0.14, 0.12, depth - 0.04)
        cushion = make.rounded_box(*soft, lighter(p.fabric), radius=0.045, steps=4)
        return [make.rounded_box(center, size, p.fabric, radius=0.03, steps=3), cushion]
    color = p.frame if p.base in ("straight", "tapered", "turned") else p.fabric
    color = color if p.cushion else lighter(color)
    edge = 0.4 * p.seat_thickness
    seat = make.rounded_box(center, size, color, radius=edge, corner_radius=0.05, steps=3)
    if not (p.cushion or p.back == "panel"):
        return [seat]
    soft = (0, y + 0.012, -0.01), (width - 0.03, 0.045, depth - 0.05)
    return [seat, make.rounded_box(*soft, p.fabric, radius=0.02, corner_radius=0.06, steps=4)]


def _arms(p: ChairShape) -> list[Solid]:
    """Two armrests and their supports."""
    x, y, front, rear = p.arm_line()
    middle = (front + rear) / 2
    if p.base == "club":
        center, size = (x, y / 2 + 0.05, middle + 0.03), (0.13, y - 0.1, rear - front + 0.1)
        return make.both_sides(make.rounded_box(center, size, p.fabric, radius=0.06, steps=4))
    color = _DARK if p.base in ("swivel", "cantilever") else p.frame
    center, size = (x, y - 0.012, middle), (0.05, 0.024, rear - front)
    pad = make.rounded_box(center, size, color, radius=0.01, corner_radius=0.022, steps=3)
    low, inner = p.seat_height - 0.6 * p.seat_thickness, p.width / 2 - 0.012
    if p.base == "swivel":
        stem = make.rounded_rectangle(0.016, 0.05, radius=0.006, steps=1)
        knots = [(0.5 * inner, low, 0.02), (x - 0.005, low + 0.01, 0.02), (x, y - 0.02, 0.02)]
        return make.both_sides(
            pad, make.sweep(make.smooth_curve(knots, 9), stem, p.frame, side=(0, 0, 1))
        )
    if p.base == "turned":
        path = np.linspace((inner, low, front + 0.06), (x, y - 0.01, front + 0.03), 5)
        section, joint = make.ellipse(0.026, 0.026, count=10), p.back_half_width(0.45)
        post = make.sweep(path, section, p.frame, scales=[0.8, 1.2, 0.8, 1.15, 0.8])
        tail = make.rod(
            (x, y - 0.012, rear - 0.05), (joint, y - 0.012, rear + 0.01), 0.014, p.frame
        )
        return make.both_sides(pad, post, tail)
    foot, head = (inner, low, front + 0.04), (x, y - 0.01, front + 0.04)
    return make.both_sides(pad, make.beam(foot, head, (0.026, 0.034), p.frame))


# Legs and pedestals -------------------------------------------------------------------------------


def _base(p: ChairShape) -> list[Solid]:
    """Everything below the seat."""
    special = {"swivel": _swivel, "cantilever": _cantilever, "club": _club_feet}
    return special[p.base](p) if p.base in special else _legs(p)


def _legs(p: ChairShape) -> list[Solid]:
    """Four legs and the bars between them; under a shell the struts that carry it."""
    insets = {"straight": 0.6 * p.leg, "tapered": 0.8 * p.leg, "splayed": 0.11, "turned": 0.07}
    inset = insets[p.base]
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
            make.ellipsoid(0.96 * tip + (0, 0.03, 0), (0.05, 0.06, 0.05), _DARK, count=16),
        ]
    return solids


def _club_feet(p: ChairShape) -> list[Solid]:
    profile = [(0, 0), (0.022, 0), (0.035, 0.12), (0, 0.12)]
    feet = [make.lathe(profile, p.frame, center=(x, 0, z), count=12) for x, z in p.feet()]
    low, high = 0.1, p.seat_height - 0.1
    center, size = (0, (low + high) / 2, 0), (p.width, high - low, p.depth)
    return [*make.both_sides(*feet), make.rounded_box(center, size, p.fabric, radius=0.02, steps=2)]


# Backs --------------------------------------------------------------------------------------------


def _slat_back(p: ChairShape) -> list[Solid]:
    x = _post_offset(p)
    low, high = 0.2 * p.back_height, 0.93 * p.back_height
    color = p.fabric if p.base == "cantilever" else p.frame
    slats = [
        make.beam(p.bowed(s, x, low), p.bowed(s, x, high), (0.75 * x / p.bars, 0.014), color)
        for s in np.linspace(-x, x, p.bars + 2)[1:-1]
    ]
    return [*_posts(p), _rail(p, high, 0.07), _rail(p, low, 0.04), *slats]


def _ladder_back(p: ChairShape) -> list[Solid]:
    heights = np.linspace(0.28, 0.9, p.bars) * p.back_height
    return [*_posts(p), *(_rail(p, height, 0.06) for height in heights)]


def _post_offset(p: ChairShape) -> float:
    return p.back_half_width(1.0) - 0.3 * p.leg


def _posts(p: ChairShape) -> list[Solid]:
    x = _post_offset(p)
    low, high = (x, *p.back_point(-0.03)[1:]), (x, *p.back_point(p.back_height)[1:])
    return make.both_sides(make.beam(low, high, (0.8 * p.leg, p.leg), p.frame, taper=0.85))


def _rail(p: ChairShape, height: float, tall: float) -> Solid:
    half = _post_offset(p)
    path = [p.bowed(x, half, height) for x in np.linspace(-half, half, 9)]
    return make.sweep(path, make.rounded_rectangle(0.02, tall, radius=0.006, steps=1), p.frame)


def _panel_back(p: ChairShape) -> list[Solid]:
    half, tall = p.back_half_width(1.0), p.back_height
    outline = make.rounded_rectangle(2 * half, 0.05, radius=0.02, steps=3)
    scales = [(0.9, 0.5), (0.95, 0.8), (1, 1), (1, 1), (1, 1), (0.97, 0.85), (0.92, 0.5)]
    path = [p.back_point(share * tall) for share in (0.28, 0.3, 0.36, 0.6, 0.9, 0.97, 1.0)]
    panel = make.sweep(path, outline, p.fabric, scales=scales)
    if p.base == "swivel":
        low, high = p.back_point(0.12 * tall), p.back_point(0.55 * tall)
        knots = [
            (0, p.seat_height - 0.04, 0.05), (0, p.seat_height - 0.03, p.depth / 2 + 0.03),
            (0, low[1], low[2] + 0.045), (0, high[1], high[2] + 0.03),
        ]  # fmt: skip
        section = make.rounded_rectangle(0.07, 0.02, radius=0.006, steps=1)
        return [panel, make.sweep(make.smooth_curve(knots, 14), section, p.frame, side=(1, 0, 0))]
    behind = np.array([p.back_point(-0.05), p.back_point(0.8 * tall)])
    low, high = behind + (half - 0.5 * p.leg, 0, 0.018)
    return [panel, *make.both_sides(make.beam(low, high, (0.028, 0.022), p.frame))]


def _spindle_back(p: ChairShape) -> list[Solid]:
    half, lower = p.back_half_width(1.0), p.back_half_width(0.0)
    path = [p.bowed(x, half, p.back_height - 0.045) for x in np.linspace(-half, half, 11)]
    scales = np.stack([np.ones(11), 0.75 + 0.25 * np.sin(np.linspace(0, np.pi, 11))], axis=1)
    crest = make.rounded_rectangle(0.024, 0.09, radius=0.011, steps=2)
    solids = [make.sweep(path, crest, p.frame, scales=scales)]
    for share in np.linspace(-1, 1, 2 * p.bars + 1):
        low = p.bowed(share * lower, lower, -0.02)
        high = p.bowed(share * (half - 0.02), half, p.back_height - 0.06)
        thick = 0.03 if abs(share) == 1.0 else 0.019
        outline, swelling = make.ellipse(thick, thick, count=8), [0.8, 1.1, 1.2, 1.0, 0.7]
        solids.append(make.sweep(np.linspace(low, high, 5), outline, p.frame, scales=swelling))
    return solids


def _club_back(p: ChairShape) -> list[Solid]:
    half, tall = p.back_half_width(1.0), p.back_height
    low, high = np.array(p.back_point(-0.1)), np.array(p.back_point(tall))
    # The last stations lie close together and round the upper end off.
    rest = 1 - np.array([0.05, 0.025, 0.006, 0.0]) / np.linalg.norm(high - low)
    path = low + np.array([0.0, 0.5, *rest])[:, None] * (high - low)
    scales = [(1, 1), (1, 1), (1, 1), (0.985, 0.9), (0.95, 0.65), (0.92, 0.3)]
    outline = make.rounded_rectangle(2 * half, 0.16, radius=0.05, steps=4)
    back = make.sweep(path, outline, p.fabric, scales=scales)
    _, y, z = p.back_point(0.5 * tall)
    size = (2 * half - 0.2, 0.75 * tall, 0.08)
    pad = make.rounded_box((0, y + 0.02, z - 0.085), size, lighter(p.fabric), radius=0.035, steps=3)
    return [back, pad, make.rod((0, y, z - 0.12), (0, y, z - 0.13), 0.012, p.frame)]


_BACKS: dict[str, Callable[[ChairShape], list[Solid]]] = {
    "slats": _slat_back,
    "ladder": _ladder_back,
    "panel": _panel_back,
    "spindles": _spindle_back,
    "shell": lambda p: [make.sheet(p.shell(), 0.014, p.fabric)],  # seat and back as one plate
    "club": _club_back,
}
