"""Gradients in PyTorch beside finite differences."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from benchmarks.section import BenchmarkData, NotGivenError, Row, Tables
from cadalign.evaluation.simulation import simulate_problem

_WELL_KNOWN_DEG = 10.0
_STEP_PX = 1e-4
_KINDS: dict[str, dict[str, Any]] = {
    "stretch": {},
    "no stretch": {"stretch": "none"},
    "prior on the stretch": {"stretch_sigma": 0.2},
    "huber": {"loss": "huber"},
    "cauchy": {"loss": "cauchy"},
    "unknown focal length": {"focal": "estimate"},
}


def gradient_errors(given: BenchmarkData) -> Tables:
    """Gradients beside finite differences, of well-determined problems of every kind.

    The gradient of a random combination of pose, stretch and focal length, along random steps of
    all pixels, relative to the root mean square of such products. Well-determined are problems of
    12 keypoints whose rotation is known to 10 degrees.
    """
    try:
        import torch
    except ImportError:
        raise NotGivenError("pip install -e '.[torch]'") from None
    from cadalign.torch import fit

    rng = np.random.default_rng(given.seed)
    count = given.count or 1000
    drawn = [simulate_problem(rng, points=12, noise_px=1.0) for _ in range(count)]
    places, pixels = (
        torch.tensor(np.array([getattr(each, name) for each in drawn]))
        for name in ("points_3d", "points_2d")
    )
    layer = partial(fit, places, camera=drawn[0].camera)
    rows = [_row(name, partial(layer, **how), pixels, rng) for name, how in _KINDS.items()]
    yield "Gradients beside finite differences, relative errors", rows


def _row(name: str, layer: Any, pixels: Any, rng: np.random.Generator) -> Row:
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
    after, before = (parts(pixels + sign * _STEP_PX * steps) for sign in (1.0, -1.0))
    expected = ((after[0] - before[0]) * weights).sum(dim=1) / (2.0 * _STEP_PX)
    slopes = (seen.grad * steps).sum(dim=(1, 2))
    turn = found.covariance.diagonal(dim1=1, dim2=2)[:, :3].sum(dim=1).sqrt()
    known = found.valid & after[1].valid & before[1].valid & (turn < np.radians(_WELL_KNOWN_DEG))
    size = seen.grad.flatten(1).norm(dim=1)
    errors = ((slopes - expected).abs() / size)[known].detach().numpy()
    median, late = np.quantile(errors, (0.5, 0.99)).tolist()
    return {"kind": name, "median": median, "99 %": late, "worst": float(errors.max())}
