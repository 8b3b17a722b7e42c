"""Parametric cars: a body with wheel arches, a glass house, wheels and lamps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.sample.car_parts import arch_stations, lamps_and_trim, wheel_set
from cadalign.datasets.sample.car_style import CarParameters
from cadalign.datasets.sample.model import Draft, mirrored_places
from cadalign.datasets.sample.solids import Solid, beam, both_sides, box, loft, stacked

_GLASS = (30, 38, 48)
_DARK = (34, 34, 38)


def build_car(p: CarParameters) -> Draft:
    """Build a car.

    Semantic ids, right (+x) before left: 0 to 3 front and rear corners of the roof; 4 to 7 middles
    of the front and rear wheels; 8, 9 head lamps; 10, 11 tail lamps; 12, 13 lower corners of the
    windscreen; 14 to 17 ends of the front and rear bumper; 18, 19 mirrors.
    """
    house = _GlassHouse(p)
    solids = [_body(p), *house.solids(), *wheel_set(p), *lamps_and_trim(p)]
    if p.kind == "pickup":
        solids += _bed(p)
    half, length = p.width / 2, p.length
    hub = (half + 0.05, p.wheel_radius)
    pairs = {
        (0, 1): (*house.corner(1.0), house.front(1.0)),
        (2, 3): (*house.corner(1.0), house.rear(1.0)),
        (4, 5): (*hub, p.z_front_axle),
        (6, 7): (*hub, p.z_rear_axle),
        (8, 9): (0.78 * half, p.nose - 0.09, -length / 2 - 0.1),
        (10, 11): (0.84 * half, p.tail_lamp, length / 2 + 0.1),
        (12, 13): (*house.corner(0.06), house.front(0.06)),
        (14, 15): (0.88 * half, 0.42, -length / 2 - 0.1),
        (16, 17): (0.9 * half, 0.43, length / 2 + 0.1),
        (18, 19): (half + 0.16, p.belt + 0.07, house.front(0.0) + 0.36),
    }
    return Draft(tuple(solids), tuple(mirrored_places(pairs)), tuple(pairs))


def _body(p: CarParameters) -> Solid:
    """Everything below the windows, with the arches cut out of it."""
    half_length = p.length / 2
    ends = np.array([0.0, 0.015, 0.05, 0.12, 0.22, 0.36])
    plain = np.concatenate(
        [ends - half_length, half_length - ends, np.linspace(-half_length, half_length, 13)]
    )
    # Two stations at the foot of each arch, a hair apart, make its upright ends.
    stations = [(z, p.sill) for z in (*plain, p.z_deck, p.z_deck + 0.05)]
    for axle in (p.z_front_axle, p.z_rear_axle):
        reach = p.wheel_radius * 1.17
        stations = [(z, y) for z, y in stations if abs(z - axle) > reach + 0.02]
        stations += arch_stations(p, axle, reach)
    return loft([_section(p, z, bottom) for z, bottom in sorted(stations)], p.paint)


def _section(p: CarParameters, z: float, bottom: float) -> FloatArray:
    """The body's outline across at z, starting at the middle of its top."""
    top = p.top(z)
    half = p.half_width(z)
    end = min(z + p.length / 2, p.length / 2 - z)
    bottom = bottom + 0.12 * max(0.0, 1 - end / 0.12) ** 2
    shoulder = max(top - p.shoulder_drop, bottom + 0.04)
    side = np.array(
        [
            (0.0, top + 0.02),
            (0.5 * half, top + 0.015),
            (0.84 * half, top - 0.005),
            (0.94 * half, top - 0.35 * (top - shoulder)),
            (half, shoulder),
            (half, bottom + 0.45 * (shoulder - bottom)),
            (0.97 * half, bottom + min(0.04, 0.3 * (shoulder - bottom))),
            (0.9 * half, bottom),
            (0.0, bottom),
        ]
    )
    outline = np.concatenate([side, side[-2:0:-1] * (-1, 1)])
    return np.insert(outline, 2, z, axis=1)


