"""Parametric chairs: seats, backs, arms and legs in several styles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.sample import solids as make
from cadalign.datasets.sample.model import Draft, mirrored_places
from cadalign.datasets.sample.solids import Color, Point, Solid, both_sides

# Base, back, and arms or none.
_STYLES = (
    ("straight", "slats", False), ("swivel", "panel", True), ("splayed", "shell", False),
    ("straight", "ladder", True), ("splayed", "panel", False), ("turned", "spindles", False),
    ("straight", "panel", True), ("tapered", "panel", False), ("swivel", "shell", False),
    ("turned", "spindles", True), ("tapered", "ladder", False), ("tapered", "slats", True),
)  # fmt: skip
# How far the feet stand out and the legs' tops lie inside [metres]; thickness along the leg.
_LEGS: dict[str, tuple[float, float, tuple[float, ...]]] = {
    "straight": (-0.023, 0.023, (1, 1)),
    "tapered": (0.0, 0.03, (1.15, 0.7)),
    "splayed": (0.03, 0.11, (1, 0.6)),
    "turned": (0.03, 0.07, (0.75, 1.0, 0.7, 1.0, 1.15, 1.1, 0.7, 0.95, 0.6)),
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
    back: str
    arms: bool
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

    def at(self, height: float, x: float = 0.0, hollow: float = 0.0) -> Point:
        """A point of the back at a height above the seat, measured along the back."""
        slope = np.radians(self.tilt)
        start = self.depth / 2 - (0.0 if self.back == "shell" else 0.025)
        z = start + height * np.sin(slope) + hollow
        return x, float(self.seat + height * np.cos(slope)), float(z)

    def back_half(self, share: float) -> float:
        """Half the width of the back at a share of its height."""
        half = self.width / 2
        if self.back == "shell":
            return half * (1 - 0.12 * share)
        return half - (0.06 - 0.05 * share if self.back == "spindles" else 0.5 * self.leg)

    def feet(self) -> FloatArray:
        """The right front and the right rear foot (2, 3)."""
        x, z = self.width / 2, self.depth / 2
        out = _LEGS[self.base][0]
        return np.array([(x + out, 0, -z - out), (x + out, 0, z + out)])

    def spokes(self) -> FloatArray:
        """The ends (5, 3) of a swivel base's spokes, on the floor."""
        angle = np.radians([144.0, 72.0, 0.0, -72.0, -144.0])  # from +z towards +x
        ends = np.stack([np.sin(angle), np.zeros(5), np.cos(angle)], axis=1)
        return np.asarray(0.58 * self.width * ends)

    def arm(self) -> tuple[float, float, float, float]:
        """The right armrest: its middle x, the y of its top, and the z of its two ends."""
        height = 0.2 if self.base == "swivel" else 0.22
        rear = 0.3 * self.depth if self.base == "swivel" else self.at(height)[2]
        return self.width / 2 + 0.01, self.seat + height, -0.32 * self.depth, rear

    def shell(self) -> FloatArray:
        """The middle of a shell with raised sides, (21, 13, 3), from its front edge to its top."""
        front, y, depth = -self.depth / 2, self.seat, self.depth
        spine = make.curve([
            (front, y - 0.02), (front + 0.06, y), (0, y - 0.02), (0.34 * depth, y),
            (0.47 * depth, y + 0.08), self.at(0.5 * self.tall)[:0:-1], self.at(self.tall)[:0:-1],
        ], 21)  # fmt: skip
        along, share = np.linspace(0, 1, 21), np.linspace(-1, 1, 13)
        # Narrower at the waist between seat and back, rounded off at both ends.
        width = self.width * (1 - 0.1 * np.exp(-(((along - 0.62) / 0.16) ** 2)))
        width *= (1 - np.abs(2 * along - 1) ** 7 * 0.22) * (1 - 0.1 * along)
        lift = 0.055 * np.sin(np.pi * along[:, None]) ** 0.6 * np.abs(share) ** 3
        tangent = np.gradient(spine, axis=0)
        z, y = (tangent / np.linalg.norm(tangent, axis=1, keepdims=True)).T[..., None]
        x = width[:, None] / 2 * share
        return np.stack([x, spine[:, 1:] + lift * z, spine[:, :1] - lift * y], axis=2)


