"""How a sample chair looks: its style, proportions and colours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cadalign.datasets.sample.solids import Color

_STYLES = (
    ("straight", "slats", False),
    ("swivel", "panel", True),
    ("splayed", "shell", False),
    ("straight", "ladder", True),
    ("club", "club", True),
    ("turned", "spindles", False),
    ("cantilever", "panel", False),
    ("tapered", "panel", False),
    ("swivel", "shell", False),
    ("turned", "spindles", True),
    ("tapered", "ladder", False),
    ("cantilever", "slats", True),
)
_WOODS: tuple[Color, ...] = (
    (150, 98, 54), (186, 134, 80), (96, 60, 38), (206, 164, 112), (122, 70, 40), (70, 46, 34),
)  # fmt: skip
_FABRICS: tuple[Color, ...] = (
    (172, 52, 46), (44, 84, 132), (70, 118, 78), (212, 160, 60), (120, 74, 120), (66, 70, 78),
    (196, 186, 168), (40, 120, 126),
)  # fmt: skip
_METALS: tuple[Color, ...] = ((168, 172, 178), (52, 54, 58), (120, 124, 130))


@dataclass(frozen=True)
class ChairParameters:
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


def draw_chair(rng: np.random.Generator, index: int) -> ChairParameters:
    """Draw a chair; the styles take turns with ``index``."""
    base, back, arms = _STYLES[index % len(_STYLES)]
    metal = base in ("swivel", "cantilever")
    frames = _METALS if metal else _WOODS
    club = base == "club"
    return ChairParameters(
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


def back_point(p: ChairParameters, height: float) -> tuple[float, float, float]:
    """The middle of the back at a height above the seat, measured along the back [metres]."""
    slope = np.radians(p.tilt)
    start = p.depth / 2 - {"shell": 0.0, "club": 0.08}.get(p.back, 0.025)
    return 0.0, float(p.seat_height + height * np.cos(slope)), float(start + height * np.sin(slope))


def back_half_width(p: ChairParameters, share: float) -> float:
    """Half the width of the back [metres] at a share of its height."""
    if p.back == "club":
        return p.width / 2 - 0.03
    if p.back == "shell":
        return p.width / 2 * (1.0 - 0.12 * share)
    if p.back == "spindles":
        return p.width / 2 - 0.06 + 0.05 * share
    return p.width / 2 - 0.5 * p.leg


def lighter(color: Color, share: float = 0.2) -> Color:
    """A colour mixed with white."""
    r, g, b = (round(value + (255 - value) * share) for value in color)
    return r, g, b
