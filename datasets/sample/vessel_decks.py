"""Structures on the decks of sample vessels: bridges and cargo, deck houses, cabins and rigs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.sample import solids as make
from cadalign.datasets.sample.solids import Color, Point, Solid
from cadalign.datasets.sample.vessel_shape import (
    BLACK,
    GLASS,
    SPAR,
    STEEL,
    WHITE,
    Superstructure,
    VesselShape,
    funnel,
    windows,
)

_TEAK = (196, 152, 100)
_Level = tuple[float, float, float, float]
_CLOTH = (246, 243, 232)
_SEAM = (214, 210, 196)
_VARNISH = (176, 128, 78)


# Cargo ships --------------------------------------------------------------------------------------


def cargo(p: VesselShape) -> Superstructure:
    """A container ship, a ship with hatches and cranes, or a tanker, its bridge at the stern."""
    hull, front, rear = p.hull, 0.3, 0.415
    y, tall = hull.deck(0.35) - 0.01, 0.03 * p.tall
    solids: list[Solid] = []
    for floor in range(4 if p.variant == 0 else 3):
        middle = (0.0, y + tall / 2, (front + rear) / 2)
        size = (0.84 * hull.beam - 0.004 * floor, tall, rear - front - 0.006 * floor)
        solids.append(make.rounded_box(middle, size, WHITE, radius=0.002, steps=1))
        solids += windows(middle, size, count=7, height=0.35)
        y += tall
    bridge_tall, z, z_mast = 0.026 * p.tall, front + 0.035, front + 0.03
    center, size = (0, y + bridge_tall / 2, z), (hull.beam, bridge_tall, 0.055)
    pane = (hull.beam + 0.002, 0.4 * bridge_tall, 0.057)
    top = y + bridge_tall
    funnel_top, mast_top = top + 0.045 * p.tall, top + 0.075 * p.tall
    bow, yard = hull.deck(-0.42), top + 0.045 * p.tall
    solids += [
        make.rounded_box(center, size, WHITE, radius=0.003, steps=1),
        make.box((0, center[1] + 0.002, z), pane, GLASS),
        *funnel((0, y - 0.05, rear + 0.018), funnel_top - y + 0.05, 0.055, 0.05, p.accent),
        make.rod((0, top - 0.01, z_mast), (0, mast_top, z_mast), 0.005, SPAR, end_radius=0.003),
        make.box((0, yard, z_mast), (0.05, 0.004, 0.006), SPAR),
        make.rod((0, bow, -0.43), (0, bow + 0.09, -0.43), 0.004, SPAR),
        *(_containers, _cranes, _tanks)[p.variant](p, hull.deck(0.1), -0.36, front - 0.02),
    ]
    return Superstructure(
        solids=tuple(solids),
        house_front=(hull.beam / 2, top, z - 0.0275),
        house_rear=(hull.beam / 2, top, z + 0.0275),
        summit=(0.0, mast_top, z_mast),
        funnel=(0.0, funnel_top, rear + 0.018),
    )


def _containers(p: VesselShape, deck: float, front: float, rear: float) -> list[Solid]:
    """Stacks of containers; the colours are the same on the right and on the left."""
    sides: list[Solid] = []
    middle: list[Solid] = []
    bays, rows, tall = 7, 3, 0.028 * p.tall
    long, wide = (rear - front) / bays, 0.9 * p.hull.beam / (2 * rows)
    size = (0.95 * wide, 0.95 * tall, 0.92 * long)
    for bay in range(bays):
        z = front + (bay + 0.5) * long
        low = max(deck, p.hull.deck(z - long / 2)) + 0.002
        room = p.hull.half_width(z - long / 2) - 0.012
        for row in (row for row in range(rows) if (row + 1) * wide <= room):
            for layer in range(3 if bay == 0 else 4 - (bay + row) % 2):
                color = p.cargo[(5 * bay + 3 * row + 2 * layer + bay * layer) % len(p.cargo)]
                center = ((row + 0.5) * wide, low + (layer + 0.5) * tall, z)
                sides.append(make.box(center, size, color))
        middle.append(make.box((0, low, z), (1.2 * wide, 0.008, 0.9 * long), STEEL))
    return [*make.both_sides(*sides), *middle]


def _cranes(p: VesselShape, deck: float, front: float, rear: float) -> list[Solid]:
    """Hatches with cranes between them."""
    solids = []
    holds = 4
    long = (rear - front) / holds
    for hold in range(holds):
        z = front + (hold + 0.45) * long
        wide = (0.72 if hold else 0.5) * p.hull.beam
        size = (wide, 0.024, 0.62 * long)
        solids.append(
            make.rounded_box((0, deck + 0.012, z), size, p.cargo[0], radius=0.003, steps=1)
        )
        for k in (-1, 0, 1):
            rib = (0, deck + 0.025, z + k * 0.18 * long)
            solids.append(make.box(rib, (wide - 0.01, 0.005, 0.006), STEEL))
    for hold in range(1, holds):
        z, high = front + (hold - 0.06) * long, deck + 0.12 * p.tall
        cabin, tip = (0, high, z), (0, high + 0.035, z - 0.8 * long)
        solids += [
            make.rod((0, deck - 0.01, z), cabin, 0.011, p.accent, end_radius=0.009),
            make.rounded_box(cabin, (0.03, 0.026, 0.03), p.accent, radius=0.004),
            make.beam(cabin, tip, (0.012, 0.012), p.accent, taper=0.5),
            make.rod((0, high + 0.01, z), (0, high + 0.04, z), 0.004, STEEL),
        ]
    return solids


def _tanks(p: VesselShape, deck: float, front: float, rear: float) -> list[Solid]:
    """Domes of a gas tanker, a catwalk over them, and pipes along the deck."""
    solids = []
    count = 4
    step = (rear - front) / count
    radius = min(0.4 * p.hull.beam, 0.44 * step)
    angle = np.linspace(0, np.pi / 2, 8)
    arc = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    for k in range(count):
        r = radius * (0.86 if k == 0 else 1.0)
        dome = np.concatenate([[(0, 0), (r, 0)], r * arc[:-1] + (0, 0.03), [(0, 0.03 + r)]])
        center = (0, deck - 0.004, front + (k + 0.55) * step)
        solids.append(make.lathe(dome, p.accent, center=center, count=28))
    high, start, pipe = deck + radius + 0.032, front + 0.4 * step, 0.42 * p.hull.beam
    ends = (pipe, deck + 0.012, front + 0.12), (pipe, deck + 0.012, rear)
    return [
        *solids,
        make.box((0, high, (start + rear) / 2), (0.018, 0.006, rear - start), STEEL),
        make.box((0, (deck + high) / 2, start + 0.01), (0.018, high - deck, 0.006), STEEL),
        *make.both_sides(make.rod(*ends, 0.006, STEEL, sides=8)),
    ]


# Tugs and motor yachts ----------------------------------------------------------------------------


def tug(p: VesselShape) -> Superstructure:
    """A tug: wheelhouse forward, one or two funnels, tyres along the side, a low open stern."""
    deck, house, front, rear = p.hull.deck(0.05), 0.62 * p.hull.beam, -0.24, 0.14
    tall = 0.1 * p.tall
    main = (0.0, deck + tall / 2 - 0.02, (front + rear) / 2)
    size = (house, tall + 0.04, rear - front)
    y, wide = deck + tall, (0.78, 0.66, 0.86)[p.variant] * house
    sill, lintel, top = y + 0.045, y + 0.1, y + 0.125
    z_front, z_rear = front + 0.03, front + 0.2
    levels = [
        (y - 0.01, wide, z_front, z_rear),
        (sill, wide, z_front, z_rear),
        (sill, 0.97 * wide, z_front + 0.004, z_rear - 0.004),
        (lintel, 1.0 * wide, z_front - 0.01, z_rear + 0.004),
        (lintel, 1.1 * wide, z_front - 0.025, z_rear + 0.015),
        (top, 1.06 * wide, z_front - 0.018, z_rear + 0.01),
    ]
    posts = [
        ((0.49 * wide, sill, z), (0.5 * wide, lintel, z))
        for z in np.linspace(z_front + 0.04, z_rear - 0.01, 3)
    ]
    mast_top, z_mast = top + 0.2 * p.tall, z_rear - 0.04
    funnel_top, z_funnel, twin = y + 0.17 * p.tall, rear - 0.06, p.variant == 2
    slim, foot = (0.075 if twin else 0.12), (0.27 * house if twin else 0.0, y - 0.02, z_funnel)
    stack = funnel(foot, funnel_top - y + 0.02, slim, 1.1 * slim, p.accent)
    solids = (
        make.rounded_box(main, size, WHITE, radius=0.012),
        *windows(main, size, count=4, height=0.3),
        *_storey(levels, p.accent, (0.03, 0.03, 0.035), posts, (0.012, 0.008)),
        make.rod((0, top - 0.02, z_mast), (0, mast_top, z_mast), 0.009, SPAR, end_radius=0.005),
        make.box((0, top + 0.12, z_mast), (0.12, 0.008, 0.012), SPAR),
        make.rounded_box((0, top + 0.055, z_mast - 0.02), (0.1, 0.014, 0.02), STEEL, radius=0.005),
        *(make.both_sides(*stack) if twin else stack),
        *_towing_gear(p),
    )
    return Superstructure(
        solids=solids,
        house_front=(0.53 * wide, top, z_front - 0.018),
        house_rear=(0.53 * wide, top, z_rear + 0.01),
        summit=(0.0, mast_top, z_mast),
        funnel=None if twin else (0.0, funnel_top, z_funnel),
    )


def yacht(p: VesselShape) -> Superstructure:
    """A motor yacht of one, two or three storeys, dark windows all around."""
    storeys = (2, 3, 1)[p.variant]
    solids: list[Solid] = []
    wide, front, rear = 0.74 * p.hull.beam, -0.2, 0.3
    y, tall = p.hull.deck(0.05) - 0.02, (0.075 if storeys > 1 else 0.085) * p.tall
    corners: list[Point] = []
    for storey in range(storeys):
        slope = 0.1 if storey == storeys - 1 or storeys < 3 else 0.06
        low, high = y, y + tall + (0.02 if storey == 0 else 0.0)
        sill, lean, bend = high - 0.7 * tall, slope / tall * (tall - 0.012), 0.3 * slope
        levels = [
            (low, wide, front, rear),
            (sill, wide, front + bend, rear),
            (sill, 0.985 * wide, front + bend + 0.003, rear - 0.004),
            (high - 0.012, 0.93 * wide, front + lean, rear - 0.012),
            (high - 0.014, 1.02 * wide, front + slope - 0.025, rear + 0.05),
            (high, 1.0 * wide, front + slope - 0.01, rear + 0.045),
        ]
        posts = [
            ((0.492 * wide, sill, z), (0.468 * wide, high - 0.01, z + 0.012))
            for z in np.linspace(front + slope + 0.06, rear - 0.01, 4)
        ]
        solids += _storey(levels, WHITE, (0.04, 0.04, 0.045), posts, (0.014, 0.006))
        corners += [(0.48 * wide, high, front + slope), (0.48 * wide, high, rear + 0.035)]
        y, front, rear = high - 0.004, front + slope + 0.03, rear - 0.07
        wide, tall = 0.88 * wide, 0.86 * tall
    arch, summit = _radar_arch(y, wide, rear)
    platform = (1.7 * p.hull.half_width(0.5, p.hull.water_share), 0.014, 0.09)
    stern = (0.0, 0.012, p.hull.stern(0.6) + 0.02)
    solids += [*arch, *_rails(p), make.rounded_box(stern, platform, _TEAK, radius=0.005)]
    y = 0.55 * p.hull.freeboard
    for z in np.linspace(-0.12, 0.22, 4):
        x = p.hull.half_width(z, (p.hull.draft + y) / (p.hull.draft + p.hull.freeboard))
        solids += make.both_sides(
            make.rounded_box((x, y, z), (0.006, 0.016, 0.05), GLASS, radius=0.003)
        )
    return Superstructure(tuple(solids), corners[0], corners[1], summit)


def _storey(
    levels: Sequence[_Level],
    roof: Color,
    radii: Sequence[float],
    posts: Sequence[tuple[Point, Point]],
    size: tuple[float, float],
) -> list[Solid]:
    """White wall, glass and roof, each between two levels, and white posts before the glass."""
    solids = [
        make.stacked(levels[2 * k : 2 * k + 2], color, radius=radii[k])
        for k, color in enumerate((WHITE, GLASS, roof))
    ]
    for foot, head in posts:
        solids += make.both_sides(make.beam(foot, head, size, WHITE, side=(0, 0, 1)))
    return solids


def _towing_gear(p: VesselShape) -> list[Solid]:
    """A winch and bollard on the stern, a fender at the bow, and tyres along the sides."""
    hull, deck = p.hull, p.hull.deck(0.25)
    drum = [(0, 0), (0.035, 0), (0.035, 0.12), (0, 0.12)]
    cheek = [(0, 0), (0.052, 0), (0.052, 0.012), (0, 0.012)]
    solids = [
        make.wheel((-0.06, deck + 0.04, 0.24), drum, STEEL, count=24),
        *make.both_sides(make.wheel((0.05, deck + 0.04, 0.24), cheek, p.accent, count=24)),
        make.beam((0, deck - 0.01, 0.33), (0, deck + 0.06, 0.33), (0.035, 0.025), BLACK),
    ]
    tyre = [(0.0, 0.006), (0.012, 0.0), (0.03, 0.0), (0.034, 0.01), (0.034, 0.02), (0.03, 0.028),
            (0.012, 0.028), (0.0, 0.022)]  # fmt: skip
    for z in np.linspace(-0.24, 0.36, 6):
        y = hull.edge(z) - 0.045
        x = hull.half_width(z, (hull.draft + y) / (hull.draft + hull.edge(z))) - 0.008
        solids += make.both_sides(make.wheel((x, y, z), tyre, BLACK, count=16))
    stations = np.linspace(-1, 1, 15)
    z = -0.505 + 0.15 * np.abs(stations) ** 1.6
    half = np.array([hull.half_width(min(max(s, -0.5), 0.5)) for s in z])
    edge = np.array([hull.edge(s) - 0.02 for s in z])
    path = np.stack([np.sign(stations) * (half + 0.004), edge, z - 0.004], axis=1)
    return [*solids, make.sweep(path, make.ellipse(0.036, 0.05, count=10), BLACK, side=(0, 1, 0))]


def _radar_arch(y: float, wide: float, rear: float) -> tuple[list[Solid], Point]:
    """An arch with a radar bar and an aerial, and the aerial's tip."""
    top, z = y + 0.06, rear - 0.02
    foot, bend = (0.42 * wide, y - 0.01, z + 0.06), (0.36 * wide, top, z)
    tip = (0.0, top + 0.13, z + 0.015)
    drum = [(0, 0), (0.01, 0), (0.01, 0.02), (0, 0.02)]
    solids = [
        *make.both_sides(make.beam(foot, bend, (0.05, 0.014), WHITE, side=(0, 0, 1))),
        make.box((0, top, z), (0.76 * wide, 0.014, 0.05), WHITE),
        make.rounded_box((0, top + 0.022, z), (0.09, 0.012, 0.014), STEEL, radius=0.004),
        make.lathe(drum, WHITE, center=(0, top, z), count=12),
        make.rod((0, top, z + 0.015), tip, 0.0045, SPAR, end_radius=0.003),
    ]
    return solids, tip


