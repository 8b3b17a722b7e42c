"""Cabins, rigs and sails of sample sailing boats."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.sample.solids import (
    Color,
    Solid,
    both_sides,
    box,
    rod,
    rounded_box,
    sheet,
    stacked,
)
from cadalign.datasets.sample.vessel_parts import BLACK, GLASS, SPAR, STEEL, WHITE, Superstructure
from cadalign.datasets.sample.vessel_style import VesselParameters

_CLOTH = (246, 243, 232)


def sail(p: VesselParameters) -> Superstructure:
    """A sailing boat: one mast with mainsail and foresail, a ketch, or one with a striped sail."""
    hull = p.hull
    deck = hull.deck(0.0)
    wide = 0.5 * hull.beam
    low, high = deck - 0.02, deck + 0.055
    front, rear = -0.14, 0.2
    house = stacked(
        [(low, wide, front - 0.02, rear), (high - 0.012, 0.92 * wide, front + 0.02, rear - 0.005),
         (high, 0.86 * wide, front + 0.03, rear - 0.015)],
        WHITE, radius=0.03,
    )  # fmt: skip
    panes = [
        rounded_box((0.475 * wide, deck + 0.022, z), (0.02, 0.018, 0.05), GLASS, radius=0.006)
        for z in (front + 0.08, front + 0.16, front + 0.24)
    ]
    coaming = stacked(
        [
            (low, 0.5 * hull.beam, rear - 0.01, 0.42),
            (deck + 0.02, 0.48 * hull.beam, rear - 0.01, 0.41),
        ],
        (176, 128, 78),
        radius=0.02,
    )
    well = box(
        (0, deck + 0.012, 0.5 * (rear + 0.41)), (0.36 * hull.beam, 0.02, 0.41 - rear - 0.04), BLACK
    )
    solids = [house, *both_sides(*panes), coaming, well, *_keel(p)]
    z_mast = -0.1
    foot = deck + 0.04
    top = deck + (1.02 if p.variant != 1 else 0.86) * p.tall
    solids += _rig(p, z_mast, foot, top, boom=0.4 if p.variant != 1 else 0.3)
    solids.append(_foresail(p, z_mast, top))
    if p.variant == 1:
        solids += _rig(p, 0.29, foot - 0.02, deck + 0.55 * p.tall, boom=0.19)
    return Superstructure(
        solids=tuple(solids),
        house_front=(0.44 * wide, high, front + 0.03),
        house_rear=(0.44 * wide, high, rear - 0.01),
        summit=(0.0, top, z_mast),
    )


def _keel(p: VesselParameters) -> list[Solid]:
    """The fin under a sailing boat, and its rudder."""
    low = -p.hull.draft
    fin = stacked(
        [
            (low - 0.13, 0.03, -0.02, 0.14),
            (low - 0.1, 0.022, -0.05, 0.14),
            (low + 0.02, 0.026, -0.1, 0.16),
        ],
        p.bottom,
        radius=0.012,
    )
    rudder = stacked(
        [(low - 0.07, 0.014, 0.36, 0.41), (low + 0.04, 0.018, 0.33, 0.41)], p.bottom, radius=0.007
    )
    return [fin, rudder]


def _rig(p: VesselParameters, z: float, foot: float, top: float, *, boom: float) -> list[Solid]:
    """A mast, its boom and a bellied-out sail between them, hoisted in the middle plane."""
    clew = foot + 0.06
    mast = rod((0, foot - 0.05, z), (0, top, z), 0.011, SPAR, end_radius=0.006)
    spar = rod((0, clew, z), (0, clew, z + boom), 0.008, SPAR)
    shrouds = both_sides(
        rod(
            (0.5 * p.hull.beam * 0.86, p.hull.edge(z) - 0.01, z + 0.02),
            (0, 0.96 * top, z),
            0.0022,
            STEEL,
            sides=6,
        )
    )
    corners = [(z + 0.012, clew + 0.012), (z + 0.97 * boom, clew + 0.014), (z + 0.012, top - 0.03)]
    stripe = p.accent if p.variant == 2 else None
    return [mast, spar, *shrouds, *_triangle_sail(corners, stripe)]


def _triangle_sail(corners: list[tuple[float, float]], stripe: Color | None) -> list[Solid]:
    """A flat sail with a curved rear edge; corners (z, y): tack, clew, head."""
    tack, clew, head = (np.array(corner) for corner in corners)
    shares = np.linspace(0, 1, 13)
    left = tack + shares[:, None] * (head - tack)
    right = clew + shares[:, None] * (head - clew)
    right[:, 0] += 0.16 * np.abs(clew[0] - tack[0]) * np.sin(np.pi * shares) * (1 - 0.3 * shares)
    right[-1] = right[-1] + (0.02 * np.sign(clew[0] - tack[0]), 0)
    solids = [_flat(left, right, _CLOTH, 0.006)]
    bands = [(0.24, 0.31), (0.62, 0.69)] if stripe is None else [(0.0, 0.3), (0.66, 1.0)]
    color = (214, 210, 196) if stripe is None else stripe
    for low, high in bands:
        steps = np.linspace(low, high, 6)
        ends = [
            np.stack([np.interp(steps, shares, edge[:, k]) for k in (0, 1)], axis=1)
            for edge in (left, right)
        ]
        solids.append(_flat(ends[0], ends[1], color, 0.008))
    return solids


def _flat(left: FloatArray, right: FloatArray, color: Color, thickness: float) -> Solid:
    """A plate in the plane x = 0 between two edges of (z, y) points."""
    across = np.linspace(0, 1, 5)[None, :, None]
    grid = left[:, None] + across * (right - left)[:, None]
    points = np.stack([np.zeros(grid.shape[:2]), grid[..., 1], grid[..., 0]], axis=-1)
    return sheet(points, thickness, color)


def _foresail(p: VesselParameters, z_mast: float, top: float) -> Solid:
    """The triangular sail between bow and mast."""
    bow = (-0.47, p.hull.edge(-0.47) + 0.02)
    head = (z_mast - 0.03, 0.86 * top)
    shares = np.linspace(0, 1, 9)[:, None]
    luff = np.array(bow) + shares * (np.array(head) - np.array(bow))
    clew = np.array([z_mast - 0.02, p.hull.edge(z_mast) + 0.05])
    leech = clew + shares * (np.array(head) - (-0.012, 0.0) - clew)
    color = _CLOTH if p.variant != 1 else p.accent
    return _flat(luff, leech, color, 0.006)
