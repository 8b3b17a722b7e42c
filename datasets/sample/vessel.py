"""Parametric vessels: cargo ships, sailing boats, motor yachts and tugs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.datasets.sample.model import Draft, mirrored_places
from cadalign.datasets.sample.solids import (
    Color,
    Point,
    Solid,
    both_sides,
    box,
    ellipsoid,
    lathe,
    loft,
    rod,
    stack,
)

_WHITE, _BLACK, _GLASS = (240, 240, 236), (32, 34, 38), (34, 46, 60)
_SPAR, _CLOTH = (206, 208, 212), (246, 243, 232)
_BOTTOMS: tuple[Color, ...] = ((140, 38, 32), (110, 34, 34), (40, 66, 60))
_SIDES: tuple[Color, ...] = (
    (36, 62, 104), (150, 40, 36), (34, 88, 80), (38, 44, 52), (226, 226, 222), (32, 74, 120),
)  # fmt: skip
_ACCENTS: tuple[Color, ...] = (
    (204, 44, 38), (238, 168, 36), (32, 92, 160), (46, 124, 78), (232, 106, 32),
)  # fmt: skip


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
    tall: float = 1.0  # scales everything above the deck
    variant: int = 0
    bottom: Color = _BOTTOMS[0]
    accent: Color = _ACCENTS[0]

    @property
    def water(self) -> float:
        """The water line's share of the height: 0 at the keel, 1 at the edge of the deck."""
        return self.draft / (self.draft + self.freeboard)

    def edge(self, z: npt.ArrayLike) -> FloatArray:
        """Heights of the side's edge."""
        z, (bow, stern) = np.asarray(z), self.sheer
        rise = bow * np.clip((0.05 - z) / 0.55, 0, 1) ** 2
        return np.asarray(self.freeboard + rise + stern * np.clip((z - 0.1) / 0.4, 0, 1) ** 2)

    def deck(self, z: float) -> float:
        return float(self.edge(z)) - self.bulwark

    def half(self, z: npt.ArrayLike, share: float = 1.0) -> FloatArray:
        """Halves of the width, at a share of the height from the keel."""
        u = np.asarray(z) + 0.5
        entry = self.entry * (1.25 - 0.25 * share)
        bow = 1 - (1 - np.clip(u / entry, 0, 1)) ** self.fullness
        run = np.clip((u - 0.6) / 0.4, 0, 1)
        stern = 1 - (1 - self.stern_width * (0.45 + 0.55 * share)) * run**2
        depth = 0.35 + 0.65 * np.sqrt(np.clip(share / 0.75, 0, 1))
        return np.asarray(self.beam / 2 * bow * stern * depth)

    def side(self, z: float) -> Point:
        """A point of the right edge."""
        return float(self.half(z)), float(self.edge(z)), z

    def ends(self, share: float) -> tuple[float, float]:
        """z of stem and stern at a share of the height."""
        return self.rake[0] * (1 - share) - 0.5, 0.5 - self.rake[1] * (1 - share)

    def outline(self, share: float, inset: float = 0.0) -> FloatArray:
        """A closed line around the hull, from the middle of the stern over the right side."""
        z = 0.5 - np.concatenate([np.linspace(0, 0.6, 13), np.linspace(0.6, 1, 15)[1:]])
        bow, stern = self.ends(share)
        above = max(0.0, (share - self.water) / (1 - self.water))
        height = min(0.0, share / self.water - 1) * self.draft + above * self.edge(z)
        place = bow + 1.6 * inset + (z + 0.5) * (stern - bow - 2.6 * inset)
        right = np.stack([np.maximum(self.half(z, share) - inset, 0.0), height, place], axis=1)
        right[-1, 0] = 0.0
        return np.concatenate([right[:1] * (0, 1, 1), right, right[-2::-1] * (-1, 1, 1)])

    def hull(self, side: Color) -> list[Solid]:
        """The part under water, a stripe at the water line, the side, and the deck."""
        water = self.water
        band = water + 0.12 * (1 - water)
        below, line, above = (
            [self.outline(share) for share in np.linspace(low, high, count)]
            for low, high, count in ((0.0, water, 6), (water, band, 2), (band, 1.0, 5))
        )
        inner = self.outline(1.0, inset=0.012)
        sunk = inner - (0, self.bulwark, 0)
        return [
            loft(below, self.bottom),
            loft(line, _WHITE),
            loft([*above, inner, sunk], side),
            loft([sunk - (0, 0.004, 0), sunk + (0, 0.002, 0)], self.planks),
        ]