def chair(rng: np.random.Generator, index: int) -> Draft:
    """Draw and build a chair.

    Semantic ids are those of KeypointNet's chairs: 0, 1 top corners of the back; 2, 3 rear and
    4, 5 front corners of the seat; 6 to 9 ends of the armrests; 10 to 14 tips of a swivel base;
    17 to 20 feet. Three more are this data set's own: 21, 22 the sides of the back and 23 the
    middle of its top.
    """
    c = _draw(rng, index)
    half, front = c.width / 2, -c.depth / 2
    pairs = {
        (0, 1): c.at(c.tall, c.back_half(1.0)),
        (2, 3): (half, c.seat, 0.43 * c.depth),
        (4, 5): (half, c.seat, front),
        (21, 22): c.at(0.84 * c.tall, c.back_half(0.84) + 0.1),
    }
    if c.back == "shell":
        edge = c.shell()[:, -1].tolist()
        pairs |= {(0, 1): tuple(edge[-1]), (2, 3): tuple(edge[11]), (4, 5): tuple(edge[1])}
    if c.arms:
        x, y, arm_front, arm_rear = c.arm()
        pairs |= {(6, 8): (x + 0.025, y, arm_front), (7, 9): (x + 0.025, y, arm_rear)}
    if c.base != "swivel":
        (x, _, foot_front), (rear_x, _, foot_rear) = c.feet().tolist()
        pairs[17, 20] = (x + c.leg, 0.01, foot_front - c.leg)
        pairs[18, 19] = (rear_x + c.leg, 0.01, foot_rear + c.leg)
    places = mirrored_places(pairs) | {23: c.at(c.tall + 0.1)}
    if c.base == "swivel":
        tips = (c.spokes() + (0, 0.09, 0)).tolist()
        places |= {number: tuple(tip) for number, tip in zip(_SPOKE_IDS, tips, strict=True)}
    return Draft(
        solids=(*_seat(c), *_base(c), *_back(c), *(_arms(c) if c.arms else ())),
        places=places,
        mirrored=tuple(pairs),
        turned=(_SPOKE_IDS,) if c.base == "swivel" else (),
    )


def _draw(rng: np.random.Generator, index: int) -> _Chair:
    base, back, arms = _STYLES[index % len(_STYLES)]
    frames = _METALS if base == "swivel" else _WOODS
    return _Chair(
        base=base,
        back=back,
        arms=arms,
        width=rng.uniform(0.4, 0.52),
        depth=rng.uniform(0.4, 0.5),
        seat=rng.uniform(0.42, 0.5),
        thickness=rng.uniform(0.028, 0.05),
        tall=rng.uniform(0.38, 0.58),
        tilt=rng.uniform(5, 13),
        leg=rng.uniform(0.032, 0.046),
        bars=int(rng.integers(3, 6)),
        cushion=bool(rng.random() < 0.6),
        frame=frames[int(rng.integers(len(frames)))],
        fabric=_FABRICS[int(rng.integers(len(_FABRICS)))],
    )


def _lighter(color: Color) -> Color:
    r, g, b = (round(value + (255 - value) * 0.2) for value in color)
    return r, g, b


def _seat(c: _Chair) -> list[Solid]:
    y = c.seat
    if c.back == "shell":
        return []  # the shell is seat and back in one
    center, size = (0, y - c.thickness / 2, 0), (c.width, c.thickness, c.depth)
    color = c.fabric if c.base == "swivel" else c.frame
    color = color if c.cushion else _lighter(color)
    seat = make.box(center, size, color, radius=0.4 * c.thickness)
    if not (c.cushion or c.back == "panel"):
        return [seat]
    size = (c.width - 0.03, 0.045, c.depth - 0.05)
    return [seat, make.box((0, y + 0.012, -0.01), size, c.fabric, radius=0.02, steps=4)]


def _arms(c: _Chair) -> list[Solid]:
    """Two armrests and their supports."""
    x, y, front, rear = c.arm()
    color = _DARK if c.base == "swivel" else c.frame
    size, z = (0.05, 0.024, rear - front), front + 0.04
    pad = make.box((x, y - 0.012, (front + rear) / 2), size, color, radius=0.01)
    post = [(c.width / 2 - 0.012, c.seat - 0.6 * c.thickness, z), (x, y - 0.01, z)]
    return both_sides(pad, make.beam(post, (0.026, 0.034), c.frame))


# Legs and pedestals -------------------------------------------------------------------------------


def _base(c: _Chair) -> list[Solid]:
    """Everything below the seat."""
    if c.base == "swivel":
        return _swivel(c)
    _, inset, scales = _LEGS[c.base]
    y = c.seat - (0.01 if c.back == "shell" else 0.4 * c.thickness)
    feet, x, z = c.feet(), c.width / 2 - inset, c.depth / 2 - inset
    tops = np.array([(x, y, -z), (x, y, z)])
    square = c.base in ("straight", "tapered")
    legs = []
    for path in np.linspace(tops, feet, len(scales), axis=1):
        if square:
            legs.append(make.beam(path, (c.leg, c.leg), c.frame, scales=scales))
        else:
            legs.append(make.rod(path, c.leg / 2, c.frame, scales=scales))
    if c.base in ("straight", "turned"):
        front, rear = feet + 0.35 * (tops - feet)
        middle = (front + rear) / 2
        legs.append(make.beam([front, rear], (0.02, 0.028), c.frame))
        legs.append(make.beam([middle * (0, 1, 1), middle], (0.02, 0.028), c.frame))
    return both_sides(*legs)


