"""The result of an estimate: values, uncertainty, plots, files and exports."""

from __future__ import annotations

import os
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, IntArray, is_number
from cadalign.errors import InputError, quote
from cadalign.estimation.options import FitOptions
from cadalign.estimation.result_parts import (
    NO_STATS,
    Alternative,
    FitStats,
    Posterior,
    ViewResult,
    points_covariances,
    rms_of,
)
from cadalign.geometry.alignment import (
    Alignment,
    Box,
    Uncertainty,
    extent,
    uncertain_of,
    uncertainty_of,
)
from cadalign.geometry.camera import Camera
from cadalign.geometry.symmetry import Symmetry
from cadalign.io.files import as_path, write_json
from cadalign.io.focal import FocalPrior

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from cadalign.estimation.model import Model
    from cadalign.estimation.result_parts import EstimateWarning, EvidenceSummary
    from cadalign.geometry.mesh import Mesh
    from cadalign.shapes.model import ShapeModel
    from cadalign.shapes.parts import TrainingShapes


@dataclass(frozen=True, eq=False)
class Result:
    """Pose, stretch and shape of an object, with their uncertainty.

    Returned by `cadalign.fit`, `cadalign.align`, batches, retrieval and the annotator.

    Parameters
    ----------
    views : tuple of ViewResult
        Camera, pose, residuals and inliers of every view.
    ids : tuple of int or str
        Ids or names of the m keypoints; for `cadalign.fit`, their rows.
    points_3d : (m, 3) float
        All keypoints of the estimated shape, visible or not, in the model's frame before the
        stretch. For an exact model these are the given keypoints; with a symmetry, moved by the
        motion that leads to this alignment.
    method : str
        Method of `cadalign.fit`, or "align" for a joint estimate from all evidence.
    posterior : Posterior
        Uncertainty of the estimate, and warnings.
    stretched_axes : str
        Axes whose scale was estimated.
    focal : {"known", "estimate"}
        Whether the cameras' focal lengths were known or estimated.
    focal_prior : FocalPrior, optional
        Prior on the estimated focal length.
    sigma : float, optional
        Standard deviation of the keypoints [px], given or estimated; None where each keypoint has
        its own.
    cost : float, optional
        -2 log likelihood of evidence and priors, up to a constant: the sum of squared whitened
        residuals, or of their losses. None for methods that are not statistical.
    alternatives : tuple of Alternative
        Other estimates that explain the evidence as well: with 4 points all other exact solutions,
        otherwise minima with at least 1/1000 of the best likelihood.
    stats : FitStats
    options : FitOptions, optional
        As for `cadalign.fit`.
    symmetry : Symmetry, optional
        The model's symmetry, as given. The result is the canonical of all equivalent alignments.
    model : Model or ShapeModel, optional
        The model of `cadalign.align`; None for a result that was read from a file.
    component : int
        Index of the mixture component that the object belongs to.
    rig_from_model : Alignment, optional
        The alignment in the rig's frame; None for views without ``cam_from_rig``.
    own_bounds, own_stretch : optional
        ``bounds`` and ``stretch``, unless they are the keypoints' bounds and the scale.
    """

    views: tuple[ViewResult, ...]
    ids: tuple[Hashable, ...]
    points_3d: FloatArray
    method: str
    posterior: Posterior = field(repr=False)
    stretched_axes: str = "yz"
    focal: str = "known"
    focal_prior: FocalPrior | None = None
    sigma: float | None = None
    cost: float | None = None
    alternatives: tuple[Alternative, ...] = ()
    stats: FitStats = NO_STATS
    options: FitOptions | None = None
    symmetry: Symmetry | None = None
    model: Model | ShapeModel | None = None
    component: int = 0
    rig_from_model: Alignment | None = None
    own_bounds: FloatArray | None = None
    own_stretch: FloatArray | None = None

    def __str__(self) -> str:
        from cadalign.export.results import result_text

        return result_text(self)

    def __repr__(self) -> str:
        stretch = ", ".join(f"{value:.3g}" for value in self.stretch)
        views = "" if len(self.views) == 1 else f"views={len(self.views)}, "
        return (
            f"Result({self.method!r}, {views}keypoints={int(self.inliers.sum())}/"
            f"{len(self.inliers)}, rms={self.rms:.3g} px, stretch=({stretch}), "
            f"warnings={len(self.warnings)})"
        )

    @property
    def alignment(self) -> Alignment:
        """Pose in the first view's camera, and scale.

        ``alignment.apply(points_3d)`` are the object's keypoints in the camera's frame.
        """
        return self.views[0].alignment

    @property
    def camera(self) -> Camera:
        """The first view's camera, with the estimated focal length if it was unknown."""
        return self.views[0].camera

    @property
    def poses(self) -> tuple[Alignment, ...]:
        """The alignment in every view's camera."""
        return tuple(view.alignment for view in self.views)

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The camera of every view."""
        return tuple(view.camera for view in self.views)

    @property
    def residuals(self) -> FloatArray:
        """Projected minus observed keypoints (n, 2) of all views, concatenated [px].

        Infinite for outliers behind the camera.
        """
        return np.concatenate([view.residuals for view in self.views])

    @property
    def inliers(self) -> BoolArray:
        """Keypoints (n,) bool of all views that the estimate uses."""
        return np.concatenate([view.inliers for view in self.views])

    @property
    def rms(self) -> float:
        """Root mean square length of the inliers' residuals [px]."""
        if len(self.views) == 1:
            return self.views[0].rms
        return rms_of(self.residuals, self.inliers)

    @property
    def covariance(self) -> FloatArray | None:
        """Calibrated covariance (9, 9) or (10, 10) of the estimate's errors.

        The unknowns are the rotation vector in the first camera's frame [rad], the translation
        [model units], the logarithms of the object's lengths along x, y, z and, if estimated, of
        the focal length. Rows of fixed unknowns are zero. None for methods that are not
        statistical.

        For keypoints of an exact model in one view, it is the posterior's second moment about the
        alignment, from some thousand draws (always the same). It is scaled so that the 95 %
        ellipsoid covers what the likelihood ratio test does not reject at 5 %. If sigma was
        estimated, it is widened for the few degrees of freedom of that estimate. It excludes the
        ``alternatives``. Beyond 100 keypoints it is ``fisher_covariance``, widened likewise.

        For other evidence it is the inverse information of all evidence and priors, calibrated for
        learned shapes. Where other estimates are likely too, it includes their distance.

        Turns about an axis of continuous symmetry have no variance.
        """
        return self.posterior.covariance

    @property
    def fisher_covariance(self) -> FloatArray | None:
        """Inverse Fisher information at the optimum (Cramer-Rao bound), laid out as ``covariance``.

        With few keypoints the errors are larger. None for methods that are not statistical, and if
        the result's file lacks it.
        """
        return self.posterior.fisher_covariance

    @property
    def std(self) -> Uncertainty | None:
        """Standard deviations from ``covariance``; None for methods that have none."""
        return None if self.covariance is None else uncertainty_of(self.covariance)

    @property
    def uncertain(self) -> tuple[str, ...]:
        """Names of quantities with a standard deviation beyond 25 %, or 30 degrees.

        Any of "s_x", "s_y", "s_z", "distance" (to the model's origin), "focal length", "rotation".
        They give no warnings.
        """
        return () if self.covariance is None else uncertain_of(self.alignment, self.covariance)

    @property
    def degrees_of_freedom(self) -> float | None:
        """Degrees of freedom of the errors' t distribution; None if the errors are Gaussian.

        All covariances are covariances of this distribution. `radius` depends on it.
        """
        return self.posterior.degrees_of_freedom

    @cached_property
    def _propagated(self) -> tuple[FloatArray, FloatArray] | None:
        if self.covariance is None:
            return None
        return points_covariances(self.points_3d, self.alignment, self.covariance)

    @property
    def points_covariance(self) -> FloatArray | None:
        """Covariance (m, 3, 3) of each keypoint in the model's frame, after the stretch."""
        stated = self.posterior.points_covariance
        return stated if stated is not None or self._propagated is None else self._propagated[0]

    @property
    def points_cam_covariance(self) -> FloatArray | None:
        """Covariance (m, 3, 3) of each keypoint in the first camera's frame."""
        stated = self.posterior.points_cam_covariance
        return stated if stated is not None or self._propagated is None else self._propagated[1]

    @property
    def warnings(self) -> tuple[EstimateWarning, ...]:
        """Warnings about problems that `std` does not show, such as contradictions or other poses.

        Quantities that are merely ``uncertain`` have none. Each warning has a ``kind``, a ``text``,
        and the ``view`` and ``keypoints`` that it concerns.
        """
        return self.posterior.warnings

    @property
    def evidence(self) -> tuple[EvidenceSummary, ...]:
        """Agreement of every piece of evidence with the estimate."""
        return self.posterior.evidence

    @property
    def bounds(self) -> FloatArray:
        """Minimum and maximum coordinates (2, 3) of the object in the model's frame.

        Bounds of the keypoints if the model has no others.
        """
        return extent(self.points_3d) if self.own_bounds is None else self.own_bounds

    @property
    def lines(self) -> IntArray:
        """Lines (k, 2) of the shape's skeleton, as rows of ``points_3d``; usually none."""
        return np.array(getattr(self.model, "lines", ()), dtype=np.int64).reshape(-1, 2)

    @property
    def box(self) -> Box:
        """The object's box in the first camera's frame."""
        return Box.from_model(self.bounds, self.alignment)

    @property
    def stretch(self) -> FloatArray:
        """Lengths (3,) of the object relative to the model or, for a learned shape, to the mean."""
        return self.alignment.scale if self.own_stretch is None else self.own_stretch

    def radius(self, probability: float, *, dimension: int = 1) -> float:
        """Radius, in standard deviations, of the region with a probability to contain the truth.

        Parameters
        ----------
        probability : float
            Between 0 and 1.
        dimension : int
            Dimension of the region: 1 for an interval, 3 for the ellipsoid of a rotation,
            translation or keypoint, along the principal axes of its covariance. Not for
            ``std.rotation_deg``, a total over three axes.

        Raises
        ------
        InputError
            If the probability is not between 0 and 1, or the dimension is not positive.
        """
        from cadalign.shapes.parts import radius_of

        if not is_number(probability) or not 0 < probability < 1:
            raise InputError(f"{quote(probability)} is not between 0 and 1", where="probability")
        if not is_number(dimension) or dimension < 1:
            raise InputError(f"{quote(dimension)} is not a positive number", where="dimension")
        return radius_of(probability, dimension, self.degrees_of_freedom)

    def mesh(self, mesh: Mesh | str | os.PathLike[str] | None = None) -> Mesh:
        """Warp a mesh so that its keypoints are the object's keypoints.

        Parameters
        ----------
        mesh : Mesh or path, optional
            Default: the mesh of the `Model` or, for a learned shape, of the nearest training model.
            For an exact or unknown model it is not warped.

        Returns
        -------
        Mesh
            In the model's frame, before the stretch; ``alignment`` places it.

        Raises
        ------
        InputError
            If there is no mesh to warp.
        """
        from cadalign.geometry.mesh import Mesh
        from cadalign.io.meshes.files import load_mesh
        from cadalign.shapes.model import ShapeModel
        from cadalign.shapes.warp import warp_mesh

        model, source = self.model, cast(FloatArray | None, None)
        if isinstance(model, ShapeModel):
            row, training = model.nearest(self.points_3d), cast("TrainingShapes", model.training)
            source = training.points_3d[row].astype(np.float64)
            mesh = training.mesh_paths[row] if mesh is None else mesh
        elif model is not None:
            source = None if model.shape_sigma is None else cast(FloatArray, model.points_3d)
            mesh = model.mesh if mesh is None else mesh
        if mesh is None:
            raise InputError("the model has no mesh", where="mesh", fix="give one")
        own = mesh if isinstance(mesh, Mesh) else load_mesh(as_path(mesh, "mesh"))
        if source is None:
            return own
        known = np.isfinite(source).all(axis=1)
        return warp_mesh(own, source[known], self.points_3d[known], bounds=self.bounds)

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
        image : (h, w, 3) uint8 or path, optional
            The photo; grey by default.
        mesh : Mesh, optional
            As for `mesh`, drawn shaded with its outline; default: the model's mesh, if it has one.
            Without a mesh the box shows ``bounds``, and ``lines`` are drawn.
        view : int
            Number of the view to draw.
        axes : matplotlib.axes.Axes, optional
            Axes to draw on; default: the axes of a new figure.

        Returns
        -------
        matplotlib.axes.Axes
            In pixels: x right, y down.

        Raises
        ------
        InputError
            If there is no such view, or the photo's size is not the camera's.

        Examples
        --------
        >>> from matplotlib.figure import Figure
        >>> from cadalign import Camera, fit
        >>> camera = Camera(640, 480, 900, 900, 319.5, 239.5)
        >>> corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
        >>> result = fit(corners, camera.project(corners + [0.1, 0.2, 5.0]), camera)
        >>> axes = result.plot(axes=Figure().add_subplot())
        >>> [float(y) for y in axes.get_ylim()]
        [479.5, -0.5]
        """
        from cadalign.export.results import plot_result

        return plot_result(self, image, mesh, view=view, axes=axes)

    def export(
        self,
        path: str | os.PathLike[str],
        **options: Any,
    ) -> Path:
        """Write the aligned object for another tool; see `cadalign.export.export_object`.

        Parameters
        ----------
        path : path-like
            The extension chooses the format: ``.glb``, ``.obj`` or ``.ply``.
        **options
            ``mesh``, ``photos`` and ``name`` of `cadalign.export.object_of`.

        Examples
        --------
        >>> result.export("chair.glb", mesh=mesh, photos=["chair.jpg"])  # doctest: +SKIP
        """
        from cadalign.export import export_object, object_of

        return export_object(path, object_of(self, **options))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the result as JSON, as `cadalign fit` does.

        Raises
        ------
        DataError
            If the file cannot be written.
        """
        write_json(as_path(path), self.to_dict())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Result:
        """Read a file written by `save` or `cadalign fit`.

        Raises
        ------
        DataError
            If the file cannot be read, or a field is missing or invalid; the message names both.
        """
        from cadalign.io.documents import name_file, read_json
        from cadalign.io.kinds import FIT

        path = as_path(path)
        data = read_json(path, FIT)
        with name_file(path):
            return cls.from_dict(data)

    def to_dict(self) -> dict[str, Any]:
        """Convert the result, without the model, to plain lists and numbers for JSON."""
        from cadalign.estimation.document import write_result  # imports the validation library

        return write_result(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Result:
        """Read a dict written by `to_dict`.

        Raises
        ------
        InputError
            If a field is missing or invalid.
        """
        from cadalign.estimation.document import read_result

        return cls(**read_result(data))