_Above = tuple[list[Solid], Point, Point, dict[int, Point]]
"""What stands above the deck, the upper front and rear corner of the deck house on the right, and
the places of the highest point and of the funnel by semantic id."""


def vessel(rng: np.random.Generator, index: int) -> Draft:
    """Draw and build a vessel.

    Semantic ids, right (+x) before left: 0 top of the bow; 1 bow at the water line; 2, 3 corners of
    the stern; 4, 5 edge of the side amidships, 6, 7 a quarter of the length from the bow; 8, 9
    front and 10, 11 rear upper corners of the deck house; 12 the highest point; 13, 14 stern at the
    water line; 15 the funnel's top, where there is one.
    """
    turn, number = divmod(index, len(_KINDS))
    kind, build = _KINDS[number]
    v = replace(
        kind,
        beam=kind.beam * rng.uniform(0.92, 1.08),
        freeboard=kind.freeboard * rng.uniform(0.88, 1.12),
        stern_width=kind.stern_width * rng.uniform(0.85, 1.08),
        tall=rng.uniform(0.92, 1.1),
        variant=turn % 3,
        bottom=_BOTTOMS[int(rng.integers(len(_BOTTOMS)))],
        accent=_ACCENTS[int(rng.integers(len(_ACCENTS)))],
    )
    side = _SIDES[(number + turn + int(rng.integers(2))) % len(_SIDES)]
    solids, house_front, house_rear, tips = build(v)
    bow, stern = v.ends(v.water)
    pairs = {
        (2, 3): v.side(0.5),
        (4, 5): v.side(0.0),
        (6, 7): v.side(-0.25),
        (8, 9): house_front,
        (10, 11): house_rear,
        (13, 14): (float(v.half(0.5, v.water)), 0.0, stern),
    }
    places = mirrored_places(pairs) | tips
    places |= {0: (0.0, float(v.edge(-0.5)), -0.5), 1: (0.0, 0.0, bow)}
    return Draft((*v.hull(side), *solids), places, tuple(pairs))


def _block(middle: Point, size: Point, *, count: int) -> list[Solid]:
    """A white block with dark panes along its front and both sides."""
    (x, y, z), (wide, tall, deep) = middle, size
    solids = [box(middle, size, _WHITE, radius=0.003, steps=1)]
    pane, height = 0.5 * wide / count, 0.34 * tall
    for s in (np.arange(count) - (count - 1) / 2) * 0.9 * wide / count:
        solids.append(box((x + s, y, z - deep / 2), (pane, height, 0.003), _GLASS))
    for s in np.arange(-0.36 * deep, 0.37 * deep, 2 * pane):
        solids += both_sides(box((wide / 2, y, z + s), (0.003, height, pane), _GLASS))
    return solids


def _storey(
    low: float, high: float, width: float, ends: tuple[float, float], slope: float, roof: Color
) -> list[Solid]:
    """A wall, a band of glass that leans back by ``slope`` in front, and a roof."""
    (front, rear), sill, top = ends, low + 0.35 * (high - low), high - 0.012
    bend, lean = front + 0.3 * slope, front + slope
    wall = [(low, width, front, rear), (sill, width, bend, rear)]
    glass = [(sill, 0.98 * width, bend, rear), (top, 0.94 * width, lean, rear - 0.01)]
    cover = [(top, 1.03 * width, lean - 0.02, rear + 0.025),
             (high, 1.0 * width, lean - 0.012, rear + 0.018)]  # fmt: skip
    levels = ((wall, _WHITE), (glass, _GLASS), (cover, roof))
    return [stack(level, color, radius=0.035) for level, color in levels]


def _funnel(foot: Point, tall: float, width: float, color: Color) -> list[Solid]:
    """A funnel with a black top and a pale ring."""
    solids = []
    for radius, low, high, tint in (
        (0.48, 0, 0.84, color), (0.49, 0.5, 0.64, _WHITE), (0.46, 0.83, 1, _BLACK)
    ):  # fmt: skip
        profile = np.array([(0, low), (radius, low), (0.97 * radius, high), (0, high)])
        solids.append(lathe(profile * (width, tall), tint, center=foot, count=20))
    return solids


def _mast(foot: Point, top: float, radius: float, yards: tuple[float, ...] = ()) -> list[Solid]:
    """A mast with bars across, at shares of its height."""
    x, y, z = foot
    bars = ((x, y + share * (top - y), z) for share in yards)
    spar = rod([foot, (x, top, z)], radius, _SPAR, scales=(1, 0.6))
    return [spar, *(box(bar, (10 * radius, radius, radius), _SPAR) for bar in bars)]


