"""Parametric chairs: seats, backs, arms and legs in several styles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.sample.model import Draft, mirrored_places
from cadalign.datasets.sample.solids import (
    Color,
    Point,
    Solid,
    beam,
    both_sides,
    box,
    ellipsoid,
    lathe,
    rectangle,
    sweep,
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
    "straight": (-0.023, 0.023, (1.0, 1.0)),
    "tapered": (0.0, 0.03, (1.15, 0.7)),
    "splayed": (0.03, 0.1, (1.1, 0.6)),
}
_WOODS: tuple[Color, ...] = (
    (150, 98, 54), (186, 134, 80), (96, 60, 38), (206, 164, 112), (122, 70, 40), (70, 46, 34),
)  # fmt: skip
_FABRICS: tuple[Color, ...] = (
    (172, 52, 46), (44, 84, 132), (70, 118, 78), (212, 160, 60), (120, 74, 120), (66, 70, 78),
    (196, 186, 168), (40, 120, 126),
)  # fmt: skip
_METALS: tuple[Color, ...] = ((168, 172, 178), (52, 54, 58), (120, 124, 130))
_DARK = (38, 38, 42)
_SPOKE_IDS = (10, 11, 12, 13, 14)


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

    def feet(self) -> FloatArray:
        """The right front and the right rear foot (2, 3)."""
        out = _LEGS[self.base][0]
        x, z = self.width / 2 + out, self.depth / 2 + out
        return np.array([(x, 0, -z), (x, 0, z)])

    def spokes(self) -> FloatArray:
        """The ends (5, 3) of a swivel base's spokes, on the floor."""
        angle = np.radians([144.0, 72.0, 0.0, -72.0, -144.0])  # from +z towards +x
        ends = np.stack([np.sin(angle), np.zeros(5), np.cos(angle)], axis=1)
        return np.asarray(0.58 * self.width * ends)

    def arm(self) -> tuple[Point, Point]:
        """The front and the rear end of the right armrest, in the middle of its top."""
        share = 0.22 / self.tall
        rear = self.back(share, self.width / 2 + 0.01)
        return (rear[0], rear[1], -0.32 * self.depth), rear


def chair(rng: np.random.Generator, index: int) -> Draft:
    """Draw and build a chair.

    Semantic ids are those of KeypointNet's chairs: 0, 1 top corners of the back; 2, 3 rear and
    4, 5 front corners of the seat; 6 to 9 ends of the armrests; 10 to 14 tips of a swivel base;
    17 to 20 feet. Three more are this data set's own: 21, 22 the sides of the back and 23 the
    middle of its top.
    """
    base, back, has_arms = _STYLES[index % len(_STYLES)]
    frames = _METALS if base == "swivel" else _WOODS
    c = _Chair(
        base=base,
        width=rng.uniform(0.4, 0.52),
        depth=rng.uniform(0.4, 0.5),
        seat=rng.uniform(0.42, 0.5),
        thickness=rng.uniform(0.028, 0.05),
        tall=rng.uniform(0.38, 0.58),
        tilt=rng.uniform(5, 13),
        leg=rng.uniform(0.032, 0.046),
        bars=int(rng.integers(3, 6)),
        cushion=bool(rng.random() < 0.6) or back == "panel",
        frame=frames[int(rng.integers(len(frames)))],
        fabric=_FABRICS[int(rng.integers(len(_FABRICS)))],
    )
    half = c.width / 2
    pairs = {
        (0, 1): c.back(1.0, half - 0.5 * c.leg),
        (2, 3): (half, c.seat, 0.43 * c.depth),
        (4, 5): (half, c.seat, -c.depth / 2),
        (21, 22): c.back(0.84, half + 0.08),
    }
    solids = [*_seat(c), *(_panel(c) if back == "panel" else _bars(c, back))]
    if has_arms:
        (x, y, front), (_, _, rear) = c.arm()
        pairs |= {(6, 8): (x + 0.025, y, front), (7, 9): (x + 0.025, y, rear)}
        solids += _arms(c)
    tips = {}
    if base == "swivel":
        solids += _swivel(c)
        ends = (c.spokes() + (0, 0.09, 0)).tolist()
        tips = {number: tuple(end) for number, end in zip(_SPOKE_IDS, ends, strict=True)}
    else:
        solids += _legs(c)
        for ids, (x, _, z) in zip(((17, 20), (18, 19)), c.feet().tolist(), strict=True):
            pairs[ids] = (x + c.leg, 0.01, z + np.sign(z) * c.leg)
    return Draft(
        solids=tuple(solids),
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


def _arms(c: _Chair) -> list[Solid]:
    """Two armrests and their supports."""
    (x, y, front), (_, _, rear) = c.arm()
    color, z = _DARK if c.base == "swivel" else c.frame, front + 0.04
    size = (0.05, 0.024, rear - front)
    pad = box((x, y - 0.012, (front + rear) / 2), size, color, radius=0.01)
    post = [(c.width / 2 - 0.012, c.seat - 0.6 * c.thickness, z), (x, y - 0.01, z)]
    return both_sides(pad, beam(post, (0.026, 0.034), c.frame))


def _legs(c: _Chair) -> list[Solid]:
    """Four legs, and bars between straight ones."""
    _, inset, scales = _LEGS[c.base]
    feet, x, z = c.feet(), c.width / 2 - inset, c.depth / 2 - inset
    y = c.seat - 0.4 * c.thickness
    legs = [
        beam([top, foot], (c.leg, c.leg), c.frame, scales=scales)
        for top, foot in zip([(x, y, -z), (x, y, z)], feet, strict=True)
    ]
    if c.base == "straight":
        front, rear = feet + (0, 0.16, 0)
        middle = (front + rear) / 2
        legs += [beam(path, (0.02, 0.028), c.frame)
                 for path in ([front, rear], [middle * (0, 1, 1), middle])]  # fmt: skip
    return both_sides(*legs)


def _swivel(c: _Chair) -> list[Solid]:
    """A column on five spokes with castors."""
    top = c.seat - 0.01
    column = [
        (0, 0.06), (0.045, 0.06), (0.045, 0.13), (0.03, 0.15), (0.03, 0.24), (0.018, 0.245),
        (0.018, top - 0.07), (0.09, top - 0.04), (0.09, top), (0, top),
    ]  # fmt: skip
    solids = [lathe(column, c.frame, count=20)]
    for x, _, z in c.spokes().tolist():
        path, castor = [(0, 0.115, 0), (x, 0.075, z)], (0.96 * x, 0.03, 0.96 * z)
        solids.append(beam(path, (0.05, 0.036), c.frame, scales=(1, 0.6), side=(z, 0, -x)))
        solids.append(ellipsoid(castor, (0.05, 0.06, 0.05), _DARK, count=16))
    return solids


def _panel(c: _Chair) -> list[Solid]:
    """An upholstered board with rounded edges before two posts."""
    half = c.width / 2 - 0.5 * c.leg
    scales = [(0.92, 0.35), (0.97, 0.75), (1, 1), (1, 1), (0.97, 0.75), (0.92, 0.35)]
    path = [c.back(share) for share in (0.28, 0.285, 0.31, 0.97, 0.995, 1.0)]
    board = sweep(path, rectangle(2 * half, 0.05, radius=0.02), c.fabric, scales=scales)
    post = [c.back(share, half - 0.5 * c.leg, 0.018) for share in (-0.1, 0.8)]
    return [board, *both_sides(beam(post, (0.028, 0.022), c.frame))]


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
