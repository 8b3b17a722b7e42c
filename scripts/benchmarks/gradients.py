"""Gradients in PyTorch: their time and errors."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from benchmarks import section
from benchmarks.section import BenchmarkData, Row, Tables
from cadalign import Camera
from cadalign.evaluation.simulation import SimulatedProblem, simulate_problem

_WELL_KNOWN_DEG = 10.0


def _torch() -> Any:
    try:
        import torch
    except ImportError:
        raise section.NotGivenError("pip install -e '.[torch]'") from None
    return torch


def _drawn(
    rng: np.random.Generator, problems: int, points: int
) -> tuple[list[SimulatedProblem], Any, Any]:
    drawn = [simulate_problem(rng, points=points, noise_px=1.0) for _ in range(problems)]
    tensor = _torch().tensor
    parts = (np.array([getattr(p, name) for p in drawn]) for name in ("points_3d", "points_2d"))
    return drawn, *map(tensor, parts)


def torch_layer(
    given: BenchmarkData,
    *,
    problems: int = 1000,
    points: int = 10,
    repeats: int = 7,
    iterations: int = 5,
) -> Tables:
    """Forward and backward pass of a batch of fits, beside Gauss-Newton unrolled in PyTorch.

    The unrolled one starts from the fit itself, perturbed: it searches nothing.

    Parameters
    ----------
    problems : int
        Problems of a batch.
    points : int
        Keypoints of each.
    repeats : int
        Passes whose median counts.
    iterations : int
        Steps of the unrolled Gauss-Newton.
    """
    torch = _torch()
    from cadalign.torch import fit

    torch.set_num_threads(2)
    rng = np.random.default_rng(given.seed)
    drawn, places, pixels = _drawn(rng, problems, points)
    camera = drawn[0].camera
    start = fit(places, pixels, camera, workers=2)

    def layer(seen: Any) -> Any:
        found = fit(places, seen, camera, workers=2)
        return found.rotation.sum() + found.translation.sum() + found.scale.sum()

    def unrolled(seen: Any) -> Any:
        return _gauss_newton(places, seen, camera, start, iterations).sum()

    ways = {"layer": layer, "unrolled": unrolled}

    def seconds_of(way: Callable[[Any], Any]) -> float:
        seen = pixels.clone().requires_grad_()
        begun = time.perf_counter()
        way(seen).backward()
        return time.perf_counter() - begun

    timed = {name: partial(seconds_of, way) for name, way in ways.items()}
    found = section.medians_in_turns(timed, repeats)
    name = f"{problems} fits of {points} points with gradients"
    ratio = found["layer"] / found["unrolled"]
    row = section.figure(name, 1e3 * found["layer"], "ms", ratio, "unrolled Gauss-Newton")
    yield "PyTorch", [row | {"unrolled, ms": 1e3 * found["unrolled"]}]


def _gauss_newton(points: Any, pixels: Any, camera: Camera, start: Any, iterations: int) -> Any:
    """Unknowns (B, 8) after steps of plain Gauss-Newton, by automatic differentiation."""
    import torch

    axes = torch.tensor(np.cross(np.eye(3)[:, None], np.eye(3)).swapaxes(1, 2), dtype=pixels.dtype)
    focal = torch.tensor([camera.fx, camera.fy], dtype=pixels.dtype)
    center = torch.tensor([camera.cx, camera.cy], dtype=pixels.dtype)

    def residuals(
        unknowns: Any, x: Any, y: Any, rotation: Any, translation: Any, scale: Any
    ) -> Any:
        skew = (unknowns[:3, None, None] * axes).sum(dim=0)
        turn = rotation + skew @ rotation + skew @ (skew @ rotation) / 2  # the turns are small
        stretch = scale * torch.exp(torch.nn.functional.pad(unknowns[6:], (1, 0)))
        seen = (x * stretch) @ turn.T + translation + unknowns[3:6]
        return (seen[:, :2] / seen[:, 2:] * focal + center - y).flatten()

    by_unknowns = torch.func.vmap(torch.func.jacfwd(residuals))
    value = torch.func.vmap(residuals)
    known = [each.detach() for each in (start.rotation, start.translation, start.scale)]
    unknowns = 0.01 * torch.ones(len(points), 8, dtype=pixels.dtype)
    for _ in range(iterations):
        jacobian = by_unknowns(unknowns, points, pixels, *known)
        error = value(unknowns, points, pixels, *known)
        normal = jacobian.transpose(1, 2) @ jacobian
        right = (jacobian.transpose(1, 2) @ error[..., None])[..., 0]
        unknowns = unknowns - torch.linalg.solve(normal, right)
    return unknowns


def gradient_errors(
    given: BenchmarkData, *, problems: int = 1000, points: int = 12, step: float = 1e-4
) -> Tables:
    """Gradients beside finite differences, of well-determined problems of every kind.

    The gradient of a random combination of pose, stretch and focal length, along random steps of
    all pixels, relative to the root mean square of such products. Well-determined are problems
    whose rotation is known to 10 degrees.

    Parameters
    ----------
    problems : int
        Problems of each kind.
    points : int
        Keypoints of each.
    step : float
        Step of the differences [px].
    """
    from cadalign.torch import fit

    rng = np.random.default_rng(given.seed)
    drawn, places, pixels = _drawn(rng, problems, points)
    camera = drawn[0].camera
    kinds: dict[str, dict[str, Any]] = {
        "stretch": {},
        "no stretch": {"stretch": "none"},
        "prior on the stretch": {"stretch_sigma": 0.2},
        "huber": {"loss": "huber"},
        "cauchy": {"loss": "cauchy"},
        "unknown focal length": {"focal": "estimate"},
    }
    rows = [
        _row(name, partial(fit, places, camera=camera, **options), pixels, rng, step)
        for name, options in kinds.items()
    ]
    yield "Gradients beside finite differences, relative errors", rows


def _row(
    name: str, layer: Callable[..., Any], pixels: Any, rng: np.random.Generator, step: float
) -> Row:
    import torch

    def parts(seen: Any) -> tuple[Any, Any]:
        found = layer(points_2d=seen)
        focal = [] if found.focal is None else [found.focal[:, None] / 100.0]
        flat = found.rotation.flatten(1), found.translation, found.scale, *focal
        return torch.cat(flat, dim=1), found

    seen = pixels.clone().requires_grad_()
    values, found = parts(seen)
    weights = torch.tensor(rng.standard_normal(tuple(values.shape)))
    (values * weights).sum().backward()
    steps = torch.tensor(rng.standard_normal(tuple(pixels.shape)))
    after, before = (parts(pixels + sign * step * steps) for sign in (1.0, -1.0))
    expected = ((after[0] - before[0]) * weights).sum(dim=1) / (2.0 * step)
    slopes = (seen.grad * steps).sum(dim=(1, 2))
    turn = found.covariance.diagonal(dim1=1, dim2=2)[:, :3].sum(dim=1).sqrt()
    known = found.valid & after[1].valid & before[1].valid & (turn < np.radians(_WELL_KNOWN_DEG))
    size = seen.grad.flatten(1).norm(dim=1)
    errors = ((slopes - expected).abs() / size)[known].detach().numpy()
    return {
        "kind": name,
        "problems": int(known.sum()),
        "median": float(np.median(errors)),
        "99 %": float(np.quantile(errors, 0.99)),
        "worst": float(errors.max()),
    }
