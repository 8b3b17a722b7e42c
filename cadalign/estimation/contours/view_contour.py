"""The contour of a view's mask as evidence: its noise, the rims on its normals, the bound with it.

A contour lies beside the rim by an offset that all of it has in common, of a mask that is dilated
say, and by its registration: programs place pixels' centres half a pixel apart, and annotators
click no better. Both are unknown, and integrated out with the rest of the shape.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, cast

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.errors import InputError
from cadalign.estimation.contours.contour import (
    Contour,
    MaskImage,
    Rims,
    Sight,
    across_rims,
    extraction_bias,
    find_rims,
    mask_contour,
    mask_image,
    without_steep,
)
from cadalign.estimation.contours.measured import OWN_MODES, Measured, Place, Sought, solved
from cadalign.estimation.contours.surface import PosedSurface, surfaces_of
from cadalign.estimation.estimates import mean_state, pose_and_border, pose_and_lengths
from cadalign.estimation.model import Model
from cadalign.estimation.pack import evidence_of
from cadalign.estimation.prior import prior_of
from cadalign.estimation.view import View
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.solvers.constants import CAUCHY, LINEAR
from cadalign.solvers.joint.covariance import information_of, joint_covariance
from cadalign.solvers.joint.evidence import Evidence, Sightings, State

REGISTRATION = 0.3
"""Standard deviation of a contour's registration along x and y [px]."""

_LOSS_SCALE = 2.4  # in standard deviations: Cauchy's loss then keeps 95 % of the information
_LEAST_LOSS_SCALE = 1.0  # [px]: where pixels end, they displace a contour by up to that
_LEAST_SIGMA = 0.1  # [px]
_FIRST_OFFSET = 1.0  # [px], standard deviation of the offset that all of a contour has in common
_LEAST_OFFSET = 0.1
_UNEVEN = 0.05  # share of the offset by which it differs from edge to edge
_EDGE = 30.0  # samples of an edge
_OF_PIXELS = 3.0  # samples that count as one where pixels alone displace them
_FIRST_CORRELATION = 10.0  # samples, of a surface that is only similar
_LEAST_OWN = 0.3  # [px], standard deviation of the part that is the model's
_FIRST_SHARE, _LARGEST_SHARE = 0.8, 0.99  # of a contour, that is the model's
_ROUNDS = 30
_TO_SIGMA = 1.4826  # from the median of absolute values to the standard deviation of a Gaussian
_OUTLYING = 3.5  # in standard deviations
_MOST_LAGS = 100
_LEAST_PAIRS = 20
_ALIKE = 0.2  # change of a variance's logarithm
_INLIER = 3.5  # in standard deviations
_BOUND_REACH = 8.0  # [px]
_LEAST_COMMON_OFFSET = 0.1  # [px], that the whole contour may have in common


def robust_deviation(residuals: FloatArray) -> float:
    """Deviation of residuals (n,) about 0, outliers among them; 0 for none."""
    return _TO_SIGMA * float(np.median(np.abs(residuals))) if len(residuals) else 0.0


def trimmed_deviation(residuals: FloatArray, least: float) -> float:
    """Root mean square of residuals (n,) about 0 without outliers, which exceed ``least``.

    It is 0 for none.
    """
    if not len(residuals):
        return 0.0
    kept = residuals[np.abs(residuals) < max(_OUTLYING * robust_deviation(residuals), least)]
    return float(np.sqrt((kept**2).mean()))


def correlation_length(contour: Contour, residuals: FloatArray, kept: BoolArray) -> float:
    """Number of neighbouring samples that count as one, at least 1.

    The integrated autocorrelation ``1 + 2 sum of rho`` of the residuals (S,) that are ``kept``, up
    to the first lag without positive correlation (Geyer, "Practical Markov chain Monte Carlo",
    1992).
    """
    values = np.where(kept, residuals, 0.0)
    variance = float((values**2).sum() / max(kept.sum(), 1))
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


