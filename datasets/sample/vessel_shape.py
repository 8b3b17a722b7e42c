"""Kind, hull and colours of a sample vessel, and the fittings that several kinds have."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.sample.solids import Color, Point, Solid, both_sides, box, lathe, loft

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
class Hull:
    """A hull of length 1 with its bow at z = -0.5 and the water line at y = 0."""

    beam: float  # greatest width
    draft: float  # depth under water
    freeboard: float  # height of the side amidships
    sheer_bow: float  # rise of the side towards the bow
    sheer_stern: float
    rake: float  # overhang of the bow over its foot
    stern_rake: float
    entry: float  # position, 0 at the bow, from which the hull has its full width
    fullness: float  # bluntness of the bow: 1 is a straight wedge, 3 very full
    stern_width: float  # relative to the beam
    bulwark: float  # height of the side's edge above the deck

    @property
    def water_share(self) -> float:
        """The water line's height: 0 at the keel, 1 at the edge of the deck."""
        return self.draft / (self.draft + self.freeboard)

    def edge(self, z: float) -> float:
        """Height of the side's edge at z."""
        return float(self._sheer(np.array([z + 0.5]))[0] + self.freeboard)

    def deck(self, z: float) -> float:
        """Height of the deck at z."""
        return self.edge(z) - self.bulwark

    def half_width(self, z: float, share: float = 1.0) -> float:
        """Half the width at z, at a share of the height from the keel."""
        return float(self._half(np.array([z + 0.5]), share)[0])

    def bow(self, share: float) -> float:
        """z of the stem at a share of the height."""
        return -0.5 + self.rake * (1 - share)

    def stern(self, share: float) -> float:
        """z of the stern at a share of the height."""
        return 0.5 - self.stern_rake * (1 - share)

    def solids(self, *, bottom: Color, stripe: Color, side: Color, deck: Color) -> list[Solid]:
        """The part under water, a stripe at the water line, the side, and the deck."""
        water = self.water_share
        band = water + 0.12 * (1 - water)
        below, line, above = (
            [self._outline(share) for share in np.linspace(low, high, count)]
            for low, high, count in ((0.0, water, 6), (water, band, 2), (band, 1.0, 5))
        )
        inner = self._outline(1.0, inset=0.012)
        lowered = inner - (0, self.bulwark, 0)
        return [
            loft(below, bottom),
            loft(line, stripe),
            loft([*above, inner, lowered], side),
            loft([lowered - (0, 0.004, 0), lowered + (0, 0.002, 0)], deck),
        ]

    def _outline(self, share: float, *, inset: float = 0.0) -> FloatArray:
        """A closed line around the hull, from the middle of the stern over the right side."""
        u = 1 - np.concatenate([np.linspace(0, 0.6, 13), np.linspace(0.6, 1, 15)[1:]])
        half = np.maximum(self._half(u, share) - inset, 0.0)
        front, rear = self.bow(share) + 1.6 * inset, self.stern(share) - inset
        z = front + u * (rear - front)
        water = self.water_share
        lift = max(0.0, (share - water) / (1 - water))
        y = -self.draft + share * (self.draft + self.freeboard) + lift * self._sheer(u)
        right = np.stack([half, y, z], axis=1)
        right[-1, 0] = 0.0
        middle = right[:1] * (0, 1, 1)
        return np.concatenate([middle, right, right[-2::-1] * (-1, 1, 1)])

    def _half(self, u: FloatArray, share: float) -> FloatArray:
        """Half the width at positions u (0 bow, 1 stern)."""
        entry = self.entry * (1.25 - 0.25 * share)
        bow = 1 - (1 - np.clip(u / entry, 0, 1)) ** self.fullness
        run = np.clip((u - 0.6) / 0.4, 0, 1)
        stern = 1 - (1 - self.stern_width * (0.45 + 0.55 * share)) * run**2
        depth = 0.35 + 0.65 * np.sqrt(np.clip(share / 0.75, 0, 1))
        return np.asarray(self.beam / 2 * bow * stern * depth)

    def _sheer(self, u: FloatArray) -> FloatArray:
        bow = np.clip(1 - u / 0.55, 0, 1) ** 2
        stern = np.clip((u - 0.6) / 0.4, 0, 1) ** 2
        return np.asarray(self.sheer_bow * bow + self.sheer_stern * stern)


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
