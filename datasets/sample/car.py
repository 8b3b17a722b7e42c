"""Parametric cars: a body with wheel arches, a glass house, wheels, lamps and trim."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.sample import solids as make
from cadalign.datasets.sample.car_shape import CarShape
from cadalign.datasets.sample.model import Draft, mirrored_places
from cadalign.datasets.sample.solids import Color, Point, Solid

_GLASS = (30, 38, 48)
_DARK = (34, 34, 38)
_TYRE = (30, 30, 32)
_TRIM = (58, 60, 64)
_CHROME = (190, 194, 200)
_HEAD_LAMP = (250, 246, 214)
_TAIL_LAMP = (214, 22, 26)
_PLATE = (240, 240, 230)


def car(rng: np.random.Generator, index: int) -> Draft:
    """Draw and build a car.

    Semantic ids, right (+x) before left: 0 to 3 front and rear corners of the roof; 4 to 7 middles
    of the front and rear wheels; 8, 9 head lamps; 10, 11 tail lamps; 12, 13 lower corners of the
    windscreen; 14 to 17 ends of the front and rear bumper; 18, 19 mirrors.
    """
    p = CarShape.draw(rng, index)
    house = _GlassHouse(p)
    half, end = p.width / 2, p.length / 2
    hub = (half + 0.05, p.wheel_radius)
    pairs = {
        (0, 1): (*house.corner(1.0), house.front(1.0)),
        (2, 3): (*house.corner(1.0), house.rear(1.0)),
        (4, 5): (*hub, p.z_axles[0]),
        (6, 7): (*hub, p.z_axles[1]),
        (8, 9): (0.78 * half, p.kind.nose - 0.09, -end - 0.1),
        (10, 11): (0.84 * half, p.tail_lamp, end + 0.1),
        (12, 13): (*house.corner(0.06), house.front(0.06)),
        (14, 15): (0.88 * half, 0.42, -end - 0.1),
        (16, 17): (0.9 * half, 0.43, end + 0.1),
        (18, 19): (half + 0.16, p.kind.belt + 0.07, house.front(0.0) + 0.36),
    }
    bed = _bed(p) if p.kind.name == "pickup" else []
    solids = (_body(p), *house.solids(), *_wheels(p), *_front(p), *_rear(p), *_sides(p), *bed)
    return Draft(solids, mirrored_places(pairs), tuple(pairs))


def _body(p: CarShape) -> Solid:
    """Everything below the windows, with the arches cut out of it."""
    end = p.length / 2
    rounded = np.array([0.0, 0.015, 0.05, 0.12, 0.22, 0.36])
    plain = np.concatenate([rounded - end, end - rounded, np.linspace(-end, end, 13)])
    stations = [(z, p.sill) for z in (*plain, p.z_deck, p.z_deck + 0.05)]
    angle, reach = np.linspace(0, np.pi, 13), p.wheel_radius * 1.17
    for axle in p.z_axles:
        arch = axle + reach * np.cos(angle), p.wheel_radius + reach * np.sin(angle)
        # Two stations at the foot of each arch, a hair apart, make its upright ends.
        feet = [(axle - reach - 0.002, p.sill), (axle + reach + 0.002, p.sill)]
        stations = [(z, y) for z, y in stations if abs(z - axle) > reach + 0.02]
        stations += [*zip(*(values.tolist() for values in arch), strict=True), *feet]
    return make.loft([_section(p, z, bottom) for z, bottom in sorted(stations)], p.paint)


def _section(p: CarShape, z: float, bottom: float) -> FloatArray:
    """The body's outline across at z, starting at the middle of its top."""
    top, half = p.top(z), p.half_width(z)
    bottom = bottom + 0.12 * max(0.0, 1 - (p.length / 2 - abs(z)) / 0.12) ** 2
    shoulder = max(top - p.shoulder_drop, bottom + 0.04)
    tall = shoulder - bottom
    side = np.array([
        (0.0, top + 0.02), (0.5 * half, top + 0.015), (0.84 * half, top - 0.005),
        (0.94 * half, top - 0.35 * (top - shoulder)), (half, shoulder),
        (half, bottom + 0.45 * tall), (0.97 * half, bottom + min(0.04, 0.3 * tall)),
        (0.9 * half, bottom), (0.0, bottom),
    ])  # fmt: skip
    outline = np.concatenate([side, side[-2:0:-1] * (-1, 1)])
    return np.insert(outline, 2, z, axis=1)