def _rails(p: VesselShape) -> list[Solid]:
    """A hand rail around the foredeck."""
    stations = np.linspace(-0.47, -0.12, 7)
    feet = np.array([(0.93 * p.hull.half_width(z), p.hull.edge(z) - 0.004, z) for z in stations])
    heads = feet + (0, 0.035, 0)
    posts = [make.rod(a, b, 0.002, STEEL, sides=6) for a, b in zip(feet, heads, strict=True)]
    return make.both_sides(make.sweep(heads, make.ellipse(0.005, 0.005, count=6), STEEL), *posts)


# Sailing boats ------------------------------------------------------------------------------------


def sail(p: VesselShape) -> Superstructure:
    """A sailing boat: one mast with mainsail and foresail, a ketch, or one with a striped sail."""
    ketch, beam, deck = p.variant == 1, p.hull.beam, p.hull.deck(0.0)
    low, high, wide, front, rear = deck - 0.02, deck + 0.055, 0.5 * beam, -0.14, 0.2
    house = [
        (low, wide, front - 0.02, rear),
        (high - 0.012, 0.92 * wide, front + 0.02, rear - 0.005),
        (high, 0.86 * wide, front + 0.03, rear - 0.015),
    ]
    panes = (
        make.rounded_box((0.475 * wide, deck + 0.022, z), (0.02, 0.018, 0.05), GLASS, radius=0.006)
        for z in (front + 0.08, front + 0.16, front + 0.24)
    )
    coaming = [(low, wide, rear - 0.01, 0.42), (deck + 0.02, 0.48 * beam, rear - 0.01, 0.41)]
    well, size = (0, deck + 0.012, (rear + 0.41) / 2), (0.36 * beam, 0.02, 0.37 - rear)
    z_mast, foot, top = -0.1, deck + 0.04, deck + (0.86 if ketch else 1.02) * p.tall
    solids = [
        make.stacked(house, WHITE, radius=0.03),
        *make.both_sides(*panes),
        make.stacked(coaming, _VARNISH, radius=0.02),
        make.box(well, size, BLACK),
        *_keel(p),
        *_rig(p, z_mast, foot, top, boom=0.3 if ketch else 0.4),
        _foresail(p, z_mast, top),
    ]
    if ketch:
        solids += _rig(p, 0.29, foot - 0.02, deck + 0.55 * p.tall, boom=0.19)
    return Superstructure(
        solids=tuple(solids),
        house_front=(0.44 * wide, high, front + 0.03),
        house_rear=(0.44 * wide, high, rear - 0.01),
        summit=(0.0, top, z_mast),
    )


