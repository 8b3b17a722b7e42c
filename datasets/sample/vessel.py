"""Parametric vessels: cargo ships, sailing boats, motor yachts and tugs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.datasets.sample import solids as make
from cadalign.datasets.sample.model import Draft, mirrored_places
from cadalign.datasets.sample.solids import Color, Point, Solid, both_sides

_WHITE, _BLACK, _GLASS = (240, 240, 236), (32, 34, 38), (34, 46, 60)
_STEEL, _SPAR, _CLOTH = (150, 154, 158), (206, 208, 212), (246, 243, 232)
_SEAM = (214, 210, 196)
_DECKS = {
    "cargo": (126, 92, 78),
    "sail": (196, 152, 100),
    "yacht": (204, 166, 118),
    "tug": (112, 118, 112),
}
_SIDES: dict[str, tuple[Color, ...]] = {
    "cargo": ((36, 62, 104), (38, 44, 52), (148, 42, 38), (34, 92, 78)),
    "sail": ((240, 240, 236), (32, 56, 110), (150, 34, 38), (24, 84, 86)),
    "yacht": ((244, 244, 242), (30, 44, 76), (206, 212, 218), (236, 230, 214)),
    "tug": ((30, 34, 40), (170, 40, 34), (34, 74, 120), (42, 94, 62)),
}
_ACCENTS: tuple[Color, ...] = (
    (204, 44, 38), (238, 168, 36), (32, 92, 160), (46, 124, 78), (232, 106, 32),
)  # fmt: skip
_CARGO: tuple[Color, ...] = (
    (186, 54, 44), (44, 98, 158), (228, 160, 48), (70, 130, 84), (150, 152, 156), (120, 66, 44),
)  # fmt: skip
_BOTTOMS: tuple[Color, ...] = ((140, 38, 32), (110, 34, 34), (40, 66, 60))


@dataclass(frozen=True)
class _Hull:
    """A hull of length 1 with its bow at z = -0.5 and the water line at y = 0."""

    beam: float  # greatest width
    freeboard: float  # height of the side amidships
    draft: float  # depth under water
    sheer: tuple[float, float]  # rise of the side towards bow and stern
    rake: tuple[float, float]  # overhang of the bow and the stern over their feet
    entry: float  # position, 0 at the bow, from which the hull has its full width
    fullness: float  # bluntness of the bow: 1 is a straight wedge, 3 very full
    stern_width: float  # relative to the beam
    bulwark: float  # height of the side's edge above the deck

    @property
    def water(self) -> float:
        """The water line's share of the height: 0 at the keel, 1 at the edge of the deck."""
        return self.draft / (self.draft + self.freeboard)

    def edge(self, z: npt.ArrayLike) -> FloatArray:
        """Heights of the side's edge."""
        z, (bow, stern) = np.asarray(z), self.sheer
        rise = bow * np.clip(-(z - 0.05) / 0.55, 0, 1) ** 2
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

    def ends(self, share: float) -> tuple[float, float]:
        """z of stem and stern at a share of the height."""
        return self.rake[0] * (1 - share) - 0.5, 0.5 - self.rake[1] * (1 - share)

    def side(self, z: float, share: float = 1.0) -> Point:
        """A point of the right side."""
        y = share * (self.draft + self.freeboard) - self.draft
        return float(self.half(z, share)), float(self.edge(z)) if share == 1 else y, z

    def outline(self, share: float, inset: float = 0.0) -> FloatArray:
        """A closed line around the hull, from the middle of the stern over the right side."""
        z = 0.5 - np.concatenate([np.linspace(0, 0.6, 13), np.linspace(0.6, 1, 15)[1:]])
        half = np.maximum(self.half(z, share) - inset, 0.0)
        bow, stern = self.ends(share)
        lift = max(0.0, (share - self.water) / (1 - self.water))
        y = (1 - lift) * (share / self.water - 1) * self.draft if share < self.water else 0.0
        height = y + lift * self.edge(z)
        place = bow + 1.6 * inset + (z + 0.5) * (stern - bow - 2.6 * inset)
        right = np.stack([half, height, place], axis=1)
        right[-1, 0] = 0.0
        return np.concatenate([right[:1] * (0, 1, 1), right, right[-2::-1] * (-1, 1, 1)])

    def solids(self, bottom: Color, side: Color, deck: Color) -> list[Solid]:
        """The part under water, a stripe at the water line, the side, and the deck."""
        water = self.water
        band = water + 0.12 * (1 - water)
        rings = [
            [self.outline(share) for share in np.linspace(low, high, count)]
            for low, high, count in ((0.0, water, 6), (water, band, 2), (band, 1.0, 5))
        ]
        inner = self.outline(1.0, inset=0.012)
        sunk = inner - (0, self.bulwark, 0)
        rings[2] += [inner, sunk]
        rings.append([sunk - (0, 0.004, 0), sunk + (0, 0.002, 0)])
        colors = (bottom, _WHITE, side, deck)
        return [make.loft(ring, color) for ring, color in zip(rings, colors, strict=True)]


