"""Kind, proportions and colours of a sample car."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cadalign.datasets.sample.solids import Color

_PAINTS: tuple[Color, ...] = (
    (186, 30, 36), (34, 78, 150), (214, 216, 220), (236, 178, 40), (58, 120, 82), (110, 116, 124),
    (60, 62, 70), (206, 96, 36), (90, 160, 190), (238, 236, 228), (112, 34, 56), (150, 160, 120),
)  # fmt: skip
_RIMS: tuple[Color, ...] = ((196, 200, 206), (168, 172, 178), (220, 222, 226))


@dataclass(frozen=True)
class _Kind:
    """A kind of car [metres]; positions along it are shares of its length, 0 at the nose.

    ``cowl`` and ``deck`` are the lower ends of the windscreen and the rear window, ``roof`` both
    ends of the roof, ``panel`` the beginning of a van's closed wall.
    """

    name: str
    length: float
    width: float
    height: float
    nose: float
    belt: float
    tail: float
    cowl: float
    roof: tuple[float, float]
    deck: float
    axles: tuple[float, float]
    wheel: float
    pillars: tuple[float, ...]
    tumblehome: float = 0.2
    panel: float | None = None


_KINDS = (
    _Kind("sedan", 4.6, 1.8, 1.45, 0.76, 0.92, 0.96, 0.27,
          (0.43, 0.69), 0.84, (0.18, 0.78), 0.32, (0.55,)),
    _Kind("hatchback", 4.0, 1.74, 1.48, 0.76, 0.93, 0.9, 0.25,
          (0.43, 0.88), 0.975, (0.19, 0.82), 0.31, (0.57,)),
    _Kind("pickup", 5.3, 1.92, 1.76, 0.98, 1.12, 0.98, 0.25,
          (0.36, 0.53), 0.57, (0.17, 0.77), 0.38, (0.46,), 0.14),
    _Kind("sports", 4.4, 1.86, 1.24, 0.73, 0.85, 0.87, 0.37,
          (0.53, 0.66), 0.9, (0.18, 0.8), 0.315, (0.67,), 0.26),
    _Kind("van", 5.0, 1.94, 2.05, 0.98, 1.18, 1.12, 0.1,
          (0.24, 0.985), 0.995, (0.17, 0.78), 0.35, (0.3,), 0.1, 0.42),
    _Kind("suv", 4.7, 1.9, 1.74, 0.95, 1.08, 1.06, 0.25,
          (0.38, 0.9), 0.965, (0.18, 0.79), 0.39, (0.53, 0.74), 0.15),
    _Kind("wagon", 4.75, 1.8, 1.48, 0.76, 0.92, 0.94, 0.25,
          (0.4, 0.91), 0.975, (0.17, 0.77), 0.32, (0.53, 0.75)),
    _Kind("city", 3.45, 1.62, 1.54, 0.8, 0.95, 0.94, 0.17,
          (0.38, 0.92), 0.985, (0.19, 0.81), 0.29, (0.62,), 0.16),
)  # fmt: skip


@dataclass(frozen=True)
class CarShape:
    """Proportions [metres] and colours of a car whose middle is at z = 0, its front at -z."""

    kind: _Kind
    length: float
    width: float
    roof: float
    sill: float
    shoulder_drop: float
    z_cowl: float
    z_roof_front: float
    z_roof_rear: float
    z_deck: float
    z_axles: tuple[float, float]
    z_panel: float | None
    pillars: tuple[float, ...]
    wheel_radius: float
    spokes: int
    paint: Color
    rim: Color

    @classmethod
    def draw(cls, rng: np.random.Generator, index: int) -> CarShape:
        """Draw a car; the kinds take turns with ``index``."""
        kind = _KINDS[index % len(_KINDS)]
        length = kind.length * rng.uniform(0.92, 1.08)
        height = kind.height * rng.uniform(0.96, 1.06)
        shift = rng.uniform(-0.012, 0.012)

        def along(share: float) -> float:
            return float((share - 0.5) * length)

        return cls(
            kind=kind,
            length=length,
            width=kind.width * rng.uniform(0.95, 1.05),
            roof=height - 0.042,
            sill=0.3 if kind.name in ("pickup", "suv") else 0.2,
            shoulder_drop=rng.uniform(0.12, 0.2),
            z_cowl=along(kind.cowl + shift),
            z_roof_front=along(kind.roof[0] + shift),
            z_roof_rear=along(kind.roof[1]),
            z_deck=along(kind.deck),
            z_axles=(along(kind.axles[0]), along(kind.axles[1])),
            z_panel=None if kind.panel is None else along(kind.panel),
            pillars=tuple(along(share) for share in kind.pillars),
            wheel_radius=kind.wheel * rng.uniform(0.97, 1.04),
            spokes=int(rng.integers(5, 9)),
            paint=_PAINTS[(index + int(rng.integers(3))) % len(_PAINTS)],
            rim=_RIMS[int(rng.integers(len(_RIMS)))],
        )

    @property
    def tail_lamp(self) -> float:
        """Height of the tail lamps."""
        return self.kind.tail - 0.14

    @property
    def steep(self) -> bool:
        """The rear window reaches to the rear end."""
        return self.z_deck > 0.44 * self.length

    def top(self, z: float) -> float:
        """Height of the body's upper edge at z: bonnet, belt line, boot."""
        end, nose, tail = self.length / 2, self.kind.nose, self.kind.tail
        bonnet = nose + (0.08 if self.kind.name == "van" else 0.06)
        boot = self.z_deck + 0.05 if self.kind.name == "pickup" else end - 0.1
        knots = [-end, -0.86 * end, self.z_cowl + 0.05, self.z_deck, boot, end]
        heights = [nose - 0.02, bonnet, self.kind.belt, self.kind.belt + 0.02, tail, tail - 0.02]
        near_front = max(0.0, 1 - (z + end) / 0.25)
        near_rear = max(0.0, 1 - (end - z) / 0.12)
        return float(np.interp(z, knots, heights) - 0.16 * near_front**2 - 0.1 * near_rear**2)

    def half_width(self, z: float) -> float:
        """Half the body's width at z: narrower towards its rounded ends."""
        end = max(self.length / 2 - abs(z), 0.0)
        rounding = 1 - min(end / 0.4, 1.0)
        corner = 0.1 if z > 0 and self.steep else 0.2
        flank = 0.03 * (2 * z / self.length) ** 4
        return float(self.width / 2 * (1 - flank - corner * rounding**3))