@dataclass(frozen=True)
class _GlassHouse:
    """The windows and the roof. Heights are shares, 0 at the belt line and 1 at the roof."""

    p: CarShape

    def front(self, share: float) -> float:
        return self.p.z_cowl + share * (self.p.z_roof_front - self.p.z_cowl)

    def rear(self, share: float) -> float:
        return self.p.z_deck + share * (self.p.z_roof_rear - self.p.z_deck)

    def half(self, share: float) -> float:
        return self.p.width / 2 * (0.9 - self.p.kind.tumblehome * share)

    def height(self, share: float) -> float:
        return self.p.kind.belt + share * (self.p.roof - self.p.kind.belt)

    def corner(self, share: float) -> tuple[float, float]:
        """x and y of the right edge."""
        return self.half(share), self.height(share)

    def level(
        self, share: float, *, grow: float = 0.0, front: float | None = None
    ) -> tuple[float, float, float, float]:
        start = self.front(share) - grow if front is None else front
        return self.height(share), 2 * (self.half(share) + grow), start, self.rear(share) + grow

    def solids(self) -> list[Solid]:
        p = self.p
        y, width, front, rear = self.level(-0.25)
        sunk = (y, width - 0.14, front, rear - 0.14)
        glass = make.stacked([sunk, self.level(0.0), self.level(0.92)], _GLASS, radius=0.12)
        y, width, front, rear = self.level(1.0)
        long = rear - front
        levels = [
            self.level(0.86, grow=0.012),
            self.level(0.93, grow=0.012),
            (y, width - 0.06, front + 0.03, rear - 0.03),
            (y + 0.03, width - 0.3, front + 0.16 * long, rear - 0.14 * long),
            (y + 0.042, width - 0.7, front + 0.34 * long, rear - 0.3 * long),
        ]
        solids = [glass, make.stacked(levels, p.paint, radius=0.12), *self._pillars()]
        if p.z_panel is not None:
            levels = [self.level(share, grow=0.008, front=p.z_panel) for share in (-0.2, 0.9)]
            middle = (0, self.height(0.5), self.rear(0.5) + 0.005)
            size = (1.3 * self.half(0.5), 0.5 * (p.roof - p.kind.belt), 0.03)
            solids += [make.stacked(levels, p.paint, radius=0.1), make.box(middle, size, _GLASS)]
        elif p.steep:
            solids.append(self._tailgate())
        return solids

    def _tailgate(self) -> Solid:
        """The painted part of a steep rear end, below its window."""
        shares = (-0.4, 0.0, 0.16)
        rears = [self.rear(max(share, 0.0)) for share in shares]
        levels = [
            (self.height(share), 2 * self.half(share) - 0.14, rear - 0.3, rear + 0.015)
            for share, rear in zip(shares, rears, strict=True)
        ]
        return make.stacked(levels, self.p.paint, radius=0.1)

    def _pillars(self) -> list[Solid]:
        shares, inset = (-0.1, 0.92), 0.045
        posts = [([self.front(share) + inset for share in shares], inset, (0.09, 0.09))]
        if self.p.z_panel is None:
            posts.append(([self.rear(share) - inset for share in shares], inset, (0.12, 0.1)))
        posts += [([z, z + 0.03], 0.012, (0.07, 0.05)) for z in self.p.pillars]
        solids = []
        for ends, depth, size in posts:
            low, high = (
                (self.half(share) - depth, self.height(share), z)
                for share, z in zip(shares, ends, strict=True)
            )
            solids.append(make.beam(low, high, size, self.p.paint, side=(0, 0, 1)))
        return make.both_sides(*solids)


def _bed(p: CarShape) -> list[Solid]:
    """The load bed of a pickup: walls around a dark floor."""
    front, rear = p.z_deck + 0.1, p.length / 2 - 0.03
    middle, half = (front + rear) / 2, p.width / 2 - 0.09
    low = p.top(middle) - 0.03
    tall = p.kind.belt + 0.08 - low
    y = low + tall / 2
    walls: list[tuple[Point, Point]] = [
        ((half, y, middle), (0.1, tall, rear - front)),
        ((-half, y, middle), (0.1, tall, rear - front)),
        ((0, y, rear - 0.04), (2 * half + 0.1, tall, 0.08)),
        ((0, y, front + 0.03), (2 * half + 0.1, tall, 0.06)),
    ]
    floor = make.box((0, low + 0.055, middle), (2 * half - 0.02, 0.04, rear - front - 0.08), _DARK)
    return [*(make.box(center, size, p.paint) for center, size in walls), floor]


# Wheels, lamps and trim ----------------------------------------------------------------------


def _wheels(p: CarShape) -> list[Solid]:
    """Four wheels, and between two a dark block, so that one doesn't see through under the car."""
    size = (1.2 * (p.width - 0.5), 1.2 * p.wheel_radius, 2.5 * p.wheel_radius)
    blocks = (make.box((0, p.sill + 0.5 * size[1], z), size, _DARK) for z in p.z_axles)
    return [*make.both_sides(*(part for z in p.z_axles for part in _wheel(p, z))), *blocks]


