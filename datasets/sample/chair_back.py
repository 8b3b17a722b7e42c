"""Backs of sample chairs."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.sample.chair_style import (
    ChairParameters,
    back_half_width,
    back_point,
    lighter,
)
from cadalign.datasets.sample.outlines import ellipse, rounded_rectangle, smooth_curve
from cadalign.datasets.sample.solids import (
    Color,
    Solid,
    beam,
    both_sides,
    rod,
    rounded_box,
    sheet,
    sweep,
)

_SHELL_THICKNESS = 0.014


def chair_back(p: ChairParameters) -> list[Solid]:
    """The back, without armrests; a shell includes the seat."""
    makers = {
        "slats": _slat_back,
        "ladder": _ladder_back,
        "panel": _panel_back,
        "spindles": _spindle_back,
        "shell": _shell,
        "club": _club_back,
    }
    return makers[p.back](p)


def _slat_back(p: ChairParameters) -> list[Solid]:
    x = _post_offset(p)
    low, high = 0.2 * p.back_height, 0.93 * p.back_height
    color = p.fabric if p.base == "cantilever" else p.frame
    slats = [
        beam(_bowed(p, s, x, low), _bowed(p, s, x, high), (0.75 * x / p.bars, 0.014), color)
        for s in np.linspace(-x, x, p.bars + 2)[1:-1]
    ]
    rails = [_rail(p, x, high, 0.07, p.frame), _rail(p, x, low, 0.04, p.frame)]
    return [*_posts(p), *rails, *slats]


def _ladder_back(p: ChairParameters) -> list[Solid]:
    heights = np.linspace(0.28, 0.9, p.bars) * p.back_height
    return [*_posts(p), *(_rail(p, _post_offset(p), h, 0.06, p.frame) for h in heights)]


def _post_offset(p: ChairParameters) -> float:
    return back_half_width(p, 1.0) - 0.3 * p.leg


def _posts(p: ChairParameters) -> list[Solid]:
    x = _post_offset(p)
    low, high = back_point(p, -0.03), back_point(p, p.back_height)
    size = (0.8 * p.leg, p.leg)
    return both_sides(beam((x, *low[1:]), (x, *high[1:]), size, p.frame, taper=0.85))


def _bowed(p: ChairParameters, x: float, half: float, height: float) -> tuple[float, float, float]:
    """A point of the back, which is hollowed between its posts at ``half`` from the middle."""
    _, y, z = back_point(p, height)
    return x, y, z + 0.025 * (1 - (x / half) ** 2)


def _rail(p: ChairParameters, half: float, height: float, tall: float, color: Color) -> Solid:
    path = [_bowed(p, x, half, height) for x in np.linspace(-half, half, 9)]
    return sweep(path, rounded_rectangle(0.02, tall, radius=0.006, steps=1), color)


def _panel_back(p: ChairParameters) -> list[Solid]:
    half = back_half_width(p, 1.0)
    outline = rounded_rectangle(2 * half, 0.05, radius=0.02, steps=3)
    heights = np.array([0.28, 0.3, 0.36, 0.6, 0.9, 0.97, 1.0]) * p.back_height
    scales = np.array([[0.9, 0.5], [0.95, 0.8], [1, 1], [1, 1], [1, 1], [0.97, 0.85], [0.92, 0.5]])
    path = [back_point(p, height) for height in heights]
    panel = sweep(path, outline, p.fabric, scales=scales)
    if p.base == "swivel":
        knots = [(0, p.seat_height - 0.04, 0.05), (0, p.seat_height - 0.03, p.depth / 2 + 0.03)]
        low, high = back_point(p, 0.12 * p.back_height), back_point(p, 0.55 * p.back_height)
        knots += [(0, low[1], low[2] + 0.045), (0, high[1], high[2] + 0.03)]
        section = rounded_rectangle(0.07, 0.02, radius=0.006, steps=1)
        return [panel, sweep(smooth_curve(knots, 14), section, p.frame, side=(1, 0, 0))]
    x = half - 0.5 * p.leg
    posts = both_sides(
        beam(
            (x, *_behind(p, -0.05)), (x, *_behind(p, 0.8 * p.back_height)), (0.028, 0.022), p.frame
        )
    )
    return [panel, *posts]


def _behind(p: ChairParameters, height: float) -> tuple[float, float]:
    """Height and z of the posts that carry a panel."""
    _, y, z = back_point(p, height)
    return y, z + 0.018


def _spindle_back(p: ChairParameters) -> list[Solid]:
    half = back_half_width(p, 1.0)
    crest = sweep(
        [_bowed(p, x, half, p.back_height - 0.045) for x in np.linspace(-half, half, 11)],
        rounded_rectangle(0.024, 0.09, radius=0.011, steps=2), p.frame,
        scales=np.stack([np.ones(11), 0.75 + 0.25 * np.sin(np.linspace(0, np.pi, 11))], axis=1),
    )  # fmt: skip
    lower = back_half_width(p, 0.0)
    solids = [crest]
    for share in np.linspace(-1, 1, 2 * p.bars + 1):
        outer = abs(share) == 1.0
        low = _bowed(p, share * lower, lower, -0.02)
        high = _bowed(p, share * (half - 0.02), half, p.back_height - 0.06)
        path = np.linspace(low, high, 5)
        thick = 0.03 if outer else 0.019
        outline = ellipse(thick, thick, count=8)
        solids.append(sweep(path, outline, p.frame, scales=[0.8, 1.1, 1.2, 1.0, 0.7]))
    return solids


def _shell(p: ChairParameters) -> list[Solid]:
    """Seat and back as one curved plate."""
    return [sheet(shell_grid(p), _SHELL_THICKNESS, p.fabric)]


def shell_grid(p: ChairParameters) -> FloatArray:
    """The middle of a shell with raised sides, (21, 13, 3), from its front edge to its top."""
    front, y, h = -p.depth / 2, p.seat_height, p.back_height
    top, middle = back_point(p, h), back_point(p, 0.5 * h)
    knots = [
        (front, y - 0.02), (front + 0.06, y), (0.0, y - 0.02), (p.depth * 0.34, y + 0.0),
        (p.depth * 0.47, y + 0.08), (middle[2], middle[1]), (top[2], top[1]),
    ]  # fmt: skip
    spine = smooth_curve(knots, 21)
    along = np.linspace(0, 1, 21)
    # Narrower at the waist between seat and back, rounded off at both ends.
    width = p.width * (1 - 0.1 * np.exp(-(((along - 0.62) / 0.16) ** 2)))
    width *= np.clip(1 - np.abs(2 * along - 1) ** 7 * 0.22, 0, 1) * (1 - 0.1 * along)
    share = np.linspace(-1, 1, 13)
    raised = 0.055 * np.sin(np.pi * along) ** 0.6
    grid = np.empty((21, 13, 3))
    tangent = np.gradient(spine, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    lift = raised[:, None] * np.abs(share) ** 3
    grid[..., 0] = width[:, None] / 2 * share
    grid[..., 1] = spine[:, None, 1] + lift * tangent[:, None, 0]
    grid[..., 2] = spine[:, None, 0] - lift * tangent[:, None, 1]
    return grid


def _club_back(p: ChairParameters) -> list[Solid]:
    half = back_half_width(p, 1.0)
    low, high = back_point(p, -0.1), back_point(p, p.back_height)
    path = _rounded_end(np.array(low), np.array(high), 0.05)
    outline = rounded_rectangle(2 * half, 0.16, radius=0.05, steps=4)
    back = sweep(path, outline, p.fabric, scales=_END_SCALES)
    middle = back_point(p, 0.5 * p.back_height)
    pad = rounded_box(
        (0, middle[1] + 0.02, middle[2] - 0.085),
        (2 * half - 0.2, 0.75 * p.back_height, 0.08), lighter(p.fabric), radius=0.035, steps=3,
    )  # fmt: skip
    button_rows = [
        rod((0, middle[1], middle[2] - 0.12), (0, middle[1], middle[2] - 0.13), 0.012, p.frame)
    ]
    return [back, pad, *button_rows]


_END_SCALES = np.array([[1, 1], [1, 1], [1, 1], [0.985, 0.9], [0.95, 0.65], [0.92, 0.3]])


def _rounded_end(low: FloatArray, high: FloatArray, length: float) -> FloatArray:
    """A straight path whose last stations lie close together, for `_END_SCALES`."""
    total = float(np.linalg.norm(high - low))
    rest = 1 - np.array([length, 0.5 * length, 0.12 * length, 0.0]) / total
    shares = np.concatenate([[0.0, 0.5], rest])
    return np.asarray(low + shares[:, None] * (high - low))
