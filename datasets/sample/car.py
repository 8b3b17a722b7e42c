"""Parametric cars: a body with wheel arches, a glass house, wheels, lamps and bumpers."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.sample.model import (
    Color,
    Draft,
    Level,
    Solid,
    beam,
    both_sides,
    box,
    ellipsoid,
    lathe,
    loft,
    mirrored_places,
    palette,
    stack,
)

_PAINTS = palette(
    "ba1e24 224e96 d6d8dc ecb228 3a7852 6e747c 3c3e46 ce6024 5aa0be eeece4 702238 96a078"
)
_GLASS, _DARK, _TRIM, _RIM, _PLATE = palette("1e2630 202023 3a3c40 c4c8ce f0f0e6")
_HEAD_LAMP, _TAIL_LAMP = palette("faf6d6 d6161a")
# Profiles of radius, in radii of the wheel, and distance outward [metres].
_TYRE = ((0.92, -0.22), (1, -0.18), (1, -0.04), (0.94, 0.0), (0.7, 0.0), (0.68, -0.035))
_DISC = ((0.71, -0.05), (0.71, 0.006), (0.64, 0.006), (0.55, -0.02), (0.24, -0.03), (0.15, 0.014))


@dataclass(frozen=True)
class _Car:
    """Proportions of a car [metres]; positions along it are shares of its length, 0 at the nose.

    ``cowl`` and ``deck`` are the lower ends of the windscreen and the rear window, ``roof`` both
    ends of the roof. The middle is at z = 0.
    """

    length: float
    width: float
    height: float
    nose: float
    belt: float
    tail: float
    cowl: float
    roof: tuple[float, float]
    deck: float
    axles: tuple[float, float]
    wheel: float
    pillars: tuple[float, ...]
    tumblehome: float = 0.2
    sill: float = 0.2
    shoulder: float = 0.16
    paint: Color = _PAINTS[0]

    def z(self, share: float) -> float:
        return (share - 0.5) * self.length

    @property
    def mirror(self) -> float:
        return self.level(0.0)[2] + 0.36

    def level(self, share: float, grow: float = 0.0) -> Level:
        """A section of the glass house, at the belt line for 0 and at the roof for 1."""
        width = self.width * (0.9 - self.tumblehome * share)
        front = self.z(self.cowl + share * (self.roof[0] - self.cowl))
        rear = self.z(self.deck + share * (self.roof[1] - self.deck))
        y = self.belt + share * (self.height - 0.042 - self.belt)
        return y, width + 2 * grow, front - grow, rear + grow

    def top(self, z: FloatArray) -> FloatArray:
        """Heights of the body's upper edge: bonnet, belt line, boot."""
        end, belt = self.length / 2, self.belt
        knots = [-end, -0.86 * end, self.z(self.cowl) + 0.05, self.z(self.deck), end - 0.1, end]
        heights = [self.nose - 0.02, self.nose + 0.06, belt, belt + 0.02, self.tail, self.tail]
        drop = 0.16 * np.clip(1 - (z + end) / 0.25, 0, 1) ** 2
        return np.asarray(np.interp(z, knots, heights) - drop - self.lift(z))

    def lift(self, z: FloatArray) -> FloatArray:
        """Rounding of the body's upper and lower edges at both ends."""
        return np.asarray(0.12 * np.clip(1 - (self.length / 2 - np.abs(z)) / 0.12, 0, 1) ** 2)


