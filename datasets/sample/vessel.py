"""Parametric vessels: cargo ships, sailing boats, motor yachts and tugs."""

from __future__ import annotations

import numpy as np

from cadalign.datasets.sample.model import Draft, mirrored_places
from cadalign.datasets.sample.vessel_decks import cargo, sail, tug, yacht
from cadalign.datasets.sample.vessel_shape import VesselShape

_STRIPE = (238, 238, 234)
_DECKS = {
    "cargo": (126, 92, 78),
    "sail": (196, 152, 100),
    "yacht": (204, 166, 118),
    "tug": (112, 118, 112),
}
_MAKERS = {"cargo": cargo, "sail": sail, "yacht": yacht, "tug": tug}


def vessel(rng: np.random.Generator, index: int) -> Draft:
    """Draw and build a vessel.

    Semantic ids, right (+x) before left: 0 top of the bow; 1 bow at the water line; 2, 3 corners of
    the stern; 4, 5 edge of the side amidships, 6, 7 a quarter of the length from the bow; 8, 9
    front and 10, 11 rear upper corners of the deck house; 12 the highest point; 13, 14 stern at the
    water line; 15 the funnel's top, where there is one.
    """
    p = VesselShape.draw(rng, index)
    hull, water, stern = p.hull, p.hull.water_share, p.hull.stern(1.0)
    above = _MAKERS[p.kind](p)
    body = hull.solids(bottom=p.bottom, stripe=_STRIPE, side=p.side, deck=_DECKS[p.kind])
    pairs = {
        (2, 3): (hull.half_width(stern), hull.edge(stern), stern),
        (4, 5): (hull.half_width(0.0), hull.edge(0.0), 0.0),
        (6, 7): (hull.half_width(-0.25), hull.edge(-0.25), -0.25),
        (8, 9): above.house_front,
        (10, 11): above.house_rear,
        (13, 14): (hull.half_width(0.5, water), 0.0, hull.stern(water)),
    }
    places = mirrored_places(pairs)
    places |= {0: (0.0, hull.edge(-0.5), -0.5), 1: (0.0, 0.0, hull.bow(water)), 12: above.summit}
    if above.funnel is not None:
        places[15] = above.funnel
    return Draft((*body, *above.solids), places, tuple(pairs))
