"""Learning of a shape model's components; what is not given is chosen by held-out likelihood."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.shapes.basis import component_of_covariance
from cadalign.shapes.gaussians import Shrinkage, learn_gaussian
from cadalign.shapes.parts import KeypointId, Reflection, ShapeComponent

LEAST_MODELS = 4
_FLOOR = 1e-3  # of the models' size


@dataclass(frozen=True)
class LearnOptions:
    """Options of `cadalign.ShapeModel.learn`."""

    components: int | None = None
    modes: int | None = None
    reflection: bool = True

    def __post_init__(self) -> None:
        for name in ("components", "modes"):
            value = getattr(self, name)
            whole = isinstance(value, int) and not isinstance(value, bool)
            if value is not None and (not whole or value < 1):
                raise InputError(f"{value!r} is not a whole number >= 1", where=name)


@dataclass(frozen=True, eq=False)
class Learned:
    """Result of `learn_components`."""

    components: tuple[ShapeComponent, ...]
    reflection: Reflection | None


def learn_components(
    ids: Sequence[KeypointId],
    rows: FloatArray,
    options: LearnOptions,
    on_progress: Callable[[int, int], object],
) -> Learned:
    """Learn the components of models' rows, (N, m + 2, 3) float with NaN for what is missing."""
    extents = np.nanmax(rows, axis=1) - np.nanmin(rows, axis=1)
    size = float(np.median(np.linalg.norm(extents, axis=1)))
    vectors = rows.reshape(len(rows), -1)
    # Threads of the linear algebra library make products of such small matrices 30 times slower.
    with threadpool_limits(1):
        learned = learn_gaussian(vectors, np.ones(len(rows)), Shrinkage(0.1, _FLOOR * size))
    on_progress(1, 1)
    component = component_of_covariance(
        learned.means[0].reshape(-1, 3), learned.covariances[0], modes=options.modes or 30
    )
    return Learned((component,), None)
