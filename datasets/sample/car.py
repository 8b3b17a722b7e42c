"""Parametric cars: a body with wheel arches, a glass house, wheels, lamps and trim."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.sample import solids as make
from cadalign.datasets.sample.model import Draft, mirrored_places
from cadalign.datasets.sample.solids import Color, Level, Solid, both_sides

_PAINTS: tuple[Color, ...] = (
    (186, 30, 36), (34, 78, 150), (214, 216, 220), (236, 178, 40), (58, 120, 82), (110, 116, 124),
    (60, 62, 70), (206, 96, 36), (90, 160, 190), (238, 236, 228), (112, 34, 56), (150, 160, 120),
)  # fmt: skip
_RIMS: tuple[Color, ...] = ((196, 200, 206), (168, 172, 178), (220, 222, 226))
_GLASS, _DARK, _TYRE, _TRIM = (30, 38, 48), (34, 34, 38), (30, 30, 32), (58, 60, 64)
_CHROME, _PLATE = (190, 194, 200), (240, 240, 230)
_HEAD_LAMP, _TAIL_LAMP = (250, 246, 214), (214, 22, 26)


@dataclass(frozen=True)
class _Car:
    """Proportions of a car [metres]; positions along it are shares of its length, 0 at the nose.

    ``cowl`` and ``deck`` are the lower ends of the windscreen and the rear window, ``roof`` both
    ends of the roof, ``panel`` the beginning of a van's closed wall. The middle is at z = 0.
    """

    name: str
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
    panel: float | None = None
    shoulder: float = 0.16
    paint: Color = _PAINTS[0]

    def z(self, share: float) -> float:
        return (share - 0.5) * self.length

    @property
    def sill(self) -> float:
        return 0.3 if self.name in ("pickup", "suv") else 0.2

    # Heights of the glass house are shares, 0 at the belt line and 1 at the roof.

    def front(self, share: float) -> float:
        return self.z(self.cowl + share * (self.roof[0] - self.cowl))

    def rear(self, share: float) -> float:
        return self.z(self.deck + share * (self.roof[1] - self.deck))

    def corner(self, share: float) -> tuple[float, float]:
        """x and y of the right edge of the glass house."""
        rise = self.height - 0.042 - self.belt
        return self.width / 2 * (0.9 - self.tumblehome * share), self.belt + share * rise

    def level(self, share: float, *, grow: float = 0.0, front: float | None = None) -> Level:
        half, y = self.corner(share)
        start = self.front(share) - grow if front is None else front
        return y, 2 * (half + grow), start, self.rear(share) + grow

    def top(self, z: FloatArray) -> FloatArray:
        """Heights of the body's upper edge: bonnet, belt line, boot."""
        end, cowl, deck = self.length / 2, self.z(self.cowl), self.z(self.deck)
        boot = deck + 0.05 if self.name == "pickup" else end - 0.1
        knots = [-end, -0.86 * end, cowl + 0.05, deck, boot, end]
        belt, tail = self.belt, self.tail
        heights = [self.nose - 0.02, self.nose + 0.06, belt, belt + 0.02, tail, tail - 0.02]
        drop = 0.16 * np.clip(1 - (z + end) / 0.25, 0, 1) ** 2
        return np.asarray(
            np.interp(z, knots, heights) - drop - 0.1 * np.clip(1 - (end - z) / 0.12, 0, 1) ** 2
        )


