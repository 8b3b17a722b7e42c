"""Known lengths of an object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, as_positive
from cadalign.errors import InputError


@dataclass(frozen=True, eq=False)
class Size:
    """Known lengths of an object's box along the model's axes.

    Parameters
    ----------
    width, height, length : float, optional
        Along x, y, z [the unit in which pose and size are wanted].
    sigma : float or (3,) float
        Standard deviation of the lengths, relative (0.01 is 1 %).

    Raises
    ------
    InputError
        If no length is given, or a value is not positive.

    Examples
    --------
    >>> Size(height=0.81, sigma=0.005).lengths.tolist()
    [nan, 0.81, nan]
    """

    width: float | None = None
    height: float | None = None
    length: float | None = None
    sigma: npt.ArrayLike = 0.01

    def __post_init__(self) -> None:
        for name in ("width", "height", "length"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, as_positive(getattr(self, name), name=name))
        if np.isnan(self.lengths).all():
            fix = "give a width, a height or a length"
            raise InputError("no length is given", where="size", fix=fix)
        relative = np.asarray(self.sigma, dtype=np.float64)
        if relative.shape not in ((), (3,)) or not (relative > 0).all():
            raise InputError("must be positive, one or one per axis", where="sigma")

    @property
    def lengths(self) -> FloatArray:
        """Lengths (3,) along x, y, z; NaN where unknown."""
        given = (self.width, self.height, self.length)
        return np.array([np.nan if each is None else each for each in given])

    @property
    def deviations(self) -> FloatArray:
        """Standard deviations (3,) of the lengths; NaN where unknown."""
        return np.asarray(self.lengths * np.asarray(self.sigma, dtype=np.float64))