def _wheel(p: CarShape, z: float) -> list[Solid]:
    """The right wheel at z: tyre, rim, disc, hub and spokes."""
    r = p.wheel_radius
    center = np.array([p.width / 2 + 0.012, r, z])
    tyre = [(0, -0.22), (0.92, -0.22), (1, -0.18), (1, -0.04), (0.94, 0.0), (0.7, 0.0),
            (0.68, -0.035), (0, -0.035)]  # fmt: skip
    rim = [(0, -0.05), (0.7, -0.05), (0.71, 0.006), (0.64, 0.006), (0.62, -0.03), (0, -0.03)]
    disc = [(0, -0.04), (0.6, -0.04), (0.6, -0.02), (0, -0.02)]
    hub = [(0, -0.05), (0.17, -0.05), (0.15, 0.01), (0, 0.014)]
    turned = ((tyre, _TYRE, 24), (hub, p.rim, 12), (rim, p.rim, 20), (disc, _TRIM, 16))
    solids = [
        make.wheel(center, np.array(profile) * (r, 1), color, count=count)
        for profile, color, count in turned
    ]
    for angle in 2 * np.pi * np.arange(p.spokes) / p.spokes:
        outward = r * np.array([0, np.cos(angle), np.sin(angle)])
        root, tip = center + 0.1 * outward - (0.004, 0, 0), center + 0.64 * outward - (0.008, 0, 0)
        size = (0.022, 0.13 * r)
        solids.append(make.beam(root, tip, size, p.rim, taper=0.8, side=(1, 0, 0), bevel=False))
    return solids


def _front(p: CarShape) -> list[Solid]:
    z, half, y = -p.length / 2, p.width / 2, p.kind.nose - 0.15
    lamp = make.ellipsoid(
        (0.72 * half, y, z + 0.04), (0.42 * half, 0.17, 0.2), _HEAD_LAMP, count=12
    )
    grille = make.rounded_box(
        (0, y - 0.01, z), (0.78 * half, 0.15, 0.06), _DARK, radius=0.02, steps=1
    )
    bars = (
        make.box((0, y - 0.01 + lift, z - 0.028), (0.74 * half, 0.014, 0.02), _CHROME)
        for lift in (-0.035, 0.0, 0.035)
    )
    plate = make.box((0, 0.4, z - 0.115), (0.5, 0.1, 0.02), _PLATE)
    return [*make.both_sides(lamp), grille, *bars, _bumper(p, -1.0, 0.4), plate]


def _rear(p: CarShape) -> list[Solid]:
    z, half = p.length / 2, p.width / 2
    tall = 0.34 if p.kind.name in ("van", "suv") else 0.16
    center = (0.76 * half, p.tail_lamp - 0.5 * tall + 0.06, z - 0.03)
    lamp = make.rounded_box(center, (0.3 * half, tall, 0.16), _TAIL_LAMP, radius=0.03)
    plate = make.box((0, p.kind.tail - 0.24, z + 0.002), (0.52, 0.11, 0.02), _PLATE)
    return [*make.both_sides(lamp), _bumper(p, 1.0, 0.42), plate]


def _bumper(p: CarShape, direction: float, height: float) -> Solid:
    """A rail around the front (-1) or rear (+1) end."""
    end, half = p.length / 2, p.width / 2
    axle = p.z_axles[0 if direction < 0 else 1]
    reach = min(0.36, end - abs(axle) - 1.22 * p.wheel_radius)
    right = np.array([
        (half * 0.99, end - reach), (half * 0.96, end - 0.4 * reach),
        (p.half_width(direction * end), end + 0.03), (half * 0.4, end + 0.06),
    ])  # fmt: skip
    x, z = make.smooth_curve([*right, (0.0, end + 0.065), *right[::-1] * (-1, 1)], 17).T
    path = np.stack([(x - x[::-1]) / 2, np.full(17, height), direction * z], axis=1)
    section = make.rounded_rectangle(0.2, 0.08, radius=0.03, steps=1)
    color = _TRIM if p.kind.name in ("pickup", "van", "suv", "city") else _darker(p.paint)
    return make.sweep(path, section, color, side=(0, 1, 0))


def _darker(color: Color) -> Color:
    r, g, b = (round(0.72 * value) for value in color)
    return r, g, b


def _sides(p: CarShape) -> list[Solid]:
    half, belt, z = p.width / 2, p.kind.belt, p.z_cowl + 0.36
    mirror = make.ellipsoid((half + 0.08, belt + 0.07, z), (0.2, 0.15, 0.12), p.paint, count=12)
    root, tip = (half - 0.12, belt + 0.01, z), (half + 0.06, belt + 0.05, z)
    solids = [mirror, make.beam(root, tip, (0.04, 0.04), _DARK)]
    shoulder = belt - p.shoulder_drop
    front, rear = p.z_axles[0] + 1.4 * p.wheel_radius, p.z_axles[1] - 1.4 * p.wheel_radius
    low = p.sill + 0.45 * (shoulder - p.sill)
    for z in (front + 0.12, *(z for z in p.pillars if z < rear)):
        center = (p.half_width(z) - 0.004, (low + shoulder) / 2, z)
        solids.append(make.box(center, (0.016, shoulder - low, 0.014), _DARK))
    for z in (z for z in p.pillars if z < rear + 0.1):
        handle = (p.half_width(z), shoulder - 0.04, z - 0.16)
        solids.append(make.rounded_box(handle, (0.04, 0.03, 0.17), _TRIM, radius=0.01, steps=1))
    skirt = (half - 0.03, p.sill + 0.03, (front + rear) / 2)
    size = (0.08, 0.07, rear - front + 0.06)
    return make.both_sides(*solids, make.rounded_box(skirt, size, _TRIM, radius=0.02, steps=1))
