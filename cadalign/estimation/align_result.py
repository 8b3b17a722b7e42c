"""The result of an alignment to everything that is known about an object."""

from __future__ import annotations

import os
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import InputError
from cadalign.estimation.model import Model
from cadalign.estimation.result import FitStats
from cadalign.estimation.uncertainty.evidence import AnyBasis, contributions_of
from cadalign.estimation.uncertainty.summary import Contribution, EvidenceSummary, MaskResiduals
from cadalign.estimation.uncertainty.weakness import Uncertainty
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.shapes.model import ShapeModel
from cadalign.shapes.parts import NearestShape
from cadalign.shapes.tails import radius_of
from cadalign.shapes.warp import warp_mesh

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from cadalign.estimation.view import View
    from cadalign.export import ExportOptions


@dataclass(frozen=True, eq=False)
class AlignAlternative:
    """Another estimate that the evidence cannot tell from the best one.

    Parameters
    ----------
    alignment : Alignment
    points_3d : (m, 3) float
        Its keypoints in the model's frame.
    bounds : (2, 3) float
        Its box in the model's frame.
    relative_likelihood : float
        Its probability over that of the best one.
    """

    alignment: Alignment
    points_3d: FloatArray
    bounds: FloatArray
    relative_likelihood: float

    @property
    def box(self) -> Box:
        """Its box in the first camera's frame."""
        return Box.from_model(self.bounds, self.alignment)


