"""Bridges and cargo of sample cargo ships."""

from __future__ import annotations

import numpy as np

from cadalign.datasets.sample.solids import Solid, beam, both_sides, box, lathe, rod, rounded_box
from cadalign.datasets.sample.vessel_parts import (
    GLASS,
    SPAR,
    STEEL,
    WHITE,
    Superstructure,
    funnel,
    windows,
)
from cadalign.datasets.sample.vessel_style import VesselParameters


def cargo(p: VesselParameters) -> Superstructure:
    """A container ship, a ship with hatches and cranes, or a tanker, its bridge at the stern."""
    hull = p.hull
    deck = hull.deck(0.1)
    wide, front, rear = 0.84 * hull.beam, 0.3, 0.415
    solids: list[Solid] = []
    y = hull.deck(0.35) - 0.01
    floors = 4 if p.variant == 0 else 3
    for floor in range(floors):
        tall = 0.03 * p.tall
        size = (wide - 0.004 * floor, tall, rear - front - 0.006 * floor)
        middle = (0.0, y + tall / 2, (front + rear) / 2)
        solids.append(rounded_box(middle, size, WHITE, radius=0.002, steps=1))
        solids += windows(middle, size, count=7, height=0.35)
        y += tall
    bridge_tall = 0.026 * p.tall
    bridge = (0.0, y + bridge_tall / 2, front + 0.035)
    solids.append(
        rounded_box(bridge, (hull.beam, bridge_tall, 0.055), WHITE, radius=0.003, steps=1)
    )
    solids.append(
        box(
            (0, bridge[1] + 0.002, front + 0.035),
            (hull.beam + 0.002, 0.4 * bridge_tall, 0.057),
            GLASS,
        )
    )
    top = y + bridge_tall
    funnel_top = top + 0.045 * p.tall
    solids += funnel((0, y - 0.05, rear + 0.018), funnel_top - y + 0.05, 0.055, 0.05, p.accent)
    mast_top = top + 0.075 * p.tall
    solids += [
        rod(
            (0, top - 0.01, front + 0.03),
            (0, mast_top, front + 0.03),
            0.005,
            SPAR,
            end_radius=0.003,
        ),
        box((0, top + 0.6 * (mast_top - top), front + 0.03), (0.05, 0.004, 0.006), SPAR),
        rod((0, hull.deck(-0.42), -0.43), (0, hull.deck(-0.42) + 0.09, -0.43), 0.004, SPAR),
    ]
    solids += (_containers, _cranes, _tanks)[p.variant](p, deck, -0.36, front - 0.02)
    return Superstructure(
        solids=tuple(solids),
        house_front=(hull.beam / 2, top, bridge[2] - 0.0275),
        house_rear=(hull.beam / 2, top, bridge[2] + 0.0275),
        summit=(0.0, mast_top, front + 0.03),
        funnel=(0.0, funnel_top, rear + 0.018),
    )


def _containers(p: VesselParameters, deck: float, front: float, rear: float) -> list[Solid]:
    """Stacks of containers; the colours are the same on the right and on the left."""
    sides: list[Solid] = []
    middle: list[Solid] = []
    bays = 7
    long = (rear - front) / bays
    rows, tall = 3, 0.028 * p.tall
    wide = 0.9 * p.hull.beam / (2 * rows)
    for bay in range(bays):
        z = front + (bay + 0.5) * long
        low = max(deck, p.hull.deck(z - long / 2)) + 0.002
        for row in range(rows):
            x = (row + 0.5) * wide
            if x + wide / 2 > p.hull.half_width(z - long / 2) - 0.012:
                continue
            for layer in range(3 if bay == 0 else 4 - (bay + row) % 2):
                color = p.cargo[(5 * bay + 3 * row + 2 * layer + bay * layer) % len(p.cargo)]
                center = (x, low + (layer + 0.5) * tall, z)
                size = (0.95 * wide, 0.95 * tall, 0.92 * long)
                sides.append(box(center, size, color))
        middle.append(box((0, low, z), (1.2 * wide, 0.008, 0.9 * long), STEEL))
    return [*both_sides(*sides), *middle]


def _cranes(p: VesselParameters, deck: float, front: float, rear: float) -> list[Solid]:
    """Hatches with cranes between them."""
    solids = []
    holds = 4
    long = (rear - front) / holds
    for hold in range(holds):
        z = front + (hold + 0.45) * long
        wide = 0.72 * p.hull.beam if hold else 0.5 * p.hull.beam
        size = (wide, 0.024, 0.62 * long)
        solids.append(rounded_box((0, deck + 0.012, z), size, p.cargo[0], radius=0.003, steps=1))
        for k in (-1, 0, 1):
            rib = (0, deck + 0.025, z + k * 0.18 * long)
            solids.append(box(rib, (wide - 0.01, 0.005, 0.006), STEEL))
    for hold in range(1, holds):
        z = front + (hold - 0.06) * long
        high = deck + 0.12 * p.tall
        cabin = (0, high, z)
        post = rod((0, deck - 0.01, z), (0, high, z), 0.011, p.accent, end_radius=0.009)
        solids += [post, rounded_box(cabin, (0.03, 0.026, 0.03), p.accent, radius=0.004)]
        tip = (0, high + 0.035, z - 0.8 * long)
        solids.append(beam(cabin, tip, (0.012, 0.012), p.accent, taper=0.5))
        solids.append(rod((0, high + 0.01, z), (0, high + 0.04, z), 0.004, STEEL))
    return solids


def _tanks(p: VesselParameters, deck: float, front: float, rear: float) -> list[Solid]:
    """Pipes along the deck, a catwalk, and domes of a gas tanker."""
    solids = []
    count = 4
    step = (rear - front) / count
    radius = min(0.4 * p.hull.beam, 0.44 * step)
    angle = np.linspace(0, np.pi / 2, 8)
    for k in range(count):
        z = front + (k + 0.55) * step
        r = radius * (0.86 if k == 0 else 1.0)
        dome = [
            (0, 0.0),
            *zip((r * np.cos(angle)).tolist(), (0.03 + r * np.sin(angle)).tolist(), strict=True),
        ]
        dome.insert(1, (r, 0.0))
        dome[-1] = (0.0, 0.03 + r)
        solids.append(lathe(dome, p.accent, center=(0, deck - 0.004, z), count=28))
    high = deck + radius + 0.032
    start = front + 0.4 * step
    solids.append(box((0, high, (start + rear) / 2), (0.018, 0.006, rear - start), STEEL))
    solids.append(box((0, (deck + high) / 2, start + 0.01), (0.018, high - deck, 0.006), STEEL))
    pipe = 0.42 * p.hull.beam
    solids += both_sides(
        rod((pipe, deck + 0.012, front + 0.12), (pipe, deck + 0.012, rear), 0.006, STEEL, sides=8)
    )
    return solids
