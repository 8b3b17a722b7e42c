"""Wheels, wheel arches, lamps and trim of sample cars."""

from __future__ import annotations

import numpy as np

from cadalign.datasets.sample.car_style import CarParameters
from cadalign.datasets.sample.outlines import rounded_rectangle, smooth_curve
from cadalign.datasets.sample.solids import (
    Solid,
    beam,
    both_sides,
    box,
    ellipsoid,
    rounded_box,
    sweep,
    wheel,
)

_TYRE = (30, 30, 32)
_DARK = (34, 34, 38)
_TRIM = (58, 60, 64)
_CHROME = (190, 194, 200)
_HEAD_LAMP = (250, 246, 214)
_TAIL_LAMP = (214, 22, 26)
_PLATE = (240, 240, 230)


def arch_stations(p: CarParameters, axle: float, reach: float) -> list[tuple[float, float]]:
    """Positions along the car and the body's lower edge there, around a wheel."""
    angle = np.linspace(0, np.pi, 13)
    z, y = axle + reach * np.cos(angle), p.wheel_radius + reach * np.sin(angle)
    arch = list(zip(z.tolist(), y.tolist(), strict=True))
    foot = reach + 0.002
    return [*arch, (axle - foot, p.sill), (axle + foot, p.sill)]


def wheel_set(p: CarParameters) -> list[Solid]:
    """Four wheels, and the dark inside of the arches."""
    solids = []
    for z in (p.z_front_axle, p.z_rear_axle):
        solids += _wheel(p, z)
    return [*both_sides(*solids), *(_axle_box(p, z) for z in (p.z_front_axle, p.z_rear_axle))]


def _axle_box(p: CarParameters, z: float) -> Solid:
    """A dark block between two wheels, so that one doesn't see through under the car."""
    size = (1.2 * (p.width - 0.5), 1.2 * p.wheel_radius, 2.5 * p.wheel_radius)
    return box((0, p.sill + 0.5 * size[1], z), size, _DARK)


def _wheel(p: CarParameters, z: float) -> list[Solid]:
    """The right wheel at z: tyre, rim, spokes and hub."""
    r, outer = p.wheel_radius, p.width / 2 + 0.012
    center = (outer, r, z)
    tyre = [(0, -0.22), (0.92 * r, -0.22), (r, -0.18), (r, -0.04), (0.94 * r, 0.0),
            (0.7 * r, 0.0), (0.68 * r, -0.035), (0, -0.035)]  # fmt: skip
    hub = [(0, -0.05), (0.17 * r, -0.05), (0.15 * r, 0.01), (0, 0.014)]
    solids = [wheel(center, tyre, _TYRE, count=24), wheel(center, hub, p.rim, count=12)]
    rim = [
        (0, -0.05),
        (0.7 * r, -0.05),
        (0.71 * r, 0.006),
        (0.64 * r, 0.006),
        (0.62 * r, -0.03),
        (0, -0.03),
    ]
    solids.append(wheel(center, rim, p.rim, count=20))
    solids.append(
        wheel(center, [(0, -0.04), (0.6 * r, -0.04), (0.6 * r, -0.02), (0, -0.02)], _TRIM, count=16)
    )
    for angle in 2 * np.pi * np.arange(p.spokes) / p.spokes:
        tip = np.array([-0.008, 0.64 * r * np.cos(angle), 0.64 * r * np.sin(angle)])
        root = np.array([-0.004, 0.1 * r * np.cos(angle), 0.1 * r * np.sin(angle)])
        solids.append(
            beam(
                root + center,
                tip + center,
                (0.022, 0.13 * r),
                p.rim,
                taper=0.8,
                side=(1, 0, 0),
                bevel=False,
            )
        )
    return solids


def lamps_and_trim(p: CarParameters) -> list[Solid]:
    """Lamps, grille, bumpers, number plates, mirrors, door gaps and handles."""
    return [*_front(p), *_rear(p), *_sides(p)]