@dataclass(frozen=True)
class _Vessel:
    """A vessel of length 1 and its colours; ``tall`` scales everything above the deck."""

    variant: int
    hull: _Hull
    tall: float
    bottom: Color
    accent: Color
    cargo: tuple[Color, ...]


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
    turn, number = divmod(index, 4)
    kind, build = (("cargo", _cargo), ("sail", _sail), ("yacht", _yacht), ("tug", _tug))[number]
    hull = _draw_hull(rng, kind)
    tall = rng.uniform(0.92, 1.1)
    side = _SIDES[kind][(turn + int(rng.integers(2))) % 4]
    bottom, accent = (many[int(rng.integers(len(many)))] for many in (_BOTTOMS, _ACCENTS))
    cargo = tuple(_CARGO[int(i)] for i in rng.permutation(len(_CARGO)))
    v = _Vessel(turn % 3, hull, tall, bottom, accent, cargo)
    solids, house_front, house_rear, tips = build(v)
    bow, stern = hull.ends(hull.water)
    pairs = {
        (2, 3): hull.side(0.5),
        (4, 5): hull.side(0.0),
        (6, 7): hull.side(-0.25),
        (8, 9): house_front,
        (10, 11): house_rear,
        (13, 14): (float(hull.half(0.5, hull.water)), 0.0, stern),
    }
    places = mirrored_places(pairs)
    places |= {0: (0.0, float(hull.edge(-0.5)), -0.5), 1: (0.0, 0.0, bow), **tips}
    return Draft((*hull.solids(bottom, side, _DECKS[kind]), *solids), places, tuple(pairs))


def _draw_hull(rng: np.random.Generator, kind: str) -> _Hull:
    if kind == "cargo":
        return _Hull(rng.uniform(0.15, 0.18), rng.uniform(0.045, 0.06), 0.04, (0.03, 0.008),
                     (0.045, 0.03), 0.2, 2.2, 0.82, 0.008)  # fmt: skip
    if kind == "sail":
        return _Hull(rng.uniform(0.25, 0.3), rng.uniform(0.065, 0.08), 0.05, (0.035, 0.01),
                     (0.11, 0.07), 0.58, 1.7, rng.uniform(0.5, 0.7), 0.01)  # fmt: skip
    if kind == "yacht":
        return _Hull(rng.uniform(0.23, 0.27), rng.uniform(0.075, 0.09), 0.035, (0.045, 0.0),
                     (0.12, 0.02), 0.55, 1.8, 0.88, 0.014)  # fmt: skip
    return _Hull(rng.uniform(0.3, 0.35), rng.uniform(0.065, 0.08), 0.07, (rng.uniform(0.07, 0.09),
                 0.015), (0.05, 0.05), 0.38, 2.3, 0.72, 0.025)  # fmt: skip


# What several kinds have ---------------------------------------------------------------------


def _block(middle: Point, size: Point, *, count: int) -> list[Solid]:
    """A white block with dark panes along its front and both sides."""
    (x, y, z), (wide, tall, deep) = middle, size
    solids = [make.box(middle, size, _WHITE, radius=0.003, steps=1)]
    pane, height = 0.5 * wide / count, 0.34 * tall
    for s in (np.arange(count) - (count - 1) / 2) * 0.9 * wide / count:
        solids.append(make.box((x + s, y, z - deep / 2), (pane, height, 0.003), _GLASS))
    for s in np.arange(-0.36 * deep, 0.37 * deep, 2 * pane):
        solids += both_sides(make.box((wide / 2, y, z + s), (0.003, height, pane), _GLASS))
    return solids