_KINDS = (
    _Car(4.6, 1.8, 1.45, .76, .92, .96, .27, (.43, .69), .84, (.18, .78), .32, (.55,)),
    _Car(4.0, 1.74, 1.48, .76, .93, .9, .25, (.43, .88), .975, (.19, .82), .31, (.57,)),
    _Car(4.7, 1.9, 1.74, .95, 1.08, 1.06, .25, (.38, .9), .965, (.18, .79), .39, (.53, .74),
         .15, .3),
    _Car(4.4, 1.86, 1.24, .73, .85, .87, .37, (.53, .66), .9, (.18, .8), .315, (.67,), .26),
    _Car(4.75, 1.8, 1.48, .76, .92, .94, .25, (.4, .91), .975, (.17, .77), .32, (.53, .75)),
    _Car(3.45, 1.62, 1.54, .8, .95, .94, .17, (.38, .92), .985, (.19, .81), .29, (.62,), .16),
    _Car(5.0, 1.94, 2.05, .98, 1.18, 1.12, .1, (.24, .985), .995, (.17, .78), .35, (.3, .52, .75),
         .1, .25),
)  # fmt: skip
"""Sedan, hatchback, off-road car, sports car, estate car, city car, minibus."""


def car(rng: np.random.Generator, index: int) -> Draft:
    """Draw and build a car.

    Semantic ids, right (+x) before left: 0 to 3 front and rear corners of the roof; 4 to 7 middles
    of the front and rear wheels; 8, 9 head lamps; 10, 11 tail lamps; 12, 13 lower corners of the
    windscreen; 14 to 17 ends of the front and rear bumper; 18, 19 mirrors.
    """
    kind = _KINDS[index % len(_KINDS)]
    shift = rng.uniform(-0.012, 0.012)
    c = replace(
        kind,
        length=kind.length * rng.uniform(0.92, 1.08),
        width=kind.width * rng.uniform(0.95, 1.05),
        height=kind.height * rng.uniform(0.96, 1.06),
        shoulder=rng.uniform(0.12, 0.2),
        cowl=kind.cowl + shift,
        roof=(kind.roof[0] + shift, kind.roof[1]),
        wheel=kind.wheel * rng.uniform(0.97, 1.04),
        paint=_PAINTS[(5 * index + int(rng.integers(3))) % len(_PAINTS)],
    )
    half, end = c.width / 2, c.length / 2
    y, width, front, rear = c.level(1.0)
    low, wide, foot, _ = c.level(0.06)
    pairs = {
        (0, 1): (width / 2, y, front),
        (2, 3): (width / 2, y, rear),
        (4, 5): (half + 0.05, c.wheel, c.z(c.axles[0])),
        (6, 7): (half + 0.05, c.wheel, c.z(c.axles[1])),
        (8, 9): (0.78 * half, c.nose - 0.09, -end - 0.1),
        (10, 11): (0.84 * half, c.tail - 0.14, end + 0.1),
        (12, 13): (wide / 2, low, foot),
        (14, 15): (0.88 * half, 0.42, -end - 0.1),
        (16, 17): (0.9 * half, 0.43, end + 0.1),
        (18, 19): (half + 0.16, c.belt + 0.07, c.mirror),
    }
    solids = [_body(c), *_glass_house(c), *_fittings(c)]
    return Draft(solids, mirrored_places(pairs), tuple(pairs))


def _body(c: _Car) -> Solid:
    """Everything below the windows: the outline seen from the side, extruded with round edges."""
    end, reach = c.length / 2, 1.17 * c.wheel
    rounded = np.array([0.0, 0.015, 0.05, 0.12, 0.22, 0.36])
    plain = np.concatenate(
        [rounded - end, end - rounded, np.linspace(-end, end, 13), [c.z(c.deck)]]
    )
    stations = [(z, c.sill) for z in plain.tolist()]
    angle = np.linspace(0, np.pi, 13)
    for axle in map(c.z, c.axles):
        stations = [(z, y) for z, y in stations if abs(z - axle) > reach + 0.02]
        # Two stations at the foot of each arch, a hair apart, make its upright ends.
        stations += [(axle - reach - 0.002, c.sill), (axle + reach + 0.002, c.sill)]
        stations += zip(axle + reach * np.cos(angle), c.wheel + reach * np.sin(angle), strict=True)
    z, low = np.array(sorted(stations)).T
    low = low + c.lift(z)
    rings = []
    # Share of half the width; how much lower the top, higher the bottom, further in the ends are.
    for share, drop, lift, inset in (
        (0.5, -0.015, 0.0, 0.0), (0.84, 0.005, 0.0, 0.02),
        (0.94, 0.35 * c.shoulder, 0.0, 0.07), (1.0, c.shoulder, 0.04, 0.15),
    ):  # fmt: skip
        ends = np.sign(z) * inset * np.clip((np.abs(z) - end + 0.5) / 0.5, 0, 1) ** 2
        top = np.maximum(c.top(z) - drop, low + lift + 0.04)
        x = np.full(len(z), share * c.width / 2)
        over, under = (np.stack([x, y, z - ends], axis=1) for y in (top, low + lift))
        front, rear = (over[[0, -1], None] + under[[0, -1], None]) / 2
        rings.append(np.concatenate([front, over, rear, under[::-1]]))
    return loft([*(ring * (-1, 1, 1) for ring in rings[::-1]), *rings], c.paint)


