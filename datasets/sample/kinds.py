"""Builders of parametric chairs, bottles, cars and vessels with random measures."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.sample.parts import (
    Draft,
    beam,
    box,
    lathe,
    loft,
    read_designs,
    select_kind,
    stack,
)

_CHAIR, _BOTTLE, _CAR, _VESSEL = read_designs("chair", "bottle", "car", "vessel")
_EDGE = 0.022  # radius of the rounded edge of a bottle's bottom


def chair(rng: np.random.Generator, index: int) -> Draft:
    """Draw the measures of a chair and build it.

    Semantic ids follow KeypointNet's chairs: 0, 1 top corners of the back; 2, 3 rear and 4, 5 front
    corners of the seat; 6 to 9 ends of the armrests; 10 to 14 tips of a swivel base; 17 to 20
    feet. Three are specific to this data set: 21, 22 the sides of the back and 23 the middle of
    its top.
    """
    style = select_kind(_CHAIR.kinds, index)
    measures = rng.uniform(_CHAIR.least, _CHAIR.most).tolist()
    width, depth, seat, thickness, tall, tilt, leg = measures
    bars, is_cushioned, is_wooden = rng.integers(3, 6), rng.random() < 0.6, style.base != "swivel"
    frame = rng.choice(_CHAIR.woods if is_wooden else _CHAIR.metals)
    fabric = rng.choice(_CHAIR.fabrics)
    draft, half = Draft(), width / 2
    color = np.round(frame + 0.2 * (255 - frame)) if is_wooden else fabric
    middle, size = (0.0, seat - thickness / 2, 0.0), (width, thickness, depth)
    draft.add(box(middle, size, color, radius=0.4 * thickness))
    if is_cushioned or style.back == "panel":
        middle, size = (0.0, seat + 0.012, -0.01), (width - 0.03, 0.045, depth - 0.05)
        draft.add(box(middle, size, fabric, radius=0.02))
    draft.mark_pair(2, 3, (half, seat, 0.43 * depth))
    draft.mark_pair(4, 5, (half, seat, -depth / 2))

    def at(share: float, x: float, hollow: float = 0.0) -> tuple[float, float, float]:
        """A point of the back at a fraction of its height."""
        slope, along = np.radians(tilt), share * tall
        z = depth / 2 - 0.025 + along * np.sin(slope) + hollow
        return x, seat + along * np.cos(slope), z

    if style.back == "panel":  # an upholstered board with rounded edges before two posts
        scales = [(0.92, 0.35), (0.97, 0.75), (1, 1), (1, 1), (0.97, 0.75), (0.92, 0.35)]
        path = [at(share, 0.0) for share in (0.28, 0.285, 0.31, 0.97, 0.995, 1.0)]
        draft.add(beam(path, (width - leg, 0.05), fabric, scales=scales, radius=0.02))
        post = [at(share, half - leg, 0.018) for share in (-0.1, 0.8)]
        draft.add_pair(beam(post, (0.028, 0.022), frame))
    else:  # slats and two rails between two posts, hollowed
        side, post = half - 0.8 * leg, [at(share, half - 0.8 * leg) for share in (-0.06, 1.0)]
        draft.add_pair(beam(post, (0.8 * leg, leg), frame, scales=(1, 0.85)))
        for x in np.linspace(-side, side, bars + 2)[1:-1]:
            path = [at(share, x, 0.025 * (1 - (x / side) ** 2)) for share in (0.2, 0.93)]
            draft.add(beam(path, (0.75 * side / bars, 0.014), frame))
        for share, high in ((0.93, 0.07), (0.2, 0.04)):
            xs = np.linspace(-side, side, 9)
            path = [at(share, x, 0.025 * (1 - (x / side) ** 2)) for x in xs]
            draft.add(beam(path, (0.022, high), frame))
    draft.mark_pair(0, 1, at(1.0, half - 0.5 * leg))
    draft.mark_pair(21, 22, at(0.84, half + 0.08))
    draft.places[23] = at(1.2, 0.0)

    if style.arms:  # each on a post in front
        (x, y, rear), front = at(0.22 / tall, half + 0.01), -0.32 * depth
        middle, size = (x, y - 0.012, (front + rear) / 2), (0.05, 0.024, rear - front)
        path = [(half - 0.012, seat - 0.6 * thickness, front + 0.04), (x, y - 0.01, front + 0.04)]
        draft.add_pair(box(middle, size, frame if is_wooden else _CHAIR.black, radius=0.01))
        draft.add_pair(beam(path, (0.026, 0.034), frame))
        draft.mark_pair(6, 8, (x + 0.025, y, front))
        draft.mark_pair(7, 9, (x + 0.025, y, rear))
    if is_wooden:  # four legs, and bars between straight ones
        out, inset, taper = _CHAIR.legs[style.base]
        x, z, top = half + out, depth / 2 + out, seat - 0.4 * thickness
        for right, left, sign in ((17, 20, -1), (18, 19, 1)):
            path = [(half - inset, top, sign * (depth / 2 - inset)), (x, 0, sign * z)]
            draft.add_pair(beam(path, (leg, leg), frame, scales=taper))
            draft.mark_pair(right, left, (x + leg, 0.01, sign * (z + leg)))
        if style.base == "straight":
            draft.add_pair(beam([(x, 0.16, -z), (x, 0.16, z)], (0.02, 0.028), frame))
            draft.add(beam([(-x, 0.16, 0), (x, 0.16, 0)], (0.02, 0.028), frame))
        return draft

    column = [(0.045, 0.06), (0.045, 0.13), (0.03, 0.15), (0.03, 0.24), (0.018, 0.245)]
    plate = [(0.018, seat - 0.08), (0.09, seat - 0.05), (0.09, seat - 0.01)]
    draft.add(lathe(column + plate, frame, count=20))
    draft.rotation_groups.append((10, 11, 12, 13, 14))
    for number, degrees in zip(*draft.rotation_groups, (144, 72, 0, -72, -144), strict=True):
        angle = np.radians(degrees)  # from +z towards +x
        x, z = 0.58 * width * np.sin(angle), 0.58 * width * np.cos(angle)
        castor = (0.96 * x, 0.03, 0.96 * z)
        draft.add(beam([(0, 0.115, 0), (x, 0.075, z)], (0.05, 0.036), frame, scales=(1, 0.6)))
        draft.add(box(castor, (0.05, 0.06, 0.05), _CHAIR.black, radius=0.03))
        draft.places[number] = (x, 0.09, z)
    return draft


def bottle(rng: np.random.Generator, index: int) -> Draft:
    """Draw the measures of a bottle and build it.

    Semantic ids follow KeypointNet's bottles: 0 to 3 around the base, 4 to 7 around the shoulder,
    8 the middle of the top, 9 to 12 around the top's rim, 13 to 16 around the lower end of the
    neck.
    """
    color, b = rng.choice(_BOTTLE.cap_colors), select_kind(_BOTTLE.kinds, index)
    b.radius *= rng.uniform(0.9, 1.14)
    b.shoulder += rng.uniform(-0.03, 0.03)
    b.neck += rng.uniform(-0.02, 0.02)
    b.neck_radius *= rng.uniform(0.92, 1.1)
    cap = np.array(_BOTTLE.caps[b.cap]) * (b.neck_radius, 1)
    cap[:, 1] = np.maximum(cap[:, 1], b.neck + 0.025)
    knots = [_EDGE, b.shoulder, b.neck, max(cap[0, 1], b.neck + 0.06) + 0.01]
    heights = np.interp(np.arange(-4, 33), [0, 15, 29, 32], knots)
    heights[:4] = _EDGE * (1 - np.cos(np.linspace(0, np.pi / 2, 5)))[:4]
    paper = np.linspace(b.low, min(b.high, b.shoulder - 0.04), 9)
    draft = Draft(is_round=True)
    draft.add(
        lathe(_profile(b, heights), rng.choice(_BOTTLE.glass[b.glass]), count=40),
        lathe(cap, color, count=40),
        lathe(_profile(b, paper) * (1.012, 1), rng.choice(_BOTTLE.labels), count=40),
        lathe(_profile(b, paper[5:8]) * (1.02, 1), rng.choice(_BOTTLE.stripes), count=40),
    )
    rim, top = cap[-1]
    draft.places[8] = (0.0, top + 0.1, 0.0)
    for first, y in ((0, 0.02), (4, b.shoulder), (9, top - 0.004), (13, b.neck)):
        x = z = np.sqrt(0.5) * (rim if first == 9 else _profile(b, np.array([y]))[0, 0])
        around = (first, first + 1, first + 2, first + 3)
        corners = ((x, y, -z), (x, y, z), (-x, y, z), (-x, y, -z))  # KeypointNet's order
        draft.places |= zip(around, corners, strict=True)
        draft.mirror_pairs += [(around[i - 1], around[i]) for i in range(4)]
        draft.rotation_groups.append(around)
    return draft


def _profile(b: SimpleNamespace, y: FloatArray) -> FloatArray:
    """Radius and height (k, 2) of a bottle's body at the heights ``y``."""
    body = np.clip((y - _EDGE) / (b.shoulder - _EDGE), 0, 1)
    above = np.clip((y - b.shoulder) / (b.neck - b.shoulder), 0, 1)
    # A smooth step from body to neck; the power moves it down (slender) or up (full).
    step = 0.5 - 0.5 * np.cos(np.pi * above ** (1 / b.curve))
    foot = np.sqrt(_EDGE**2 - np.clip(_EDGE - y, 0, _EDGE) ** 2) - _EDGE
    radius = b.radius * (1 - b.waist * np.sin(np.pi * body) ** 4) + foot
    return np.stack([radius + (b.neck_radius - b.radius) * step, y], axis=1)