_KINDS = (
    _Car("sedan", 4.6, 1.8, 1.45, 0.76, 0.92, 0.96, 0.27,
         (0.43, 0.69), 0.84, (0.18, 0.78), 0.32, (0.55,)),
    _Car("hatchback", 4.0, 1.74, 1.48, 0.76, 0.93, 0.9, 0.25,
         (0.43, 0.88), 0.975, (0.19, 0.82), 0.31, (0.57,)),
    _Car("pickup", 5.3, 1.92, 1.76, 0.98, 1.12, 0.98, 0.25,
         (0.36, 0.53), 0.57, (0.17, 0.77), 0.38, (0.46,), 0.14),
    _Car("sports", 4.4, 1.86, 1.24, 0.73, 0.85, 0.87, 0.37,
         (0.53, 0.66), 0.9, (0.18, 0.8), 0.315, (0.67,), 0.26),
    _Car("van", 5.0, 1.94, 2.05, 0.98, 1.18, 1.12, 0.1,
         (0.24, 0.985), 0.995, (0.17, 0.78), 0.35, (0.3,), 0.1, 0.42),
    _Car("suv", 4.7, 1.9, 1.74, 0.95, 1.08, 1.06, 0.25,
         (0.38, 0.9), 0.965, (0.18, 0.79), 0.39, (0.53, 0.74), 0.15),
    _Car("wagon", 4.75, 1.8, 1.48, 0.76, 0.92, 0.94, 0.25,
         (0.4, 0.91), 0.975, (0.17, 0.77), 0.32, (0.53, 0.75)),
    _Car("city", 3.45, 1.62, 1.54, 0.8, 0.95, 0.94, 0.17,
         (0.38, 0.92), 0.985, (0.19, 0.81), 0.29, (0.62,), 0.16),
)  # fmt: skip


def car(rng: np.random.Generator, index: int) -> Draft:
    """Draw and build a car.

    Semantic ids, right (+x) before left: 0 to 3 front and rear corners of the roof; 4 to 7 middles
    of the front and rear wheels; 8, 9 head lamps; 10, 11 tail lamps; 12, 13 lower corners of the
    windscreen; 14 to 17 ends of the front and rear bumper; 18, 19 mirrors.
    """
    kind = _KINDS[index % len(_KINDS)]
    length, height = kind.length * rng.uniform(0.92, 1.08), kind.height * rng.uniform(0.96, 1.06)
    shift = rng.uniform(-0.012, 0.012)
    c = replace(
        kind,
        length=length,
        width=kind.width * rng.uniform(0.95, 1.05),
        height=height,
        shoulder=rng.uniform(0.12, 0.2),
        cowl=kind.cowl + shift,
        roof=(kind.roof[0] + shift, kind.roof[1]),
        wheel=kind.wheel * rng.uniform(0.97, 1.04),
    )
    spokes = int(rng.integers(5, 9))
    c = replace(c, paint=_PAINTS[(index + int(rng.integers(3))) % len(_PAINTS)])
    rim = _RIMS[int(rng.integers(len(_RIMS)))]
    half, end = c.width / 2, c.length / 2
    front, rear = map(c.z, c.axles)
    pairs = {
        (0, 1): (*c.corner(1.0), c.front(1.0)),
        (2, 3): (*c.corner(1.0), c.rear(1.0)),
        (4, 5): (half + 0.05, c.wheel, front),
        (6, 7): (half + 0.05, c.wheel, rear),
        (8, 9): (0.78 * half, c.nose - 0.09, -end - 0.1),
        (10, 11): (0.84 * half, c.tail - 0.14, end + 0.1),
        (12, 13): (*c.corner(0.06), c.front(0.06)),
        (14, 15): (0.88 * half, 0.42, -end - 0.1),
        (16, 17): (0.9 * half, 0.43, end + 0.1),
        (18, 19): (half + 0.16, c.belt + 0.07, c.front(0.0) + 0.36),
    }
    wheels = (part for z in (front, rear) for part in _wheel(c, z, spokes, rim))
    solids = (_body(c), *_glass_house(c), *both_sides(*wheels, *_right_trim(c)), *_middle_trim(c))
    return Draft(solids, mirrored_places(pairs), tuple(pairs))


