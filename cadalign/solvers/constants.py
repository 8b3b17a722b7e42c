"""Constants shared by compiled kernels and their callers; imports without Numba."""

from typing import Final, NamedTuple

UNKNOWNS: Final = 8
"""Unknowns of an alignment: rotation vector (3), translation (3), log s_y, log s_z."""
POSE_SIZE: Final = 15
"""Length of a packed alignment: rotation row by row (9), translation (3), scale (3)."""

UNOBSERVABLE: Final = 1e-11
"""Least information about a determined unknown given the others, relative to its own."""

LINEAR: Final = 0
HUBER: Final = 1
CAUCHY: Final = 2
"""Loss functions of the length of a whitened residual."""

AP4P: Final = 0
AEPNP: Final = 1
"""Solvers of RANSAC samples."""
SAMPLE_SIZES: Final = (4, 6)
"""Points per sample, indexed by `AP4P` and `AEPNP`."""
LEAST_POINTS: Final = 3
"""Least number of keypoints that leave a finite number of poses."""


class ScalePrior(NamedTuple):
    """Prior on log scales: flat within +-``width``, Gaussian beyond; ``weight`` 0 for none."""

    weight: float
    width: float


OK: Final = 0
"""Status of a solved problem; kernels return a status instead of raising."""
TOO_FEW: Final = 1
"""Status: fewer points than the method needs."""
DEGENERATE: Final = 2
"""Status: the points do not span a volume."""
NOT_FOUND: Final = 3
"""Status: no alignment with all points in front of the camera."""
OUT_OF_RANGE: Final = 4
"""Status: the numbers of the solution overflow."""
