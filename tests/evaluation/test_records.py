"""Instance records: the alignment of a model's box to an estimated one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cadalign import Alignment, Box
from cadalign.evaluation.instances.record import box_alignment


@pytest.mark.slow
@given(seed=st.integers(0, 10_000))
def test_box_alignment_gives_the_same_box(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=seed).as_matrix()
    found = Alignment(rotation, rng.normal(size=3), rng.uniform(0.5, 2, 3))
    bounds, given = (np.sort(rng.normal(size=(2, 3)), axis=0) for _ in range(2))
    given[1] += 0.1
    bounds[1] += 0.1
    box = Box.from_model(given, box_alignment(found, bounds, model_bounds=given))
    wanted = Box.from_model(bounds, found)
    np.testing.assert_allclose(box.corners, wanted.corners, atol=1e-9)
