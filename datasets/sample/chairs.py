"""Parametric chairs: several kinds of legs and backs, with and without armrests."""

from __future__ import annotations

import numpy as np

from cadalign.datasets.sample.model import Draft
from cadalign.datasets.sample.parts import beam, box, lathe, palette

# Base, back, and armrests or none.
_STYLES = (
    ("straight", "slats", False), ("swivel", "panel", True), ("splayed", "panel", False),
    ("straight", "ladder", True), ("tapered", "panel", True), ("splayed", "slats", False),
    ("straight", "panel", True), ("tapered", "panel", False), ("swivel", "panel", False),
    ("splayed", "slats", True), ("tapered", "ladder", False), ("tapered", "slats", True),
)  # fmt: skip
# How far the feet stand out and the legs' tops lie inside [metres]; thickness of top and foot.
_LEGS = {
    "straight": (-0.023, 0.023, (1.0, 1.0)),
    "tapered": (0.0, 0.03, (1.15, 0.7)),
    "splayed": (0.03, 0.1, (1.1, 0.6)),
}
# Ranges of the seat's width, depth, height, thickness, of the back's length, tilt, of a leg's size.
_LEAST, _MOST = (0.4, 0.4, 0.42, 0.028, 0.38, 5, 0.032), (0.52, 0.5, 0.5, 0.05, 0.58, 13, 0.046)
_WOODS = palette("966236 ba8650 603c26 cea470 7a4628 462e22")
_METALS = palette("a8acb2 34363a 787c82")
_FABRICS = palette("ac342e 2c5484 46764e d4a03c 784a78 42464e c4baa8 28787e")
(_DARK,) = palette("26262a")


