"""Outlines in a plane, and smooth curves, for the solids of the sample models."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cadalign.arrays import FloatArray


def ellipse(width: float, height: float, *, count: int = 16, exponent: float = 2.0) -> FloatArray:
    """An outline (count, 2): an ellipse, or for larger exponents a rounder and rounder rectangle.

    It starts at the top and is mirror symmetric in its first coordinate. A superellipse (Lame
    curve), ``|x/a|^exponent + |y/b|^exponent = 1``.
    """
    angle = 2 * np.pi * np.arange(count) / count
    sine, cosine = np.round(np.sin(angle), 12), np.round(np.cos(angle), 12)
    power = 2.0 / exponent
    x = np.sign(sine) * np.abs(sine) ** power
    y = np.sign(cosine) * np.abs(cosine) ** power
    return np.stack([x * width / 2, y * height / 2], axis=1)


def rounded_rectangle(
    width: float, height: float, *, radius: float = 0.0, steps: int = 2
) -> FloatArray:
    """An outline (n, 2): a rectangle with round corners, starting at the middle of its top."""
    radius = max(min(radius, 0.499 * width, 0.499 * height), 0.0)
    angle = np.linspace(0, np.pi / 2, steps + 1)
    x = width / 2 - radius + radius * np.sin(angle)
    y = height / 2 - radius + radius * np.cos(angle)
    top = np.array([[0.0, height / 2]])
    upper = np.stack([x, y], axis=1)
    lower = upper[::-1] * (1, -1)
    right = np.concatenate([upper, [[width / 2, 0.0]], lower])
    return np.concatenate([top, right, -top, right[::-1] * (-1, 1)])


def smooth_curve(knots: Sequence[tuple[float, ...]], count: int) -> FloatArray:
    """A smooth curve through knots, (count, d) float: a Catmull-Rom spline."""
    points = np.asarray(knots, dtype=float)
    padded = np.concatenate([[2 * points[0] - points[1]], points, [2 * points[-1] - points[-2]]])
    position = np.linspace(0, len(points) - 1, count)
    segment = np.minimum(position.astype(int), len(points) - 2)
    t = (position - segment)[:, None]
    p0, p1, p2, p3 = (padded[segment + k] for k in range(4))
    return np.asarray(
        0.5
        * (
            2 * p1
            + (p2 - p0) * t
            + (2 * p0 - 5 * p1 + 4 * p2 - p3) * t**2
            + (3 * p1 - p0 - 3 * p2 + p3) * t**3
        )
    )
