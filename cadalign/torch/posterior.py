"""A loss over the pose's posterior: how unlikely the keypoints make the true pose.

Chen, Wang, Wang, Tian, Xiong, Li, *EPro-PnP: Generalized End-to-End Probabilistic Perspective-n-
Points for Monocular Object Pose Estimation*, CVPR 2022: the posterior of the pose is a softmax of
``-cost / 2`` over all poses, and the loss its Kullback-Leibler divergence from the truth,

    loss = cost(truth) / 2 + log of the integral of exp(-cost / 2).

The integral is estimated by adaptive multiple importance sampling (Cornuet, Marin, Mira, Robert,
*Adaptive Multiple Importance Sampling*, 2012). Here the pose has a stretch, too, and proposals are
Student distributions about the fit in the unknowns of `cadalign.Result.covariance`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from cadalign.arrays import is_whole
from cadalign.errors import InputError, quote
from cadalign.estimation.options import FitOptions
from cadalign.geometry.camera import Camera
from cadalign.torch.poses import (
    PoseBatch,
    calibrations,
    checked,
    expanded,
    require_same_count,
    torch,
)

if TYPE_CHECKING:
    from torch import Tensor

_FREEDOM = 5.0  # of the proposals' Student distribution
_INFLATION = 1.5  # of their covariance
_LEAST_SPREAD = 1e-12
_WIDEST = 1.0  # of turns [rad], shifts over the distance and log scales; keypoints may tell nothing


def posterior_loss(
    found: PoseBatch,
    truth: PoseBatch,
    points_3d: Tensor,
    points_2d: Tensor,
    camera: Camera | Sequence[Camera],
    *,
    sigma: Tensor | float = 1.0,
    mask: Tensor | None = None,
    loss: str = FitOptions.loss,
    loss_scale: float = FitOptions.loss_scale,
    stretch_sigma: float | None = FitOptions.stretch_sigma,
    samples: int = 128,
    rounds: int = 2,
    seed: int = 0,
) -> Tensor:
    """Negative log posterior density (B,) of the true poses, by Monte-Carlo integration.

    Gradients flow through the cost of truth and samples to ``points_2d``, ``sigma`` and
    ``points_3d``, not through the fit, which only places the samples: the loss also tells which
    keypoints to trust, and has a gradient where several poses explain the keypoints.

    Parameters
    ----------
    found : PoseBatch
        Of `cadalign.torch.fit`, for the same keypoints.
    truth : PoseBatch
    points_3d, points_2d, camera, sigma, mask, loss, loss_scale, stretch_sigma
        As for `cadalign.torch.fit`, whose are to be given again; without lens distortion.
    samples : int
        Number of samples of each problem and round.
    rounds : int
        Number of rounds, each of which adapts the proposal to the samples before it.
    seed : int
        Seed of the samples.

    Returns
    -------
    (B,) tensor
        0, without gradient, for problems that are not valid.

    Raises
    ------
    InputError
        If ``found`` has no covariance, as poses of `cadalign.torch.align` have none, or focal
        lengths of its own, there are neither as many truths nor one, or an option is wrong.

    Examples
    --------
    >>> corners = torch.cartesian_prod(*[torch.tensor([0.0, 1.0]).double()] * 3)
    >>> camera = Camera(640, 480, 900, 900, 319.5, 239.5)
    >>> true = PoseBatch(torch.eye(3)[None].double(), torch.tensor([[0.1, 0.2, 5.0]]).double(),
    ...                  torch.tensor([[1.0, 1.2, 0.8]]).double())
    >>> seen = true.project(corners, camera)
    >>> from cadalign.torch import fit
    >>> near, far = (
    ...     posterior_loss(fit(corners, each, camera), true, corners, each, camera)
    ...     for each in (seen, seen + torch.tensor([[[9.0, 0.0]]] * 1))
    ... )
    >>> bool(near < far)
    True
    """
    if found.covariance is None or found.valid is None:
        what = "the poses have no covariance to draw samples from"
        raise InputError(what, where="found", fix="give poses of cadalign.torch.fit")
    if found.focal is not None:
        what = "the poses have estimated focal lengths, which the posterior does not integrate over"
        raise InputError(what, where="found", fix='fit with focal="known"')
    for name, count in (("samples", samples), ("rounds", rounds)):
        if not is_whole(count) or count < 1:
            raise InputError(f"{quote(count)} is not a whole number from 1", where=name)
    require_same_count(found, truth)
    options = FitOptions(loss=loss, loss_scale=loss_scale, stretch_sigma=stretch_sigma)
    sigmas, present, _ = checked(points_2d, camera, sigma, mask)
    points = expanded(points_3d, (*points_2d.shape[:2], 3), "points_3d")
    calibration = calibrations(camera, len(points)).to(points_2d)
    if not len(points):
        return points_2d.sum(dim=(1, 2))
    valid = found.valid
    is_seen = present.to(points_2d.device) & torch.isfinite(sigmas) & (sigmas > 0)
    for each in (points_2d, points):
        is_seen = is_seen & torch.isfinite(each).all(dim=2)
    # What is absent is replaced, not weighed: 0 times NaN is NaN, and so are its gradients.
    pixels = torch.where(is_seen[..., None], points_2d, torch.zeros_like(points_2d))
    points = torch.where(is_seen[..., None], points, torch.zeros_like(points))
    sigmas = torch.where(is_seen, sigmas, torch.ones_like(sigmas))
    weights = (is_seen & valid[:, None]).to(points_2d)
    prior = options.scale_prior

    def costs(rotation: Tensor, translation: Tensor, scale: Tensor) -> Tensor:
        """-2 log likelihood (B, k) with the prior on the scales, normalised over the pixels."""
        poses = PoseBatch(rotation, translation, scale)
        projected = poses.project_by(calibration[:, None, None], points[:, None])
        each = sigmas[:, None]
        squares = ((projected - pixels[:, None]) ** 2).sum(dim=-1) / each**2
        bent = _bent(squares, loss, loss_scale)
        whole = weights[:, None] * (bent + 4 * torch.log(each))
        excess = torch.relu(torch.log(scale).abs() - prior.width)
        return whole.sum(dim=-1) + prior.weight * (excess**2).sum(dim=-1)

    with torch.no_grad():
        steps, log_density = _samples(costs, found, found.covariance, (samples, rounds), seed)
    logs = -costs(*_moved(found, steps)) / 2 + _log_haar(steps) - log_density
    logs, is_sampled = _usable(logs)
    log_integral = torch.logsumexp(logs, dim=1) - math.log(steps.shape[1])
    true = truth.rotation[:, None], truth.translation[:, None], truth.scale[:, None]
    value = costs(*true)[:, 0] / 2 + log_integral
    is_known = valid & is_sampled & torch.isfinite(value)
    return torch.where(is_known, value, torch.zeros_like(value))


def _usable(logs: Tensor) -> tuple[Tensor, Tensor]:
    """Log weights (B, k), equal ones where none is finite, and where some are (B,).

    Whatever is not finite would make NaN of the gradients of all parameters.
    """
    is_known = torch.isfinite(logs)
    has_some = is_known.any(dim=1)
    logs = torch.where(is_known, logs, torch.full_like(logs, -math.inf))
    return torch.where(has_some[:, None], logs, torch.zeros_like(logs)), has_some


def _bent(squares: Tensor, loss: str, bend: float) -> Tensor:
    """The loss on squared whitened lengths."""
    if loss == "huber":
        lengths = torch.sqrt(torch.clamp(squares, min=bend**2))
        return torch.where(squares <= bend**2, squares, 2 * bend * lengths - bend**2)
    if loss == "cauchy":
        return bend**2 * torch.log1p(squares / bend**2)
    return squares


def _samples(
    costs: Callable[[Tensor, Tensor, Tensor], Tensor],
    found: PoseBatch,
    covariance: Tensor,
    effort: tuple[int, int],
    seed: int,
) -> tuple[Tensor, Tensor]:
    """Steps (B, k, 10) from the fits, and the log densities (B, k) of the mixture drawn from."""
    generator = torch.Generator().manual_seed(seed)
    samples, rounds = effort
    free = covariance.diagonal(dim1=1, dim2=2).amax(dim=0) > 0
    places = torch.nonzero(free)[:, 0]
    size = len(places)
    widest = _widest(found)[:, places]
    spread = _bounded(_INFLATION * covariance[:, places][:, :, places], widest)
    mean = spread.new_zeros(len(spread), size)
    proposals: list[tuple[Tensor, Tensor]] = []
    drawn: list[Tensor] = []
    log_density = spread.new_zeros(len(spread), 0)
    for _ in range(rounds):
        factor = _factor(spread)
        proposals.append((mean, factor))
        shape = (len(spread), samples, size)
        normal = torch.randn(shape, generator=generator, dtype=torch.float64).to(spread)
        squares = torch.randn(
            (*shape[:2], int(_FREEDOM)), generator=generator, dtype=torch.float64
        ).square()
        lengths = torch.sqrt(squares.sum(dim=2) / _FREEDOM).to(spread)
        drawn.append(mean[:, None] + normal @ factor.transpose(1, 2) / lengths[..., None])
        every = torch.cat(drawn, dim=1)
        log_density = torch.logsumexp(
            torch.stack([_log_student(every, *each) for each in proposals]), dim=0
        ) - math.log(len(proposals))
        steps = spread.new_zeros(*every.shape[:2], 10)
        steps[..., places] = every
        logs = -costs(*_moved(found, steps)) / 2 + _log_haar(steps) - log_density
        weights = torch.softmax(_usable(logs)[0], dim=1)
        mean = (weights[..., None] * every).sum(dim=1)
        apart = every - mean[:, None]
        adapted = _INFLATION * (apart * weights[..., None]).transpose(1, 2) @ apart
        spread = _bounded(adapted, widest)
    return steps, log_density


def _widest(found: PoseBatch) -> Tensor:
    """Standard deviations (B, 10) of proposals beyond which most samples would be of no use."""
    widest = found.scale.new_full((len(found.scale), 10), _WIDEST)
    widest[:, 3:6] *= found.translation.detach().norm(dim=1, keepdim=True)
    return widest


def _bounded(spread: Tensor, widest: Tensor) -> Tensor:
    """Covariances whose standard deviations are at most ``widest`` (B, m)."""
    deviations = torch.sqrt(torch.clamp(spread.diagonal(dim1=1, dim2=2), min=_LEAST_SPREAD))
    share = torch.clamp(widest / deviations, max=1.0)
    return spread * share[:, :, None] * share[:, None]


def _factor(spread: Tensor) -> Tensor:
    """Cholesky factors of covariances, which may be singular."""
    deviations = torch.sqrt(torch.clamp(spread.diagonal(dim1=1, dim2=2), min=_LEAST_SPREAD))
    scaled = spread / (deviations[:, :, None] * deviations[:, None])
    eye = torch.eye(spread.shape[1], dtype=spread.dtype, device=spread.device)
    factor, info = torch.linalg.cholesky_ex(scaled + 1e-6 * eye)
    return deviations[:, :, None] * torch.where((info == 0)[:, None, None], factor, eye)


def _log_student(steps: Tensor, mean: Tensor, factor: Tensor) -> Tensor:
    """Log density (B, k) of a Student distribution with mean (B, m) and factor (B, m, m)."""
    size = mean.shape[1]
    white = torch.linalg.solve_triangular(
        factor, (steps - mean[:, None]).transpose(1, 2), upper=False
    )
    constant = math.lgamma((_FREEDOM + size) / 2) - math.lgamma(_FREEDOM / 2)
    constant -= size / 2 * math.log(_FREEDOM * math.pi)
    log_determinant = torch.log(factor.diagonal(dim1=1, dim2=2)).sum(dim=1)
    logs = torch.log1p((white**2).sum(dim=1) / _FREEDOM)
    return constant - log_determinant[:, None] - (_FREEDOM + size) / 2 * logs


def _moved(found: PoseBatch, steps: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rotations (B, k, 3, 3), translations and scales (B, k, 3) after steps, without gradients."""
    rotation, translation = found.rotation.detach(), found.translation.detach()
    turned = _rotations(steps[..., :3]) @ rotation[:, None]
    scale = found.scale.detach()[:, None] * torch.exp(steps[..., 6:9].clamp(-5, 5))
    return turned, translation[:, None] + steps[..., 3:6], scale


def _rotations(vectors: Tensor) -> Tensor:
    """Rotations (..., 3, 3) of vectors (..., 3), by Rodrigues' formula."""
    angles = vectors.norm(dim=-1, keepdim=True)
    x, y, z = (vectors / torch.clamp(angles, min=1e-12)).unbind(dim=-1)
    none = torch.zeros_like(x)
    cross = torch.stack([none, -z, y, z, none, -x, -y, x, none], dim=-1).reshape(*x.shape, 3, 3)
    sine, cosine = torch.sin(angles)[..., None], torch.cos(angles)[..., None]
    return torch.eye(3).to(vectors) + sine * cross + (1 - cosine) * (cross @ cross)


def _log_haar(steps: Tensor) -> Tensor:
    """Log density (B, k) of the uniform distribution of rotations over their vectors."""
    angles = steps[..., :3].norm(dim=-1)
    inside = angles < math.pi
    density = 2 * torch.log(torch.sinc(torch.where(inside, angles, 0.0) / (2 * math.pi)))
    return torch.where(inside, density, -math.inf)