def _funnel(foot: Point, tall: float, width: float, color: Color) -> list[Solid]:
    """A funnel with a black top and a pale ring."""
    solids = []
    for radius, low, high, tint in (
        (0.48, 0, 0.84, color), (0.49, 0.5, 0.64, _WHITE), (0.46, 0.83, 1, _BLACK)
    ):  # fmt: skip
        profile = np.array([(0, low), (radius, low), (0.97 * radius, high), (0, high)])
        solids.append(make.lathe(profile * (width, tall), tint, center=foot, count=20))
    return solids


def _mast(foot: Point, top: float, radius: float, yards: tuple[float, ...] = ()) -> list[Solid]:
    """A mast with bars across, at shares of its height."""
    x, y, z = foot
    bars = ((x, y + share * (top - y), z) for share in yards)
    size = (10 * radius, radius, 1.2 * radius)
    spar = make.rod([foot, (x, top, z)], radius, _SPAR, scales=(1, 0.6))
    return [spar, *(make.box(bar, size, _SPAR) for bar in bars)]


def _storey(
    low: float, high: float, width: float, ends: tuple[float, float], slope: float, roof: Color
) -> list[Solid]:
    """A wall, a band of glass that leans back by ``slope``, posts before it, and a roof."""
    (front, rear), sill, top = ends, low + 0.35 * (high - low), high - 0.012
    wall = [(low, width, front, rear), (sill, width, front + 0.3 * slope, rear)]
    glass = [(sill, 0.98 * width, front + 0.3 * slope + 0.003, rear - 0.004),
             (top, 0.94 * width, front + slope, rear - 0.01)]  # fmt: skip
    cover = [(top, 1.03 * width, front + slope - 0.02, rear + 0.025),
             (high, 1.0 * width, front + slope - 0.012, rear + 0.018)]  # fmt: skip
    levels = ((wall, _WHITE), (glass, _GLASS), (cover, roof))
    solids = [make.stack(level, color, radius=0.035) for level, color in levels]
    for z in np.linspace(front + slope + 0.05, rear - 0.02, 4):
        post = [(0.49 * width, sill, z), (0.47 * width, top, z + 0.01)]
        solids += both_sides(make.beam(post, (0.013, 0.008), _WHITE, side=(0, 0, 1)))
    return solids


# Cargo ships ---------------------------------------------------------------------------------


def _cargo(v: _Vessel) -> _Above:
    """A container ship or a gas tanker, its bridge at the stern."""
    hull, front, rear, tall = v.hull, 0.3, 0.415, 0.03 * v.tall
    y = hull.deck(0.35) - 0.01
    solids: list[Solid] = []
    for _ in range(3 if v.variant == 1 else 4):
        middle = (0.0, y + tall / 2, (front + rear) / 2)
        solids += _block(middle, (0.84 * hull.beam, tall, rear - front), count=7)
        y += tall
    top, z = y + 0.026 * v.tall, front + 0.035
    summit, funnel = (0.0, top + 0.075 * v.tall, front + 0.03), (0.0, top + 0.045 * v.tall, 0.433)
    solids += [
        *_block((0, (y + top) / 2, z), (hull.beam, top - y, 0.055), count=9),
        *_funnel((0, y - 0.05, 0.433), funnel[1] - y + 0.05, 0.055, v.accent),
        *_mast((0, top - 0.01, summit[2]), summit[1], 0.005, (0.6,)),
        *_mast((0, hull.deck(-0.42), -0.43), hull.deck(-0.42) + 0.09, 0.004),
        *(_tanks if v.variant == 1 else _containers)(v, hull.deck(0.1), -0.36, front - 0.02),
    ]
    half = hull.beam / 2
    return solids, (half, top, z - 0.0275), (half, top, z + 0.0275), {12: summit, 15: funnel}


def _containers(v: _Vessel, deck: float, front: float, rear: float) -> list[Solid]:
    """Stacks of containers; the colours are the same on the right and on the left."""
    bays, rows, tall = 7, 3, 0.028 * v.tall
    long, wide = (rear - front) / bays, 0.45 * v.hull.beam / rows
    sides: list[Solid] = []
    for bay in range(bays):
        z = front + (bay + 0.5) * long
        low = max(deck, v.hull.deck(z - long / 2)) + 0.002
        room = float(v.hull.half(z - long / 2)) - 0.012
        for row in (row for row in range(rows) if (row + 1) * wide <= room):
            for layer in range(3 if bay == 0 else 4 - (bay + row) % 2):
                color = v.cargo[(5 * bay + 3 * row + 2 * layer + bay * layer) % len(v.cargo)]
                center = ((row + 0.5) * wide, low + (layer + 0.5) * tall, z)
                sides.append(make.box(center, (0.95 * wide, 0.95 * tall, 0.92 * long), color))
    return both_sides(*sides)


