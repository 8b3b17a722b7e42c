"""Parametric cars, and vessels: container ships, sailing boats, motor yachts and tugs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.datasets.sample.model import (
    Color,
    Draft,
    Level,
    Point,
    beam,
    both_sides,
    box,
    ellipsoid,
    lathe,
    loft,
    mirrored_places,
    palette,
    pick,
    rectangle,
    stack,
    varied,
)
from cadalign.geometry.mesh import Mesh

# Cars ---------------------------------------------------------------------------------------------

_PAINTS = palette(
    "ba1e24 224e96 d6d8dc ecb228 3a7852 6e747c 3c3e46 ce6024 5aa0be eeece4 702238 96a078"
)
_GLASS, _DARK, _TRIM, _RIM, _HEAD_LAMP, _TAIL_LAMP = palette(
    "1e2630 202023 3a3c40 c4c8ce faf6d6 d6161a"
)
# Profiles of radius, in radii of the wheel, and distance outward [metres].
_TYRE = ((0.92, -0.22), (1, -0.18), (1, -0.04), (0.94, 0.0), (0.7, 0.0), (0.68, -0.035))
_DISC = ((0.71, -0.05), (0.71, 0.006), (0.64, 0.006), (0.55, -0.005), (0.24, -0.005), (0.15, 0.014))


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

    def level(self, share: float, grow: float = 0.0) -> Level:
        """A section of the glass house, at the belt line for 0 and at the roof for 1."""
        width = self.width * (0.9 - self.tumblehome * share)
        front = self.z(self.cowl + share * (self.roof[0] - self.cowl))
        rear = self.z(self.deck + share * (self.roof[1] - self.deck))
        y = self.belt + share * (self.height - 0.042 - self.belt)
        return y, width + 2 * grow, front - grow, rear + grow


_CARS = (
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
    kind = _CARS[index % len(_CARS)]
    shift = rng.uniform(-0.012, 0.012)
    c = varied(kind, rng, length=(0.92, 1.08), width=(0.95, 1.05), height=(0.96, 1.06))
    c = replace(
        c,
        shoulder=rng.uniform(0.12, 0.2),
        cowl=kind.cowl + shift,
        roof=(kind.roof[0] + shift, kind.roof[1]),
        wheel=kind.wheel * rng.uniform(0.97, 1.04),
        paint=_PAINTS[(5 * index + int(rng.integers(3))) % len(_PAINTS)],
    )
    half, end = c.width / 2, c.length / 2
    y, width, front, rear = c.level(1.0)
    low, wide, foot, _ = c.level(0.06)
    mirror = (half + 0.08, c.belt + 0.07, c.level(0.0)[2] + 0.36)
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
        (18, 19): (half + 0.16, *mirror[1:]),
    }
    lamp, tail = (0.72 * half, c.nose - 0.15, 0.04 - end), (0.76 * half, c.tail - 0.16, end - 0.03)
    grille = (0, c.nose - 0.16, -end)
    right = [
        ellipsoid(lamp, (0.42 * half, 0.17, 0.2), _HEAD_LAMP, count=12),
        box(tail, (0.3 * half, 0.18, 0.16), _TAIL_LAMP, radius=0.03),
        ellipsoid(mirror, (0.2, 0.15, 0.12), c.paint, count=12),
    ]
    middle = [_body(c), box(grille, (0.78 * half, 0.15, 0.06), _DARK, radius=0.02)]
    for direction, axle in zip((-1, 1), map(c.z, c.axles), strict=True):
        right += _wheel(c, axle)
        long = 0.06 + min(0.36, end - abs(axle) - 1.22 * c.wheel)
        bumper = (0, 0.41, direction * (end + 0.065 - long / 2))
        middle.append(box(bumper, (1.97 * half, 0.2, long), _TRIM, radius=0.07, steps=3))
    parts = [*both_sides(*right), *middle, *_glass_house(c)]
    return Draft(parts, mirrored_places(pairs), tuple(pairs))


def _body(c: _Car) -> Mesh:
    """Everything below the windows: plans with round corners, from the sill to the belt line."""
    rings = []
    # How much of the way from the sill to the edge of bonnet and boot; how far below; inset.
    for share, below, inset in (
        (0, 0, 0.1), (0, -0.1, 0), (1, c.shoulder, 0), (1, 0.35 * c.shoulder, 0.05), (1, 0, 0.14),
    ):  # fmt: skip
        x, z = rectangle(c.width - inset, c.length - 2 * inset, radius=0.18, steps=4).T
        edge = c.nose + (c.tail - c.nose) * (z / c.length + 0.5)
        rings.append(np.stack([x, c.sill + share * (edge - c.sill) - below, z], axis=1))
    y, width, front, rear = c.level(0.0, 0.02)
    x, z = rectangle(width, rear - front, radius=0.12, steps=4).T
    rings.append(np.stack([x, np.full(len(x), y + 0.01), z + (front + rear) / 2], axis=1))
    return loft(rings, c.paint)


def _wheel(c: _Car, axle: float) -> list[Mesh]:
    """A wheel of the right side, and the wheel arch: half a dark disc in the body's side."""
    hub, reach = (c.width / 2 + 0.012, c.wheel, axle), 1.17 * c.wheel
    angle = np.linspace(0, np.arccos((c.sill - c.wheel) / reach), 12)
    rim = reach * np.stack([np.cos(angle), np.sin(angle)], axis=1) + (c.wheel, 0)
    outline = np.concatenate([rim, [[c.sill, 0]], rim[:0:-1] * (1, -1)]) + (0, axle)
    arch = loft([np.insert(outline, 0, c.width / 2 + x, axis=1) for x in (-0.2, 0.004)], _DARK)
    turned = [
        lathe(np.multiply(profile, (c.wheel, 1)), tint, center=hub, sideways=True)
        for profile, tint in ((_TYRE, _DARK), (_DISC, _RIM))
    ]
    return [arch, *turned]


