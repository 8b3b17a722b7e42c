"""What the deck houses of sample vessels have in common."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cadalign.datasets.sample.solids import Color, Solid, both_sides, box, lathe

WHITE = (240, 240, 236)
GLASS = (34, 46, 60)
STEEL = (150, 154, 158)
BLACK = (32, 34, 38)
SPAR = (206, 208, 212)

Point = tuple[float, float, float]


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
    x, y, z = middle
    wide, tall, deep = size
    pane = 0.55 * wide / count
    solids = [
        box((s, y, z - deep / 2), (pane, height * tall, 0.003), GLASS)
        for s in (np.arange(count) - (count - 1) / 2) * 0.9 * wide / count
    ]
    along = max(2, int(count * deep / wide))
    step = 0.9 * deep / along
    for offset in (np.arange(along) - (along - 1) / 2) * step:
        solids += both_sides(
            box((x + wide / 2, y, z + offset), (0.003, height * tall, 0.55 * step), GLASS)
        )
    return solids


def funnel(foot: Point, tall: float, width: float, depth: float, color: Color) -> list[Solid]:
    """An oval funnel with a black top and a pale ring."""
    ratio = depth / width
    parts = [
        ([(0, 0), (0.5 * width, 0), (0.46 * width, 0.84 * tall), (0, 0.84 * tall)], color),
        ([(0, 0.5 * tall), (0.492 * width, 0.5 * tall), (0.485 * width, 0.64 * tall),
          (0, 0.64 * tall)], WHITE),
        ([(0, 0.83 * tall), (0.475 * width, 0.83 * tall), (0.47 * width, tall), (0, tall)], BLACK),
    ]  # fmt: skip
    return [lathe(profile, tint, center=foot, count=20, depth=ratio) for profile, tint in parts]
