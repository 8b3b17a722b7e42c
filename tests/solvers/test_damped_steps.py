"""Steps of the damped normal equations."""

from __future__ import annotations

import numpy as np
import pytest

from cadalign.solvers.alignment import room_for, solve_damped


def test_an_unknown_without_evidence_stays_where_it_is() -> None:
    equations, step = room_for(3), np.empty(3)
    equations.hessian[:] = np.diag([4.0, 1e-3, 0.0])
    equations.gradient[:] = 2.0, 1e-3, 0.0
    assert solve_damped(equations, 3, 0.0, step) == pytest.approx(1.0 + 1e-3)
    np.testing.assert_allclose(step, [-0.5, -1.0, 0.0])