def _tanks(v: _Vessel, deck: float, front: float, rear: float) -> list[Solid]:
    """The domes of a gas tanker."""
    step = (rear - front) / 4
    size = min(0.8 * v.hull.beam, 0.88 * step)
    return [
        make.ellipsoid((0, deck + 0.03, front + (k + 0.55) * step), (r, r, r), v.accent, count=24)
        for k, r in enumerate((0.86 * size, size, size, size))
    ]


# Tugs, motor yachts and sailing boats --------------------------------------------------------


def _tug(v: _Vessel) -> _Above:
    """A tug: wheelhouse forward, one or two funnels, tyres along the side, a low open stern."""
    hull, house, twin = v.hull, 0.62 * v.hull.beam, v.variant == 2
    deck, tall, wide = hull.deck(0.05), 0.1 * v.tall, (0.78, 0.66, 0.86)[v.variant] * house
    y, front, rear = deck + tall, -0.21, -0.04
    top = y + 0.125
    summit, funnel = (0.0, top + 0.2 * v.tall, rear - 0.04), (0.0, y + 0.17 * v.tall, 0.08)
    width, foot = (0.08, (0.27 * house, y - 0.02, 0.08)) if twin else (0.125, (0, y - 0.02, 0.08))
    stack = _funnel(foot, funnel[1] - y + 0.02, width, v.accent)
    tyre = [(0, 0.006), (0.012, 0), (0.03, 0), (0.034, 0.01), (0.034, 0.02), (0.03, 0.028),
            (0.012, 0.028), (0, 0.022)]  # fmt: skip
    solids = [
        *_block((0, deck + tall / 2 - 0.02, -0.05), (house, tall + 0.04, 0.38), count=4),
        *_storey(y - 0.01, top, wide, (front, rear), 0.01, v.accent),
        *_mast((0, top - 0.02, summit[2]), summit[1], 0.009, (0.3, 0.6)),
        *(both_sides(*stack) if twin else stack),
        make.box((0, deck + 0.03, 0.27), (0.12, 0.08, 0.06), _STEEL, radius=0.02),
    ]
    for z in np.linspace(-0.24, 0.36, 6):
        x, y, _ = hull.side(z)
        center = (x - 0.012, y - 0.045, z)
        solids += both_sides(make.lathe(tyre, _BLACK, center=center, count=16, sideways=True))
    tips = {12: summit} if twin else {12: summit, 15: funnel}
    return solids, (0.51 * wide, top, front), (0.51 * wide, top, rear + 0.018), tips


def _yacht(v: _Vessel) -> _Above:
    """A motor yacht of one, two or three storeys, dark windows all around."""
    storeys = (2, 3, 1)[v.variant]
    y, tall = v.hull.deck(0.05) - 0.004, (0.075 if storeys > 1 else 0.085) * v.tall
    wide, front, rear = 0.74 * v.hull.beam, -0.2, 0.3
    solids: list[Solid] = []
    corners = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    for storey in range(storeys):
        slope = 0.1 if storey == storeys - 1 or storeys < 3 else 0.06
        high = y + tall + (0.02 if storey == 0 else 0.0)
        solids += _storey(y, high, wide, (front, rear), slope, _WHITE)
        if storey == 0:
            corners = ((0.48 * wide, high, front + slope), (0.48 * wide, high, rear + 0.015))
        y, front, rear = high - 0.004, front + slope + 0.03, rear - 0.07
        wide, tall = 0.88 * wide, 0.86 * tall
    z, top = rear - 0.02, y + 0.06
    arch = [(0.42 * wide, y - 0.01, z + 0.06), (0.36 * wide, top, z), (0, top, z)]
    stations = np.linspace(-0.47, -0.12, 7)
    feet = np.stack([0.93 * v.hull.half(stations), v.hull.edge(stations) - 0.004, stations], axis=1)
    posts = [make.rod([foot, foot + (0, 0.035, 0)], 0.002, _STEEL, count=4) for foot in feet]
    solids += [
        *both_sides(
            make.beam(arch, (0.05, 0.014), _WHITE, side=(0, 0, 1)),
            make.rod(feet + (0, 0.035, 0), 0.0025, _STEEL, count=4),
            *posts,
        ),
        make.box((0, top + 0.022, z), (0.09, 0.012, 0.014), _STEEL, radius=0.004),
        *_mast((0, top, z + 0.015), top + 0.13, 0.0045),
    ]
    return solids, *corners, {12: (0.0, top + 0.13, z + 0.015)}


