"""Matches of a retrieval, and the uncertainty of their pose and stretch."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.estimation.assemble import KeypointPosterior
from cadalign.estimation.options import LOSSES, FitOptions, pixel_information
from cadalign.estimation.result import Result
from cadalign.estimation.result_parts import FittedKeypoints, Posterior, create_unchecked
from cadalign.estimation.uncertainty.residuals import loss_weights
from cadalign.geometry.alignment import Alignment, Box, Uncertainty, deviation_text
from cadalign.geometry.camera import Camera, projection_jacobian
from cadalign.geometry.mesh import Mesh
from cadalign.io.meshes.files import load_mesh
from cadalign.io.observation import Observation


@dataclass(frozen=True, eq=False)
class Match:
    """A model of the library, aligned with an image's keypoints."""

    category: str
    model_id: str
    result: Result
    """The alignment: camera, pose, stretch, box, and the keypoints that model and image share, with
    residuals. Its ``std`` is as of `cadalign.fit`; in a ranking by shape it is the uncertainty of
    the estimated shape's alignment, in the model's unit."""
    log_likelihood: float
    """Log-likelihood of all keypoints, marked and missing; see `cadalign.retrieval.options`."""
    score: float
    """Probability that this is the object's model: the likelihood over the sum of all models'
    likelihoods. It assumes that the object is in the library (in the category, if given) and all
    models are equally likely a priori. Under these assumptions it is calibrated: nine in ten
    matches with the score 0.9 are correct."""
    missing_ids: tuple[int, ...]
    """Semantic ids of the image's keypoints that the model lacks."""
    mesh_path: Path | None
    none_probability: float | None = None
    """Probability that the object is none of the library's models, even stretched; the same in all
    matches of an image. See `cadalign.retrieval.absence`. None in a ranking by shape, which assumes
    that the object is not in the library."""

    @property
    def alignment(self) -> Alignment:
        """Pose and stretch of the model."""
        return self.result.alignment

    @property
    def box(self) -> Box:
        """Box of the model in the camera frame."""
        return self.result.box

    @property
    def rms(self) -> float:
        """Root mean square length of the residuals [px]."""
        return self.result.rms

    @property
    def std(self) -> Uncertainty | None:
        """Standard deviations of pose and stretch, assuming that this is the object's model."""
        return self.result.std

    @property
    def shared(self) -> int:
        """Number of keypoints that model and image share."""
        return len(self.result.ids)

    def __repr__(self) -> str:
        stretch = ", ".join(f"{value:.3g}" for value in self.alignment.scale)
        return (
            f"Match({self.category!r}, {self.model_id!r}, score={self.score:.3g}, "
            f"rms={self.rms:.3g} px, shared={self.shared}, scale=({stretch}))"
        )

    @property
    def shared_text(self) -> str:
        """Numbers of shared keypoints and of the image's keypoints, such as "7/9", for tables."""
        return f"{self.shared}/{self.shared + len(self.missing_ids)}"

    @property
    def stretch_texts(self) -> tuple[str, str]:
        """Stretches along y and z with their standard deviations, for tables."""
        std = (0.0, 0.0, 0.0) if self.std is None else self.std.scale
        _, y, z = map("{:.3f}{}".format, self.alignment.scale, map(deviation_text, std))
        return y, z

    def observation(self, seen: Observation) -> Observation:
        """Select an observation's keypoints that the model has, and pair them with the model's."""
        given = cast(IntArray, seen.ids)
        shared = np.array(self.result.ids)
        kept = np.flatnonzero(np.isin(given, shared))
        ids = given[kept]
        own: dict[str, Any] = {name: getattr(seen, name) for name in ("sigma", "scores", "depths")}
        own = {name: None if each is None else each[kept] for name, each in own.items()}
        return replace(
            seen,
            points_3d=self.result.points_3d[np.searchsorted(shared, ids)],
            points_2d=seen.points_2d[kept],
            ids=ids,
            names=seen.names and tuple(seen.names[row] for row in kept.tolist()),
            model=self.mesh_path,
            others=(),
            **own,
        )

    def mesh(self) -> Mesh | None:
        """Read the model's mesh; None if it has none.

        Examples
        --------
        >>> best = library.retrieve(points_2d, ids, camera)[0]  # doctest: +SKIP
        >>> best.result.export("chair.glb", mesh=best.mesh())  # doctest: +SKIP
        """
        return None if self.mesh_path is None else load_mesh(self.mesh_path)

    def to_dict(self) -> dict[str, Any]:
        """Convert the match to plain lists and numbers, for JSON."""
        names = ("category", "model_id", "score", "log_likelihood", "rms", "shared")
        box = {name: getattr(self.box, name).tolist() for name in ("center", "rotation", "extents")}
        return {
            **{name: getattr(self, name) for name in names},
            "alignment": self.alignment.to_dict(),
            "box": box,
            "semantic_ids": list(self.result.ids),
            "residuals": self.result.residuals.tolist(),
            "missing_ids": list(self.missing_ids),
            "mesh": None if self.mesh_path is None else str(self.mesh_path),
            "camera": self.result.camera.to_dict(),
            "none_probability": self.none_probability,
            "std": self.std
            and {name: np.asarray(each).tolist() for name, each in vars(self.std).items()},
        }


def posterior_of_keypoints(
    points_3d: FloatArray,
    residuals: FloatArray,
    alignment: Alignment,
    camera: Camera,
    options: FitOptions,
) -> Posterior:
    """Posterior of `cadalign.fit` at its optimum, of keypoints (n, 3) with residuals (n, 2) [px].

    It has no covariance if the pose is not determined.
    """
    information = pixel_information(options.sigma, len(points_3d))
    squares = np.einsum("ni,nij,nj->n", residuals, information, residuals)
    weights = loss_weights(squares, LOSSES[options.loss], options.loss_scale)
    slopes = projection_jacobian(points_3d, camera, alignment)[:, :, :9]
    total = np.einsum("nki,n,nkl,nlj->ij", slopes, weights, information, slopes)
    total[range(6, 9), range(6, 9)] += options.prior_weight
    free, covariance = options.estimated_unknowns, np.zeros((9, 9))
    try:
        covariance[np.ix_(free, free)] = np.linalg.inv(total[np.ix_(free, free)])
    except np.linalg.LinAlgError:
        return Posterior()
    inliers = np.ones(len(points_3d), dtype=bool)
    given = points_3d, residuals, inliers, alignment, camera, options
    keypoints = FittedKeypoints(*given, fisher_covariance=covariance)
    known = {"keypoints": keypoints, "diagnosis": None, "fisher_covariance": covariance}
    return create_unchecked(KeypointPosterior, known)


def posterior_by_shape(shape: Result, alignment: Alignment, options: FitOptions) -> Posterior:
    """Posterior of an estimated shape's alignment, in the unit of a match's model."""
    free = options.stretched_axes
    held = next(axis for axis, name in enumerate("xyz") if name not in free)
    change, size = np.eye(9), np.linalg.norm(shape.alignment.translation)
    change[3:6] *= np.linalg.norm(alignment.translation) / size
    change[3:6, 6 + held] = -alignment.translation
    change[6:, 6 + held] -= 1.0
    change[6:] *= np.array([[name in free] for name in "xyz"])
    covariance = cast(FloatArray, shape.covariance)
    return Posterior(change @ covariance @ change.T, degrees_of_freedom=shape.degrees_of_freedom)
