"""Parametric cars of seven kinds; container ships, sailing boats, motor yachts and tugs."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.sample.model import (
    Draft,
    Kind,
    beam,
    box,
    lathe,
    loft,
    palette,
    stack,
    table,
)

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


# The length is 1, the bow at z = -0.5 and the water line at y = 0. ``draft`` is the depth under
# water, ``side`` the height amidships, which rises by ``fore`` and ``aft`` at the ends; these hang
# over by ``bow`` and ``stern``. The hull is as wide as ``beam`` from ``entry`` on, its bow a wedge
# for ``full`` 1 and blunt for 3, its ``transom`` a share of the beam. ``lean`` is that of the front
# of the house. A mast has a radius, a ``rise`` and a place ``before`` the roof's rear end; a funnel
# has a place z and a radius.
_VESSELS = table("""
    kind  beam draft side fore aft  bow  stern entry full transom lean mast rise before z    funnel
    ship  .165 .04   .052 .03  .008 .045 .03   .2    2.2  .82     0    .005 .075 .0325  .433 .027
    sloop .275 .05   .072 .035 .01  .11  .07   .58   1.7  .6      .05  .011 .965 .29    0    0
    yacht .25  .035  .082 .045 0    .12  .02   .55   1.8  .88     .08  .006 .19  .08    0    0
    tug   .325 .07   .072 .08  .015 .05  .05   .38   2.3  .72     .01  .009 .2   .04    .08  .06
