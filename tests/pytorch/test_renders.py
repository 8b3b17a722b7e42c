"""Pictures that detectors are trained with."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch", reason='needs pip install -e ".[torch]"')
from cadalign.torch.detector import _on_background


def test_pictures_show_the_object_where_it_is_opaque_and_noise_elsewhere() -> None:
    """And both by halves where half of the light passes."""
    color = np.full((48, 48, 4), 100, dtype=np.uint8)
    color[..., 3] = 0
    color[:, 16:32, 3], color[:, 32:, 3] = 128, 255
    shown = np.array([_on_background(color, np.random.default_rng(k)) for k in range(40)]).astype(
        float
    )
    clear, half, opaque = (shown[:, :, 16 * k : 16 * (k + 1)] for k in range(3))
    tint = opaque.mean(axis=(1, 2), keepdims=True)  # of each picture
    assert np.abs(tint - 100).max() < 60
    assert (opaque - tint).std() < 0.25 * clear.std()
    assert half.std() == pytest.approx(clear.std() / 2, rel=0.3)
    assert half.mean() == pytest.approx((opaque.mean() + clear.mean()) / 2, abs=12)
