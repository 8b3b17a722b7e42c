"""Storeys and fittings of sample motor yachts."""

from __future__ import annotations

import numpy as np

from cadalign.datasets.sample.outlines import ellipse
from cadalign.datasets.sample.solids import (
    Solid,
    beam,
    both_sides,
    box,
    lathe,
    rod,
    rounded_box,
    stacked,
    sweep,
)
from cadalign.datasets.sample.vessel_parts import (
    GLASS,
    SPAR,
    STEEL,
    WHITE,
    Point,
    Superstructure,
)
from cadalign.datasets.sample.vessel_style import VesselParameters

_TEAK = (196, 152, 100)


def yacht(p: VesselParameters) -> Superstructure:
    """A motor yacht of one, two or three storeys, dark windows all around."""
    hull = p.hull
    deck = hull.deck(0.05)
    storeys = (2, 3, 1)[p.variant]
    solids: list[Solid] = []
    wide, front, rear = 0.74 * hull.beam, -0.2, 0.3
    y = deck - 0.02
    tall = (0.075 if storeys > 1 else 0.085) * p.tall
    house_front = house_rear = (0.0, 0.0, 0.0)
    for storey in range(storeys):
        slope = 0.1 if storey == storeys - 1 or storeys < 3 else 0.06
        low, high = y, y + tall + (0.02 if storey == 0 else 0.0)
        base = high - tall
        sill = base + 0.3 * tall
        lean = slope / tall
        solids += [
            stacked(
                [(low, wide, front, rear), (sill, wide, front + 0.3 * slope, rear)],
                WHITE,
                radius=0.04,
            ),
            stacked(
                [
                    (sill, 0.985 * wide, front + 0.3 * slope + 0.003, rear - 0.004),
                    (high - 0.012, 0.93 * wide, front + lean * (high - base - 0.012), rear - 0.012),
                ],
                GLASS,
                radius=0.04,
            ),
            stacked(
                [
                    (high - 0.014, 1.02 * wide, front + slope - 0.025, rear + 0.05),
                    (high, 1.0 * wide, front + slope - 0.01, rear + 0.045),
                ],
                WHITE,
                radius=0.045,
            ),
        ]
        for z in np.linspace(front + slope + 0.06, rear - 0.01, 4):
            foot, head = (0.492 * wide, sill, z), (0.468 * wide, high - 0.01, z + 0.012)
            solids += both_sides(beam(foot, head, (0.014, 0.006), WHITE, side=(0, 0, 1)))
        if storey == 0:
            house_front = (0.48 * wide, high, front + slope)
            house_rear = (0.48 * wide, high, rear + 0.035)
        y, front, rear = high - 0.004, front + slope + 0.03, rear - 0.07
        wide, tall = 0.88 * wide, 0.86 * tall
    arch, summit = _radar_arch(y, wide, rear)
    solids += arch
    solids += _rails(p, -0.47, -0.12)
    wide = 1.7 * hull.half_width(0.5, hull.water_share)
    center = (0.0, 0.012, hull.stern(0.6) + 0.02)
    solids.append(rounded_box(center, (wide, 0.014, 0.09), _TEAK, radius=0.005))
    stripe_z = np.linspace(-0.12, 0.22, 4)
    for z in stripe_z:
        side_y = 0.55 * hull.freeboard
        share = (hull.draft + side_y) / (hull.draft + hull.freeboard)
        x = hull.half_width(z, share)
        solids += both_sides(rounded_box((x, side_y, z), (0.006, 0.016, 0.05), GLASS, radius=0.003))
    return Superstructure(tuple(solids), house_front, house_rear, summit)


def _radar_arch(y: float, wide: float, rear: float) -> tuple[list[Solid], Point]:
    """An arch with a radar bar and an aerial, and the aerial's tip."""
    top = y + 0.06
    z = rear - 0.02
    foot, bend = (0.42 * wide, y - 0.01, z + 0.06), (0.36 * wide, top, z)
    tip = (0.0, top + 0.13, z + 0.015)
    drum = [(0, 0), (0.01, 0), (0.01, 0.02), (0, 0.02)]
    solids = [
        *both_sides(beam(foot, bend, (0.05, 0.014), WHITE, side=(0, 0, 1))),
        box((0, top, z), (0.76 * wide, 0.014, 0.05), WHITE),
        rounded_box((0, top + 0.022, z), (0.09, 0.012, 0.014), STEEL, radius=0.004),
        lathe(drum, WHITE, center=(0, top, z), count=12),
        rod((0, top, z + 0.015), tip, 0.0045, SPAR, end_radius=0.003),
    ]
    return solids, tip


def _rails(p: VesselParameters, front: float, rear: float) -> list[Solid]:
    """A hand rail around the foredeck."""
    stations = np.linspace(front, rear, 7)
    feet = np.array([(0.93 * p.hull.half_width(z), p.hull.edge(z) - 0.004, z) for z in stations])
    heads = feet - (0, -0.035, 0)
    rail = sweep(heads, ellipse(0.005, 0.005, count=6), STEEL)
    posts = [rod(a, b, 0.002, STEEL, sides=6) for a, b in zip(feet, heads, strict=True)]
    return both_sides(rail, *posts)