def _glass_house(c: _Car) -> list[Mesh]:
    """The windows, the pillars between them, and the roof."""
    y, width, front, rear = c.level(-0.25)
    sunk = (y, width - 0.14, front, rear - 0.14)
    top, wide, start, stop = c.level(1.0)
    ridge = (top + 0.042, wide - 0.5, 0.75 * start + 0.25 * stop, 0.22 * start + 0.78 * stop)
    roof = [c.level(0.86, 0.012), c.level(0.93, 0.012), c.level(1.0, -0.03), ridge]
    parts = [
        stack([sunk, c.level(0.0), c.level(0.92)], _GLASS, radius=0.12),
        stack(roof, c.paint, radius=0.12),
    ]
    (y, wide, front, rear), (top, width, start, stop) = c.level(-0.1, -0.045), c.level(0.92, -0.045)
    for foot, head in ((front, start), (rear, stop), *((c.z(s), c.z(s)) for s in c.pillars)):
        path = [(wide / 2 + 0.015, y, foot), (width / 2 + 0.015, top, head)]
        parts += both_sides(beam(path, (0.08, 0.05), c.paint))
    return parts


# Vessels ------------------------------------------------------------------------------------------

_WHITE, _BLACK, _SPAR, _CLOTH = palette("f0f0ec 202226 ced0d4 f6f3e8")
_BOTTOMS = palette("8c2620 6e2222 28423c")
_SIDES = palette("243e68 962824 225850 262c34 e2e2de 204a78")
_ACCENTS = palette("cc2c26 eea824 205ca0 2e7c4e e86a20")
_DECKS = palette("7e5c4e c49864 cca676 707670")


