"""Deck houses and gear of sample tugs and motor yachts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

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
        make.wheel((-0.06, deck + 0.04, 0.24), drum, STEEL),
        *make.both_sides(make.wheel((0.05, deck + 0.04, 0.24), cheek, p.accent)),
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
