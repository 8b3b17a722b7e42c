"""Knowledge of the object's shape: that of its category, or that the model is only similar."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cadalign.annotate.options import SessionOptions
from cadalign.arrays import FloatArray
from cadalign.datasets.models.model_keypoints import ModelKeypoint
from cadalign.errors import InputError
from cadalign.estimation.model import Model
from cadalign.geometry.mesh import Mesh
from cadalign.shapes.model import ShapeModel
from cadalign.shapes.parts import KeypointId


@dataclass(frozen=True, eq=False)
class ObjectShape:
    """A category's learned shape with its file, or else the ``sigma`` of a similar model.

    ``sigma`` is the ``shape_sigma`` of `cadalign.Model`.
    """

    learned: ShapeModel | None = None
    path: Path | None = None
    sigma: float | None = None

    @classmethod
    def open(cls, options: SessionOptions) -> ObjectShape | None:
        """Read the shape that the options name; None without one. Raises a CadalignError."""
        path, sigma = options.shape, options.shape_sigma
        if path is None and sigma is None:
            return None
        if path is not None and sigma is not None:
            raise InputError(
                "--shape has learned how far objects of the category differ",
                where="--shape-sigma",
                fix="give one of the two options",
            )
        if path is not None:
            return cls(ShapeModel.open(path), path)
        if not (sigma and 0 < sigma < np.inf):
            raise InputError(
                f"{sigma:g} is not a standard deviation",
                where="--shape-sigma",
                fix="give a positive number",
            )
        return cls(sigma=sigma)

    @property
    def ids(self) -> tuple[KeypointId, ...]:
        """Ids or names of the learned keypoints; empty for a similar model."""
        return () if self.learned is None else self.learned.ids

    @property
    def reserved(self) -> tuple[int, ...]:
        """Semantic ids that points placed on the model must not get by chance."""
        return tuple(label for label in self.ids if isinstance(label, int))

    @property
    def is_named(self) -> bool:
        """True if the learned keypoints are known by their names."""
        return bool(self.ids) and isinstance(self.ids[0], str)

    @property
    def average(self) -> str:
        """The noun that the object is compared with in a sentence."""
        return "the model" if self.learned is None else f"the average {self.learned.category}"

    def id_of(self, point: ModelKeypoint) -> KeypointId | None:
        """The id of a model's point in the estimate; None for one that was not learned."""
        if self.learned is None:
            return point.semantic_id
        label: KeypointId | None = point.name if self.is_named else point.semantic_id
        return label if label in self.ids else None

    def knows(self, point: ModelKeypoint) -> bool:
        """True if pairs of this point count."""
        return self.id_of(point) is not None

    def model_with(
        self, points: Iterable[ModelKeypoint], mesh: Mesh, *, up_axis: str | None = "y"
    ) -> Model | ShapeModel:
        """The model to align, similar to these points.

        Those that no pair shows do not change the estimate: it is that of `cadalign fit`.
        """
        if self.learned is not None:
            return self.learned
        known = list(points)
        return Model(
            points_3d=[point.xyz for point in known],
            ids=[point.semantic_id for point in known],
            mesh=mesh,
            shape_sigma=self.sigma,
            up_axis=up_axis,
        )

    def length_sigmas(self, model: Model | ShapeModel) -> FloatArray:
        """Standard deviations (3,) of the logarithms of the box's lengths before any pair."""
        if isinstance(model, ShapeModel):
            lengths = np.ptp(model.mean[-2:], axis=0)
            squares = np.zeros(3)
            for part in model.components:
                mode = part.modes[:, -1] - part.modes[:, -2]
                own = (mode**2).sum(axis=0) + 2 * part.residual_sigma**2
                squares += part.weight * (own + (np.ptp(part.mean[-2:], axis=0) - lengths) ** 2)
        else:
            lengths = np.ptp(np.asarray(model.bounds), axis=0)
            options = model.fit_options(1.0)
            free = np.isin(list("xyz"), list(options.stretched_axes))
            prior = options.stretch_sigma or 0.0
            squares = 2 * float(self.sigma or 0.0) ** 2 + np.where(free, prior * lengths, 0.0) ** 2
        safe = np.where(lengths > 0, lengths, np.inf)
        return np.asarray(np.sqrt(squares) / safe)