def _keel(p: VesselShape) -> list[Solid]:
    """The fin under a sailing boat, and its rudder."""
    y = -p.hull.draft
    fin = [
        (y - 0.13, 0.03, -0.02, 0.14),
        (y - 0.1, 0.022, -0.05, 0.14),
        (y + 0.02, 0.026, -0.1, 0.16),
    ]
    rudder = [(y - 0.07, 0.014, 0.36, 0.41), (y + 0.04, 0.018, 0.33, 0.41)]
    return [make.stacked(fin, p.bottom, radius=0.012), make.stacked(rudder, p.bottom, radius=0.007)]


def _rig(p: VesselShape, z: float, foot: float, top: float, *, boom: float) -> list[Solid]:
    """A mast, its boom and shrouds, and a flat sail with a curved rear edge."""
    low = foot + 0.06
    chain = (0.43 * p.hull.beam, p.hull.edge(z) - 0.01, z + 0.02)
    # Edges of the sail as (z, y), from the boom to the head.
    shares = np.linspace(0, 1, 13)
    tack, clew, head = np.array([
        (z + 0.012, low + 0.012), (z + 0.97 * boom, low + 0.014), (z + 0.012, top - 0.03),
    ])  # fmt: skip
    luff, leech = tack + shares[:, None] * (head - tack), clew + shares[:, None] * (head - clew)
    leech[:, 0] += 0.16 * (clew[0] - tack[0]) * np.sin(np.pi * shares) * (1 - 0.3 * shares)
    leech[-1, 0] += 0.02
    striped = p.variant == 2
    bands = [(0.0, 0.3), (0.66, 1.0)] if striped else [(0.24, 0.31), (0.62, 0.69)]
    solids = [
        make.rod((0, foot - 0.05, z), (0, top, z), 0.011, SPAR, end_radius=0.006),
        make.rod((0, low, z), (0, low, z + boom), 0.008, SPAR),
        *make.both_sides(make.rod(chain, (0, 0.96 * top, z), 0.0022, STEEL, sides=6)),
        _flat(luff, leech, _CLOTH, 0.006),
    ]
    for start, end in bands:
        steps = np.linspace(start, end, 6)
        left, right = (
            np.stack([np.interp(steps, shares, values) for values in edge.T], axis=1)
            for edge in (luff, leech)
        )
        solids.append(_flat(left, right, p.accent if striped else _SEAM, 0.008))
    return solids


def _flat(left: FloatArray, right: FloatArray, color: Color, thickness: float) -> Solid:
    """A plate in the plane x = 0 between two edges of (z, y) points."""
    across = np.linspace(0, 1, 5)[None, :, None]
    grid = left[:, None] + across * (right - left)[:, None]
    points = np.insert(grid[..., ::-1], 0, 0.0, axis=-1)
    return make.sheet(points, thickness, color)


def _foresail(p: VesselShape, z_mast: float, top: float) -> Solid:
    """The triangular sail between bow and mast."""
    bow, head = np.array([(-0.47, p.hull.edge(-0.47) + 0.02), (z_mast - 0.03, 0.86 * top)])
    clew = np.array([z_mast - 0.02, p.hull.edge(z_mast) + 0.05])
    shares = np.linspace(0, 1, 9)[:, None]
    leech = clew + shares * (head + (0.012, 0.0) - clew)
    return _flat(bow + shares * (head - bow), leech, p.accent if p.variant == 1 else _CLOTH, 0.006)