def _body(c: _Car) -> Solid:
    """Everything below the windows: the outline seen from the side, extruded with round edges."""
    end, reach = c.length / 2, 1.17 * c.wheel
    rounded = np.array([0.0, 0.015, 0.05, 0.12, 0.22, 0.36])
    plain = np.concatenate([rounded - end, end - rounded, np.linspace(-end, end, 13)])
    deck = c.z(c.deck)
    stations = [(float(z), c.sill) for z in (*plain, deck, deck + 0.05)]
    angle = np.linspace(0, np.pi, 13)
    for axle in map(c.z, c.axles):
        stations = [(z, y) for z, y in stations if abs(z - axle) > reach + 0.02]
        # Two stations at the foot of each arch, a hair apart, make its upright ends.
        stations += [(axle - reach - 0.002, c.sill), (axle + reach + 0.002, c.sill)]
        stations += [
            *zip(axle + reach * np.cos(angle), c.wheel + reach * np.sin(angle), strict=True)
        ]
    z, low = np.array(sorted(stations)).T
    low = low + 0.12 * np.clip(1 - (end - np.abs(z)) / 0.12, 0, 1) ** 2
    rings = []
    # Share of half the width; how much lower the top, higher the bottom, further in the ends are.
    for share, drop, lift, inset in (
        (0.5, -0.015, 0.0, 0.0), (0.84, 0.005, 0.0, 0.02),
        (0.94, 0.35 * c.shoulder, 0.0, 0.07), (1.0, c.shoulder, 0.04, 0.15),
    ):  # fmt: skip
        ends = np.sign(z) * inset * np.clip((np.abs(z) - end + 0.5) / 0.5, 0, 1) ** 2
        bottom = low + lift
        top = np.maximum(c.top(z) - drop, bottom + 0.04)
        right = np.stack([np.full(len(z), share * c.width / 2), top, z - ends], axis=1)
        under = right * (1, 0, 1) + bottom[:, None] * (0, 1, 0)
        front, rear = (right[[0, -1], None] + under[[0, -1], None]) / 2
        rings.append(np.concatenate([front, right, rear, under[::-1]]))
    return make.loft([*(ring * (-1, 1, 1) for ring in rings[::-1]), *rings], c.paint)


def _glass_house(c: _Car) -> list[Solid]:
    """The windows, the pillars between them, and the roof."""
    y, width, front, rear = c.level(-0.25)
    sunk = (y, width - 0.14, front, rear - 0.14)
    glass = make.stack([sunk, c.level(0.0), c.level(0.92)], _GLASS, radius=0.12)
    y, width, front, rear = c.level(1.0)
    long = rear - front
    levels = [
        c.level(0.86, grow=0.012),
        c.level(0.93, grow=0.012),
        (y, width - 0.06, front + 0.03, rear - 0.03),
        (y + 0.042, width - 0.5, front + 0.25 * long, rear - 0.22 * long),
    ]
    solids = [glass, make.stack(levels, c.paint, radius=0.12)]
    low, high = -0.1, 0.92
    ends = [(c.front(low) + 0.045, c.front(high) + 0.045), *((c.z(s),) * 2 for s in c.pillars)]
    if c.panel is None:
        ends.append((c.rear(low) - 0.045, c.rear(high) - 0.045))
    else:
        wall = [c.level(share, grow=0.008, front=c.z(c.panel)) for share in (-0.2, 0.9)]
        half, y = c.corner(0.5)
        size = (1.3 * half, 0.5 * (c.height - c.belt), 0.03)
        solids.append(make.stack(wall, c.paint, radius=0.1))
        solids.append(make.box((0, y, c.rear(0.5) + 0.005), size, _GLASS))
    for start, stop in ends:
        post = [
            np.array((*c.corner(share), z)) - (0.03, 0, 0)
            for share, z in ((low, start), (high, stop))
        ]
        solids += both_sides(make.beam(post, (0.09, 0.08), c.paint, side=(0, 0, 1)))
    return solids


def _wheel(c: _Car, z: float, spokes: int, rim: Color) -> list[Solid]:
    """The right wheel at z: tyre, rim, disc, hub and spokes."""
    r = c.wheel
    center = np.array([c.width / 2 + 0.012, r, z])
    tyre = [(0, -0.22), (0.92, -0.22), (1, -0.18), (1, -0.04), (0.94, 0.0), (0.7, 0.0),
            (0.68, -0.035), (0, -0.035)]  # fmt: skip
    ring = [(0, -0.05), (0.7, -0.05), (0.71, 0.006), (0.64, 0.006), (0.62, -0.03), (0, -0.03)]
    disc = [(0, -0.04), (0.6, -0.04), (0.6, -0.02), (0, -0.02)]
    hub = [(0, -0.05), (0.17, -0.05), (0.15, 0.01), (0, 0.014)]
    solids = [
        make.lathe(np.array(profile) * (r, 1), color, center=center, count=count, sideways=True)
        for profile, color, count in (
            (tyre, _TYRE, 20), (hub, rim, 12), (ring, rim, 20), (disc, _TRIM, 16)
        )
    ]  # fmt: skip
    for angle in 2 * np.pi * np.arange(spokes) / spokes:
        outward = r * np.array([0, np.cos(angle), np.sin(angle)])
        path = center + np.array([0.1, 0.64])[:, None] * outward - (0.006, 0, 0)
        solids.append(make.beam(path, (0.022, 0.13 * r), rim, scales=(1, 0.8), side=(1, 0, 0)))
    return solids