def car(rng: np.random.Generator, index: int) -> Draft:
    """Draw the measures of a car and build it.

    Semantic ids, right (+x) before left: 0 to 3 front and rear corners of the roof; 4 to 7 centres
    of the front and rear wheels; 8, 9 head lamps; 10, 11 tail lamps; 12, 13 lower corners of the
    windscreen; 14 to 17 ends of the front and rear bumper; 18, 19 mirrors.
    """
    c, shift = select_kind(_CAR.kinds, index), rng.uniform(-0.012, 0.012)
    least, most = (0.92, 0.95, 0.96), (1.08, 1.05, 1.06)
    length, width, height = (c.length, c.width, c.height) * rng.uniform(least, most)
    shoulder, wheel = rng.uniform(0.12, 0.2), c.wheel * rng.uniform(0.97, 1.04)
    paint = _CAR.paints[(5 * index + rng.integers(3)) % len(_CAR.paints)]
    draft, half, end = Draft(), width / 2, length / 2

    def level(share: float, grow: float = 0.0) -> tuple[float, float, float, float]:
        """A section of the cabin, from the belt line (0) to the roof (1)."""
        front = (c.cowl + shift + share * (c.roof - c.cowl) - 0.5) * length - grow
        rear = (c.deck + share * (c.rear - c.deck) - 0.5) * length + grow
        y = c.belt + share * (height - 0.042 - c.belt)
        return y, width * (0.9 - c.lean * share) + 2 * grow, front, rear

    # The rounded edge of bonnet and boot, from below: depth below the top, and inset.
    edge = ((shoulder, 0.0), (0.35 * shoulder, 0.05), (0.0, 0.14))
    body = [
        (c.sill, width - 0.1, 0.1 - end, end - 0.1),
        (c.sill + 0.1, width, -end, end),
        *(((c.nose - y, c.tail - y), width - x, x - end, end - x) for y, x in edge),
        level(0.03, 0.02),
    ]
    y, wide, front, rear = level(1.0)
    ridge = (y + 0.042, wide - 0.5, 0.75 * front + 0.25 * rear, 0.22 * front + 0.78 * rear)
    roof = [level(0.86, 0.012), level(0.93, 0.012), level(1.0, -0.03), ridge]
    draft.add(
        stack(body, paint, radius=0.18),
        stack([level(-0.25, -0.07), level(0.0), level(0.92)], _CAR.panes, radius=0.12),
        stack(roof, paint, radius=0.12),
        box((0, c.nose - 0.16, -end), (0.78 * half, 0.15, 0.06), _CAR.dark, radius=0.02),
    )
    draft.mark_pair(0, 1, (wide / 2, y, front))
    draft.mark_pair(2, 3, (wide / 2, y, rear))
    y, wide, front, _ = level(0.06)
    draft.mark_pair(12, 13, (wide / 2, y, front))
    (y, wide, *feet), (top, narrow, *heads) = level(-0.1, -0.03), level(0.92, -0.03)
    for foot, head in np.linspace((feet[0], heads[0]), (feet[1], heads[1]), c.posts):
        draft.add_pair(beam([(wide / 2, y, foot), (narrow / 2, top, head)], (0.08, 0.05), paint))
    lamp, tail = (0.72 * half, c.nose - 0.15, 0.04 - end), (0.76 * half, c.tail - 0.16, end - 0.03)
    mirror = (half + 0.08, c.belt + 0.07, level(0.0)[2] + 0.36)
    draft.add_pair(
        box(lamp, (0.42 * half, 0.17, 0.2), _CAR.lamp, radius=0.09),
        box(tail, (0.3 * half, 0.18, 0.16), _CAR.red, radius=0.03),
        box(mirror, (0.2, 0.15, 0.12), paint, radius=0.06),
    )
    draft.mark_pair(8, 9, (0.78 * half, c.nose - 0.09, -end - 0.1))
    draft.mark_pair(10, 11, (0.84 * half, c.tail - 0.14, end + 0.1))
    draft.mark_pair(18, 19, (half + 0.16, *mirror[1:]))
    for first, share, sign in ((4, c.axle, -1), (6, c.back, 1)):
        z = (share - 0.5) * length
        for ring in _CAR.wheel:
            hub = (half + 0.012, ring["lift"] * wheel, z)
            turned = np.multiply(ring["profile"], (wheel, 1))
            draft.add_pair(lathe(turned, ring["color"], center=hub, sideways=True))
        long = 0.06 + min(0.36, end - abs(z) - 1.22 * wheel)
        middle, size = (0, 0.41, sign * (end + 0.065 - long / 2)), (1.97 * half, 0.2, long)
        draft.add(box(middle, size, _CAR.trim, radius=0.07))
        draft.mark_pair(first, first + 1, (half + 0.05, wheel, z))
        draft.mark_pair(first + 10, first + 11, (0.89 * half, 0.42, sign * (end + 0.1)))
    return draft