def _sail(v: _Vessel) -> _Above:
    """A sailing boat: one mast with mainsail and foresail, a ketch, or one with a striped sail."""
    hull, ketch, beam, deck = v.hull, v.variant == 1, v.hull.beam, v.hull.deck(0.0)
    wide, front, rear, high = 0.5 * beam, -0.14, 0.2, deck + 0.055
    z, top, keel = -0.1, deck + (0.86 if ketch else 1.02) * v.tall, -hull.draft
    house = [
        (deck - 0.02, wide, front - 0.02, rear),
        (high, 0.88 * wide, front + 0.03, rear - 0.01),
    ]
    fin = [(keel - 0.13, 0.03, -0.02, 0.14), (keel + 0.02, 0.026, -0.1, 0.16)]
    rudder = [(keel - 0.07, 0.014, 0.36, 0.41), (keel + 0.04, 0.018, 0.33, 0.41)]
    jib = ((-0.47, float(hull.edge(-0.47)) + 0.02), (z - 0.03, 0.86 * top), (z - 0.02, deck + 0.1))
    solids = [
        make.stack(house, _WHITE, radius=0.03),
        make.stack(fin, v.bottom, radius=0.012),
        make.stack(rudder, v.bottom, radius=0.007),
        make.box((0, deck + 0.01, 0.3), (0.36 * beam, 0.024, 0.17), _BLACK),
        *_rig(v, z, deck + 0.1, top, 0.3 if ketch else 0.4),
        _cloth(jib, 0.012, v.accent if ketch else _CLOTH),
        *(_rig(v, 0.29, deck + 0.08, deck + 0.55 * v.tall, 0.19) if ketch else ()),
    ]
    for pane in (front + 0.08, front + 0.16, front + 0.24):
        center, size = (0.475 * wide, deck + 0.022, pane), (0.02, 0.018, 0.05)
        solids += both_sides(make.box(center, size, _GLASS, radius=0.006))
    x = 0.44 * wide
    return solids, (x, high, front + 0.03), (x, high, rear - 0.01), {12: (0.0, top, z)}


def _rig(v: _Vessel, z: float, low: float, top: float, boom: float) -> list[Solid]:
    """A mast, its boom at a height, and a sail with bands."""
    corners = ((z + 0.012, low + 0.012), (z + 0.012, top - 0.03), (z + 0.97 * boom, low + 0.014))
    striped = v.variant == 2
    bands = ((0.0, 0.3), (0.66, 1.0)) if striped else ((0.24, 0.31), (0.62, 0.69))
    color = v.accent if striped else _SEAM
    return [
        make.rod([(0, low - 0.11, z), (0, top, z)], 0.011, _SPAR, scales=(1, 0.55)),
        make.rod([(0, low, z), (0, low, z + boom)], 0.008, _SPAR),
        _cloth(corners, 0.16 * boom, _CLOTH),
        *(_cloth(corners, 0.16 * boom, color, band) for band in bands),
    ]


def _cloth(
    corners: tuple[tuple[float, float], ...],
    roach: float,
    color: Color,
    band: tuple[float, float] = (0.0, 1.0),
) -> Solid:
    """A flat sail between tack, head and clew (z, y) in the plane x = 0, or a band on it."""
    tack, head, clew = (np.array(corner) for corner in corners)
    shares = np.linspace(*band, 11)[:, None]
    luff, leech = tack + shares * (head - tack), clew + shares * (head - clew)
    leech[:, :1] += roach * np.sin(np.pi * shares) * (1 - 0.3 * shares) + 0.012 * shares
    grid = luff[:, None] + np.linspace(0, 1, 5)[:, None] * (leech - luff)[:, None]
    thickness = 0.006 if band == (0.0, 1.0) else 0.008
    return make.sheet(np.insert(grid[..., ::-1], 0, 0.0, axis=-1), thickness, color)
