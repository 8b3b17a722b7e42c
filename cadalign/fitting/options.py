"""How to fit: the options that `fit` and `fit_batch` share, checked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.fitting.focal.prior import FocalPrior
from cadalign.fitting.noise import Sigma
from cadalign.solvers.objective import CAUCHY, HUBER, LINEAR, UNKNOWNS

METHODS = ("optimal", "aepnp", "aepnp-paper", "epnp")
FOCALS = ("known", "estimate")
LOSSES = {"linear": LINEAR, "huber": HUBER, "cauchy": CAUCHY}


@dataclass(frozen=True)
class Options:
    """How to fit, checked; see `cadalign.fit` for what each means."""

    method: str = "optimal"
    sigma: Sigma | None = 1.0
    loss: str = "linear"
    loss_scale: float = 2.0
    stretch: str | None = None
    scale_prior_sigma: float | None = None
    known_axis: str = "x"
    focal: str = "known"
    focal_prior: FocalPrior | None = None

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise InputError(
                f"unknown method {self.method!r}",
                where="method",
                fix=f"known are {', '.join(METHODS)}",
            )
        if self.loss not in LOSSES:
            raise InputError(
                f"unknown loss {self.loss!r}", where="loss", fix=f"known are {', '.join(LOSSES)}"
            )
        if not isinstance(self.loss_scale, int | float) or not 0 < self.loss_scale < np.inf:
            raise InputError(f"{self.loss_scale} is not positive", where="loss_scale")
        if self.known_axis not in ("x", "y", "z"):
            raise InputError(
                f"{self.known_axis!r} is not an axis", where="known_axis", fix="give x, y or z"
            )
        if self.stretch is not None:
            self._check_stretch()
        prior = self.scale_prior_sigma
        if prior is not None and not 0 < prior < np.inf:
            raise InputError(f"{prior} is not positive", where="scale_prior_sigma")
        if self.focal != "known" or self.focal_prior is not None:
            self._check_focal()
        if self.method != "optimal" and (
            self.loss != "linear"
            or prior is not None
            or (self.stretch is not None and len(self.stretched_axes) < 2)
        ):
            raise InputError(
                f"the method {self.method!r} knows neither loss, stretch nor scale prior",
                where="method",
                fix="use the method 'optimal', or leave these options alone",
            )

    def _check_stretch(self) -> None:
        axes = [axis for axis in "xyz" if axis != self.known_axis]
        allowed = ("".join(axes), axes[0], axes[1], "none")
        if self.stretch not in allowed:
            raise InputError(
                f"{self.stretch!r} are not axes that can stretch where {self.known_axis} is known",
                where="stretch",
                fix=f"give one of {', '.join(allowed)}",
            )

    def _check_focal(self) -> None:
        if self.focal not in FOCALS:
            raise InputError(
                f"unknown choice {self.focal!r}", where="focal", fix=f"give {' or '.join(FOCALS)}"
            )
        if self.focal == "estimate" and self.method != "optimal":
            raise InputError(
                f"the method {self.method!r} needs a known focal length",
                where="focal",
                fix="use the method 'optimal'",
            )
        if self.focal_prior is None:
            return
        if not isinstance(self.focal_prior, FocalPrior):
            raise InputError(
                f"expected a cadalign.FocalPrior, got {type(self.focal_prior).__name__}",
                where="focal_prior",
            )
        if self.focal != "estimate":
            raise InputError(
                "given for a known focal length",
                where="focal_prior",
                fix='give focal="estimate" with it',
            )

    @property
    def stretched_axes(self) -> str:
        """The axes whose scale is estimated."""
        if self.stretch == "none":
            return ""
        return self.stretch or "xyz".replace(self.known_axis, "")

    @property
    def axis_order(self) -> list[int]:
        """The model's axes as the solvers want them: the known one first, no reflection."""
        first = "xyz".index(self.known_axis)
        return [first, (first + 1) % 3, (first + 2) % 3]

    @property
    def free(self) -> FloatArray:
        """1 for each of the solvers' 8 unknowns that is estimated."""
        free = np.ones(UNKNOWNS)
        for place, axis in enumerate(self.axis_order[1:]):
            free[6 + place] = float("xyz"[axis] in self.stretched_axes)
        return free

    @property
    def prior_weight(self) -> float:
        """Inverse variance of the prior on the log scales."""
        return 0.0 if self.scale_prior_sigma is None else self.scale_prior_sigma**-2

    @property
    def estimates_in_rounds(self) -> bool:
        """Whether sigma is estimated, and the optimum depends on it."""
        return (
            self.method == "optimal"
            and self.sigma is None
            and (self.loss != "linear" or self.prior_weight > 0 or self.focal_prior is not None)
        )

    @property
    def unknowns(self) -> int:
        """How many unknowns are estimated."""
        return 6 + len(self.stretched_axes) + (self.focal == "estimate")

    @property
    def min_points(self) -> int:
        """How many keypoints the method needs."""
        if self.method == "optimal":
            prior = len(self.stretched_axes) if self.scale_prior_sigma is not None else 0
            prior += self.focal_prior is not None
            return (self.unknowns - prior + 1) // 2
        return 4 if self.method == "epnp" else 6
