"""Surfaces, measurements of their outlines, and the noise of these."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import ClassVar, Literal, NamedTuple, cast

import numpy as np
from scipy.spatial import ConvexHull

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.errors import InputError
from cadalign.estimation.contours.contour import Contour
from cadalign.estimation.model import Model
from cadalign.estimation.result_parts import EstimateWarning, EvidenceSummary
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh, barycentric_of
from cadalign.geometry.raycaster import RayCaster
from cadalign.io.meshes.files import mesh_at
from cadalign.shapes.model import ShapeModel
from cadalign.shapes.warp import LinearWarp, linear_warp
from cadalign.solvers.joint.evidence import Shape, State, points_of

_QHULL = "QJ Pp"  # joggled, for flat meshes


class RigidSurface:
    """The surface of an exact or stretched model, the same at all states."""

    is_exact = True

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self.caster = RayCaster(mesh)

    def pose(self, shape: Shape, state: State) -> PosedSurface:
        """The mesh at a state."""
        return self

    def rows(self, points: FloatArray, face: IntArray) -> tuple[FloatArray, FloatArray]:
        """Mean (n, 3) and modes (K, n, 3) of ``points`` (n, 3) on the triangles ``face`` (n,)."""
        return points, np.zeros((0, len(points), 3))


class WarpedSurface:
    """A mesh or hull that is warped from keypoints ``source`` (n, 3) to ``rows`` of a shape."""

    is_exact = False

    def __init__(self, mesh: Mesh, source: FloatArray, rows: IntArray, *, is_hull: bool) -> None:
        self.mesh = mesh
        self._rows, self._is_hull = rows, is_hull
        used = np.unique(_hull_faces(mesh.vertices)) if is_hull else slice(None)
        self._warp = linear_warp(mesh.vertices[used], mesh.bounds, source)

    def pose(self, shape: Shape, state: State) -> PosedSurface:
        """See `RigidSurface`."""
        points = points_of(shape, state) / np.exp(state.log_scales)
        vertices = self._warp.apply(points[self._rows], np.sort(points[-2:], axis=0))
        mesh = Mesh(vertices, _hull_faces(vertices) if self._is_hull else self.mesh.faces)
        return WarpedMesh(mesh, self._warp, self._rows, shape.modes, state.coefficients)


@dataclass(frozen=True, eq=False)
class WarpedMesh:
    """A mesh warped to one state, with ``modes`` and ``coefficients`` of the shape."""

    mesh: Mesh
    warp: LinearWarp
    keypoints: IntArray
    modes: FloatArray
    coefficients: FloatArray

    @cached_property
    def caster(self) -> RayCaster:
        return RayCaster(self.mesh)

    def rows(self, points: FloatArray, face: IntArray) -> tuple[FloatArray, FloatArray]:
        """See `RigidSurface`."""
        corners = self.mesh.faces[face]
        shares = _barycentric(self.mesh.vertices[corners], points)[:, :, None]
        here = LinearWarp(*((shares * each[corners]).sum(axis=1) for each in self.warp))
        modes = np.zeros((len(self.modes), len(points), 3))
        for k, mode in enumerate(self.modes):
            modes[k] = here.derivative(mode[self.keypoints], mode[-2:])
        # The mean includes the keypoints' independent displacements.
        return points - np.tensordot(self.coefficients, modes, axes=1), modes


rigid_surface = lru_cache(maxsize=32)(RigidSurface)
"""The cached surface of a mesh."""

PosedSurface = RigidSurface | WarpedMesh
"""A surface at one state of the shape, before its stretch."""
Surface = RigidSurface | WarpedSurface
"""A mesh that follows the shape."""


def _barycentric(triangles: FloatArray, points: FloatArray) -> FloatArray:
    """Barycentric coordinates (n, 3) of points (n, 3) on triangles (n, 3, 3)."""
    shares = barycentric_of(triangles, points)
    shares = np.clip(np.where(np.isfinite(shares), shares, 1 / 3), 0.0, 1.0)
    return np.asarray(shares / shares.sum(axis=1, keepdims=True))


def _hull_faces(vertices: FloatArray) -> IntArray:
    return cast(IntArray, ConvexHull(vertices, qhull_options=_QHULL).simplices.astype(np.int64))


def surface_of(
    model: Model | ShapeModel, points_3d: FloatArray, where: str, *, is_hull: bool = False
) -> Surface:
    """The surface of a shape with keypoints near ``points_3d`` (m, 3).

    A learned shape has the mesh of the nearest training model. Raises InputError, at the mask or
    photo ``where``, if there is no mesh; DataError if it cannot be read.
    """
    wanting = "a photo" if where.endswith("image") else "a mask"
    if isinstance(model, ShapeModel):
        return WarpedSurface(*_nearest_with_mesh(model, points_3d, where, wanting), is_hull=is_hull)
    if model.mesh is None:
        fix = "give it: Model(..., mesh=cadalign.load_mesh(path))"
        raise InputError(f"the model has no mesh, which {wanting} needs", where=where, fix=fix)
    if model.shape_sigma is None:
        return rigid_surface(model.mesh)
    points = cast(FloatArray, model.points_3d)
    return WarpedSurface(model.mesh, points, np.arange(len(points)), is_hull=is_hull)


def _nearest_with_mesh(
    model: ShapeModel, points_3d: FloatArray, where: str, wanting: str
) -> tuple[Mesh, FloatArray, IntArray]:
    training = model.training
    rows = [] if training is None else training.rows_with_mesh
    if training is None or not rows:
        fix = "learn it from a data set with meshes, such as KeypointNet beside ShapeNet's models"
        what = f"no training model has a mesh, which {wanting} needs"
        raise InputError(what, where=where, fix=fix)
    squares = ((training.points_3d[rows].astype(np.float64) - points_3d) ** 2).sum(axis=2)
    known = np.isfinite(squares)
    sums = np.where(known, squares, 0.0).sum(axis=1)
    distances = np.where(known.any(axis=1), sums / np.maximum(known.sum(axis=1), 1), np.inf)
    row = rows[int(distances.argmin())]
    source = training.points_3d[row].astype(np.float64)
    known = np.flatnonzero(np.isfinite(source).all(axis=1))
    return mesh_at(cast(Path, training.mesh_paths[row])), source[known], known


LOSS_SCALE = 2.4
"""Scale of Cauchy's loss [sigma], for 95 % efficiency."""
LEAST_LOSS_SCALE = 1.0
"""Least scale of Cauchy's loss [px]: quantisation displaces a contour by up to one pixel."""
LEAST_OFFSET = 0.1
"""Least standard deviation of a contour's common offset [px]."""
REGISTRATION = 0.3
"""Standard deviation of a contour's registration along x and y [px]."""
INLIER = 3.5
"""Largest residual of an inlier [sigma]."""
_TO_SIGMA = 1.4826  # from the median of absolute values to the standard deviation of a Gaussian
_MOST_LAGS = 100
_LEAST_PAIRS = 20
_ALIKE, _ALIKE_OFFSETS = 0.2, 0.8  # largest changes of log variances