""")
# Height, width relative to the beam, and z of front and rear, from the lowest up.
_STOREYS = {
    "ship": 4 * [(0.034, 0.84, 0.3, 0.415)] + [(0.03, 1.0, 0.3075, 0.3625)],
    "sloop": [(0.065, 0.44, -0.11, 0.19)],
    "yacht": [(0.1, 0.74, -0.12, 0.3), (0.085, 0.65, -0.01, 0.23), (0.07, 0.57, 0.1, 0.16)],
    "tug": [(0.11, 0.62, -0.22, 0.12), (0.135, 0.484, -0.2, -0.04)],
}
# Of the lower and upper end of a storey's parts: height, width, and how far it juts out.
_WALL, _WINDOWS = ((0.0, 1.0, 0.0), (0.35, 1.0, 0.0)), ((0.35, 0.98, 0.0), (0.88, 0.94, 0.0))
_ROOF = ((0.88, 1.03, 0.2), (1.0, 1.0, 0.12))
_PLANKS = dict(zip(_STOREYS, palette("7e5c4e c49864 cca676 707670"), strict=True))
_WHITE, _BLACK, _PANES, _SPAR, _CLOTH = palette("f0f0ec 202226 1e2630 ced0d4 f6f3e8")
_BOTTOMS = palette("8c2620 6e2222 28423c")
_SIDES = palette("243e68 962824 225850 262c34 e2e2de 204a78")
_ACCENTS = palette("cc2c26 eea824 205ca0 2e7c4e e86a20")
_BULWARK = 0.011  # height of the side's edge above the deck


def vessel(rng: np.random.Generator, index: int) -> Draft:
    """Draw and build a vessel.

    Semantic ids, right (+x) before left: 0 top of the bow; 1 bow at the water line; 2, 3 corners of
    the stern; 4, 5 edge of the side amidships, 6, 7 a quarter of the length from the bow; 8, 9
    front and 10, 11 rear upper corners of the deck house; 12 the highest point; 13, 14 stern at the
    water line; 15 the funnel's top, where there is one.
    """
    turn, number = divmod(index, len(_VESSELS))
    sizes = {"beam": (0.92, 1.08), "side": (0.88, 1.12), "transom": (0.85, 1.08)}
    v, variant, tall = _VESSELS[number].varied(rng, **sizes), turn % 3, rng.uniform(0.92, 1.1)
    bottom, accent, draft = rng.choice(_BOTTOMS), rng.choice(_ACCENTS), Draft()
    color = _SIDES[(number + turn + rng.integers(2)) % len(_SIDES)]
    edge, water, inner = _outline(v, 1.0), _outline(v, 0.0), _outline(v, 1.0, inset=0.012)
    planks, low = inner - (0, _BULWARK, 0), v.side - _BULWARK
    draft.add(
        loft([_outline(v, level) for level in np.linspace(-1.0, 0.0, 6)], bottom),
        loft([water, _outline(v, 0.12)], _WHITE),  # a stripe above the water line
        loft([*(_outline(v, level) for level in np.linspace(0.12, 1.0, 5)), inner, planks], color),
        loft([planks - (0, 0.004, 0), planks + (0, 0.002, 0)], _PLANKS[v.kind]),
    )
    draft.places |= {0: edge[29], 1: water[29]}
    for right, place in ((2, edge[1]), (4, edge[11]), (6, edge[19]), (13, water[1])):
        draft.mark_pair(right, right + 1, place)

    if v.kind == "ship":  # seven bays of containers
        size = np.array((0.15 * v.beam, 0.028 * tall, 0.64 / 7))
        for bay, row, layer in np.ndindex(7, 2, 4):
            if layer < (3 if bay == 0 else 4 - (bay + row + variant) % 2):
                middle = np.add((row, layer, bay), 0.5) * size + (0, low, -0.36)
                color = _ACCENTS[(5 * bay + 3 * row + (2 + bay) * layer) % len(_ACCENTS)]
                draft.add_pair(box(middle, size * (0.95, 0.95, 0.92), color))
    elif v.kind == "sloop":  # a fin, a boom, mainsail and foresail, one of them coloured or none
        fin = [(-v.draft - 0.13, 0.03, -0.02, 0.14), (0.02 - v.draft, 0.026, -0.1, 0.16)]
        draft.add(stack(fin, bottom, radius=0.012))
        draft.add(box((0, low + 0.1, 0.1), (0.016, 0.016, 0.4), _SPAR))
        top, bulge = low + 1.02 * tall, 0.15 * np.sin(np.linspace(0, np.pi, 11))
        main = [(low + 0.112, 0.006, -0.088, 0.29), (top - 0.03, 0.006, -0.088, -0.076)]
        fore = [(low + 0.03, 0.006, -0.47, -0.12), (0.86 * top, 0.006, -0.13, -0.118)]
        for number, (foot, head) in ((2, main), (1, fore)):
            levels = np.linspace(foot, head, 11)
            levels[:, 3] += (foot[3] - foot[2]) * bulge
            draft.add(stack(levels, accent if variant == number else _CLOTH, radius=0.0))

    roofs, low = [], low - 0.01
    storeys = _STOREYS[v.kind][: (2, 3, 1)[variant] if v.kind == "yacht" else None]
    for number, (rise, share, front, rear) in enumerate(storeys, 1):
        high, width = rise * tall, share * v.beam
        roof = accent if v.funnel and number == len(storeys) else _WHITE
        for ends, color in ((_WALL, _WHITE), (_WINDOWS, _PANES), (_ROOF, roof)):
            y, x, out = np.transpose(ends)
            heads, tails = front - v.lean * (1 - y) - out * high, rear + out * high
            levels = np.column_stack([low + y * high, x * width, heads, tails])
            draft.add(stack(levels, color, radius=0.35 * high))
        roofs.append((width / 2, low + high, front, rear))
        low += high - 0.004
    x, y, front, rear = roofs[0 if v.kind == "yacht" else -1]
    draft.mark_pair(8, 9, (x, y, front))
    draft.mark_pair(10, 11, (x, y, rear))
    z, top = roofs[-1][3] - v.before, low + v.rise * tall
    mast = [(v.mast, low - 0.01), (0.6 * v.mast, top)]
    draft.add(lathe(mast, _SPAR, center=(0, 0, z), count=12))
    draft.add(box((0, 0.4 * low + 0.6 * top, z), (10 * v.mast, v.mast, v.mast), _SPAR))
    draft.places[12] = (0.0, top, z)
    if v.funnel:
        center, rim, top = (0, 0, v.z), low + 0.05 * tall - 0.03, low + 0.05 * tall
        lower, upper = [(1.0, low - 0.14), (0.97, rim)], [(0.95, rim), (0.93, top)]
        draft.add(lathe(np.multiply(lower, (v.funnel, 1)), accent, center=center))
        draft.add(lathe(np.multiply(upper, (v.funnel, 1)), _BLACK, center=center))
        draft.places[15] = (0.0, top, v.z)
    return draft


def _outline(v: Kind, level: float, inset: float = 0.0) -> FloatArray:
    """A closed line around the hull, from the middle of the stern over the right side.

    The level is -1 at the keel, 0 at the water line, 1 at the edge of the deck.
    """
    z = np.concatenate([np.linspace(0.5, -0.1, 13), np.linspace(-0.1, -0.5, 17)[1:]])
    fore, aft = np.clip((0.05 - z) / 0.55, 0, 1), np.clip((z - 0.1) / 0.4, 0, 1)
    y = v.draft * min(level, 0.0) + (v.side + v.fore * fore**2 + v.aft * aft**2) * max(level, 0.0)
    flare = 0.35 + 0.65 * np.sqrt(min((level + 1) / 1.75, 1.0))
    entry, transom = v.entry * (1.125 - 0.125 * level), v.transom * (0.725 + 0.275 * level)
    narrow = (1 - np.clip((z + 0.5) / entry, 0, 1)) ** v.full
    x = flare * v.beam / 2 * (1 - narrow) * (1 - (1 - transom) * np.clip(2.5 * z - 0.25, 0, 1) ** 2)
    bow, stern = (end * (1 - level) / 2 + 1.3 * inset for end in (v.bow, v.stern))
    z = z + bow * (0.5 - z) - stern * (0.5 + z)
    right = np.stack([np.maximum(x - inset, 0.0), y, z], axis=1)
    return np.concatenate([right[:1] * (0, 1, 1), right, right[-2::-1] * (-1, 1, 1)])
