"""How to retrieve: the options of `cadalign.Library.retrieve`, checked, and the model behind it.

A model of the library is scored by the likelihood of everything the image shows, under these
assumptions:

- A keypoint of the object is marked in the image with the probability ``1 - missing_prob``,
  independently of the others; it may be hidden, or overlooked.
- A marked keypoint lies where the model's keypoint projects to, with Gaussian noise of the standard
  deviation ``sigma``, to which ``shape_sigma`` adds what the shapes differ by. With a robust loss,
  that takes the place of the squared error.
- An image shows ``spurious`` keypoints, on average, that the object does not have, anywhere in the
  image with equal density: each costs ``log(spurious / area)``.
- The logarithms of the stretches along y and z are Gaussian about zero, with the standard deviation
  ``scale_prior_sigma``, and within ``max_stretch``.

So with N the number of shared keypoints, their errors r_i whitened by their covariances C_i, m the
number of the model's keypoints that the image lacks and e of the image's that the model lacks::

    log-likelihood = sum over the shared [log(1 - missing_prob) - log(2 pi) - log det(C_i) / 2
                                          - |r_i|^2 / 2]
                     + m log(missing_prob) + e log(spurious / area)
                     + log density of the stretches

at the pose and stretch that maximise it. A model that lacks keypoints of the image has fewer errors
to explain, and pays for each of them some 15 units; one that has keypoints which the image does not
show pays 0.7 each.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from cadalign.errors import InputError
from cadalign.fitting.options import FitOptions, Sigma

METHODS = ("optimal", "epnp")


@dataclass(frozen=True)
class RetrievalOptions:
    """How to retrieve; see `cadalign.Library.retrieve` for what each option means.

    Raises
    ------
    InputError
        If a value is out of range or unknown.
    """

    top: int = 10
    category: str | None = None
    method: str = "optimal"
    sigma: Sigma = 1.0
    shape_sigma: float = 0.0
    loss: str = "linear"
    loss_scale: float = 2.0
    stretch: str | None = None
    scale_prior_sigma: float | None = 0.4
    max_stretch: float = 4.0
    symmetries: bool = False
    missing_prob: float = 0.5
    spurious: float = 0.01
    exhaustive: bool = False
    fitting: FitOptions = field(init=False, compare=False)

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise InputError(
                f"unknown method {self.method!r}",
                where="method",
                fix=f"known are {', '.join(METHODS)}",
            )
        if not isinstance(self.top, int) or self.top < 1:
            raise InputError(f"{self.top!r} is not a number of matches", where="top")
        if self.sigma is None:
            raise InputError(
                "the noise must be known to compare models",
                where="sigma",
                fix="give pixels, and shape_sigma where shapes differ",
            )
        for name, low, high in (
            ("shape_sigma", 0.0, math.inf),
            ("missing_prob", 1e-9, 1 - 1e-9),
            ("spurious", 1e-9, math.inf),
            ("max_stretch", 1.0, 1000.0),
        ):
            value = getattr(self, name)
            if not (low <= value <= high and value < math.inf):
                raise InputError(f"{value} is out of range", where=name)
        if self.method == "epnp" and (self.loss != "linear" or self.stretch not in (None, "none")):
            raise InputError(
                "the method 'epnp' knows neither loss nor stretch",
                where="method",
                fix="use the method 'optimal', or leave these options alone",
            )
        stretch = "none" if self.method == "epnp" else self.stretch
        options = FitOptions(
            loss=self.loss,
            loss_scale=self.loss_scale,
            stretch=stretch,
            scale_prior_sigma=self.scale_prior_sigma,
        )
        object.__setattr__(self, "fitting", options)

    @property
    def log_scale_constant(self) -> float:
        """The log density of the prior at no stretch; 0 without a prior."""
        sigma = self.scale_prior_sigma
        if sigma is None:
            return 0.0
        axes = len(self.fitting.stretched_axes)
        return -axes * (0.5 * math.log(2 * math.pi) + math.log(sigma))
