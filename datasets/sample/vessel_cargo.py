"""Bridges and cargo of sample cargo ships."""

from __future__ import annotations

import numpy as np

from cadalign.datasets.sample import solids as make
from cadalign.datasets.sample.solids import Solid
from cadalign.datasets.sample.vessel_shape import (
    GLASS,
    SPAR,
    STEEL,
    WHITE,
    Superstructure,
    VesselShape,
    funnel,
    windows,
)


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
