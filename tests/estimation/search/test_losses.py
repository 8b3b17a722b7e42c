"""Losses of squared whitened lengths."""

from __future__ import annotations

import numpy as np
import pytest

from cadalign.estimation.uncertainty.residuals import loss_weights
from cadalign.retrieval.ranking import apply_loss
from cadalign.solvers.constants import CAUCHY, HUBER, LINEAR


@pytest.mark.parametrize("loss", [LINEAR, HUBER, CAUCHY])
def test_the_weights_of_a_loss_are_its_derivatives(loss: int) -> None:
    squares, bend, step = np.array([0.5, 2.0, 3.0, 10.0, 40.0]), 1.5, 1e-5
    above, below = squares + step, squares - step
    by_square = (apply_loss(above, loss, bend) - apply_loss(below, loss, bend)) / (2 * step)
    np.testing.assert_allclose(loss_weights(squares, loss, bend), by_square, rtol=1e-6)
