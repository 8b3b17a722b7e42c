"""Wheelhouses and gear of sample tugs."""

from __future__ import annotations

import numpy as np

from cadalign.datasets.sample.outlines import ellipse
from cadalign.datasets.sample.solids import (
    Solid,
    beam,
    both_sides,
    box,
    rod,
    rounded_box,
    stacked,
    sweep,
    wheel,
)
from cadalign.datasets.sample.vessel_parts import (
    BLACK,
    GLASS,
    SPAR,
    STEEL,
    WHITE,
    Superstructure,
    funnel,
    windows,
)
from cadalign.datasets.sample.vessel_style import VesselParameters


def tug(p: VesselParameters) -> Superstructure:
    """A tug: wheelhouse forward, one or two funnels, tyres along the side, a low open stern."""
    hull = p.hull
    deck = hull.deck(0.05)
    wide = 0.62 * hull.beam
    front, rear = -0.24, 0.14
    tall = 0.1 * p.tall
    main = (0.0, deck + tall / 2 - 0.02, (front + rear) / 2)
    size = (wide, tall + 0.04, rear - front)
    solids: list[Solid] = [rounded_box(main, size, WHITE, radius=0.012)]
    solids += windows(main, size, count=4, height=0.3)
    y = deck + tall
    wheel_wide = (0.78, 0.66, 0.86)[p.variant] * wide
    z_front, z_rear = front + 0.03, front + 0.2
    sill, lintel, top = y + 0.045, y + 0.1, y + 0.125
    solids += [
        stacked(
            [(y - 0.01, wheel_wide, z_front, z_rear), (sill, wheel_wide, z_front, z_rear)],
            WHITE,
            radius=0.03,
        ),
        stacked(
            [
                (sill, 0.97 * wheel_wide, z_front + 0.004, z_rear - 0.004),
                (lintel, 1.0 * wheel_wide, z_front - 0.01, z_rear + 0.004),
            ],
            GLASS,
            radius=0.03,
        ),
        stacked(
            [
                (lintel, 1.1 * wheel_wide, z_front - 0.025, z_rear + 0.015),
                (top, 1.06 * wheel_wide, z_front - 0.018, z_rear + 0.01),
            ],
            p.accent,
            radius=0.035,
        ),
    ]
    for z in np.linspace(z_front + 0.04, z_rear - 0.01, 3):
        foot, head = (0.49 * wheel_wide, sill, z), (0.5 * wheel_wide, lintel, z)
        solids += both_sides(beam(foot, head, (0.012, 0.008), WHITE, side=(0, 0, 1)))
    mast_top = top + 0.2 * p.tall
    z_mast = z_rear - 0.04
    solids += [
        rod((0, top - 0.02, z_mast), (0, mast_top, z_mast), 0.009, SPAR, end_radius=0.005),
        box((0, top + 0.12, z_mast), (0.12, 0.008, 0.012), SPAR),
        rounded_box((0, top + 0.055, z_mast - 0.02), (0.1, 0.014, 0.02), STEEL, radius=0.005),
    ]
    funnel_top = y + 0.17 * p.tall
    z_funnel = rear - 0.06
    x_funnel = 0.0 if p.variant != 2 else 0.27 * wide
    slim = 0.12 if p.variant != 2 else 0.075
    stack = funnel(
        (x_funnel, y - 0.02, z_funnel), funnel_top - y + 0.02, slim, 1.1 * slim, p.accent
    )
    solids += stack if p.variant != 2 else both_sides(*stack)
    solids += _towing_gear(p)
    return Superstructure(
        solids=tuple(solids),
        house_front=(0.53 * wheel_wide, top, z_front - 0.018),
        house_rear=(0.53 * wheel_wide, top, z_rear + 0.01),
        summit=(0.0, mast_top, z_mast),
        funnel=(0.0, funnel_top, z_funnel) if p.variant != 2 else None,
    )


def _towing_gear(p: VesselParameters) -> list[Solid]:
    """A winch and bollard on the stern, a fender at the bow, and tyres along the sides."""
    hull = p.hull
    deck = hull.deck(0.25)
    drum = wheel((-0.06, deck + 0.04, 0.24), [(0, 0), (0.035, 0), (0.035, 0.12), (0, 0.12)], STEEL)
    cheeks = both_sides(
        wheel((0.05, deck + 0.04, 0.24), [(0, 0), (0.052, 0), (0.052, 0.012), (0, 0.012)], p.accent)
    )
    hook = beam((0, deck - 0.01, 0.33), (0, deck + 0.06, 0.33), (0.035, 0.025), BLACK)
    solids = [drum, *cheeks, hook]
    ring = [(0.012, 0.0), (0.03, 0.0), (0.034, 0.01), (0.034, 0.02), (0.03, 0.028), (0.012, 0.028)]
    tyre = [(0.0, 0.006), *ring, (0.0, 0.022)]
    for z in np.linspace(-0.24, 0.36, 6):
        y = hull.edge(z) - 0.045
        share = (hull.draft + y) / (hull.draft + hull.edge(z))
        x = hull.half_width(z, share) - 0.008
        solids += both_sides(wheel((x, y, z), tyre, BLACK, count=16))
    stations = np.linspace(-1, 1, 15)
    z = -0.505 + 0.15 * np.abs(stations) ** 1.6
    half = np.array([hull.half_width(min(max(s, -0.5), 0.5)) for s in z])
    path = np.stack(
        [np.sign(stations) * (half + 0.004), [hull.edge(s) - 0.02 for s in z], z - 0.004], 1
    )
    return [*solids, sweep(path, ellipse(0.036, 0.05, count=10), BLACK, side=(0, 1, 0))]
