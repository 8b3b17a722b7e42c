"""How a sample vessel looks: its kind, hull and colours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cadalign.datasets.sample.hull import Hull
from cadalign.datasets.sample.solids import Color

_KINDS = ("cargo", "sail", "yacht", "tug")
_SIDES: dict[str, tuple[Color, ...]] = {
    "cargo": ((36, 62, 104), (38, 44, 52), (148, 42, 38), (34, 92, 78)),
    "sail": ((240, 240, 236), (32, 56, 110), (150, 34, 38), (24, 84, 86)),
    "yacht": ((244, 244, 242), (30, 44, 76), (206, 212, 218), (236, 230, 214)),
    "tug": ((30, 34, 40), (170, 40, 34), (34, 74, 120), (42, 94, 62)),
}
_ACCENTS: tuple[Color, ...] = (
    (204, 44, 38),
    (238, 168, 36),
    (32, 92, 160),
    (46, 124, 78),
    (232, 106, 32),
)


@dataclass(frozen=True)
class VesselParameters:
    """A vessel of length 1: kind (cargo, sail, yacht or tug), variant, hull and colours.

    ``tall`` scales what stands on the deck.
    """

    kind: str
    variant: int
    hull: Hull
    tall: float
    side: Color
    bottom: Color
    accent: Color
    cargo: tuple[Color, ...]


def draw_vessel(rng: np.random.Generator, index: int) -> VesselParameters:
    """Draw a vessel; kinds and variants take turns with ``index``."""
    kind = _KINDS[index % len(_KINDS)]
    sides = _SIDES[kind]
    colors = [
        (186, 54, 44),
        (44, 98, 158),
        (228, 160, 48),
        (70, 130, 84),
        (150, 152, 156),
        (120, 66, 44),
    ]
    bottoms: tuple[Color, ...] = ((140, 38, 32), (110, 34, 34), (40, 66, 60))
    return VesselParameters(
        kind=kind,
        variant=index // len(_KINDS) % 3,
        hull=_draw_hull(rng, kind),
        tall=rng.uniform(0.92, 1.1),
        side=sides[(index // len(_KINDS) + int(rng.integers(2))) % len(sides)],
        bottom=bottoms[int(rng.integers(len(bottoms)))],
        accent=_ACCENTS[int(rng.integers(len(_ACCENTS)))],
        cargo=tuple(colors[int(i)] for i in rng.permutation(len(colors))),
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
        beam=rng.uniform(0.3, 0.35),
        draft=0.07,
        freeboard=rng.uniform(0.065, 0.08),
        sheer_bow=rng.uniform(0.07, 0.09),
        sheer_stern=0.015,
        rake=0.05,
        stern_rake=0.05,
        entry=0.38,
        fullness=2.3,
        stern_width=0.72,
        bulwark=0.025,
    )
