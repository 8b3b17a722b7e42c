"""Constants that compiled kernels share with their callers; importing them needs no compiler."""

from typing import Final, NamedTuple

UNKNOWNS: Final = 8
"""Unknowns of an alignment: rotation vector (3), translation (3), log s_y, log s_z."""
POSE_SIZE: Final = 15
"""Length of a packed alignment: rotation row by row (9), translation (3), scale (3)."""

UNOBSERVABLE: Final = 1e-11
"""Share of an unknown's information that the others must leave for it to count as determined."""

LINEAR: Final = 0
HUBER: Final = 1
CAUCHY: Final = 2
"""Losses on the length of a whitened residual."""

AP4P: Final = 0
AEPNP: Final = 1
"""Minimal solvers of RANSAC."""
SAMPLE_SIZES: Final = (4, 6)
"""Points per sample, by minimal solver."""
LEAST_POINTS: Final = 3
"""Keypoints that leave a pose a few alternatives; fewer leave it open."""


class ScalePrior(NamedTuple):
    """Prior on log scales: flat up to ``width``, then a Gaussian flank; ``weight`` 0 is none."""

    weight: float
    width: float


OK: Final = 0
"""Status of a solved problem; kernels return one in place of an exception."""
TOO_FEW: Final = 1
"""Fewer points than the method needs."""
DEGENERATE: Final = 2
"""The points do not span a volume."""
NOT_FOUND: Final = 3
"""No alignment with all points in front of the camera."""
OUT_OF_RANGE: Final = 4
"""The numbers of the solution overflow."""
