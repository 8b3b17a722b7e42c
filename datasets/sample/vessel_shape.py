"""Kind, hull and colours of a sample vessel, and the fittings that several kinds have."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cadalign.datasets.sample.hull import Hull
from cadalign.datasets.sample.solids import Color, Point, Solid, both_sides, box, lathe

WHITE = (240, 240, 236)
GLASS = (34, 46, 60)
STEEL = (150, 154, 158)
BLACK = (32, 34, 38)
SPAR = (206, 208, 212)

_KINDS = ("cargo", "sail", "yacht", "tug")
_SIDES: dict[str, tuple[Color, ...]] = {
    "cargo": ((36, 62, 104), (38, 44, 52), (148, 42, 38), (34, 92, 78)),
    "sail": ((240, 240, 236), (32, 56, 110), (150, 34, 38), (24, 84, 86)),
    "yacht": ((244, 244, 242), (30, 44, 76), (206, 212, 218), (236, 230, 214)),
    "tug": ((30, 34, 40), (170, 40, 34), (34, 74, 120), (42, 94, 62)),
}
_ACCENTS: tuple[Color, ...] = (
    (204, 44, 38), (238, 168, 36), (32, 92, 160), (46, 124, 78), (232, 106, 32),
)  # fmt: skip
_CARGO: tuple[Color, ...] = (
    (186, 54, 44), (44, 98, 158), (228, 160, 48), (70, 130, 84), (150, 152, 156), (120, 66, 44),
)  # fmt: skip
_BOTTOMS: tuple[Color, ...] = ((140, 38, 32), (110, 34, 34), (40, 66, 60))


@dataclass(frozen=True)
class VesselShape:
    """A vessel of length 1: kind (cargo, sail, yacht or tug), variant, hull and colours.

    ``tall`` scales everything above the deck.
    """

    kind: str
    variant: int
    hull: Hull
    tall: float
    side: Color
    bottom: Color
    accent: Color
    cargo: tuple[Color, ...]

    @classmethod
    def draw(cls, rng: np.random.Generator, index: int) -> VesselShape:
        """Draw a vessel; kinds and variants take turns with ``index``."""
        kind, turn = _KINDS[index % len(_KINDS)], index // len(_KINDS)
        sides = _SIDES[kind]
        return cls(
            kind=kind,
            variant=turn % 3,
            hull=_draw_hull(rng, kind),
            tall=rng.uniform(0.92, 1.1),
            side=sides[(turn + int(rng.integers(2))) % len(sides)],
            bottom=_BOTTOMS[int(rng.integers(len(_BOTTOMS)))],
            accent=_ACCENTS[int(rng.integers(len(_ACCENTS)))],
            cargo=tuple(_CARGO[int(i)] for i in rng.permutation(len(_CARGO))),
        )


def _draw_hull(rng: np.random.Generator, kind: str) -> Hull:
    if kind == "cargo":
        return Hull(
            beam=rng.uniform(0.15, 0.18), draft=0.04, freeboard=rng.uniform(0.045, 0.06),
            sheer_bow=0.03, sheer_stern=0.008, rake=0.045, stern_rake=0.03, entry=0.2,
            fullness=2.2, stern_width=0.82, bulwark=0.008,
        )  # fmt: skip
    if kind == "sail":
        return Hull(
            beam=rng.uniform(0.25, 0.3), draft=0.05, freeboard=rng.uniform(0.065, 0.08),
            sheer_bow=0.035, sheer_stern=0.01, rake=0.11, stern_rake=0.07, entry=0.58,
            fullness=1.7, stern_width=rng.uniform(0.5, 0.7), bulwark=0.01,
        )  # fmt: skip
    if kind == "yacht":
        return Hull(
            beam=rng.uniform(0.23, 0.27), draft=0.035, freeboard=rng.uniform(0.075, 0.09),
            sheer_bow=0.045, sheer_stern=0.0, rake=0.12, stern_rake=0.02, entry=0.55,
            fullness=1.8, stern_width=0.88, bulwark=0.014,
        )  # fmt: skip
    return Hull(
        beam=rng.uniform(0.3, 0.35), draft=0.07, freeboard=rng.uniform(0.065, 0.08),
        sheer_bow=rng.uniform(0.07, 0.09), sheer_stern=0.015, rake=0.05, stern_rake=0.05,
        entry=0.38, fullness=2.3, stern_width=0.72, bulwark=0.025,
    )  # fmt: skip


@dataclass(frozen=True)
class Superstructure:
    """The parts above the deck, and the places on them that are keypoints.

    ``house_front`` and ``house_rear`` are the right upper corners of the deck house.
    """

    solids: tuple[Solid, ...]
    house_front: Point
    house_rear: Point
    summit: Point
    funnel: Point | None = None


def windows(middle: Point, size: Point, *, count: int, height: float) -> list[Solid]:
    """Dark panes along the front and both sides of a block."""
    (x, y, z), (wide, tall, deep) = middle, size
    along = max(2, int(count * deep / wide))
    front = (np.arange(count) - (count - 1) / 2) * 0.9 * wide / count
    side = (np.arange(along) - (along - 1) / 2) * 0.9 * deep / along
    pane, long_pane = (0.55 * wide / count, height * tall, 0.003), 0.55 * 0.9 * deep / along
    flank = (box((x + wide / 2, y, z + s), (0.003, height * tall, long_pane), GLASS) for s in side)
    return [*(box((s, y, z - deep / 2), pane, GLASS) for s in front), *both_sides(*flank)]


def funnel(foot: Point, tall: float, width: float, depth: float, color: Color) -> list[Solid]:
    """An oval funnel with a black top and a pale ring."""
    parts = (  # lower and upper radius over the width, lower and upper end over the height
        ((0.5, 0.46), (0.0, 0.84), color),
        ((0.492, 0.485), (0.5, 0.64), WHITE),
        ((0.475, 0.47), (0.83, 1.0), BLACK),
    )
    solids = []
    for (wide, slim), (low, high), tint in parts:
        profile = np.array([(0, low), (wide, low), (slim, high), (0, high)]) * (width, tall)
        solids.append(lathe(profile, tint, center=foot, count=20, depth=depth / width))
    return solids