@dataclass(frozen=True)
class _Vessel:
    """A vessel of length 1 with its bow at z = -0.5 and the water line at y = 0."""

    beam: float  # greatest width
    draft: float  # depth under water
    freeboard: float  # height of the side amidships
    sheer: tuple[float, float]  # rise of the side towards bow and stern
    rake: tuple[float, float]  # overhang of the bow and the stern over their feet
    entry: float  # position, 0 at the bow, from which the hull has its full width
    fullness: float  # bluntness of the bow: 1 is a straight wedge, 3 very full
    stern_width: float  # relative to the beam
    bulwark: float  # height of the side's edge above the deck
    planks: Color  # of the deck
    storeys: tuple[Level, ...]  # height, width relative to the beam, front and rear
    mast: Point  # radius, height over the upper roof, place before the rear of it
    house: int = -1  # the storey whose roof has keypoints
    counts: tuple[int, int, int] = (5, 5, 5)  # of storeys at most, by variant
    lean: float = 0.0  # of the windows in front
    funnel: tuple[float, float] | None = None  # z and radius
    variant: int = 0
    tall: float = 1.0  # scales everything above the deck
    bottom: Color = _BOTTOMS[0]
    accent: Color = _ACCENTS[0]

    @property
    def water(self) -> float:
        """The water line's share of the height: 0 at the keel, 1 at the edge of the deck."""
        return self.draft / (self.draft + self.freeboard)

    def edge(self, z: npt.ArrayLike) -> FloatArray:
        z, (bow, stern) = np.asarray(z), self.sheer
        rise = bow * np.clip((0.05 - z) / 0.55, 0, 1) ** 2
        return np.asarray(self.freeboard + rise + stern * np.clip((z - 0.1) / 0.4, 0, 1) ** 2)

    def deck(self, z: float) -> float:
        return float(self.edge(z)) - self.bulwark

    def half(self, z: npt.ArrayLike, share: float = 1.0) -> FloatArray:
        """Halves of the width, at a share of the height from the keel."""
        u, depth = np.asarray(z) + 0.5, 0.35 + 0.65 * np.sqrt(min(share / 0.75, 1.0))
        bow = 1 - (1 - np.clip(u / (self.entry * (1.25 - 0.25 * share)), 0, 1)) ** self.fullness
        narrow = 1 - self.stern_width * (0.45 + 0.55 * share)
        return np.asarray(
            depth * self.beam / 2 * bow * (1 - narrow * np.clip(2.5 * u - 1.5, 0, 1) ** 2)
        )

    def ends(self, share: float) -> list[float]:
        """z of stem and stern at a share of the height."""
        return [self.rake[0] * (1 - share) - 0.5, 0.5 - self.rake[1] * (1 - share)]

    def outline(self, share: float, inset: float = 0.0) -> FloatArray:
        """A closed line around the hull, from the middle of the stern over the right side."""
        z = np.concatenate([np.linspace(0.5, -0.1, 13), np.linspace(-0.1, -0.5, 15)[1:]])
        bow, stern = self.ends(share)
        above = max(0.0, (share - self.water) / (1 - self.water))
        height = min(0.0, share / self.water - 1) * self.draft + above * self.edge(z)
        place = bow + 1.6 * inset + (z + 0.5) * (stern - bow - 2.6 * inset)
        right = np.stack([np.maximum(self.half(z, share) - inset, 0.0), height, place], axis=1)
        right[-1, 0] = 0.0
        return np.concatenate([right[:1] * (0, 1, 1), right, right[-2::-1] * (-1, 1, 1)])

    def hull(self, side: Color) -> list[Mesh]:
        """The part under water, a stripe at the water line, the side, and the deck."""
        band = 0.88 * self.water + 0.12
        below, above = np.linspace(0.0, self.water, 6), np.linspace(band, 1.0, 5)
        inner = self.outline(1.0, inset=0.012)
        sunk = inner - (0, self.bulwark, 0)
        return [
            loft([*map(self.outline, below)], self.bottom),
            loft([*map(self.outline, (self.water, band))], _WHITE),
            loft([*map(self.outline, above), inner, sunk], side),
            loft([sunk - (0, 0.004, 0), sunk + (0, 0.002, 0)], self.planks),
        ]