class Noise(NamedTuple):
    """Noise of a contour's samples.

    ``sigma`` is their standard deviation [px], or a factor on the samples' own; ``correlation`` the
    number of neighbours that count as one; ``offset`` the deviation of their common offset [px].
    """

    sigma: float
    correlation: float
    offset: float

    @property
    def loss_scale(self) -> float:
        """Scale of Cauchy's loss, in standard deviations ``sigma``."""
        return max(LOSS_SCALE, LEAST_LOSS_SCALE / self.sigma)

    @property
    def deviation(self) -> float:
        """Standard deviation of an independent sample with the same information [px]."""
        return self.sigma * float(np.sqrt(self.correlation))

    def costs(self, residuals: FloatArray) -> FloatArray:
        square = self.loss_scale**2
        return np.asarray(
            square / self.correlation * np.log1p((residuals / self.sigma) ** 2 / square)
        )


def trimmed_deviation(residuals: FloatArray, least: float) -> float:
    """Root mean square of residuals (n,) without outliers beyond ``least``; 0 if empty."""
    if not len(residuals):
        return 0.0
    robust = _TO_SIGMA * float(np.median(np.abs(residuals)))
    kept = residuals[np.abs(residuals) < max(INLIER * robust, least)]
    return float(np.sqrt((kept**2).mean()))


def correlation_length(
    contour: Contour,
    residuals: FloatArray,
    kept: BoolArray,
    scale: float = np.inf,
    least: float = 0.0,
) -> float:
    """Number of neighbouring samples that count as one, at least 1.

    The integrated autocorrelation ``1 + 2 sum of rho`` of the ``kept`` residuals (S,), weighted by
    Cauchy's loss of ``scale``, up to the first lag without positive correlation (Geyer, "Practical
    Markov chain Monte Carlo", 1992). A variance below the square of ``least`` is filled up with
    uncorrelated noise.
    """
    values = np.where(kept, residuals / (1 + (residuals / scale) ** 2), 0.0)
    variance = max(float((values**2).sum() / max(kept.sum(), 1)), least**2)
    if not variance > 0:
        return 1.0
    total = 1.0
    for lag in range(1, _MOST_LAGS):
        pairs = contour.neighbours(kept, lag)
        count = int(pairs.sum())
        if count < _LEAST_PAIRS:
            break
        rho = float((values[lag:] * values[:-lag])[pairs].sum() / count / variance)
        if rho <= 0:
            break
        total += 2 * rho
    return total


