"""Parametric chairs: seats, backs, arms and legs in several styles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cadalign.datasets.sample.model import (
    Color,
    Draft,
    Point,
    Solid,
    beam,
    both_sides,
    box,
    ellipsoid,
    lathe,
    mirrored_places,
    palette,
    pick,
)

# Base, back, and arms or none.
_STYLES = (
    ("straight", "slats", False), ("swivel", "panel", True), ("splayed", "panel", False),
    ("straight", "ladder", True), ("tapered", "panel", True), ("splayed", "slats", False),
    ("straight", "panel", True), ("tapered", "panel", False), ("swivel", "panel", False),
    ("splayed", "slats", True), ("tapered", "ladder", False), ("tapered", "slats", True),
)  # fmt: skip
# How far the feet stand out and the legs' tops lie inside [metres]; thickness of top and foot.
_LEGS = {
    "straight": (-0.023, 0.023, (1.0, 1.0)), "tapered": (0.0, 0.03, (1.15, 0.7)),
    "splayed": (0.03, 0.1, (1.1, 0.6)),
}  # fmt: skip
_WOODS, _METALS = (
    palette("966236 ba8650 603c26 cea470 7a4628 462e22"),
    palette("a8acb2 34363a 787c82"),
)
_FABRICS = palette("ac342e 2c5484 46764e d4a03c 784a78 42464e c4baa8 28787e")
(_DARK,) = palette("26262a")
_SPOKE_IDS = (10, 11, 12, 13, 14)
# Ranges of a chair's width, depth, seat, thickness, tall, tilt and leg.
_LEAST = (0.4, 0.4, 0.42, 0.028, 0.38, 5, 0.032)
_MOST = (0.52, 0.5, 0.5, 0.05, 0.58, 13, 0.046)


@dataclass(frozen=True)
class _Chair:
    """Style and proportions of a chair [metres, degrees]; ``seat`` is the height of its seat."""

    base: str
    width: float
    depth: float
    seat: float
    thickness: float
    tall: float
    tilt: float
    leg: float
    bars: int
    cushion: bool
    frame: Color
    fabric: Color

    def back(self, share: float, x: float = 0.0, hollow: float = 0.0) -> Point:
        """A point of the back at a share of its height."""
        slope, along = np.radians(self.tilt), share * self.tall
        z = self.depth / 2 - 0.025 + along * np.sin(slope) + hollow
        return x, float(self.seat + along * np.cos(slope)), float(z)


def chair(rng: np.random.Generator, index: int) -> Draft:
    """Draw and build a chair.

    Semantic ids are those of KeypointNet's chairs: 0, 1 top corners of the back; 2, 3 rear and
    4, 5 front corners of the seat; 6 to 9 ends of the armrests; 10 to 14 tips of a swivel base;
    17 to 20 feet. Three more are this data set's own: 21, 22 the sides of the back and 23 the
    middle of its top.
    """
    base, back, has_arms = _STYLES[index % len(_STYLES)]
    width, depth, seat, thickness, tall, tilt, leg = rng.uniform(_LEAST, _MOST).tolist()
    c = _Chair(
        base, width, depth, seat, thickness, tall, tilt, leg,
        bars=int(rng.integers(3, 6)),
        cushion=bool(rng.random() < 0.6) or back == "panel",
        frame=pick(rng, _METALS if base == "swivel" else _WOODS),
        fabric=pick(rng, _FABRICS),
    )  # fmt: skip
    half = c.width / 2
    pairs = {
        (0, 1): c.back(1.0, half - 0.5 * c.leg),
        (2, 3): (half, c.seat, 0.43 * c.depth),
        (4, 5): (half, c.seat, -c.depth / 2),
        (21, 22): c.back(0.84, half + 0.08),
    }
    tips: dict[int, Point] = {}
    solids = [*_seat(c), *(_panel(c) if back == "panel" else _bars(c, back))]
    if has_arms:
        _add_arms(c, solids, pairs)
    if base == "swivel":
        _add_swivel(c, solids, tips)
    else:
        _add_legs(c, solids, pairs)
    return Draft(
        solids=solids,
        places={**mirrored_places(pairs), 23: c.back(1.2), **tips},
        mirrored=tuple(pairs),
        turned=(_SPOKE_IDS,) if tips else (),
    )


def _seat(c: _Chair) -> list[Solid]:
    size = (c.width, c.thickness, c.depth)
    r, g, b = (round(value + 0.2 * (255 - value)) for value in c.frame)
    color = c.fabric if c.base == "swivel" else (r, g, b)
    seat = box((0, c.seat - c.thickness / 2, 0), size, color, radius=0.4 * c.thickness)
    soft = (c.width - 0.03, 0.045, c.depth - 0.05)
    cushion = box((0, c.seat + 0.012, -0.01), soft, c.fabric, radius=0.02, steps=4)
    return [seat, cushion] if c.cushion else [seat]


def _panel(c: _Chair) -> list[Solid]:
    """An upholstered board with rounded edges before two posts."""
    half = c.width / 2 - 0.5 * c.leg
    scales = [(0.92, 0.35), (0.97, 0.75), (1, 1), (1, 1), (0.97, 0.75), (0.92, 0.35)]
    path = [c.back(share) for share in (0.28, 0.285, 0.31, 0.97, 0.995, 1.0)]
    post = [c.back(share, half - 0.5 * c.leg, 0.018) for share in (-0.1, 0.8)]
    return [
        beam(path, (2 * half, 0.05), c.fabric, scales=scales, radius=0.02),
        *both_sides(beam(post, (0.028, 0.022), c.frame)),
    ]


def _bars(c: _Chair, kind: str) -> list[Solid]:
    """Two posts with slats or the rungs of a ladder between them, hollowed."""
    half = c.width / 2 - 0.8 * c.leg

    def at(share: float, x: float) -> Point:
        return c.back(share, x, 0.025 * (1 - (x / half) ** 2))

    def rail(share: float, tall: float) -> Solid:
        return beam([at(share, x) for x in np.linspace(-half, half, 9)], (0.022, tall), c.frame)

    post = [c.back(-0.06, half), c.back(1.0, half)]
    solids = both_sides(beam(post, (0.8 * c.leg, c.leg), c.frame, scales=(1, 0.85)))
    if kind == "ladder":
        return solids + [rail(share, 0.06) for share in np.linspace(0.28, 0.9, c.bars)]
    for x in np.linspace(-half, half, c.bars + 2)[1:-1]:
        solids.append(beam([at(0.2, x), at(0.93, x)], (0.75 * half / c.bars, 0.014), c.frame))
    return [*solids, rail(0.93, 0.07), rail(0.2, 0.04)]


def _add_arms(c: _Chair, solids: list[Solid], pairs: dict[tuple[int, int], Point]) -> None:
    x, y, rear = c.back(0.22 / c.tall, c.width / 2 + 0.01)
    front = -0.32 * c.depth
    color, size = _DARK if c.base == "swivel" else c.frame, (0.05, 0.024, rear - front)
    pad = box((x, y - 0.012, (front + rear) / 2), size, color, radius=0.01)
    post = [
        (c.width / 2 - 0.012, c.seat - 0.6 * c.thickness, front + 0.04),
        (x, y - 0.01, front + 0.04),
    ]
    solids += both_sides(pad, beam(post, (0.026, 0.034), c.frame))
    pairs |= {(6, 8): (x + 0.025, y, front), (7, 9): (x + 0.025, y, rear)}


def _add_legs(c: _Chair, solids: list[Solid], pairs: dict[tuple[int, int], Point]) -> None:
    """Four legs, and bars between straight ones."""
    out, inset, scales = _LEGS[c.base]
    side, end = c.width / 2, c.depth / 2
    for ids, sign in (((17, 20), -1), ((18, 19), 1)):
        top, foot = (
            (side - inset, c.seat - 0.4 * c.thickness, sign * (end - inset)),
            (side + out, 0.0, sign * (end + out)),
        )
        solids += both_sides(beam([top, foot], (c.leg, c.leg), c.frame, scales=scales))
        pairs[ids] = (foot[0] + c.leg, 0.01, foot[2] + sign * c.leg)
    if c.base == "straight":
        x, z = side + out, end + out
        along, across = [(x, 0.16, -z), (x, 0.16, z)], [(-x, 0.16, 0), (x, 0.16, 0)]
        solids += both_sides(beam(along, (0.02, 0.028), c.frame))
        solids.append(beam(across, (0.02, 0.028), c.frame))


def _add_swivel(c: _Chair, solids: list[Solid], tips: dict[int, Point]) -> None:
    top = c.seat - 0.01
    column = [
        (0.045, 0.06), (0.045, 0.13), (0.03, 0.15), (0.03, 0.24), (0.018, 0.245),
        (0.018, top - 0.07), (0.09, top - 0.04), (0.09, top),
    ]  # fmt: skip
    solids.append(lathe(column, c.frame, count=20))
    for number, degrees in zip(_SPOKE_IDS, (144, 72, 0, -72, -144), strict=True):
        angle = np.radians(degrees)  # from +z towards +x
        x, z = float(0.58 * c.width * np.sin(angle)), float(0.58 * c.width * np.cos(angle))
        path, size = [(0, 0.115, 0), (x, 0.075, z)], (0.05, 0.036)
        solids.append(beam(path, size, c.frame, scales=(1, 0.6), side=(z, 0, -x)))
        castor = (0.96 * x, 0.03, 0.96 * z)
        solids.append(ellipsoid(castor, (0.05, 0.06, 0.05), _DARK, count=16))
        tips[number] = (x, 0.09, z)
