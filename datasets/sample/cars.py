"""Parametric cars of seven kinds."""

from __future__ import annotations

import numpy as np

from cadalign.datasets.sample.model import Draft, table
from cadalign.datasets.sample.parts import beam, box, lathe, palette, stack

# Metres, but for positions along the car: shares of its length, 0 at the nose. ``nose``, ``belt``
# and ``tail`` are heights; the windscreen goes from ``cowl`` to ``roof``, the rear window from
# ``rear`` to ``deck``; ``lean`` is that of the sides; ``posts`` stand between the windows.
_CARS = table("""
    kind      length width height nose belt tail cowl roof rear deck axle back wheel lean sill posts
    sedan     4.6    1.8   1.45   .76  .92  .96  .27  .43  .69  .84  .18  .78  .32   .2   .2   3
    hatchback 4.0    1.74  1.48   .76  .93  .9   .25  .43  .88  .975 .19  .82  .31   .2   .2   3
    off-road  4.7    1.9   1.74   .95  1.08 1.06 .25  .38  .9   .965 .18  .79  .39   .15  .3   4
    sports    4.4    1.86  1.24   .73  .85  .87  .37  .53  .66  .9   .18  .8   .315  .26  .2   3
    estate    4.75   1.8   1.48   .76  .92  .94  .25  .4   .91  .975 .17  .77  .32   .2   .2   4
    city      3.45   1.62  1.54   .8   .95  .94  .17  .38  .92  .985 .19  .81  .29   .16  .2   3
    minibus   5.0    1.94  2.05   .98  1.18 1.12 .1   .24  .985 .995 .17  .78  .35   .1   .25  5
""")
_PAINTS = palette(
    "ba1e24 224e96 d6d8dc ecb228 3a7852 6e747c 3c3e46 ce6024 5aa0be eeece4 702238 96a078"
)
_GLASS, _DARK, _TRIM, _RIM, _LAMP, _RED = palette("1e2630 202023 3a3c40 c4c8ce faf6d6 d6161a")
# Profiles of radius, in radii of the wheel, and distance outward [metres].
_TYRE = ((0.92, -0.22), (1, -0.18), (1, -0.04), (0.94, 0.0), (0.7, 0.0), (0.68, -0.035))
_DISC = ((0.71, -0.05), (0.71, 0.006), (0.64, 0.006), (0.55, -0.005), (0.24, -0.005), (0.15, 0.014))
_ARCH = ((1.12, -0.2), (1.12, -0.008))


def car(rng: np.random.Generator, index: int) -> Draft:
    """Draw and build a car.

    Semantic ids, right (+x) before left: 0 to 3 front and rear corners of the roof; 4 to 7 middles
    of the front and rear wheels; 8, 9 head lamps; 10, 11 tail lamps; 12, 13 lower corners of the
    windscreen; 14 to 17 ends of the front and rear bumper; 18, 19 mirrors.
    """
    kind, shift = _CARS[index % len(_CARS)], rng.uniform(-0.012, 0.012)
    c = kind.varied(rng, length=(0.92, 1.08), width=(0.95, 1.05), height=(0.96, 1.06))
    shoulder, wheel = rng.uniform(0.12, 0.2), c.wheel * rng.uniform(0.97, 1.04)
    paint = _PAINTS[(5 * index + rng.integers(3)) % len(_PAINTS)]
    draft, half, end = Draft(), c.width / 2, c.length / 2

    def level(share: float, grow: float = 0.0) -> tuple[float, float, float, float]:
        """A section of the glass house, at the belt line for 0 and at the roof for 1."""
        front = (c.cowl + shift + share * (c.roof - c.cowl) - 0.5) * c.length - grow
        rear = (c.deck + share * (c.rear - c.deck) - 0.5) * c.length + grow
        y = c.belt + share * (c.height - 0.042 - c.belt)
        return y, c.width * (0.9 - c.lean * share) + 2 * grow, front, rear

    # The edge of bonnet and boot, from below: how far under it, and how far inside.
    edge = ((shoulder, 0.0), (0.35 * shoulder, 0.05), (0.0, 0.14))
    body = [
        (c.sill, c.width - 0.1, 0.1 - end, end - 0.1),
        (c.sill + 0.1, c.width, -end, end),
        *(((c.nose - y, c.tail - y), c.width - x, x - end, end - x) for y, x in edge),
        level(0.03, 0.02),
    ]
    y, wide, front, rear = level(1.0)
    ridge = (y + 0.042, wide - 0.5, 0.75 * front + 0.25 * rear, 0.22 * front + 0.78 * rear)
    roof = [level(0.86, 0.012), level(0.93, 0.012), level(1.0, -0.03), ridge]
    draft.add(
        stack(body, paint, radius=0.18),
        stack([level(-0.25, -0.07), level(0.0), level(0.92)], _GLASS, radius=0.12),
        stack(roof, paint, radius=0.12),
        box((0, c.nose - 0.16, -end), (0.78 * half, 0.15, 0.06), _DARK, radius=0.02),
    )
    draft.mark_pair(0, 1, (wide / 2, y, front))
    draft.mark_pair(2, 3, (wide / 2, y, rear))
    y, wide, front, _ = level(0.06)
    draft.mark_pair(12, 13, (wide / 2, y, front))
    (y, wide, *feet), (top, narrow, *heads) = level(-0.1, -0.03), level(0.92, -0.03)
    for foot, head in np.linspace((feet[0], heads[0]), (feet[1], heads[1]), int(c.posts)):
        draft.add_pair(beam([(wide / 2, y, foot), (narrow / 2, top, head)], (0.08, 0.05), paint))
    lamp, tail = (0.72 * half, c.nose - 0.15, 0.04 - end), (0.76 * half, c.tail - 0.16, end - 0.03)
    mirror = (half + 0.08, c.belt + 0.07, level(0.0)[2] + 0.36)
    draft.add_pair(
        box(lamp, (0.42 * half, 0.17, 0.2), _LAMP, radius=0.09, steps=3),
        box(tail, (0.3 * half, 0.18, 0.16), _RED, radius=0.03),
        box(mirror, (0.2, 0.15, 0.12), paint, radius=0.06, steps=3),
    )
    draft.mark_pair(8, 9, (0.78 * half, c.nose - 0.09, -end - 0.1))
    draft.mark_pair(10, 11, (0.84 * half, c.tail - 0.14, end + 0.1))
    draft.mark_pair(18, 19, (half + 0.16, *mirror[1:]))
    for first, share, sign in ((4, c.axle, -1), (6, c.back, 1)):
        z = (share - 0.5) * c.length
        for profile, color, lift in ((_TYRE, _DARK, 1), (_DISC, _RIM, 1), (_ARCH, _DARK, 1.12)):
            hub, turned = (half + 0.012, lift * wheel, z), np.multiply(profile, (wheel, 1))
            draft.add_pair(lathe(turned, color, center=hub, sideways=True))
        long = 0.06 + min(0.36, end - abs(z) - 1.22 * wheel)
        middle, size = (0, 0.41, sign * (end + 0.065 - long / 2)), (1.97 * half, 0.2, long)
        draft.add(box(middle, size, _TRIM, radius=0.07, steps=3))
        draft.mark_pair(first, first + 1, (half + 0.05, wheel, z))
        draft.mark_pair(first + 10, first + 11, (0.89 * half, 0.42, sign * (end + 0.1)))
    return draft