def chair(rng: np.random.Generator, index: int) -> Draft:
    """Draw and build a chair.

    Semantic ids are those of KeypointNet's chairs: 0, 1 top corners of the back; 2, 3 rear and
    4, 5 front corners of the seat; 6 to 9 ends of the armrests; 10 to 14 tips of a swivel base;
    17 to 20 feet. Three more are this data set's own: 21, 22 the sides of the back and 23 the
    middle of its top.
    """
    base, back, has_arms = _STYLES[index % len(_STYLES)]
    width, depth, seat, thickness, tall, tilt, leg = rng.uniform(_LEAST, _MOST).tolist()
    bars, is_cushioned, is_wooden = rng.integers(3, 6), rng.random() < 0.6, base != "swivel"
    frame, fabric = rng.choice(_WOODS if is_wooden else _METALS), rng.choice(_FABRICS)
    draft, half = Draft(), width / 2
    color = np.round(frame + 0.2 * (255 - frame)) if is_wooden else fabric
    middle, size = (0.0, seat - thickness / 2, 0.0), (width, thickness, depth)
    draft.add(box(middle, size, color, radius=0.4 * thickness))
    if is_cushioned or back == "panel":
        middle, size = (0.0, seat + 0.012, -0.01), (width - 0.03, 0.045, depth - 0.05)
        draft.add(box(middle, size, fabric, radius=0.02, steps=4))
    draft.mark_pair(2, 3, (half, seat, 0.43 * depth))
    draft.mark_pair(4, 5, (half, seat, -depth / 2))

    def at(share: float, x: float, hollow: float = 0.0) -> tuple[float, float, float]:
        """A point of the back at a share of its height."""
        slope, along = np.radians(tilt), share * tall
        z = depth / 2 - 0.025 + along * np.sin(slope) + hollow
        return x, seat + along * np.cos(slope), z

    if back == "panel":  # an upholstered board with rounded edges before two posts
        scales = [(0.92, 0.35), (0.97, 0.75), (1, 1), (1, 1), (0.97, 0.75), (0.92, 0.35)]
        path = [at(share, 0.0) for share in (0.28, 0.285, 0.31, 0.97, 0.995, 1.0)]
        draft.add(beam(path, (width - leg, 0.05), fabric, scales=scales, radius=0.02))
        post = [at(share, half - leg, 0.018) for share in (-0.1, 0.8)]
        draft.add_pair(beam(post, (0.028, 0.022), frame))
    else:  # two posts with slats or the rungs of a ladder between them, hollowed
        side, rungs = half - 0.8 * leg, [(0.93, 0.07), (0.2, 0.04)]
        post = [at(share, side) for share in (-0.06, 1.0)]
        draft.add_pair(beam(post, (0.8 * leg, leg), frame, scales=(1, 0.85)))
        if back == "ladder":
            rungs = [(share, 0.06) for share in np.linspace(0.28, 0.9, bars)]
        else:
            for x in np.linspace(-side, side, bars + 2)[1:-1]:
                path = [at(share, x, 0.025 * (1 - (x / side) ** 2)) for share in (0.2, 0.93)]
                draft.add(beam(path, (0.75 * side / bars, 0.014), frame))
        for share, high in rungs:
            xs = np.linspace(-side, side, 9)
            path = [at(share, x, 0.025 * (1 - (x / side) ** 2)) for x in xs]
            draft.add(beam(path, (0.022, high), frame))
    draft.mark_pair(0, 1, at(1.0, half - 0.5 * leg))
    draft.mark_pair(21, 22, at(0.84, half + 0.08))
    draft.places[23] = at(1.2, 0.0)

    if has_arms:  # each on a post in front
        (x, y, rear), front = at(0.22 / tall, half + 0.01), -0.32 * depth
        middle, size = (x, y - 0.012, (front + rear) / 2), (0.05, 0.024, rear - front)
        path = [(half - 0.012, seat - 0.6 * thickness, front + 0.04), (x, y - 0.01, front + 0.04)]
        draft.add_pair(box(middle, size, frame if is_wooden else _DARK, radius=0.01))
        draft.add_pair(beam(path, (0.026, 0.034), frame))
        draft.mark_pair(6, 8, (x + 0.025, y, front))
        draft.mark_pair(7, 9, (x + 0.025, y, rear))
    if is_wooden:  # four legs, and bars between straight ones
        out, inset, taper = _LEGS[base]
        x, z, top = half + out, depth / 2 + out, seat - 0.4 * thickness
        for right, left, sign in ((17, 20, -1), (18, 19, 1)):
            path = [(half - inset, top, sign * (depth / 2 - inset)), (x, 0, sign * z)]
            draft.add_pair(beam(path, (leg, leg), frame, scales=taper))
            draft.mark_pair(right, left, (x + leg, 0.01, sign * (z + leg)))
        if base == "straight":
            draft.add_pair(beam([(x, 0.16, -z), (x, 0.16, z)], (0.02, 0.028), frame))
            draft.add(beam([(-x, 0.16, 0), (x, 0.16, 0)], (0.02, 0.028), frame))
        return draft

    column = [(0.045, 0.06), (0.045, 0.13), (0.03, 0.15), (0.03, 0.24), (0.018, 0.245)]
    plate = [(0.018, seat - 0.08), (0.09, seat - 0.05), (0.09, seat - 0.01)]
    draft.add(lathe(column + plate, frame, count=20))
    draft.turned.append((10, 11, 12, 13, 14))
    for number, degrees in zip(*draft.turned, (144, 72, 0, -72, -144), strict=True):
        angle = np.radians(degrees)  # from +z towards +x
        x, z = 0.58 * width * np.sin(angle), 0.58 * width * np.cos(angle)
        spoke, castor = [(0, 0.115, 0), (x, 0.075, z)], (0.96 * x, 0.03, 0.96 * z)
        draft.add(beam(spoke, (0.05, 0.036), frame, scales=(1, 0.6), side=(z, 0, -x)))
        draft.add(box(castor, (0.05, 0.06, 0.05), _DARK, radius=0.03, steps=3))
        draft.places[number] = (x, 0.09, z)
    return draft