def cost_of_contour(residuals: FloatArray, reach: float) -> float:
    """The mean of -log density of a contour's distances (S,) from a rim, at most ``reach`` [px].

    Part of the contour is an occluder's, and lies anywhere within the reach; the rest is Gaussian.
    Its share and standard deviation are the likeliest, by expectation and maximisation (Dempster,
    Laird and Rubin, "Maximum likelihood from incomplete data via the EM algorithm", 1977).
    """
    squares, elsewhere = residuals**2, 1 / (2 * reach)
    share, variance = _FIRST_SHARE, max(float(np.median(squares)), _LEAST_OWN**2)
    for _ in range(_ROUNDS):
        own = share * np.exp(-squares / (2 * variance)) / np.sqrt(2 * np.pi * variance)
        density = own + (1 - share) * elsewhere
        belongs = own / density
        share = min(float(belongs.mean()), _LARGEST_SHARE)
        variance = max(float(belongs @ squares / max(belongs.sum(), 1e-9)), _LEAST_OWN**2)
    return float(-np.log(density).mean())


class Noise(NamedTuple):
    """Noise of a contour's samples.

    Their standard deviation ``sigma`` [px], the number of neighbours that count as one, and the
    standard deviation of the ``offset`` [px] that all have in common.
    """

    sigma: float
    correlation: float
    offset: float

    @property
    def loss_scale(self) -> float:
        """Scale of Cauchy's loss, in standard deviations of a sample."""
        return max(_LOSS_SCALE, _LEAST_LOSS_SCALE / self.sigma)

    def cost(self, residual: float) -> float:
        """Cost of one sample's residual [px]."""
        square = self.loss_scale**2
        return float(square / self.correlation * np.log1p((residual / self.sigma) ** 2 / square))

    def is_like(self, other: Noise) -> bool:
        """True if samples weigh about the same."""
        weights = self.sigma**2 * self.correlation / (other.sigma**2 * other.correlation)
        offsets = (self.offset / other.offset) ** 2
        return bool(max(abs(np.log(weights)), abs(np.log(offsets))) < _ALIKE)


def first_noise(sigma: float | None, reach: float, *, is_exact: bool) -> Noise:
    """The noise before rims are found, at most ``reach`` [px] away; ``sigma`` where it is given."""
    if is_exact:
        return Noise(sigma or reach / 3, 1.0, _FIRST_OFFSET)
    return Noise(reach / 3, _FIRST_CORRELATION, _LEAST_OFFSET)


def noise_of(
    contour: Contour,
    sigma: float | None,
    rims: Rims,
    residuals: FloatArray,
    noise: Noise,
    *,
    correlated: bool,
) -> Noise:
    """Noise that the residuals (S,) [px] show, free of the extraction's bias.

    The correlation is that of the samples' influence on the estimate, which runs of outliers have,
    too; what the residuals don't reach of the given ``sigma`` is correlated as pixels are. Beside
    the rim a contour lies unevenly, by a share of the offset that all of an edge has in common.
    """
    found = trimmed_deviation(residuals[rims.found], _LEAST_LOSS_SCALE)
    measured = max(found, _LEAST_SIGMA)
    sigma = measured if sigma is None else sigma
    length = 1.0
    if correlated:
        some = np.nan_to_num(residuals)
        scale = max(_LOSS_SCALE * measured, _LEAST_LOSS_SCALE)
        influence = some / (1 + (some / scale) ** 2)
        share = min((found / sigma) ** 2, 1.0)
        along = max(correlation_length(contour, influence, rims.found), _OF_PIXELS)
        length = share * along + (1 - share) * _OF_PIXELS
        length += _EDGE * (_UNEVEN * noise.offset / sigma) ** 2
    return Noise(sigma, length, noise.offset)


def noise_of_similar(
    contour: Contour, sigma: float | None, rims: Rims, residuals: FloatArray, reach: float
) -> Noise:
    """Noise where the surface is only similar to the object's.

    Samples without a rim count as the farthest: there the surface lacks a part or has one more.
    """
    everywhere = np.nan_to_num(residuals, nan=reach)
    found = max(robust_deviation(everywhere), sigma or _LEAST_SIGMA)
    length = correlation_length(contour, np.nan_to_num(residuals), rims.found)
    return Noise(found, length, _LEAST_OFFSET)