def vessel(rng: np.random.Generator, index: int) -> Draft:
    """Draw the measures of a vessel and build it.

    Semantic ids, right (+x) before left: 0 top of the bow; 1 bow at the water line; 2, 3 corners of
    the stern; 4, 5 edge of the side amidships, 6, 7 a quarter of the length from the bow; 8, 9
    front and 10, 11 rear upper corners of the deck house; 12 the highest point; 13, 14 stern at the
    water line; 15 the top of the funnel, if there is one.
    """
    turn, number = divmod(index, len(_VESSEL.kinds["kind"]))
    v = select_kind(_VESSEL.kinds, number)
    v.beam, v.side = (v.beam, v.side) * rng.uniform((0.92, 0.88), (1.08, 1.12))
    variant, tall = turn % 3, rng.uniform(0.92, 1.1)
    draft, accents = Draft(), _VESSEL.accents
    bottom, accent = rng.choice(_VESSEL.bottoms), rng.choice(accents)
    color = _VESSEL.sides[(number + turn + rng.integers(2)) % len(_VESSEL.sides)]
    low, edge, water = v.side - 0.011, _outline(v, 1.0), _outline(v, 0.0)
    planks = edge * (0.92, 1, 0.98) - (0, 0.011, 0)
    draft.add(
        loft([_outline(v, level) for level in np.linspace(-1.0, 0.0, 6)], bottom),
        loft([water, _outline(v, 0.12)], _VESSEL.white),  # a stripe above the water line
        loft([*(_outline(v, level) for level in np.linspace(0.12, 1.0, 5)), planks], color),
        loft([planks - (0, 0.004, 0), planks + (0, 0.002, 0)], _VESSEL.planks),
    )
    draft.places |= {0: edge[29], 1: water[29]}
    for right, place in ((2, edge[1]), (4, edge[11]), (6, edge[19]), (13, water[1])):
        draft.mark_pair(right, right + 1, place)

    if v.kind == "ship":  # seven bays of containers
        size = np.array((0.15 * v.beam, 0.028 * tall, 0.64 / 7))
        for bay, row, layer in np.ndindex(7, 2, 4):
            if layer < (3 if bay == 0 else 4 - (bay + row + variant) % 2):
                middle = np.add((row, layer, bay), 0.5) * size + (0, low, -0.36)
                color = accents[(5 * bay + 3 * row + (2 + bay) * layer) % len(accents)]
                draft.add_pair(box(middle, size * (0.95, 0.95, 0.92), color))
    elif v.kind == "sloop":  # a fin, mainsail and foresail, one of them coloured
        fin = [(-v.draft - 0.13, 0.03, -0.02, 0.14), (0.02 - v.draft, 0.026, -0.1, 0.16)]
        top, sails = low + 1.02 * tall, [_VESSEL.cloth, accent][:: 1 - 2 * (turn % 2)]
        main = [(low + 0.112, 0.006, -0.088, 0.29), (top - 0.03, 0.006, -0.088, -0.076)]
        fore = [(low + 0.03, 0.006, -0.47, -0.12), (0.86 * top, 0.006, -0.13, -0.118)]
        for levels, color in zip((fin, main, fore), (bottom, *sails), strict=True):
            draft.add(stack(levels, color, radius=0.0))

    roofs, low = [], low - 0.01
    storeys = _VESSEL.storeys[v.kind][: (2, 3, 1)[variant] if v.kind == "yacht" else None]
    for number, (rise, share, front, rear) in enumerate(storeys, 1):
        high, width = rise * tall, share * v.beam
        for part in _VESSEL.parts:
            is_top = number == len(storeys) and part is _VESSEL.parts[-1]
            color = accent if v.funnel and is_top else part["color"]
            y, x, out = np.transpose(part["ends"])
            ends = np.column_stack([front - out * high, rear + out * high])
            walls = np.column_stack([low + y * high, x * width, ends])
            draft.add(stack(walls, color, radius=0.35 * high))
        roofs.append((width / 2, low + high, front, rear))
        low += high - 0.004
    x, y, front, rear = roofs[0 if v.kind == "yacht" else -1]
    draft.mark_pair(8, 9, (x, y, front))
    draft.mark_pair(10, 11, (x, y, rear))
    z, top = roofs[-1][3] - v.before, low + v.rise * tall
    draft.add(lathe([(0.008, low - 0.01), (0.005, top)], _VESSEL.spar, center=(0, 0, z), count=12))
    draft.places[12] = (0.0, top, z)
    if v.funnel:
        rim = np.array([(1.0, low - 0.14), (0.95, low + 0.02), (0.95, low + 0.05 * tall)])
        for two, color in ((rim[:2], accent), (rim[1:], _VESSEL.black)):
            draft.add(lathe(two * (v.funnel, 1), color, center=(0, 0, v.z)))
        draft.places[15] = (0.0, low + 0.05 * tall, v.z)
    return draft


def _outline(v: SimpleNamespace, level: float) -> FloatArray:
    """A closed line around the hull, starting at the middle of the stern, right side first.

    The level is -1 at the keel, 0 at the water line, 1 at the edge of the deck.
    """
    z = np.concatenate([np.linspace(0.5, -0.1, 13), np.linspace(-0.1, -0.5, 17)[1:]])
    sheer = np.clip((0.05 - z) / 0.55, 0, 1) ** 2
    y = v.draft * min(level, 0) + (v.side + v.fore * sheer) * max(level, 0)
    flare = 0.35 + 0.65 * np.sqrt(min((level + 1) / 1.75, 1.0))
    entry, transom = v.entry * (1.125 - 0.125 * level), v.transom * (0.725 + 0.275 * level)
    narrow = (1 - np.clip((z + 0.5) / entry, 0, 1)) ** v.full
    x = flare * v.beam / 2 * (1 - narrow) * (1 - (1 - transom) * np.clip(2.5 * z - 0.25, 0, 1) ** 2)
    right = np.stack([x, y, z + v.bow * (1 - level) / 2 * (0.5 - z)], axis=1)
    return np.concatenate([right[:1] * (0, 1, 1), right, right[-2::-1] * (-1, 1, 1)])