def _cargo(v: _Vessel) -> _Above:
    """A container ship or a gas tanker, its bridge at the stern."""
    front, rear, tall = 0.3, 0.415, 0.03 * v.tall
    y = v.deck(0.35) - 0.01
    solids: list[Solid] = []
    for _ in range(4):
        middle = (0.0, y + tall / 2, (front + rear) / 2)
        solids += _block(middle, (0.84 * v.beam, tall, rear - front), count=7)
        y += tall
    top, z = y + 0.026 * v.tall, front + 0.035
    summit, funnel = (0.0, top + 0.075 * v.tall, front + 0.03), (0.0, top + 0.045 * v.tall, 0.433)
    solids += [
        *_block((0, (y + top) / 2, z), (v.beam, top - y, 0.055), count=9),
        *_funnel((0, y - 0.05, 0.433), funnel[1] - y + 0.05, 0.055, v.accent),
        *_mast((0, top - 0.01, summit[2]), summit[1], 0.005, (0.6,)),
        *_mast((0, v.deck(-0.42), -0.43), v.deck(-0.42) + 0.09, 0.004),
    ]
    freight = _tanks if v.variant == 1 else _containers
    half = v.beam / 2
    tips = {12: summit, 15: funnel}
    return [*solids, *freight(v)], (half, top, z - 0.0275), (half, top, z + 0.0275), tips


def _containers(v: _Vessel) -> list[Solid]:
    """Stacks of containers; the colours are the same on the right and on the left."""
    solids = []
    wide, tall, long = 0.15 * v.beam, 0.028 * v.tall, 0.64 / 7
    for bay, z in enumerate(-0.36 + long * np.arange(0.5, 7)):
        low, room = v.deck(min(z - long / 2, 0.1)), float(v.half(z - long / 2)) - 0.012
        for row in range(min(3, int(room / wide))):
            for layer in range(3 if bay == 0 else 4 - (bay + row) % 2):
                color = _ACCENTS[(5 * bay + 3 * row + 2 * layer + bay * layer) % len(_ACCENTS)]
                center = ((row + 0.5) * wide, low + (layer + 0.5) * tall, z)
                solids.append(box(center, (0.95 * wide, 0.95 * tall, 0.92 * long), color))
    return both_sides(*solids)


def _tanks(v: _Vessel) -> list[Solid]:
    """The domes of a gas tanker."""
    size = (0.82 * v.beam, 0.82 * v.beam, 0.82 * v.beam)
    deck = v.deck(0.1) + 0.025
    return [ellipsoid((0, deck, z), size, v.accent, count=24) for z in (-0.26, -0.1, 0.06, 0.22)]


def _tug(v: _Vessel) -> _Above:
    """A tug: wheelhouse forward, one or two funnels, tyres along the side, a low open stern."""
    house, twin = 0.62 * v.beam, v.variant == 2
    deck, tall, wide = v.deck(0.05), 0.1 * v.tall, (0.78, 0.66, 0.86)[v.variant] * house
    y, front, rear = deck + tall, -0.21, -0.04
    top = y + 0.125
    summit, funnel = (0.0, top + 0.2 * v.tall, rear - 0.04), (0.0, y + 0.17 * v.tall, 0.08)
    width, x = (0.08, 0.27 * house) if twin else (0.125, 0.0)
    stacks = _funnel((x, y - 0.02, 0.08), funnel[1] - y + 0.02, width, v.accent)
    tyre = [(0, 0), (0.03, 0), (0.034, 0.01), (0.034, 0.02), (0.03, 0.028), (0.012, 0.028),
            (0, 0.022)]  # fmt: skip
    solids = [
        *_block((0, deck + tall / 2 - 0.02, -0.05), (house, tall + 0.04, 0.38), count=4),
        *_storey(y - 0.01, top, wide, (front, rear), 0.01, v.accent),
        *_mast((0, top - 0.02, summit[2]), summit[1], 0.009, (0.3, 0.6)),
        *(both_sides(*stacks) if twin else stacks),
    ]
    for z in np.linspace(-0.24, 0.36, 6):
        x, y, _ = v.side(z)
        center = (x - 0.012, y - 0.045, z)
        solids += both_sides(lathe(tyre, _BLACK, center=center, count=16, sideways=True))
    tips = {12: summit} if twin else {12: summit, 15: funnel}
    return solids, (0.51 * wide, top, front), (0.51 * wide, top, rear + 0.018), tips