def _swivel(c: _Chair) -> list[Solid]:
    top = c.seat - (0.035 if c.back == "shell" else 0.01)
    column = [
        (0, 0.06), (0.045, 0.06), (0.045, 0.13), (0.03, 0.15), (0.03, 0.24), (0.018, 0.245),
        (0.018, top - 0.07), (0.09, top - 0.04), (0.09, top), (0, top),
    ]  # fmt: skip
    solids = [make.lathe(column, c.frame, count=20)]
    for x, _, z in c.spokes().tolist():
        path, wheel = [(0, 0.115, 0), (x, 0.075, z)], (0.96 * x, 0.03, 0.96 * z)
        solids.append(make.beam(path, (0.05, 0.036), c.frame, scales=(1, 0.6), side=(z, 0, -x)))
        solids.append(make.ellipsoid(wheel, (0.05, 0.06, 0.05), _DARK, count=16))
    return solids


# Backs --------------------------------------------------------------------------------------------


def _back(c: _Chair) -> list[Solid]:
    if c.back == "shell":
        return [make.sheet(c.shell(), 0.014, c.fabric)]
    return _panel(c) if c.back == "panel" else _frame(c)


def _panel(c: _Chair) -> list[Solid]:
    """An upholstered board with rounded edges, and the posts or the bracket that carry it."""
    half, tall = c.back_half(1.0), c.tall
    scales = [(0.92, 0.35), (0.97, 0.75), (1, 1), (1, 1), (0.97, 0.75), (0.92, 0.35)]
    path = [c.at(share * tall) for share in (0.28, 0.285, 0.31, 0.97, 0.995, 1.0)]
    section = make.rectangle(2 * half, 0.05, radius=0.02)
    panel = make.sweep(path, section, c.fabric, scales=scales)
    if c.base == "swivel":
        knots = [
            (0, c.seat - 0.035, 0.05), (0, c.seat - 0.03, c.depth / 2 + 0.03),
            c.at(0.12 * tall, hollow=0.045), c.at(0.55 * tall, hollow=0.03),
        ]  # fmt: skip
        return [panel, make.beam(make.curve(knots, 14), (0.07, 0.02), c.frame, side=(1, 0, 0))]
    x = half - 0.5 * c.leg
    post = [c.at(-0.05, x, 0.018), c.at(0.8 * tall, x, 0.018)]
    return [panel, *both_sides(make.beam(post, (0.028, 0.022), c.frame))]


def _frame(c: _Chair) -> list[Solid]:
    """Slats, spindles or the rungs of a ladder; hollowed between its posts."""
    spindles, tall = c.back == "spindles", c.tall
    half = c.back_half(1.0) - (0.0 if spindles else 0.3 * c.leg)

    def rail(height: float, size: float) -> Solid:
        path = [c.at(height, x, 0.025 * (1 - (x / half) ** 2)) for x in np.linspace(-half, half, 9)]
        return make.beam(path, (0.022, size), c.frame)

    if spindles:
        solids = [rail(tall - 0.045, 0.09)]
        for s in np.linspace(-1, 1, 2 * c.bars + 1):
            hollow = 0.025 * (1 - s**2)
            path = np.linspace(
                c.at(-0.02, s * c.back_half(0), hollow), c.at(tall - 0.06, s * half, hollow), 5
            )
            thick = 0.015 if abs(s) == 1 else 0.0095
            solids.append(make.rod(path, thick, c.frame, scales=[0.8, 1.1, 1.2, 1, 0.7], count=8))
        return solids
    post = [c.at(-0.03, half), c.at(tall, half)]
    solids = both_sides(make.beam(post, (0.8 * c.leg, c.leg), c.frame, scales=(1, 0.85)))
    if c.back == "ladder":
        return solids + [rail(h, 0.06) for h in np.linspace(0.28, 0.9, c.bars) * tall]
    for x in np.linspace(-half, half, c.bars + 2)[1:-1]:
        slat = [c.at(h * tall, x, 0.025 * (1 - (x / half) ** 2)) for h in (0.2, 0.93)]
        solids.append(make.beam(slat, (0.75 * half / c.bars, 0.014), c.frame))
    return [*solids, rail(0.93 * tall, 0.07), rail(0.2 * tall, 0.04)]