def vessel(rng: np.random.Generator, index: int) -> Draft:
    """Draw and build a vessel.

    Semantic ids, right (+x) before left: 0 top of the bow; 1 bow at the water line; 2, 3 corners of
    the stern; 4, 5 edge of the side amidships, 6, 7 a quarter of the length from the bow; 8, 9
    front and 10, 11 rear upper corners of the deck house; 12 the highest point; 13, 14 stern at the
    water line; 15 the funnel's top, where there is one.
    """
    turn, number = divmod(index, len(_VESSELS))
    kind, load = _VESSELS[number]
    sizes = {"beam": (0.92, 1.08), "freeboard": (0.88, 1.12), "stern_width": (0.85, 1.08)}
    v = varied(kind, rng, **sizes, tall=(0.92, 1.1))
    v = replace(v, variant=turn % 3, bottom=pick(rng, _BOTTOMS), accent=pick(rng, _ACCENTS))
    side = _SIDES[(number + turn + int(rng.integers(2))) % len(_SIDES)]
    above, roof, tips = _above(v)
    (bow, stern), (top, width, front, rear) = v.ends(v.water), roof
    pairs = {
        (8, 9): (width / 2, top, front),
        (10, 11): (width / 2, top, rear),
        (13, 14): (float(v.half(0.5, v.water)), 0.0, stern),
    }
    for right, z in ((2, 0.5), (4, 0.0), (6, -0.25)):
        pairs[right, right + 1] = float(v.half(z)), float(v.edge(z)), z
    places = {0: (0.0, float(v.edge(-0.5)), -0.5), 1: (0.0, 0.0, bow)} | tips
    parts = [*v.hull(side), *above, *load(v)]
    return Draft(parts, mirrored_places(pairs) | places, tuple(pairs))


def _above(v: _Vessel) -> tuple[list[Mesh], Level, dict[int, Point]]:
    """Storeys, mast and funnel; the roof of the deck house; places by semantic id."""
    parts: list[Mesh] = []
    roofs: list[Level] = []
    low = v.deck(0.05) - 0.01
    storeys = v.storeys[: v.counts[v.variant]]
    for rise, width, front, rear in storeys:
        roof = (low + rise * v.tall, width * v.beam, front, rear)
        is_painted = v.funnel is not None and len(roofs) == len(storeys) - 1
        parts += _storey(low, roof, v.lean, v.accent if is_painted else _WHITE)
        roofs.append(roof)
        low = roof[0] - 0.004
    radius, rise, before = v.mast
    z, top = roofs[-1][3] - before, low + rise * v.tall
    yard = (0, 0.4 * low + 0.6 * top, z)
    pole = [(radius, low - 0.01), (0.6 * radius, top)]
    parts.append(lathe(pole, _SPAR, center=(0, 0, z), count=12))
    parts.append(box(yard, (10 * radius, radius, radius), _SPAR))
    tips = {12: (0.0, top, z)}
    if v.funnel:
        (z, radius), top = v.funnel, low + 0.05 * v.tall
        lower = [(radius, low - 0.14), (0.97 * radius, top - 0.03)]
        upper = [(0.95 * radius, top - 0.03), (0.93 * radius, top)]
        parts += [lathe(p, c, center=(0, 0, z)) for p, c in ((lower, v.accent), (upper, _BLACK))]
        tips[15] = (0.0, top, z)
    return parts, roofs[v.house], tips


def _storey(low: float, roof: Level, lean: float, color: Color) -> list[Mesh]:
    """A wall, a band of glass that leans back by ``lean`` to the roof in front, and the roof."""
    high, width, head, rear = roof
    tall, front = high - low, head - lean
    sill, top, bend = low + 0.35 * tall, high - 0.12 * tall, front + 0.3 * lean
    wall = [(low, width, front, rear), (sill, width, bend, rear)]
    glass = [(sill, 0.98 * width, bend, rear), (top, 0.94 * width, head, rear - 0.1 * tall)]
    cover = [(top, 1.03 * width, head - 0.2 * tall, rear + 0.25 * tall),
             (high, width, head - 0.12 * tall, rear + 0.18 * tall)]  # fmt: skip
    levels = ((wall, _WHITE), (glass, _GLASS), (cover, color))
    return [stack(level, tint, radius=0.35 * tall) for level, tint in levels]


