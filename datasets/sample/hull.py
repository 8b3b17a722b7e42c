"""Hulls of sample vessels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.sample.solids import Color, Solid, loft


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
