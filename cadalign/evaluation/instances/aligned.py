"""An aligned shape in the terms of an instance: as if its box were the given model's, stretched."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.estimation.uncertainty.summary import Uncertainty
from cadalign.estimation.view import View
from cadalign.evaluation.instances.instance import Instance
from cadalign.geometry.alignment import Alignment
from cadalign.shapes.model import ShapeModel

if TYPE_CHECKING:
    from cadalign.estimation.result import Result
    from cadalign.estimation.result_parts import Alternative

_LEAST_SCALE = 1e-6


@dataclass(frozen=True, eq=False)
class Warp:
    """Deformation of the given model to the estimated shape.

    ``source`` (k, 3) are keypoints of the given model, ``target`` (k, 3) their places on the
    estimated object, in the model's coordinates: the alignment takes both into the camera's.
    """

    source: FloatArray
    target: FloatArray


@dataclass(frozen=True, eq=False)
class AlignedAlternative:
    """Another likely estimate; see `AlignedShape`."""

    alignment: Alignment
    relative_likelihood: float
    warp: Warp


@dataclass(frozen=True, eq=False)
class AlignedShape:
    """The estimate of an object's own shape, for an instance's record.

    Parameters
    ----------
    alignment : Alignment
        Takes the box of the model that other methods are given to the estimated one.
    std : Uncertainty, optional
        None for a method that states none.
    rms : float
        Of the residuals [px].
    sigma : float
        Standard deviation of the keypoints [px].
    warnings : tuple of str
    alternatives : tuple of AlignedAlternative
    warp : Warp
        What remains of the shape after the alignment.
    """

    alignment: Alignment
    std: Uncertainty | None
    rms: float
    sigma: float
    warnings: tuple[str, ...]
    alternatives: tuple[AlignedAlternative, ...]
    warp: Warp


def align_instance(
    shape: ShapeModel,
    instance: Instance,
    own_ids: npt.ArrayLike,
    own_xyz: npt.ArrayLike,
    *,
    sigma: float,
) -> AlignedShape:
    """Align a category's shape with an instance's keypoints, of which the shape knows.

    Parameters
    ----------
    shape : ShapeModel
    instance : Instance
    own_ids : (k,) int
        Semantic ids of all keypoints of the instance's model, whose extent is its box where it has
        no mesh.
    own_xyz : (k, 3) float
        These keypoints as the image shows them.
    sigma : float
        Standard deviation of the keypoints [px].

    Raises
    ------
    DegenerateError
        As `cadalign.align`.
    """
    # Only here: their kernels take time to import, and most experiments do without.
    from cadalign.estimation.align import align

    known = np.isin(instance.semantic_ids, shape.ids)
    view = View(
        instance.camera,
        instance.points_2d[known],
        ids=instance.semantic_ids[known].tolist(),
        sigma=sigma,
    )
    result = align(shape, view)
    ids = np.asarray(own_ids)
    rows = np.isin(shape.ids, ids)
    given = np.asarray(own_xyz)[np.isin(ids, shape.ids)] / instance.gt.scale
    order = shape.rows(ids[np.isin(ids, shape.ids)].tolist())

    def in_terms_of_the_model(
        alignment: Alignment, points: FloatArray, bounds: FloatArray
    ) -> Alignment:
        if instance.scene is None and rows.any():
            bounds = np.stack([points[rows].min(axis=0), points[rows].max(axis=0)])
        return box_alignment(alignment, bounds, model_bounds=instance.bounds)

    def found(each: Result | Alternative) -> tuple[Alignment, Warp]:
        alignment = in_terms_of_the_model(each.alignment, each.points_3d, each.bounds)
        target = alignment.inverse(each.alignment.apply(each.points_3d[order]))
        return alignment, Warp(given, target)

    return shape_of_result(result, found, rms=_rms(result), sigma=sigma)


def shape_of_result(
    result: Result,
    placed: Callable[[Result | Alternative], tuple[Alignment, Warp]],
    *,
    rms: float,
    sigma: float,
) -> AlignedShape:
    """The aligned shape of a result.

    ``placed`` tells the alignment of an estimate's box and what remains of its shape; ``rms`` and
    ``sigma`` are those of `AlignedShape` [px].
    """
    alternatives = []
    for other in result.alternatives:
        alignment, warp = placed(other)
        alternatives.append(AlignedAlternative(alignment, other.relative_likelihood, warp))
    alignment, warp = placed(result)
    return AlignedShape(
        alignment, result.std, rms, sigma, result.warnings, tuple(alternatives), warp
    )


def box_alignment(
    alignment: Alignment, bounds: FloatArray, *, model_bounds: FloatArray
) -> Alignment:
    """The alignment that takes a model's box to where another one takes given bounds (2, 3).

    Examples
    --------
    >>> found = Alignment(np.eye(3), [0, 0, 4], [1, 1, 1])
    >>> other = box_alignment(found, np.array([[0, 0, 0], [1, 2, 3]]),
    ...                       model_bounds=np.array([[-1, -1, -1], [1, 1, 1]]))
    >>> other.scale.tolist(), other.translation.tolist()
    ([0.5, 1.0, 1.5], [0.5, 1.0, 5.5])
    """
    lengths, given = np.ptp(bounds, axis=0) * alignment.scale, np.ptp(model_bounds, axis=0)
    scale = np.maximum(lengths, _LEAST_SCALE) / np.where(given > 0, given, 1.0)
    scale = np.where(given > 0, scale, 1.0)
    center = alignment.apply(bounds.mean(axis=0)[None])[0]
    shift = alignment.rotation @ (scale * model_bounds.mean(axis=0))
    return Alignment(alignment.rotation, center - shift, scale)


def _rms(result: Result) -> float:
    """Root mean square residual [px], outliers included, as of the other methods."""
    return float(np.sqrt((result.residuals**2).sum(axis=1).mean()))
