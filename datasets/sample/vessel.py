"""Parametric vessels: container ships, sailing boats, motor yachts and tugs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.datasets.sample.model import (
    Color,
    Draft,
    Level,
    Point,
    Solid,
    both_sides,
    box,
    lathe,
    loft,
    mirrored_places,
    palette,
    pick,
    stack,
)

_WHITE, _BLACK, _GLASS, _SPAR, _CLOTH = palette("f0f0ec 202226 222e3c ced0d4 f6f3e8")
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
    tall: float = 1.0  # scales everything above the deck
    variant: int = 0
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
        u = np.asarray(z) + 0.5
        entry = self.entry * (1.25 - 0.25 * share)
        bow = 1 - (1 - np.clip(u / entry, 0, 1)) ** self.fullness
        run = np.clip((u - 0.6) / 0.4, 0, 1)
        stern = 1 - (1 - self.stern_width * (0.45 + 0.55 * share)) * run**2
        depth = 0.35 + 0.65 * np.sqrt(np.clip(share / 0.75, 0, 1))
        return np.asarray(self.beam / 2 * bow * stern * depth)

    def ends(self, share: float) -> FloatArray:
        """z of stem and stern at a share of the height."""
        return (np.array(self.rake) * (1 - share) - 0.5) * (1, -1)

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
        band = 0.88 * self.water + 0.12
        below, above = np.linspace(0.0, self.water, 6), np.linspace(band, 1.0, 5)
        inner = self.outline(1.0, inset=0.012)
        sunk = inner - (0, self.bulwark, 0)
        return [
            loft([self.outline(share) for share in below], self.bottom),
            loft([self.outline(share) for share in (self.water, band)], _WHITE),
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
    turn, number = divmod(index, len(_KINDS))
    kind, build = _KINDS[number]
    v = replace(
        kind,
        beam=kind.beam * rng.uniform(0.92, 1.08),
        freeboard=kind.freeboard * rng.uniform(0.88, 1.12),
        stern_width=kind.stern_width * rng.uniform(0.85, 1.08),
        tall=rng.uniform(0.92, 1.1),
        variant=turn % 3,
        bottom=pick(rng, _BOTTOMS),
        accent=pick(rng, _ACCENTS),
    )
    side = _SIDES[(number + turn + int(rng.integers(2))) % len(_SIDES)]
    solids, (top, width, front, rear), tips = build(v)
    bow, stern = v.ends(v.water).tolist()
    pairs = {
        (8, 9): (width / 2, top, front),
        (10, 11): (width / 2, top, rear),
        (13, 14): (float(v.half(0.5, v.water)), 0.0, stern),
    }
    for right, z in ((2, 0.5), (4, 0.0), (6, -0.25)):
        pairs[right, right + 1] = float(v.half(z)), float(v.edge(z)), z
    places = {0: (0.0, float(v.edge(-0.5)), -0.5), 1: (0.0, 0.0, bow)}
    return Draft([*v.hull(side), *solids], mirrored_places(pairs) | places | tips, tuple(pairs))


# What stands above the deck, the roof of the deck house, places by semantic id.
_Above = tuple[list[Solid], Level, dict[int, Point]]


def _storey(low: float, roof: Level, *, slope: float = 0.0, color: Color = _WHITE) -> list[Solid]:
    """A wall, a band of glass that leans back by ``slope`` to the roof in front, and the roof."""
    high, width, lean, rear = roof
    tall, front = high - low, lean - slope
    sill, top, bend = low + 0.35 * tall, high - 0.12 * tall, front + 0.3 * slope
    wall = [(low, width, front, rear), (sill, width, bend, rear)]
    glass = [(sill, 0.98 * width, bend, rear), (top, 0.94 * width, lean, rear - 0.1 * tall)]
    cover = [(top, 1.03 * width, lean - 0.2 * tall, rear + 0.25 * tall),
             (high, width, lean - 0.12 * tall, rear + 0.18 * tall)]  # fmt: skip
    levels = ((wall, _WHITE), (glass, _GLASS), (cover, color))
    return [stack(level, tint, radius=0.35 * tall) for level, tint in levels]


def _funnel(top: Point, low: float, radius: float, color: Color) -> list[Solid]:
    _, high, z = top
    bend = low + 0.8 * (high - low)
    lower, upper = (
        [(radius, low), (0.97 * radius, bend)],
        [(0.95 * radius, bend), (0.93 * radius, high)],
    )
    return [lathe(lower, color, center=(0, 0, z)), lathe(upper, _BLACK, center=(0, 0, z))]


def _mast(top: Point, low: float, radius: float, *yards: float) -> list[Solid]:
    """A mast with bars across, at shares of its height."""
    _, high, z = top
    pole = lathe([(radius, low), (0.6 * radius, high)], _SPAR, center=(0, 0, z), count=12)
    size = (10 * radius, radius, radius)
    return [pole, *(box((0, low + share * (high - low), z), size, _SPAR) for share in yards)]


def _cargo(v: _Vessel) -> _Above:
    """A container ship, its bridge at the stern."""
    low, wide, tall, long = v.deck(0.35) - 0.01, 0.15 * v.beam, 0.028 * v.tall, 0.64 / 7
    decks = low + 0.03 * v.tall * np.arange(5)
    roof = top, *_ = (decks[-1] + 0.026 * v.tall, v.beam, 0.3075, 0.3625)
    summit, funnel = (0.0, top + 0.075 * v.tall, 0.33), (0.0, top + 0.045 * v.tall, 0.433)
    solids = [
        *_storey(decks[-1], roof),
        *_funnel(funnel, decks[-1] - 0.05, 0.027, v.accent),
        *_mast(summit, top - 0.01, 0.005, 0.6),
    ]
    for floor, ceiling in pairwise(decks):
        solids += _storey(floor, (ceiling, 0.84 * v.beam, 0.3, 0.415))
    for bay, z in enumerate(-0.36 + long * np.arange(0.5, 7)):
        deck, room = v.deck(min(z - long / 2, 0.1)), float(v.half(z - long / 2)) - 0.012
        for row in range(min(3, int(room / wide))):
            for layer in range(3 if bay == 0 else 4 - (bay + row + v.variant) % 2):
                color = _ACCENTS[(5 * bay + 3 * row + (2 + bay) * layer) % len(_ACCENTS)]
                center = ((row + 0.5) * wide, deck + (layer + 0.5) * tall, z)
                size = (0.95 * wide, 0.95 * tall, 0.92 * long)
                solids += both_sides(box(center, size, color))
    return solids, roof, {12: summit, 15: funnel}


def _tug(v: _Vessel) -> _Above:
    deck, house = v.deck(0.05), 0.62 * v.beam
    y, wide = deck + 0.1 * v.tall, 0.78 * house
    top = y + 0.125
    summit, funnel = (0.0, top + 0.2 * v.tall, -0.08), (0.0, y + 0.17 * v.tall, 0.08)
    solids = [
        *_storey(deck - 0.02, (y, house, -0.22, 0.12)),
        *_storey(y - 0.01, (top, wide, -0.2, -0.04), slope=0.01, color=v.accent),
        *_funnel(funnel, y - 0.02, 0.06, v.accent),
        *_mast(summit, top - 0.02, 0.009, 0.3, 0.6),
    ]
    return solids, (top, 1.02 * wide, -0.21, -0.022), {12: summit, 15: funnel}


def _yacht(v: _Vessel) -> _Above:
    """A motor yacht of one, two or three storeys, dark windows all around."""
    low, wide, front, rear = v.deck(0.05) - 0.004, 0.74 * v.beam, -0.12, 0.3
    solids: list[Solid] = []
    roofs = []
    for storey in range((2, 3, 1)[v.variant]):
        high = low + (0.1 - 0.015 * storey) * v.tall
        solids += _storey(low, (high, wide, front, rear), slope=0.08)
        roofs.append((high, 0.96 * wide, front, rear + 0.015))
        low, wide, front, rear = high - 0.004, 0.88 * wide, front + 0.11, rear - 0.07
    summit = (0.0, low + 0.19, rear - 0.01)
    return [*solids, *_mast(summit, low - 0.01, 0.006, 0.3)], roofs[0], {12: summit}


def _sail(v: _Vessel) -> _Above:
    """A sailing boat with mainsail and foresail, one of them coloured or none."""
    deck, wide, keel = v.deck(0.0), 0.5 * v.beam, -v.draft
    roof, top = (deck + 0.055, 0.88 * wide, -0.11, 0.19), deck + 1.02 * v.tall
    fin = [(keel - 0.13, 0.03, -0.02, 0.14), (keel + 0.02, 0.026, -0.1, 0.16)]
    main, fore = (v.accent if v.variant == k else _CLOTH for k in (2, 1))
    solids = [
        stack([(deck - 0.02, wide, -0.16, 0.2), roof], _WHITE, radius=0.03),
        stack(fin, v.bottom, radius=0.012),
        box((0, deck + 0.025, 0.04), (0.97 * wide, 0.018, 0.2), _GLASS),
        box((0, deck + 0.1, 0.1), (0.016, 0.016, 0.4), _SPAR),
        *_mast((0.0, top, -0.1), deck - 0.01, 0.011),
        _cloth((deck + 0.112, top - 0.03), (-0.088, -0.088), (0.29, -0.076), main),
        _cloth((deck + 0.03, 0.86 * top), (-0.47, -0.13), (-0.12, -0.118), fore),
    ]
    return solids, roof, {12: (0.0, top, -0.1)}


def _cloth(
    heights: tuple[float, float],
    luff: tuple[float, float],
    leech: tuple[float, float],
    color: Color,
) -> Solid:
    """A flat sail in the plane x = 0: z of its front and rear edge, below and above."""
    shares = np.linspace(0, 1, 11)
    y, front, rear = (low + shares * (high - low) for low, high in (heights, luff, leech))
    rear = rear + 0.15 * (leech[0] - luff[0]) * np.sin(np.pi * shares)
    return stack([*zip(y, np.full(11, 0.006), front, rear, strict=True)], color, radius=0.0)


_KINDS = (
    (_Vessel(.165, .04, .052, (.03, .008), (.045, .03), .2, 2.2, .82, .008, _DECKS[0]), _cargo),
    (_Vessel(.275, .05, .072, (.035, .01), (.11, .07), .58, 1.7, .6, .01, _DECKS[1]), _sail),
    (_Vessel(.25, .035, .082, (.045, 0.0), (.12, .02), .55, 1.8, .88, .014, _DECKS[2]), _yacht),
    (_Vessel(.325, .07, .072, (.08, .015), (.05, .05), .38, 2.3, .72, .025, _DECKS[3]), _tug),
)  # fmt: skip
