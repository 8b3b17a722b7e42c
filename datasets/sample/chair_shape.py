"""Style, proportions and reference points of a sample chair."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.sample.solids import Color, Point, smooth_curve

# Base, back, and arms or none.
_STYLES = (
    ("straight", "slats", False), ("swivel", "panel", True), ("splayed", "shell", False),
    ("straight", "ladder", True), ("club", "club", True), ("turned", "spindles", False),
    ("cantilever", "panel", False), ("tapered", "panel", False), ("swivel", "shell", False),
    ("turned", "spindles", True), ("tapered", "ladder", False), ("cantilever", "slats", True),
)  # fmt: skip
_WOODS: tuple[Color, ...] = (
    (150, 98, 54), (186, 134, 80), (96, 60, 38), (206, 164, 112), (122, 70, 40), (70, 46, 34),
)  # fmt: skip
_FABRICS: tuple[Color, ...] = (
    (172, 52, 46), (44, 84, 132), (70, 118, 78), (212, 160, 60), (120, 74, 120), (66, 70, 78),
    (196, 186, 168), (40, 120, 126),
)  # fmt: skip
_METALS: tuple[Color, ...] = ((168, 172, 178), (52, 54, 58), (120, 124, 130))


@dataclass(frozen=True)
class ChairShape:
    """Style and proportions of a chair [metres, degrees].

    ``base`` is straight, tapered, splayed, turned, cantilever, swivel or club; ``back`` is slats,
    ladder, panel, spindles, shell or club.
    """

    base: str
    back: str
    arms: bool
    width: float
    depth: float
    seat_height: float
    seat_thickness: float
    back_height: float
    tilt: float
    leg: float
    bars: int
    cushion: bool
    frame: Color
    fabric: Color

    @classmethod
    def draw(cls, rng: np.random.Generator, index: int) -> ChairShape:
        """Draw a chair; the styles take turns with ``index``."""
        base, back, arms = _STYLES[index % len(_STYLES)]
        frames = _METALS if base in ("swivel", "cantilever") else _WOODS
        club = base == "club"
        return cls(
            base=base,
            back=back,
            arms=arms,
            width=rng.uniform(0.62, 0.72) if club else rng.uniform(0.4, 0.52),
            depth=rng.uniform(0.55, 0.62) if club else rng.uniform(0.4, 0.5),
            seat_height=rng.uniform(0.38, 0.42) if club else rng.uniform(0.42, 0.5),
            seat_thickness=rng.uniform(0.16, 0.2) if club else rng.uniform(0.028, 0.05),
            back_height=rng.uniform(0.38, 0.46) if club else rng.uniform(0.38, 0.58),
            tilt=rng.uniform(5, 13),
            leg=rng.uniform(0.032, 0.046),
            bars=int(rng.integers(3, 6)),
            cushion=bool(rng.random() < 0.6),
            frame=frames[int(rng.integers(len(frames)))],
            fabric=_FABRICS[int(rng.integers(len(_FABRICS)))],
        )

    def back_point(self, height: float) -> Point:
        """The middle of the back at a height above the seat, measured along the back."""
        slope = np.radians(self.tilt)
        start = self.depth / 2 - {"shell": 0.0, "club": 0.08}.get(self.back, 0.025)
        y, z = self.seat_height + height * np.cos(slope), start + height * np.sin(slope)
        return 0.0, float(y), float(z)

    def back_half_width(self, share: float) -> float:
        """Half the width of the back at a share of its height."""
        half = self.width / 2
        if self.back == "club":
            return half - 0.03
        if self.back == "shell":
            return half * (1.0 - 0.12 * share)
        if self.back == "spindles":
            return half - 0.06 + 0.05 * share
        return half - 0.5 * self.leg

    def bowed(self, x: float, half: float, height: float) -> Point:
        """A point of the back, which is hollowed between its posts at ``half`` from the middle."""
        _, y, z = self.back_point(height)
        return x, y, z + 0.025 * (1 - (x / half) ** 2)

    def shell(self) -> FloatArray:
        """The middle of a shell with raised sides, (21, 13, 3), from its front edge to its top."""
        front, y, depth = -self.depth / 2, self.seat_height, self.depth
        top, middle = self.back_point(self.back_height), self.back_point(0.5 * self.back_height)
        knots = [
            (front, y - 0.02), (front + 0.06, y), (0.0, y - 0.02), (depth * 0.34, y),
            (depth * 0.47, y + 0.08), (middle[2], middle[1]), (top[2], top[1]),
        ]  # fmt: skip
        spine = smooth_curve(knots, 21)
        along = np.linspace(0, 1, 21)
        # Narrower at the waist between seat and back, rounded off at both ends.
        width = self.width * (1 - 0.1 * np.exp(-(((along - 0.62) / 0.16) ** 2)))
        width *= np.clip(1 - np.abs(2 * along - 1) ** 7 * 0.22, 0, 1) * (1 - 0.1 * along)
        share = np.linspace(-1, 1, 13)
        lift = 0.055 * np.sin(np.pi * along[:, None]) ** 0.6 * np.abs(share) ** 3
        tangent = np.gradient(spine, axis=0)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        grid = np.empty((21, 13, 3))
        grid[..., 0] = width[:, None] / 2 * share
        grid[..., 1] = spine[:, None, 1] + lift * tangent[:, None, 0]
        grid[..., 2] = spine[:, None, 0] - lift * tangent[:, None, 1]
        return grid

    def feet(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """The feet of the right front and right rear leg: their middle, (x, z) each."""
        x, z = self.width / 2, self.depth / 2
        if self.base == "cantilever":
            return (x - 0.015, -z + 0.03), (x - 0.015, z)
        spreads = {"straight": -0.6 * self.leg, "tapered": 0.0, "club": -0.06}
        spread = spreads.get(self.base, 0.03)
        return (x + spread, -z - spread), (x + spread, z + spread)

    def spokes(self) -> FloatArray:
        """The ends (5, 3) of a swivel base's spokes, on the floor."""
        angle = np.radians([144.0, 72.0, 0.0, -72.0, -144.0])  # from +z towards +x
        ends = np.stack([np.sin(angle), np.zeros(5), np.cos(angle)], axis=1)
        return np.asarray(0.58 * self.width * ends)

    def arm_line(self) -> tuple[float, float, float, float]:
        """The right armrest: its middle x, the y of its top, and the z of its two ends."""
        x, front = self.width / 2, -self.depth / 2
        if self.base == "club":
            return x, self.seat_height + 0.2, front + 0.02, -front - 0.14
        height = 0.2 if self.base == "swivel" else 0.22
        rear = 0.3 * self.depth if self.base == "swivel" else self.back_point(height)[2]
        return x + 0.01, self.seat_height + height, -0.32 * self.depth, rear


def lighter(color: Color) -> Color:
    """A colour mixed with a fifth of white."""
    r, g, b = (round(value + (255 - value) * 0.2) for value in color)
    return r, g, b
