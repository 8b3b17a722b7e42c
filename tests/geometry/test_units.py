"""Keypoints and mesh of a model in different units, or of different models."""

from __future__ import annotations

import numpy as np
import pytest

from cadalign import Model
from cadalign.errors import InputError
from cadalign.geometry.mesh import Mesh, check_near

CORNERS = np.array([[x, y, z] for x in (-0.3, 0.3) for y in (0, 0.8) for z in (-0.4, 0.4)])
BOUNDS = np.array([CORNERS[0], CORNERS[-1]])


@pytest.mark.parametrize("factor", [1000, 100, 25.4, 10, 0.01, 0.001])
def test_factor_between_the_units_is_named(factor: float) -> None:
    with pytest.raises(InputError, match=rf"divided by {factor:g}, .* by {1 / factor:g}$"):
        check_near(CORNERS * factor, BOUNDS, where="points_3d")


@pytest.mark.parametrize("share", [1.0, 0.2, 0.04])
def test_keypoints_on_a_part_of_a_mesh_are_accepted(share: float) -> None:
    check_near([0.3, 0.8, 0.4] + share * (CORNERS - CORNERS[-1]), BOUNDS, where="points_3d")


def test_keypoints_of_another_model_are_refused() -> None:
    with pytest.raises(InputError, match=r"keypoint 3 lies 6\.\d+ mesh diagonals from the mesh"):
        check_near(np.vstack([CORNERS[:3], [[8.0, 0.0, 0.0]]]), BOUNDS, where="points_3d")


def test_a_model_compares_its_keypoints_with_its_mesh() -> None:
    mesh = Mesh(CORNERS, [[0, 1, 2], [5, 6, 7]])  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"points_3d: .* multiply the keypoints by 0.001"):
        Model(points_3d=1000 * CORNERS, mesh=mesh)