def with_learned_offsets(
    evidence: Evidence, state: State, noises: list[Noise], own: FloatArray
) -> tuple[list[Noise], FloatArray]:
    """Noises with the standard deviations of the offsets learned by their own likelihood.

    The contours' ``own`` coefficients (V, 3), last of the evidence's unknowns, come along.
    """
    _, information = information_of(evidence, state)
    size = len(information)
    rows = np.arange(size - own.size, size, OWN_MODES)
    variances = solved(information, np.eye(size)[:, rows])[rows].diagonal()
    learned = []
    for noise, coefficient, variance in zip(noises, own[:, 0], variances, strict=True):
        without_prior = 1 / max(1 / min(variance, 1.0) - 1, 1e-6)  # in squares of noise.offset
        free = coefficient * (1 + without_prior)
        square = noise.offset**2 * max(free**2 - without_prior, 0.0)
        learned.append(noise._replace(offset=max(float(np.sqrt(square)), _LEAST_OFFSET)))
    scales = [before.offset / after.offset for before, after in zip(noises, learned, strict=True)]
    return learned, own * np.column_stack([scales, np.ones((len(own), OWN_MODES - 1))])


@dataclass(frozen=True, eq=False)
class ViewContour:
    """The contour in view number ``image``.

    ``slopes`` (S, 2, 2) are the derivatives of its samples' places [px] by their rays; ``sigma`` is
    the given standard deviation [px], None to estimate it. The contour is that of ``mask``.
    """

    image: int
    camera: Camera
    contour: Contour
    slopes: FloatArray
    sigma: float | None
    mask: MaskImage

    def registered(self, camera: Camera, own: FloatArray) -> Camera:
        """A camera registered to the mask by the contour's own coefficients (3,)."""
        right, down = (REGISTRATION * own[1:]).tolist()
        return replace(camera, cx=camera.cx + right, cy=camera.cy + down)

    def shown_by(self, line: FloatArray) -> ViewContour:
        """The part that no line (3,) hides, beyond which rays have ``line @ ray > 0``."""
        if not line.any():
            return self
        rays, _ = self.camera.normalize_where_valid(self.contour.points)
        shown = rays @ line[:2] + line[2] <= 0
        return replace(self, contour=self.contour.taken(shown), slopes=self.slopes[shown])

    def evidence_of(
        self, rims: Rims, noise: Noise, surface: PosedSurface, sight: Sight, bias: FloatArray
    ) -> Measured:
        """The rims that were found, in the form of the evidence.

        The camera of ``sight`` is `registered`. Rims are to lie outside of the contour by the
        ``bias`` (S,) of its extraction [px]. The contour's own modes move every rim outwards, to
        the right and down, by one standard deviation.
        """
        kept = np.flatnonzero(rims.found)
        across = np.einsum("ni,nij->nj", across_rims(self.contour, rims)[kept], self.slopes[kept])
        weight = 1 / (noise.sigma * np.sqrt(noise.correlation))
        return contour_rows(
            self.image,
            surface,
            sight.pose,
            rims.points[kept],
            rims.face[kept],
            across=across,
            places=bias[kept] - rims.offset[kept],
            weights=np.full(len(kept), weight),
            loss_scale=noise.loss_scale / np.sqrt(noise.correlation),
            own=(noise.offset, REGISTRATION, REGISTRATION),
            cameras=(self.camera, sight.camera),
        )