def _containers(v: _Vessel) -> list[Mesh]:
    wide, tall, long, parts = 0.15 * v.beam, 0.028 * v.tall, 0.64 / 7, []
    for bay, z in enumerate(-0.36 + long * np.arange(0.5, 7)):
        deck, room = v.deck(min(z - long / 2, 0.1)), float(v.half(z - long / 2)) - 0.012
        for row in range(min(3, int(room / wide))):
            for layer in range(3 if bay == 0 else 4 - (bay + row + v.variant) % 2):
                color = _ACCENTS[(5 * bay + 3 * row + (2 + bay) * layer) % len(_ACCENTS)]
                center = ((row + 0.5) * wide, deck + (layer + 0.5) * tall, z)
                size = (0.95 * wide, 0.95 * tall, 0.92 * long)
                parts += both_sides(box(center, size, color))
    return parts


def _sails(v: _Vessel) -> list[Mesh]:
    """Mainsail and foresail in the plane x = 0, one of them coloured or none, boom and fin."""
    deck, keel = v.deck(0.0), -v.draft
    top, share = deck + 1.02 * v.tall, np.linspace(0, 1, 11)
    fin = [(keel - 0.13, 0.03, -0.02, 0.14), (keel + 0.02, 0.026, -0.1, 0.16)]
    parts = [
        stack(fin, v.bottom, radius=0.012),
        box((0, deck + 0.1, 0.1), (0.016, 0.016, 0.4), _SPAR),
    ]
    # Lower and upper end of a sail, of its front and of its rear edge, which is curved.
    for variant, heights, luff, leech in (
        (2, (deck + 0.112, top - 0.03), (-0.088, -0.088), (0.29, -0.076)),
        (1, (deck + 0.03, 0.86 * top), (-0.47, -0.13), (-0.12, -0.118)),
    ):
        y, front, rear = (low + share * (high - low) for low, high in (heights, luff, leech))
        rear = rear + 0.15 * (leech[0] - luff[0]) * np.sin(np.pi * share)
        levels = [*zip(y, np.full(11, 0.006), front, rear, strict=True)]
        parts.append(stack(levels, v.accent if v.variant == variant else _CLOTH, radius=0.0))
    return parts


_VESSELS: tuple[tuple[_Vessel, Callable[[_Vessel], list[Mesh]]], ...] = (
    (_Vessel(.165, .04, .052, (.03, .008), (.045, .03), .2, 2.2, .82, .008, _DECKS[0],
             (*4 * ((.034, .84, .3, .415),), (.03, 1.0, .3075, .3625)), (.005, .075, .0325),
             funnel=(.433, .027)), _containers),
    (_Vessel(.275, .05, .072, (.035, .01), (.11, .07), .58, 1.7, .6, .01, _DECKS[1],
             ((.065, .44, -.11, .19),), (.011, .965, .29), lean=.05), _sails),
    (_Vessel(.25, .035, .082, (.045, 0.0), (.12, .02), .55, 1.8, .88, .014, _DECKS[2],
             ((.1, .74, -.12, .3), (.085, .65, -.01, .23), (.07, .57, .1, .16)), (.006, .19, .08),
             house=0, counts=(2, 3, 1), lean=.08), lambda _: []),
    (_Vessel(.325, .07, .072, (.08, .015), (.05, .05), .38, 2.3, .72, .025, _DECKS[3],
             ((.11, .62, -.22, .12), (.135, .484, -.2, -.04)), (.009, .2, .04),
             lean=.01, funnel=(.08, .06)), lambda _: []),
)  # fmt: skip
"""Container ship, sailing boat, motor yacht, tug; and what they carry."""
