"""Losses of squared whitened lengths."""

from __future__ import annotations

import numpy as np
import pytest

from cadalign.estimation.uncertainty.residuals import loss_slopes
from cadalign.retrieval.ranking import bent
from cadalign.solvers.constants import CAUCHY, HUBER, LINEAR


@pytest.mark.parametrize("loss", [LINEAR, HUBER, CAUCHY])
def test_the_slopes_of_a_loss_are_its_derivatives(loss: int) -> None:
    squares, bend, step = np.array([0.5, 2.0, 3.0, 10.0, 40.0]), 1.5, 1e-5
    first, second = loss_slopes(squares, loss, bend)
    above, below = squares + step, squares - step
    by_square = (bent(above, loss, bend) - bent(below, loss, bend)) / (2 * step)
    np.testing.assert_allclose(first, by_square, rtol=1e-6)
    by_square = (loss_slopes(above, loss, bend)[0] - loss_slopes(below, loss, bend)[0]) / (2 * step)
    np.testing.assert_allclose(second, by_square, rtol=1e-6, atol=1e-9)