@dataclass(frozen=True)
class _GlassHouse:
    """The windows and the roof. Heights are shares, 0 at the belt line and 1 at the roof."""

    p: CarParameters

    def front(self, share: float) -> float:
        return self.p.z_cowl + share * (self.p.z_roof_front - self.p.z_cowl)

    def rear(self, share: float) -> float:
        return self.p.z_deck + share * (self.p.z_roof_rear - self.p.z_deck)

    def half(self, share: float) -> float:
        return self.p.width / 2 * (0.9 - self.p.tumblehome * share)

    def height(self, share: float) -> float:
        return self.p.belt + share * (self.p.roof - self.p.belt)

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
        glass = stacked([sunk, self.level(0.0), self.level(0.92)], _GLASS, radius=0.12)
        y, width, front, rear = self.level(1.0)
        tall, long = p.roof - p.belt, rear - front
        roof = stacked(
            [self.level(0.86, grow=0.012), self.level(0.93, grow=0.012),
             (y, width - 0.06, front + 0.03, rear - 0.03),
             (y + 0.03, width - 0.3, front + 0.16 * long, rear - 0.14 * long),
             (y + 0.042, width - 0.7, front + 0.34 * long, rear - 0.3 * long)],
            p.paint, radius=0.12,
        )  # fmt: skip
        solids = [glass, roof, *self._pillars()]
        if p.z_panel is not None:
            lower = self.level(-0.2, grow=0.008, front=p.z_panel)
            upper = self.level(0.9, grow=0.008, front=p.z_panel)
            solids.append(stacked([lower, upper], p.paint, radius=0.1))
            rear_glass = (0, self.height(0.5), self.rear(0.5) + 0.005)
            solids.append(box(rear_glass, (1.3 * self.half(0.5), 0.5 * tall, 0.03), _GLASS))
        elif p.z_deck > 0.44 * p.length:
            solids.append(self._tailgate())
        return solids

    def _tailgate(self) -> Solid:
        """The painted part of a steep rear end, below its window."""
        levels = [
            (
                self.height(share),
                2 * self.half(share) - 0.14,
                self.rear(max(share, 0.0)) - 0.3,
                self.rear(max(share, 0.0)) + 0.015,
            )
            for share in (-0.4, 0.0, 0.16)
        ]
        return stacked(levels, self.p.paint, radius=0.1)

    def _pillars(self) -> list[Solid]:
        p = self.p
        solids = []
        inset = 0.045
        front_low = (self.half(-0.1) - inset, self.height(-0.1), self.front(-0.1) + inset)
        front_high = (self.half(0.92) - inset, self.height(0.92), self.front(0.92) + inset)
        solids.append(beam(front_low, front_high, (0.09, 0.09), p.paint, side=(0, 0, 1)))
        if p.z_panel is None:
            low = (self.half(-0.1) - inset, self.height(-0.1), self.rear(-0.1) - inset)
            high = (self.half(0.92) - inset, self.height(0.92), self.rear(0.92) - inset)
            solids.append(beam(low, high, (0.12, 0.1), p.paint, side=(0, 0, 1)))
        for z in p.pillars:
            low = (self.half(-0.1) - 0.012, self.height(-0.1), z)
            high = (self.half(0.92) - 0.012, self.height(0.92), z + 0.03)
            solids.append(beam(low, high, (0.07, 0.05), p.paint, side=(0, 0, 1)))
        return both_sides(*solids)


def _bed(p: CarParameters) -> list[Solid]:
    """The load bed of a pickup: walls around a dark floor."""
    front, rear = p.z_deck + 0.1, p.length / 2 - 0.03
    low, high = p.top(0.5 * (front + rear)) - 0.03, p.belt + 0.08
    tall, middle, half = high - low, (front + rear) / 2, p.width / 2 - 0.09
    wall = box((half, low + tall / 2, middle), (0.1, tall, rear - front), p.paint)
    gate = box((0, low + tall / 2, rear - 0.04), (2 * half + 0.1, tall, 0.08), p.paint)
    head = box((0, low + tall / 2, front + 0.03), (2 * half + 0.1, tall, 0.06), p.paint)
    floor = box((0, low + 0.055, middle), (2 * half - 0.02, 0.04, rear - front - 0.08), _DARK)
    return [*both_sides(wall), gate, head, floor]
