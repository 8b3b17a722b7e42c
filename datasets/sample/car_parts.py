"""Wheels, lamps and trim of sample cars."""

from __future__ import annotations

import numpy as np

from cadalign.datasets.sample import solids as make
from cadalign.datasets.sample.car_shape import CarShape
from cadalign.datasets.sample.solids import Color, Solid

_TYRE = (30, 30, 32)
_DARK = (34, 34, 38)
_TRIM = (58, 60, 64)
_CHROME = (190, 194, 200)
_HEAD_LAMP = (250, 246, 214)
_TAIL_LAMP = (214, 22, 26)
_PLATE = (240, 240, 230)


def wheels(p: CarShape) -> list[Solid]:
    """Four wheels, and between two a dark block, so that one doesn't see through under the car."""
    size = (1.2 * (p.width - 0.5), 1.2 * p.wheel_radius, 2.5 * p.wheel_radius)
    blocks = (make.box((0, p.sill + 0.5 * size[1], z), size, _DARK) for z in p.z_axles)
    return [*make.both_sides(*(part for z in p.z_axles for part in _wheel(p, z))), *blocks]


def _wheel(p: CarShape, z: float) -> list[Solid]:
    """The right wheel at z: tyre, rim, disc, hub and spokes."""
    r = p.wheel_radius
    center = np.array([p.width / 2 + 0.012, r, z])
    tyre = [(0, -0.22), (0.92, -0.22), (1, -0.18), (1, -0.04), (0.94, 0.0), (0.7, 0.0),
            (0.68, -0.035), (0, -0.035)]  # fmt: skip
    rim = [(0, -0.05), (0.7, -0.05), (0.71, 0.006), (0.64, 0.006), (0.62, -0.03), (0, -0.03)]
    disc = [(0, -0.04), (0.6, -0.04), (0.6, -0.02), (0, -0.02)]
    hub = [(0, -0.05), (0.17, -0.05), (0.15, 0.01), (0, 0.014)]
    turned = ((tyre, _TYRE, 24), (hub, p.rim, 12), (rim, p.rim, 20), (disc, _TRIM, 16))
    solids = [
        make.wheel(center, np.array(profile) * (r, 1), color, count=count)
        for profile, color, count in turned
    ]
    for angle in 2 * np.pi * np.arange(p.spokes) / p.spokes:
        outward = r * np.array([0, np.cos(angle), np.sin(angle)])
        root, tip = center + 0.1 * outward - (0.004, 0, 0), center + 0.64 * outward - (0.008, 0, 0)
        size = (0.022, 0.13 * r)
        solids.append(make.beam(root, tip, size, p.rim, taper=0.8, side=(1, 0, 0), bevel=False))
    return solids


def trim(p: CarShape) -> list[Solid]:
    """Lamps, grille, bumpers, number plates, mirrors, door gaps and handles."""
    return [*_front(p), *_rear(p), *_sides(p)]


def _front(p: CarShape) -> list[Solid]:
    z, half, y = -p.length / 2, p.width / 2, p.nose - 0.15
    lamp = make.ellipsoid(
        (0.72 * half, y, z + 0.04), (0.42 * half, 0.17, 0.2), _HEAD_LAMP, count=12
    )
    grille = make.rounded_box(
        (0, y - 0.01, z), (0.78 * half, 0.15, 0.06), _DARK, radius=0.02, steps=1
    )
    bars = (
        make.box((0, y - 0.01 + lift, z - 0.028), (0.74 * half, 0.014, 0.02), _CHROME)
        for lift in (-0.035, 0.0, 0.035)
    )
    plate = make.box((0, 0.4, z - 0.115), (0.5, 0.1, 0.02), _PLATE)
    return [*make.both_sides(lamp), grille, *bars, _bumper(p, -1.0, 0.4), plate]


def _rear(p: CarShape) -> list[Solid]:
    z, half = p.length / 2, p.width / 2
    tall = 0.34 if p.kind in ("van", "suv") else 0.16
    center = (0.76 * half, p.tail_lamp - 0.5 * tall + 0.06, z - 0.03)
    lamp = make.rounded_box(center, (0.3 * half, tall, 0.16), _TAIL_LAMP, radius=0.03)
    plate = make.box((0, p.tail - 0.24, z + 0.002), (0.52, 0.11, 0.02), _PLATE)
    return [*make.both_sides(lamp), _bumper(p, 1.0, 0.42), plate]


def _bumper(p: CarShape, direction: float, height: float) -> Solid:
    """A rail around the front (-1) or rear (+1) end."""
    end, half = p.length / 2, p.width / 2
    axle = p.z_axles[0 if direction < 0 else 1]
    reach = min(0.36, end - abs(axle) - 1.22 * p.wheel_radius)
    right = np.array([
        (half * 0.99, end - reach), (half * 0.96, end - 0.4 * reach),
        (p.half_width(direction * end), end + 0.03), (half * 0.4, end + 0.06),
    ])  # fmt: skip
    x, z = make.smooth_curve([*right, (0.0, end + 0.065), *right[::-1] * (-1, 1)], 17).T
    path = np.stack([(x - x[::-1]) / 2, np.full(17, height), direction * z], axis=1)
    section = make.rounded_rectangle(0.2, 0.08, radius=0.03, steps=1)
    color = _TRIM if p.kind in ("pickup", "van", "suv", "city") else _darker(p.paint)
    return make.sweep(path, section, color, side=(0, 1, 0))


def _darker(color: Color) -> Color:
    r, g, b = (round(0.72 * value) for value in color)
    return r, g, b


def _sides(p: CarShape) -> list[Solid]:
    half, z = p.width / 2, p.z_cowl + 0.36
    mirror = make.ellipsoid((half + 0.08, p.belt + 0.07, z), (0.2, 0.15, 0.12), p.paint, count=12)
    root, tip = (half - 0.12, p.belt + 0.01, z), (half + 0.06, p.belt + 0.05, z)
    solids = [mirror, make.beam(root, tip, (0.04, 0.04), _DARK)]
    shoulder = p.belt - p.shoulder_drop
    front, rear = p.z_axles[0] + 1.4 * p.wheel_radius, p.z_axles[1] - 1.4 * p.wheel_radius
    low = p.sill + 0.45 * (shoulder - p.sill)
    for z in (front + 0.12, *(z for z in p.pillars if z < rear)):
        center = (p.half_width(z) - 0.004, (low + shoulder) / 2, z)
        solids.append(make.box(center, (0.016, shoulder - low, 0.014), _DARK))
    for z in (z for z in p.pillars if z < rear + 0.1):
        handle = (p.half_width(z), shoulder - 0.04, z - 0.16)
        solids.append(make.rounded_box(handle, (0.04, 0.03, 0.17), _TRIM, radius=0.01, steps=1))
    skirt = (half - 0.03, p.sill + 0.03, (front + rear) / 2)
    size = (0.08, 0.07, rear - front + 0.06)
    return make.both_sides(*solids, make.rounded_box(skirt, size, _TRIM, radius=0.02, steps=1))