def _yacht(v: _Vessel) -> _Above:
    """A motor yacht of one, two or three storeys, dark windows all around."""
    y, wide, front, rear = v.deck(0.05) - 0.004, 0.74 * v.beam, -0.2, 0.3
    solids: list[Solid] = []
    corners = []
    for storey in range((2, 3, 1)[v.variant]):
        high = y + (0.1 - 0.015 * storey) * v.tall
        solids += _storey(y, high, wide, (front, rear), 0.08, _WHITE)
        corners.append(((0.48 * wide, high, front + 0.08), (0.48 * wide, high, rear + 0.015)))
        y, wide, front, rear = high - 0.004, 0.88 * wide, front + 0.11, rear - 0.07
    z, top = rear - 0.01, y + 0.19
    solids += [
        *_mast((0, y - 0.01, z), top, 0.006, (0.3,)),
        box((0, y + 0.01, z), (0.4 * wide, 0.04, 0.05), _WHITE, radius=0.012),
    ]
    return solids, *corners[0], {12: (0.0, top, z)}


def _sail(v: _Vessel) -> _Above:
    """A sailing boat with mainsail and foresail, one of them coloured or none."""
    deck, wide, front, rear = v.deck(0.0), 0.5 * v.beam, -0.14, 0.2
    high, z, low, top, keel = deck + 0.055, -0.1, deck + 0.1, deck + 1.02 * v.tall, -v.draft
    house = [
        (deck - 0.02, wide, front - 0.02, rear),
        (high, 0.88 * wide, front + 0.03, rear - 0.01),
    ]
    fin = [(keel - 0.13, 0.03, -0.02, 0.14), (keel + 0.02, 0.026, -0.1, 0.16)]
    main, fore = (v.accent if v.variant == k else _CLOTH for k in (2, 1))
    jib = ((-0.47, float(v.edge(-0.47)) + 0.02), (z - 0.03, 0.86 * top), (z - 0.02, deck + 0.1))
    solids = [
        stack(house, _WHITE, radius=0.03),
        stack(fin, v.bottom, radius=0.012),
        box((0, deck + 0.01, 0.3), (0.36 * v.beam, 0.024, 0.17), _BLACK),
        rod([(0, low - 0.11, z), (0, top, z)], 0.011, _SPAR, scales=(1, 0.55)),
        rod([(0, low, z), (0, low, z + 0.4)], 0.008, _SPAR),
        _cloth((z + 0.012, low + 0.012), (z + 0.012, top - 0.03), (z + 0.39, low + 0.014), main),
        _cloth(*jib, fore),
    ]
    for pane in (front + 0.08, front + 0.16, front + 0.24):
        center, size = (0.475 * wide, deck + 0.022, pane), (0.02, 0.018, 0.05)
        solids += both_sides(box(center, size, _GLASS, radius=0.006))
    x = 0.44 * wide
    return solids, (x, high, front + 0.03), (x, high, rear - 0.01), {12: (0.0, top, z)}


def _cloth(
    tack: tuple[float, float], head: tuple[float, float], clew: tuple[float, float], color: Color
) -> Solid:
    """A flat sail with a curved rear edge in the plane x = 0, its corners as (z, y)."""
    shares = np.linspace(0, 1, 11)[:, None]
    luff, leech = (np.add(low, shares * np.subtract(head, low)) for low in (tack, clew))
    leech[:, :1] += 0.15 * (clew[0] - tack[0]) * np.sin(np.pi * shares) + 0.012 * shares
    foot, top = ((luff[[k]] + leech[[k]]) / 2 for k in (0, -1))
    outline = np.concatenate([foot, luff, top, leech[::-1]])[:, ::-1]
    return loft([np.insert(outline, 0, x, axis=1) for x in (-0.003, 0.003)], color)


_KINDS = (
    (_Vessel(0.165, 0.04, 0.052, (0.03, 0.008), (0.045, 0.03), 0.2, 2.2, 0.82, 0.008,
             (126, 92, 78)), _cargo),
    (_Vessel(0.275, 0.05, 0.072, (0.035, 0.01), (0.11, 0.07), 0.58, 1.7, 0.6, 0.01,
             (196, 152, 100)), _sail),
    (_Vessel(0.25, 0.035, 0.082, (0.045, 0.0), (0.12, 0.02), 0.55, 1.8, 0.88, 0.014,
             (204, 166, 118)), _yacht),
    (_Vessel(0.325, 0.07, 0.072, (0.08, 0.015), (0.05, 0.05), 0.38, 2.3, 0.72, 0.025,
             (112, 118, 112)), _tug),
)  # fmt: skip