def _front(p: CarParameters) -> list[Solid]:
    z, half = -p.length / 2, p.width / 2
    y = p.nose - 0.15
    lamp = ellipsoid((0.72 * half, y, z + 0.04), (0.42 * half, 0.17, 0.2), _HEAD_LAMP, count=12)
    grille = rounded_box(
        (0, y - 0.01, z + 0.0), (0.78 * half, 0.15, 0.06), _DARK, radius=0.02, steps=1
    )
    bars = [
        box((0, y - 0.01 + d, z - 0.028), (0.74 * half, 0.014, 0.02), _CHROME)
        for d in (-0.035, 0.0, 0.035)
    ]
    plate = box((0, 0.4, z - 0.115), (0.5, 0.1, 0.02), _PLATE)
    return [*both_sides(lamp), grille, *bars, _bumper(p, -1.0, 0.4), plate]


def _rear(p: CarParameters) -> list[Solid]:
    z, half = p.length / 2, p.width / 2
    tall = 0.34 if p.kind in ("van", "suv") else 0.16
    lamp = rounded_box(
        (0.76 * half, p.tail_lamp - 0.5 * tall + 0.06, z - 0.03), (0.3 * half, tall, 0.16),
        _TAIL_LAMP, radius=0.03,
    )  # fmt: skip
    plate = box((0, p.tail - 0.24, z + 0.002), (0.52, 0.11, 0.02), _PLATE)
    return [*both_sides(lamp), _bumper(p, 1.0, 0.42), plate]


def _bumper(p: CarParameters, direction: float, height: float) -> Solid:
    """A rail around the front (-1) or rear (+1) end."""
    end, half = p.length / 2, p.width / 2
    axle = p.z_front_axle if direction < 0 else p.z_rear_axle
    reach = min(0.36, end - abs(axle) - 1.22 * p.wheel_radius)
    corner = p.half_width(direction * end)
    right = [
        (half * 0.99, end - reach),
        (half * 0.96, end - 0.4 * reach),
        (corner, end + 0.03),
    ]
    right += [(half * 0.4, end + 0.06)]
    knots = [*right, (0.0, end + 0.065), *((-x, z) for x, z in reversed(right))]
    curve = smooth_curve(knots, 17)
    path = np.stack([curve[:, 0], np.full(17, height), direction * curve[:, 1]], axis=1)
    path[:, 0] = (path[:, 0] - path[::-1, 0]) / 2
    section = rounded_rectangle(0.2, 0.08, radius=0.03, steps=1)
    color = _TRIM if p.kind in ("pickup", "van", "suv", "city") else _darker(p.paint)
    return sweep(path, section, color, side=(0, 1, 0))


def _darker(color: tuple[int, int, int]) -> tuple[int, int, int]:
    r, g, b = (round(0.72 * value) for value in color)
    return r, g, b


def _sides(p: CarParameters) -> list[Solid]:
    half = p.width / 2
    mirror_z = p.z_cowl + 0.36
    mirror = ellipsoid((half + 0.08, p.belt + 0.07, mirror_z), (0.2, 0.15, 0.12), p.paint, count=12)
    stalk = beam((half - 0.12, p.belt + 0.01, mirror_z), (half + 0.06, p.belt + 0.05, mirror_z),
                 (0.04, 0.04), _DARK)  # fmt: skip
    solids = [mirror, stalk]
    shoulder = p.belt - p.shoulder_drop
    front, rear = p.z_front_axle + 1.4 * p.wheel_radius, p.z_rear_axle - 1.4 * p.wheel_radius
    gaps = [front + 0.12, *(z for z in p.pillars if z < rear)]
    for z in gaps:
        x = p.half_width(z)
        low = p.sill + 0.45 * (shoulder - p.sill)
        solids.append(
            box((x - 0.004, (low + shoulder) / 2, z), (0.016, shoulder - low, 0.014), _DARK)
        )
    for z in p.pillars:
        if z < rear + 0.1:
            x = p.half_width(z)
            solids.append(
                rounded_box(
                    (x, shoulder - 0.04, z - 0.16), (0.04, 0.03, 0.17), _TRIM, radius=0.01, steps=1
                )
            )
    skirt = (p.width / 2 - 0.03, p.sill + 0.03, (front + rear) / 2)
    solids.append(
        rounded_box(skirt, (0.08, 0.07, rear - front + 0.06), _TRIM, radius=0.02, steps=1)
    )
    return both_sides(*solids)