class Outline(NamedTuple):
    """Measurements at S samples of a model's outline in one view.

    ``points`` (S, 3) lie on the rim, in the model's frame before the stretch, on triangles ``face``
    (S,). Where ``found`` (S,), the source's ``contour`` lies ``places`` (S,) [px] outwards of it,
    with relative deviations ``sigmas`` (S,). A change of a ray (2,) times ``across`` (S, 2) is the
    motion outwards [px]. ``reach`` [px] is the largest distance of a contour, ``contrast`` [nats]
    the difference of the colours inside and outside.
    """

    contour: Contour
    found: BoolArray
    places: FloatArray
    sigmas: FloatArray
    points: FloatArray
    face: IntArray
    across: FloatArray
    reach: float
    contrast: float = 0.0

    def residuals(self, offset: float) -> FloatArray:
        """Places (S,) [px] minus the common ``offset``; NaN where not found."""
        return np.where(self.found, self.places - offset, np.nan)

    def noise(self, residuals: FloatArray, least: Noise, outlying: float) -> Noise:
        """Estimate the noise of residuals (S,), NaN if unknown; outliers exceed ``outlying``."""
        kept = np.isfinite(residuals)
        relative = np.where(kept, residuals, 0.0) / self.sigmas
        sigma = max(trimmed_deviation(relative[kept], outlying), least.sigma)
        scale = least._replace(sigma=sigma).loss_scale * sigma
        length = correlation_length(self.contour, relative, kept, scale, least.sigma)
        return Noise(sigma, max(length, least.correlation), least.offset)


class MeasuredOutline(NamedTuple):
    """An outline at an estimate, its common offset [px], and its noise."""

    outline: Outline
    offset: float
    noise: Noise

    @property
    def residuals(self) -> FloatArray:
        return self.outline.residuals(self.offset)

    @property
    def inliers(self) -> BoolArray:
        """True (S,) for samples within the noise."""
        sizes = np.abs(np.nan_to_num(self.residuals, nan=np.inf))
        return np.asarray(sizes < INLIER * self.noise.sigma * self.outline.sigmas)


class Track(NamedTuple):
    """Noise and reach of a source in a round.

    The reach is in pixels for a mask, and relative to the silhouette's size for a photo; ``levels``
    are the reaches of the next rounds.
    """

    noise: Noise
    reach: float
    levels: tuple[float, ...] = ()
    is_fine: bool = False

    def is_like(self, other: Track) -> bool:
        """True if the weights of samples and of the common offset are about the same."""
        one, two = self.noise, other.noise
        changes = 2 * np.log([one.deviation / two.deviation, one.offset / two.offset])
        return bool((np.abs(changes) < (_ALIKE, _ALIKE_OFFSETS)).all())

    @property
    def next(self) -> Track:
        """The track of the next round."""
        if not self.levels:
            return self
        return self._replace(reach=self.levels[0], levels=self.levels[1:])


class OutlineSupport(NamedTuple):
    """Agreement of a source with a model's outline.

    ``share`` is the share of samples near the outline, 0 if unknown; ``agreeing`` the number of
    inliers; ``rms`` [px] and ``rms_sigmas`` the root mean square of their residuals.
    """

    share: float = 0.0
    agreeing: int = 0
    rms: float = float("nan")
    rms_sigmas: float = float("nan")


@dataclass(frozen=True, eq=False)
class OutlineSource:
    """Base class of masks and photos; ``image`` and ``number`` are indices of the view.

    The evidence's rays are in ``camera``. ``is_exact`` is False for a surface that is only similar.
    """

    kind: ClassVar[Literal["mask", "photo"]]
    field: ClassVar[str]
    learns_sigma: ClassVar[bool]
    """True if all samples share one unknown standard deviation."""
    good_share: ClassVar[float]
    """Share of the outline that must agree, to raise no warning."""
    tolerances: ClassVar[tuple[float, float, float]]
    """Largest residual of a near sample: [px], and relative to exact and to similar surfaces."""

    image: int
    number: int
    camera: Camera
    is_exact: bool

    @property
    def where(self) -> str:
        return f"views[{self.number}].{self.field}"

    def support(self, found: MeasuredOutline) -> OutlineSupport:
        least, exact, similar = self.tolerances
        tolerance = max(least, (exact if self.is_exact else similar) * found.outline.contour.size)
        near = np.abs(np.nan_to_num(found.residuals, nan=np.inf)) < tolerance
        kept = found.residuals[found.inliers]
        if not near.any() or not len(kept):
            return OutlineSupport()
        sigmas = found.outline.sigmas[found.inliers]
        sigmas = sigmas * found.noise.sigma if self.learns_sigma else sigmas
        rms, rms_sigmas = (float(np.sqrt((x**2).mean())) for x in (kept, kept / sigmas))
        return OutlineSupport(float(near.mean()), len(kept), rms, rms_sigmas)

    def warning(self, text: str) -> EstimateWarning:
        return EstimateWarning(self.kind, text, self.number)

    def summary(self, support: OutlineSupport) -> EvidenceSummary:
        """The entry in the result's evidence."""
        figures = support.agreeing, support.rms_sigmas, support.rms
        share = None if self.learns_sigma else support.share
        return EvidenceSummary(self.kind, self.number, *figures, "px", share)