@dataclass(frozen=True, eq=False)
class AlignResult:
    """An object's pose, stretch and shape, with their uncertainty.

    Parameters
    ----------
    alignment : Alignment
        Pose in the first view's camera, and stretch. ``alignment.apply(points_3d)`` are the
        object's keypoints in that camera's frame.
    ids : tuple of int or str
        Ids or names of the m keypoints.
    points_3d : (m, 3) float
        All keypoints of the model as they are on the object, also those that no view shows, in the
        model's frame and before its stretch.
    bounds : (2, 3) float
        Least and greatest coordinates of the object in the same frame.
    poses : tuple of Alignment
        The alignment in every view's camera.
    residuals : tuple of (n_v, 2) float
        Projected minus observed keypoints of every view [px].
    inliers : tuple of (n_v,) bool
        Keypoints of every view that the estimate rests on.
    covariance : (9, 9) float
        Of the rotation vector in the first camera's frame [rad], the translation [model units], and
        the logarithms of the object's lengths along x, y, z relative to the mean's; zero for what
        is held. The second moment of the posterior about the estimate: the inverse information of
        all evidence and priors and, where other estimates are likely too, their distance.
    points_covariance : (m, 3, 3) float
        Of each keypoint in the model's frame, stretch included [model units squared].
    points_cam_covariance : (m, 3, 3) float
        Of each keypoint in the first camera's frame, where pose and shape vary together
        [model units squared].
    stretch : (3,) float
        Lengths of the object along x, y, z relative to the model's or, for a learned shape, to the
        mean's.
    component : int
        Number of the mixture's component that the object belongs to.
    model : Model or ShapeModel, optional
        The model, as given; None for a result that was read from a file.
    alternatives : tuple of AlignAlternative
        Other estimates whose probability is at least 1/1000 of the best one's.
    warnings : tuple of str
        What the evidence leaves undetermined, and what contradicts the rest.
    stats : FitStats
    evidence : tuple of EvidenceSummary
        Agreement of every piece of evidence with the estimate.
    mask_residuals : tuple of MaskResiduals or None
        Agreement of the contour of every view's mask with the estimate; empty without masks.
    rig_from_model : Alignment, optional
        The alignment in the frame that views with ``cam_from_rig`` share; None without them.
    basis : AnyBasis, optional
        What `contributions` is computed from.
    equal_under_symmetry : str
        Clause about the alignments that are equal to this one under the model's symmetry; empty
        without one. This is the canonical one of them, in which ``covariance`` leaves out rotations
        about an axis of the symmetry.
    cameras : tuple of Camera
        The camera of every view; empty for a result that an earlier version wrote.
    observed : tuple of (n_v, 2) float
        Observed keypoints of every view [px]; empty where ``cameras`` is.
    degrees_of_freedom : float, optional
        Of the t distribution of the errors, whose covariance the stated ones are; None if they are
        Gaussian. `radius` depends on it.
    """

    alignment: Alignment
    ids: tuple[Hashable, ...]
    points_3d: FloatArray
    bounds: FloatArray
    poses: tuple[Alignment, ...]
    residuals: tuple[FloatArray, ...]
    inliers: tuple[BoolArray, ...]
    covariance: FloatArray
    points_covariance: FloatArray
    points_cam_covariance: FloatArray
    stretch: FloatArray
    component: int
    model: Model | ShapeModel | None
    alternatives: tuple[AlignAlternative, ...]
    warnings: tuple[str, ...]
    stats: FitStats
    evidence: tuple[EvidenceSummary, ...] = ()
    mask_residuals: tuple[MaskResiduals | None, ...] = ()
    rig_from_model: Alignment | None = None
    basis: AnyBasis | None = field(default=None, repr=False)
    equal_under_symmetry: str = ""
    cameras: tuple[Camera, ...] = ()
    observed: tuple[FloatArray, ...] = ()
    degrees_of_freedom: float | None = None

    @property
    def rms(self) -> float:
        """Root mean square length of the inliers' residuals [px]."""
        pairs = zip(self.residuals, self.inliers, strict=True)
        kept = np.concatenate([residuals[inliers] for residuals, inliers in pairs])
        return float(np.sqrt((kept * kept).sum() / max(len(kept), 1)))

    @property
    def std(self) -> Uncertainty:
        """Standard deviations of rotation, translation and stretch."""
        variance = np.maximum(self.covariance.diagonal(), 0.0)
        tx, ty, tz, sx, sy, sz = np.sqrt(variance[3:]).tolist()
        rotation_deg = float(np.degrees(np.sqrt(variance[:3].sum())))
        return Uncertainty(rotation_deg, (tx, ty, tz), (sx, sy, sz), focal=0.0)

    @property
    def probability(self) -> float:
        """Probability of the estimate itself rather than of one of its alternatives."""
        return 1 / (1 + sum(other.relative_likelihood for other in self.alternatives))

    def radius(self, probability: float, *, dimension: int = 1) -> float:
        """Radius, in stated deviations, of the region that holds the truth with a probability.

        Parameters
        ----------
        probability : float
            Between 0 and 1.
        dimension : int
            Number of coordinates that the region has: 1 for an interval, 3 for a rotation or a
            keypoint, whose regions are ellipsoids.

        Raises
        ------
        InputError
            If the probability is not between 0 and 1, or the dimension is not positive.
        """
        if not 0 < probability < 1:
            raise InputError(f"{probability!r} is not between 0 and 1", where="probability")
        if dimension < 1:
            raise InputError(f"{dimension!r} is not a positive number", where="dimension")
        return radius_of(probability, dimension, self.degrees_of_freedom)

    @property
    def box(self) -> Box:
        """The object's box in the first camera's frame."""
        return Box.from_model(self.bounds, self.alignment)

    def mesh(self, mesh: Mesh | None = None) -> Mesh:
        """A model's mesh, warped so that its keypoints are the object's.

        Parameters
        ----------
        mesh : Mesh, optional
            By default that of the `Model`. For a learned shape, that of `nearest`.

        Returns
        -------
        Mesh
            In the model's frame, before the stretch; ``alignment`` places it.

        Raises
        ------
        InputError
            If there is no mesh to warp.
        """
        if isinstance(self.model, Model):
            given = mesh if mesh is not None else self.model.mesh
            if given is None:
                raise InputError("the model has no mesh", where="mesh", fix="give one")
            if self.model.shape_sigma is None:
                return given
            return warp_mesh(given, self.model.points_3d, self.points_3d, bounds=self.bounds)
        if mesh is None:
            fix = "give that of the training model `nearest`, read from its mesh_path"
            raise InputError("a learned shape has no mesh of its own", where="mesh", fix=fix)
        source = self.nearest.points_3d
        known = np.isfinite(source).all(axis=1)
        return warp_mesh(mesh, source[known], self.points_3d[known], bounds=self.bounds)

    @property
    def nearest(self) -> NearestShape:
        """The training model of a learned shape whose keypoints are nearest to the object's.

        Raises
        ------
        InputError
            If the model is not learned, or its training models are not known.
        """
        if not isinstance(self.model, ShapeModel):
            raise InputError("only a learned shape has training models", where="model")
        return self.model.nearest(self.points_3d)

    def export(
        self,
        path: str | os.PathLike[str],
        views: View | Sequence[View],
        *,
        format: str | None = None,
        options: ExportOptions | None = None,
        **of_the_object: Any,
    ) -> Path:
        """Write the aligned object for another tool; see `cadalign.export.export_object`.

        Parameters
        ----------
        path, format, options
            As for `cadalign.FitResult.export`.
        views : View or sequence of View
            Those of the alignment.
        **of_the_object
            ``mesh``, ``images``, ``world_from_cam``, ``name`` and ``metres`` of
            `cadalign.estimation.exporting.object_of_align`.
        """
        from cadalign.estimation.exporting import object_of_align
        from cadalign.export import export_object

        exported = object_of_align(self, views, **of_the_object)
        return export_object(path, exported, format=format, options=options)

    def contributions(self) -> tuple[Contribution, ...]:
        """Standard deviations without each piece of evidence; compare them with ``std``.

        They are linearised at the estimate, infinite for what nothing else determines. Without the
        known motion of its camera, a view has a pose of its own. Empty for the keypoints of one
        view of an exact model, which nothing can be left out of.

        Raises
        ------
        InputError
            If the result was read from a file, which does not hold the evidence.

        Examples
        --------
        >>> from cadalign import Camera, Size, View, align
        >>> corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
        >>> camera = Camera(640, 480, 900, 900, 319.5, 239.5)
        >>> truth = Alignment(np.diag([-1.0, -1.0, 1.0]), [0.3, 0.2, 6.0], [1.2, 1.1, 0.9])
        >>> view = View(camera, camera.project(truth.apply(corners)))
        >>> result = align(Model(points_3d=corners), view, size=Size(width=1.2))
        >>> [(each.name, round(each.without.scale[0], 3)) for each in result.contributions()]
        [('views[0].points_2d', 0.01), ('size', inf)]
        """
        if self.basis is None:
            if self.model is not None:
                return ()
            what = "the result holds no evidence: it was read from a file"
            raise InputError(what, where="contributions", fix="align again")
        return contributions_of(self.basis)

    def __repr__(self) -> str:
        stretch = ", ".join(f"{value:.3g}" for value in self.stretch)
        return (
            f"AlignResult(views={len(self.poses)}, rms={self.rms:.3g} px, stretch=({stretch}), "
            f"warnings={len(self.warnings)})"
        )

    def _repr_html_(self) -> str:
        from cadalign.estimation.drawing import alignment_html

        return alignment_html(self)

    def plot(
        self,
        image: npt.ArrayLike | str | os.PathLike[str] | None = None,
        mesh: Mesh | None = None,
        *,
        view: int = 0,
        axes: Axes | None = None,
    ) -> Axes:
        """Draw photo, model, box, and keypoints with their residuals on matplotlib axes.

        Parameters
        ----------
        image, axes
            As for `FitResult.plot`.
        mesh : Mesh, optional
            As for `mesh`; by default that of the `Model`, if it has one.
        view : int
            Number of the view to draw.

        Returns
        -------
        matplotlib.axes.Axes

        Raises
        ------
        InputError
            If there is no such view, or the photo is not of its camera's size.
        """
        from cadalign.estimation.drawing import plot_alignment

        return plot_alignment(self, image, mesh, view=view, axes=axes)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the result as JSON, without its model; see `FitResult.save`."""
        from cadalign.io.files import write_json

        write_json(Path(path), self.to_dict())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> AlignResult:
        """Read what `save` or `cadalign fit` wrote; see `FitResult.load`."""
        from cadalign.io.documents import in_file, read_json

        data = read_json(Path(path))
        with in_file(Path(path)):
            return cls.from_dict(data)

    def to_dict(self) -> dict[str, Any]:
        """Write the result as plain lists and numbers, for JSON; its model is not part of it."""
        from cadalign.estimation.align_document import write_result

        return write_result(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> AlignResult:
        """Read what `to_dict` wrote.

        Raises
        ------
        InputError
            If a field is missing or invalid.
        """
        from cadalign.estimation.align_document import read_result

        return read_result(data)

    def __str__(self) -> str:
        count = sum(int(inliers.sum()) for inliers in self.inliers)
        of = sum(len(inliers) for inliers in self.inliers)
        text = f"{count}" if count == of else f"{count} of {of}"
        views = "" if len(self.poses) == 1 else f" in {len(self.poses)} views"
        std = self.std
        angle = np.degrees(np.arccos(np.clip((np.trace(self.alignment.rotation) - 1) / 2, -1, 1)))
        shift = ", ".join(f"{value:.4g}" for value in self.alignment.translation)
        shift_std = ", ".join(f"{value:.2g}" for value in std.translation)
        stretch = ", ".join(
            f"{value:.4g}" if deviation == 0 else f"{value:.4g} +- {100 * deviation:.2g} %"
            for value, deviation in zip(self.stretch, std.scale, strict=True)
        )
        lines = [
            f"{text} keypoints{views}, rms {self.rms:.3g} px",
            f"  rotation     {angle:.4g} deg from the camera's axes, +- {std.rotation_deg:.2g} deg",
            f"  translation  ({shift}) +- ({shift_std})",
            f"  stretch      ({stretch})",
        ]
        if self.equal_under_symmetry:
            lines.append(f"  symmetry     {self.equal_under_symmetry}")
        lines.extend(
            f"  also likely  ({other.relative_likelihood:.2g} x)" for other in self.alternatives
        )
        lines.extend(f"  warning      {text}" for text in self.warnings)
        return "\n".join(lines)
