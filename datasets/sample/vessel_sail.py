"""Cabins, rigs and sails of sample sailing boats."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.sample import solids as make
from cadalign.datasets.sample.solids import Color, Solid
from cadalign.datasets.sample.vessel_shape import (
    BLACK,
    GLASS,
    SPAR,
    STEEL,
    WHITE,
    Superstructure,
    VesselShape,
)

_CLOTH = (246, 243, 232)
_SEAM = (214, 210, 196)
_VARNISH = (176, 128, 78)


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
