"""Alignment in JAX programs: fits with gradients.

Needs the extra ``jax``: ``pip install "cadalign[jax]"``. Fits run in the compiled kernels, on the
processor, called back from JAX; gradients are those of the optimum, by the implicit function
theorem.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from cadalign.errors import CadalignError, InputError
from cadalign.estimation.focal import PriorOption
from cadalign.estimation.layers import BatchMinima, FitTask, FitValues, fits_of
from cadalign.estimation.options import FitOptions
from cadalign.geometry.camera import Camera
from cadalign.torch.poses import cameras_of

if TYPE_CHECKING:
    from jax import Array
    from jax.typing import ArrayLike

__all__ = ["FitArrays", "fit"]


class FitArrays(NamedTuple):
    """Alignments of B objects: ``depth (u, v, 1) = rotation diag(scale) x + translation``.

    Parameters
    ----------
    rotation : (B, 3, 3)
    translation : (B, 3)
        [model units].
    scale : (B, 3)
        Stretch along x, y and z.
    focal : (B,)
        Focal lengths along the image's x [px], the given ones unless they were estimated.
    covariance : (B, 10, 10)
        Inverse of the cost's Hessian, without gradients, in the order of
        `cadalign.Result.covariance`; 0 for what is held or not determined.
    valid : (B,) bool
        Marks the estimates that exist and that the keypoints determine; the others are an identity
        without gradients.
    """

    rotation: Array
    translation: Array
    scale: Array
    focal: Array
    covariance: Array
    valid: Array


def fit(
    points_3d: ArrayLike,
    points_2d: ArrayLike,
    camera: Camera | Sequence[Camera],
    *,
    sigma: ArrayLike = 1.0,
    mask: ArrayLike | None = None,
    loss: str = FitOptions.loss,
    loss_scale: float = FitOptions.loss_scale,
    stretch: str | None = FitOptions.stretch,
    stretch_sigma: float | None = FitOptions.stretch_sigma,
    known_axis: str = FitOptions.known_axis,
    focal: str = FitOptions.focal,
    focal_prior: PriorOption = FitOptions.focal_prior,
    exact: bool = True,
    workers: int = -1,
) -> FitArrays:
    """Fit a batch of models to their keypoints, as `cadalign.fit` does, with gradients.

    Works under ``jax.jit``, ``jax.grad`` and ``jax.vmap``. Problems without a solution do not
    raise: ``valid`` marks the others.

    Parameters
    ----------
    points_3d, points_2d, camera, sigma, mask, exact, workers
        As for `cadalign.torch.fit`, arrays in the place of tensors.
    loss, loss_scale, stretch, stretch_sigma, known_axis, focal, focal_prior
        As for `cadalign.torch.fit`.

    Returns
    -------
    FitArrays

    Raises
    ------
    InputError
        If a type, a shape or an option is wrong, a focal length is unknown, or a lens is a wide
        one.
    CadalignError
        If JAX is not installed.

    Examples
    --------
    >>> import jax
    >>> corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    >>> camera = Camera(640, 480, 900, 900, 319.5, 239.5)
    >>> seen = camera.project(corners * [1.0, 1.2, 0.8] + [0.1, 0.2, 5.0])
    >>> distance = lambda pixels: fit(corners, pixels, camera).translation[0, 2]
    >>> round(float(distance(seen[None])), 2)
    5.0
    >>> jax.grad(distance)(seen[None]).shape
    (1, 8, 2)
    """
    jnp = _jax().numpy
    pixels = _array(points_2d, "points_2d")
    if not jnp.issubdtype(pixels.dtype, jnp.floating):  # the estimates are of its type
        what = f"expected floating point numbers, got {pixels.dtype}"
        raise InputError(what, where="points_2d", fix="give points_2d.astype(float)")
    if pixels.ndim != 3 or pixels.shape[2] != 2:
        raise InputError(f"shape {pixels.shape}, expected (B, n, 2)", where="points_2d")
    options = FitOptions(
        loss=loss,
        loss_scale=loss_scale,
        stretch=stretch,
        stretch_sigma=stretch_sigma,
        known_axis=known_axis,
        focal=focal,
        focal_prior=focal_prior,
    )
    task = FitTask(cameras_of(camera, len(pixels)), options, exact, workers)
    present = True if mask is None else mask
    given = [
        _expanded(points_3d, (*pixels.shape[:2], 3), "points_3d").astype(pixels.dtype),
        pixels,
        _expanded(sigma, pixels.shape[:2], "sigma").astype(pixels.dtype),
        _expanded(present, pixels.shape[:2], "mask").astype(bool),
    ]
    return FitArrays(*_layer(task, pixels.dtype)(*given))


def _jax() -> Any:
    try:
        import jax
    except ImportError:
        fix = "pip install 'cadalign[jax]'"
        raise CadalignError("JAX is not installed", where="cadalign.jax", fix=fix) from None
    return jax


def _array(values: ArrayLike, where: str) -> Any:
    try:
        return _jax().numpy.asarray(values)
    except (TypeError, ValueError) as error:
        what = f"not an array of numbers ({str(error)[:200]})"
        raise InputError(what, where=where, fix="give an array of JAX or NumPy") from None


def _expanded(values: ArrayLike, shape: tuple[int, ...], where: str) -> Any:
    array = _array(values, where)
    try:
        return _jax().numpy.broadcast_to(array, shape)
    except ValueError:
        what = f"shape {array.shape}, expected one that broadcasts to {shape}"
        raise InputError(what, where=where) from None


def _layer(task: FitTask, dtype: Any) -> Callable[..., Any]:
    """The fits of a task as a function of points, pixels, sigmas and mask."""
    jax = _jax()

    def on_processor(run: Callable[..., Any], kinds: Sequence[Any], *given: Any) -> Any:
        """The arrays of ``run``, which computes in double precision, as they are declared."""

        def called(*arrays: Any) -> list[Any]:
            plain = map(np.asarray, arrays)
            found = run(*(each if each.dtype == bool else each.astype(float) for each in plain))
            return [each.astype(kind.dtype) for each, kind in zip(found, kinds, strict=True)]

        return jax.pure_callback(called, kinds, *given, vmap_method="sequential")

    def forward(*given: Any) -> tuple[Any, Any]:
        def run(*arrays: Any) -> tuple[Any, ...]:
            fits = fits_of(task, *arrays)
            return *fits.values, *fits.minima

        def each(*shape: int, kind: Any = dtype) -> Any:
            return jax.ShapeDtypeStruct((given[0].shape[0], *shape), kind)

        pose = each(3, 3), each(3), each(3), each()
        values = FitValues(*pose, each(10, 10), each(kind=bool))
        minima = BatchMinima(each(15), each(), each(kind=bool))
        found = on_processor(run, [*values, *minima], *given)
        return tuple(found[: len(values)]), (given, found[len(values) :])

    def backward(known: Any, slopes: Any) -> tuple[Any, ...]:
        given, minima = known

        def run(*arrays: Any) -> tuple[Any, ...]:
            points, pixels, sigmas, mask, *rest = arrays
            fits = fits_of(task, points, pixels, sigmas, mask, BatchMinima(*rest[:3]))
            return fits.pulled_back(*rest[3:])

        kinds = [jax.ShapeDtypeStruct(each.shape, dtype) for each in given[:3]]
        return *on_processor(run, kinds, *given, *minima, *slopes[:4]), None

    layer: Callable[..., Any] = jax.custom_vjp(lambda *given: forward(*given)[0])
    layer.defvjp(forward, backward)  # type: ignore[attr-defined]
    return layer
