"""The studio: a soft key light, a fill light and light from all around, in linear light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.render.drawing.color import LinearArray

Direction = tuple[float, float, float]

# No real paint is blacker; perfectly black parts would show no form.
DARKEST = 0.015


@dataclass(frozen=True)
class Studio:
    """Lights that stand still relative to the camera, and an ambient light from above.

    Parameters
    ----------
    key, fill : tuple of 3 float
        Towards the light, in the camera frame (x right, y down, z forward).
    key_power, fill_power, sky_power, ground_power : float
        Light reflected by white that faces the light, or the upper or lower hemisphere.
    wrap : float
        How far a light reaches round the object, 0 (a point) to 1 (a hemisphere).
    gloss, gloss_exponent : float
        Strength and narrowness of the key light's highlight.
    occlusion, occlusion_reach : float
        Share of the light that is lost where other parts of the object hide the whole sky, and how
        far off these may be, in diagonals of the object; 0 turns ambient occlusion off.
    """

    key: Direction = (-0.55, -0.75, -0.75)
    fill: Direction = (0.9, -0.15, -0.6)
    key_power: float = 0.60
    fill_power: float = 0.12
    sky_power: float = 0.28
    ground_power: float = 0.08
    wrap: float = 0.25
    gloss: float = 0.08
    gloss_exponent: float = 40.0
    occlusion: float = 0.7
    occlusion_reach: float = 0.2

    def shade(
        self, albedo: LinearArray, normal: LinearArray, view: LinearArray, up: FloatArray
    ) -> LinearArray:
        """Linear light (n, 3) that points of a surface send towards the camera.

        ``albedo`` is linear colour; ``normal``, on the seen side, ``view``, from the points to the
        camera, and ``up``, towards the sky, are unit vectors in the camera frame.
        """
        key, fill = _unit(self.key), _unit(self.fill)
        towards_sky = 0.5 + 0.5 * (normal @ up.astype(np.float32))
        light = (
            np.float32(self.ground_power)
            + np.float32(self.sky_power - self.ground_power) * towards_sky
            + np.float32(self.key_power) * self._diffuse(normal @ key)
            + np.float32(self.fill_power) * self._diffuse(normal @ fill)
        )
        halfway = view + key
        halfway /= np.sqrt(np.einsum("nk,nk->n", halfway, halfway))[:, None]
        facing = np.maximum(np.einsum("nk,nk->n", normal, halfway), 0)
        shine = np.float32(self.gloss) * facing ** np.float32(self.gloss_exponent)
        lifted = np.float32(DARKEST) + np.float32(1 - DARKEST) * albedo
        return np.asarray(lifted * light[:, None] + shine[:, None], dtype=np.float32)

    def _diffuse(self, cosine: LinearArray) -> LinearArray:
        """Lambert's law for a light of some size."""
        wrap = np.float32(self.wrap)
        return np.asarray(np.maximum((cosine + wrap) / (1 + wrap), 0), dtype=np.float32)


def _unit(direction: Direction) -> LinearArray:
    vector = np.array(direction, dtype=np.float32)
    return np.asarray(vector / np.linalg.norm(vector), dtype=np.float32)