def _glass_house(c: _Car) -> list[Solid]:
    """The windows, the pillars between them, and the roof."""
    y, width, front, rear = c.level(-0.25)
    sunk = (y, width - 0.14, front, rear - 0.14)
    top, wide, start, stop = c.level(1.0)
    ridge = (top + 0.042, wide - 0.5, 0.75 * start + 0.25 * stop, 0.22 * start + 0.78 * stop)
    roof = [c.level(0.86, 0.012), c.level(0.93, 0.012), c.level(1.0, -0.03), ridge]
    solids = [
        stack([sunk, c.level(0.0), c.level(0.92)], _GLASS, radius=0.12),
        stack(roof, c.paint, radius=0.12),
    ]
    (y, wide, front, rear), (top, width, start, stop) = c.level(-0.1, -0.045), c.level(0.92, -0.045)
    for foot, head in ((front, start), (rear, stop), *((c.z(s), c.z(s)) for s in c.pillars)):
        path = [(wide / 2 + 0.015, y, foot), (width / 2 + 0.015, top, head)]
        solids += both_sides(beam(path, (0.09, 0.08), c.paint, side=(0, 0, 1)))
    return solids


def _fittings(c: _Car) -> list[Solid]:
    half, end = c.width / 2, c.length / 2
    lamp, tail = (0.72 * half, c.nose - 0.15, 0.04 - end), (0.76 * half, c.tail - 0.16, end - 0.03)
    right = [
        ellipsoid(lamp, (0.42 * half, 0.17, 0.2), _HEAD_LAMP, count=12),
        box(tail, (0.3 * half, 0.18, 0.16), _TAIL_LAMP, radius=0.03),
        ellipsoid((half + 0.08, c.belt + 0.07, c.mirror), (0.2, 0.15, 0.12), c.paint, count=12),
    ]
    middle = [
        box((0, c.nose - 0.16, -end), (0.78 * half, 0.15, 0.06), _DARK, radius=0.02),  # grille
        box((0, 0.4, -end - 0.075), (0.5, 0.1, 0.02), _PLATE),
        box((0, c.tail - 0.24, end + 0.002), (0.52, 0.11, 0.02), _PLATE),
    ]
    for direction, axle in zip((-1, 1), map(c.z, c.axles), strict=True):
        hub, block = (half + 0.012, c.wheel, axle), (1.2 * (c.width - 0.5), 1.2 * c.wheel)
        for profile, color in ((_TYRE, _DARK), (_DISC, _RIM)):
            shape = np.array(profile) * (c.wheel, 1)
            right.append(lathe(shape, color, center=hub, sideways=True))
        long = 0.06 + min(0.36, end - abs(axle) - 1.22 * c.wheel)
        bumper = (0, 0.41, direction * (end + 0.065 - long / 2))
        middle.append(box(bumper, (1.97 * half, 0.2, long), _TRIM, radius=0.07, steps=3))
        # It closes the space between the wheels.
        middle.append(box((0, c.sill + block[1] / 2, axle), (*block, 2.5 * c.wheel), _DARK))
    return [*both_sides(*right), *middle]