def contour_rows(
    image: int,
    surface: PosedSurface,
    pose: Alignment,
    points: FloatArray,
    face: IntArray,
    *,
    across: FloatArray,
    places: FloatArray,
    weights: FloatArray,
    loss_scale: float,
    own: tuple[float, ...],
    cameras: tuple[Camera, Camera],
) -> Measured:
    """Distances of a surface's rim ``points`` (n, 3), on triangles ``face`` (n,), from a contour.

    A step of the ray by ``across`` (n, 2), over its square, moves the image by one pixel outwards,
    where the contour is by ``places`` (n,) [px]; ``weights`` (n,) [1/px] are of these. ``own`` are
    standard deviations [px] of what all have in common: an offset outwards, shifts to the right and
    down. The ``cameras`` are the one of the evidence's rays, and the one of the state.
    """
    given, camera = cameras
    focal = np.array([given.fx, given.fy])
    step = across / (across**2).sum(axis=1, keepdims=True)
    seen, ratio, count = pose.apply(points), camera.fx / given.fx, len(points)
    # At this state the residual is the distance that was found, whatever the normals are.
    rays = ratio * seen[:, :2] / seen[:, 2:]
    rays += np.subtract((camera.cx, camera.cy), (given.cx, given.cy)) / focal
    rays += places[:, None] * step
    moved = np.zeros((len(own), count, 3))
    moved[0, :, :2] = own[0] * step
    for axis, shift in enumerate(own[1:]):
        moved[1 + axis, :, axis] = shift / focal[axis]
    moved *= seen[:, 2:] / ratio
    return Measured(
        *surface.rows(points, face),
        Sightings(
            np.arange(count),
            np.full(count, image),
            rays,
            np.column_stack([across * weights[:, None], np.zeros(count)]),
            np.zeros((count, 2)),
            np.full(count, CAUCHY),
            np.full(count, loss_scale),
            np.zeros((count, 2)),
        ),
        moved @ pose.rotation / pose.scale,
    )


def contour_view(image: int, view: View, where: str, camera: Camera) -> ViewContour:
    """The contour of a view's mask, with what the sightings need of the camera.

    Samples outside of its lens are dropped.

    Raises InputError if the mask ``where`` has no contour.
    """
    mask = cast("FloatArray | BoolArray", view.mask_image)
    contour = mask_contour(mask, where)
    rays, valid = camera.normalize_where_valid(contour.points)
    slopes = np.array([[camera.fx], [camera.fy]]) * camera.distortion_jacobian(rays[valid])
    contour = contour.taken(valid)
    return ViewContour(image, camera, contour, slopes, view.mask_sigma, mask_image(mask, contour))


def contour_bound(model: Model, view: View, gt: Alignment) -> FloatArray:
    """The least covariance (9, 9) of an estimate from one view's keypoints and mask.

    It is in the form of `cadalign.Result.covariance`. The contour has the standard deviation and
    the correlation that its residuals show at the true alignment, which has the scale 1 along the
    model's known axis. Raises InputError if the view has no mask, its mask no contour, or the model
    no mesh or is not exact.
    """
    if view.mask_image is None or model.shape_sigma is not None:
        raise InputError("expected a view with a mask, and an exact model", where="view")
    evidence = evidence_of(prior_of(model), [view])
    state = mean_state(evidence, gt.packed[None, :12], np.log(gt.scale))
    keypoints = len(evidence.shape.mean) - 2
    (surface,), _ = surfaces_of(model, evidence.shape.mean[:keypoints], "view.mask")
    sought = Sought(evidence, keypoints, [0], surface)
    posed, (pose,) = sought.at(state)
    seen = contour_view(0, view, "view.mask", view.camera)
    sight = Sight(posed.caster, seen.camera, pose)
    rims = find_rims(sight, seen.contour, _BOUND_REACH)
    bias = extraction_bias(sight, seen.mask, seen.contour, rims)
    rims = without_steep(seen.contour, rims, bias)
    offset = float(np.median(rims.offset[rims.found])) if rims.found.any() else 0.0
    centred = np.where(rims.found, rims.offset - offset, np.nan)
    known = Noise(1.0, 1.0, max(abs(offset), _LEAST_COMMON_OFFSET))
    noise = noise_of(seen.contour, seen.sigma, rims, centred - bias, known, correlated=True)
    agreeing = rims.found & (np.abs(np.nan_to_num(centred - bias)) < _INLIER * noise.sigma)
    rows = seen.evidence_of(rims._replace(found=agreeing), noise, posed, sight, bias)
    sightings = rows.sightings._replace(loss=np.full_like(rows.sightings.loss, LINEAR))
    joined = sought.joined(Place.of(state, 1), [rows._replace(sightings=sightings)])
    unknowns = pose_and_border(joint_covariance(joined.evidence, joined.state), 0)
    return pose_and_lengths(joined.evidence, joined.state, unknowns)
