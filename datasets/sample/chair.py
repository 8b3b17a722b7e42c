"""Parametric chairs: seats, legs, backs and arms in several styles."""

from __future__ import annotations

import numpy as np

from cadalign.datasets.sample.chair_back import chair_back, shell_grid
from cadalign.datasets.sample.chair_base import (
    SPOKE_DEGREES,
    arm_line,
    chair_arms,
    chair_base,
    feet,
    spoke_reach,
)
from cadalign.datasets.sample.chair_style import (
    ChairParameters,
    back_half_width,
    back_point,
    lighter,
)
from cadalign.datasets.sample.model import Draft, Place, mirrored_places
from cadalign.datasets.sample.solids import Solid, rounded_box

_SPOKE_IDS = (10, 11, 12, 13, 14)


def build_chair(p: ChairParameters) -> Draft:
    """Build a chair.

    Semantic ids are those of KeypointNet's chairs: 0, 1 top corners of the back; 2, 3 rear and
    4, 5 front corners of the seat; 6 to 9 ends of the armrests; 10 to 14 tips of a swivel base;
    17 to 20 feet. Three more are this data set's own: 21, 22 the sides of the back and 23 the
    middle of its top.
    """
    arms = chair_arms(p) if p.arms else []
    solids = [*_seat(p), *chair_base(p), *chair_back(p), *arms]
    _, top, rear = back_point(p, p.back_height)
    half, front = p.width / 2, -p.depth / 2
    pairs = {
        (0, 1): (back_half_width(p, 1.0), top, rear),
        (2, 3): (half, p.seat_height, 0.43 * p.depth),
        (4, 5): (half, p.seat_height, front),
    }
    if p.back == "shell":
        edge = shell_grid(p)[:, -1].tolist()
        pairs |= {(0, 1): tuple(edge[-1]), (2, 3): tuple(edge[11]), (4, 5): tuple(edge[1])}
    if p.base == "club":  # the corners of the cushion; those of the seat are hidden by the arms
        pairs[2, 3] = (half - 0.08, p.seat_height + 0.09, 0.5 * p.depth - 0.2)
        pairs[4, 5] = (half - 0.08, p.seat_height + 0.05, front)
    if p.arms:
        x, y, arm_front, arm_rear = arm_line(p)
        outer = x + (0.065 if p.base == "club" else 0.025)
        pairs |= {(6, 8): (outer, y, arm_front), (7, 9): (outer, y, arm_rear)}
    _, side, side_z = back_point(p, 0.84 * p.back_height)
    pairs[21, 22] = (back_half_width(p, 0.84) + 0.1, side, side_z)
    places = [Place(23, (0.0, top + 0.1, rear + 0.02))]
    if p.base == "swivel":
        reach = spoke_reach(p)
        for semantic_id, degrees in zip(_SPOKE_IDS, SPOKE_DEGREES, strict=True):
            a = np.radians(degrees)
            places.append(Place(semantic_id, (reach * np.sin(a), 0.09, reach * np.cos(a))))
    else:
        (x_front, z_front), (x_rear, z_rear) = feet(p)
        pairs |= {
            (17, 20): (x_front + p.leg, 0.01, z_front - p.leg),
            (18, 19): (x_rear + p.leg, 0.01, z_rear + p.leg),
        }
    places += mirrored_places(pairs)
    return Draft(
        solids=tuple(solids),
        places=tuple(sorted(places, key=lambda place: place.semantic_id)),
        mirrored=tuple(pairs),
        turned=(_SPOKE_IDS,) if p.base == "swivel" else (),
    )


def _seat(p: ChairParameters) -> list[Solid]:
    if p.back == "shell":
        return []  # the shell is seat and back in one
    size = (p.width, p.seat_thickness, p.depth)
    center = (0, p.seat_height - p.seat_thickness / 2, 0)
    if p.base == "club":
        cushion = rounded_box(
            (0, p.seat_height + 0.03, -0.03), (p.width - 0.14, 0.12, p.depth - 0.04),
            lighter(p.fabric), radius=0.045, steps=4,
        )  # fmt: skip
        return [rounded_box(center, size, p.fabric, radius=0.03, steps=3), cushion]
    color = p.frame if p.base in ("straight", "tapered", "turned") else p.fabric
    color = color if p.cushion else lighter(color)
    edge = 0.4 * p.seat_thickness
    seat = rounded_box(center, size, color, radius=edge, corner_radius=0.05, steps=3)
    if not (p.cushion or p.back == "panel"):
        return [seat]
    cushion = rounded_box(
        (0, p.seat_height + 0.012, -0.01), (p.width - 0.03, 0.045, p.depth - 0.05),
        p.fabric, radius=0.02, corner_radius=0.06, steps=4,
    )  # fmt: skip
    return [seat, cushion]