def _right_trim(c: _Car) -> list[Solid]:
    """Lamp, tail lamp, mirror, door handles and skirt of the right side; a pickup's wall."""
    half, end, belt, z = c.width / 2, c.length / 2, c.belt, c.front(0.0) + 0.36
    tall, y = 0.34 if c.name in ("van", "suv") else 0.16, c.tail - 0.08
    middle, long = (c.z(sum(c.axles) / 2)), c.z(c.axles[1]) - c.z(c.axles[0]) - 2.6 * c.wheel
    solids = [
        make.ellipsoid(
            (0.72 * half, c.nose - 0.15, 0.04 - end), (0.42 * half, 0.17, 0.2), _HEAD_LAMP, count=12
        ),
        make.box((0.76 * half, y - tall / 2, end - 0.03), (0.3 * half, tall, 0.16), _TAIL_LAMP,
                 radius=0.03),
        make.ellipsoid((half + 0.08, belt + 0.07, z), (0.2, 0.15, 0.12), c.paint, count=12),
        make.beam([(half - 0.12, belt, z), (half + 0.06, belt + 0.05, z)], (0.04, 0.04), _DARK),
        make.box((half - 0.03, c.sill + 0.03, middle), (0.08, 0.07, long), _TRIM, radius=0.02),
    ]  # fmt: skip
    for door in (c.z(share) for share in c.pillars):
        handle = (half, belt - c.shoulder - 0.04, door - 0.16)
        solids.append(make.box(handle, (0.03, 0.03, 0.17), _TRIM, radius=0.01, steps=1))
    if c.name == "pickup":
        front = c.z(c.deck) + 0.1
        size = (0.1, 0.34, end - 0.03 - front)
        solids.append(make.box((half - 0.09, belt - 0.09, front + size[2] / 2), size, c.paint))
    return solids


def _middle_trim(c: _Car) -> list[Solid]:
    """Grille, bumpers, plates, and what is dark: between the wheels and on a pickup's bed."""
    half, end, y = c.width / 2, c.length / 2, c.nose - 0.16
    color = _TRIM
    if c.name not in ("pickup", "van", "suv", "city"):
        r, g, b = (round(0.72 * value) for value in c.paint)
        color = (r, g, b)
    solids = [
        make.box((0, y, -end), (0.78 * half, 0.15, 0.06), _DARK, radius=0.02, steps=1),
        make.box((0, 0.4, -end - 0.075), (0.5, 0.1, 0.02), _PLATE),
        make.box((0, c.tail - 0.24, end + 0.002), (0.52, 0.11, 0.02), _PLATE),
        *(make.box((0, y + k * 0.035, -end - 0.028), (0.74 * half, 0.014, 0.02), _CHROME)
          for k in (-1, 0, 1)),
    ]  # fmt: skip
    for direction, axle in zip((-1, 1), map(c.z, c.axles), strict=True):
        long = 0.06 + min(0.36, end - abs(axle) - 1.22 * c.wheel)
        center, size = (0, 0.41, direction * (end + 0.065 - long / 2)), (1.97 * half, 0.2, long)
        solids.append(make.box(center, size, color, radius=0.07, steps=3))
        block = (1.2 * (c.width - 0.5), 1.2 * c.wheel, 2.5 * c.wheel)
        solids.append(make.box((0, c.sill + block[1] / 2, axle), block, _DARK))
    if c.name == "pickup":
        front, rear, wide = c.z(c.deck) + 0.1, end - 0.03, 2 * half - 0.08
        for z, deep in ((rear - 0.04, 0.08), (front + 0.03, 0.06)):
            solids.append(make.box((0, c.belt - 0.09, z), (wide, 0.34, deep), c.paint))
        floor = (0, c.tail + 0.02, (front + rear) / 2)
        solids.append(make.box(floor, (wide - 0.12, 0.04, rear - front - 0.08), _DARK))
    return solids
