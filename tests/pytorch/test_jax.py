"""`cadalign.jax.fit`: results of `fit_batch`, gradients, masks, failures, refusals."""

from __future__ import annotations

import subprocess
import sys
from inspect import signature
from typing import Any

import numpy as np
import pytest
from support.problems import problem_of

import cadalign
from cadalign import Camera
from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError, InputError

COUNT, POINTS = 6, 10


def test_nothing_loads_jax_unasked() -> None:
    program = "import sys, cadalign\nassert callable(cadalign.jax.fit)\nprint('jax' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout == "False\n", done.stderr


def test_without_jax_the_message_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "jax", None)
    camera = Camera(640, 480, 900, 900, 319.5, 239.5)
    with pytest.raises(CadalignError) as refused:
        cadalign.jax.fit(np.zeros((8, 3)), np.zeros((1, 8, 2)), camera)
    message = "cadalign.jax: JAX is not installed; pip install 'cadalign[jax]'"
    assert str(refused.value) == message


@pytest.fixture
def doubles() -> Any:
    """JAX, in double precision."""
    jax = pytest.importorskip("jax", reason='needs pip install -e ".[jax]"')
    before = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", True)
    yield jax
    jax.config.update("jax_enable_x64", before)


def arrays() -> tuple[FloatArray, FloatArray, Camera]:
    """Model points (B, n, 3) and pixels (B, n, 2) of synthetic problems, and their camera."""
    problems = [problem_of(seed, points=POINTS) for seed in range(COUNT)]
    points = np.array([each.points_3d for each in problems])
    return points, np.array([each.points_2d for each in problems]), problems[0].camera


@pytest.mark.parametrize("focal", ["known", "estimate"])
def test_results_are_those_of_fit_batch(doubles: Any, focal: str) -> None:
    points, pixels, camera = arrays()
    found = cadalign.jax.fit(points, pixels, camera, focal=focal, sigma=0.5)
    expected = cadalign.fit_batch(points, pixels, camera, focal=focal, sigma=0.5)
    assert found.valid.all()
    np.testing.assert_allclose(found.rotation, expected.rotation, atol=1e-4)
    np.testing.assert_allclose(found.scale, expected.scale, rtol=1e-4)
    assert (found.focal == camera.fx).all() == (focal == "known")
    assert (doubles.numpy.diagonal(found.covariance, axis1=1, axis2=2)[:, :6] > 0).all()


@pytest.mark.parametrize("options", [{}, {"loss": "cauchy"}, {"focal": "estimate"}], ids=str)
def test_gradients_are_those_of_finite_differences(doubles: Any, options: dict[str, Any]) -> None:
    points, pixels, camera = arrays()

    def outcome(points: Any, pixels: Any, sigma: Any) -> Any:
        found = cadalign.jax.fit(points, pixels, camera, sigma=sigma, **options)
        turned = found.rotation[:, 0, 1] + found.translation.sum(axis=1)
        return (turned + found.scale[:, 1] + found.focal / camera.fx).sum()

    given = [points, pixels, np.linspace(0.6, 1.4, POINTS) * np.ones((COUNT, 1))]
    slopes = doubles.jit(doubles.grad(outcome, argnums=(0, 1, 2)))(*given)
    rng = np.random.default_rng(0)
    for place, slope in enumerate(slopes):
        step = 1e-5 * rng.standard_normal(given[place].shape)
        after, before = list(given), list(given)
        after[place], before[place] = given[place] + step, given[place] - step
        expected = float(outcome(*after) - outcome(*before)) / 2
        assert (np.asarray(slope) * step).sum() == pytest.approx(expected, rel=1e-4)


def test_single_precision_vmap_masks_and_failures(doubles: Any) -> None:
    points, pixels, camera = arrays()
    mapped = doubles.vmap(lambda each: cadalign.jax.fit(points[0], each[None], camera).scale[0])
    expected = cadalign.jax.fit(points[0], pixels, camera)
    np.testing.assert_array_equal(mapped(pixels), expected.scale)
    mask = np.ones((COUNT, POINTS), dtype=bool)
    mask[0, 3:] = False  # too few
    moved = pixels.copy()
    moved[1, 4] += 50.0
    mask[1, 4] = False

    def depth(pixels: Any) -> Any:
        return cadalign.jax.fit(points, pixels, camera, mask=mask).translation[:, 2].sum()

    single = doubles.numpy.asarray(moved, "float32")
    found = cadalign.jax.fit(points, single, camera, mask=mask)
    assert found.rotation.dtype == "float32"
    assert found.valid.tolist() == [False] + [True] * (COUNT - 1)
    np.testing.assert_array_equal(found.rotation[0], np.eye(3))
    slope = np.asarray(doubles.grad(depth)(moved))
    assert (slope[0] == 0).all()
    assert (slope[1, 4] == 0).all()
    assert (np.abs(slope[1:]).max(axis=(1, 2)) > 0).all()
    rest = np.delete(np.arange(POINTS), 4)
    without = cadalign.fit(points[1, rest], pixels[1, rest], camera).alignment
    np.testing.assert_allclose(found.translation[1], without.translation, rtol=1e-4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points_2d": np.zeros((8, 2))}, "points_2d: shape (8, 2), expected (B, n, 2)"),
        (
            {"points_3d": np.zeros((7, 3))},
            "points_3d: shape (7, 3), expected one that broadcasts to (6, 10, 3)",
        ),
        ({"sigma": np.ones(3)}, "sigma: shape (3,), expected one that broadcasts to (6, 10)"),
        ({"mask": np.ones(3)}, "mask: shape (3,), expected one that broadcasts to (6, 10)"),
        ({"cameras": 2}, "camera: 2 cameras for 6 problems; give one, or one for each problem"),
        ({"loss": "l1"}, "loss: "),
        (
            {"points_2d": np.zeros((6, 10, 2), dtype=int)},
            "points_2d: expected floating point numbers, got int64; give points_2d.astype(float)",
        ),
        ({"points_3d": "chair"}, "points_3d: not an array of numbers ("),
        ({"sigma": None}, "sigma: not an array of numbers ("),
        ({"camera": Camera.without_focal(640, 480)}, "camera: the focal length is unknown; "),
    ],
)
def test_refusals(doubles: Any, change: dict[str, Any], message: str) -> None:
    points, pixels, camera = arrays()
    given: dict[str, Any] = {"points_3d": points, "points_2d": pixels} | change
    given["camera"] = given.get("camera", [camera] * given.pop("cameras", 1))
    with pytest.raises(InputError) as refused:
        cadalign.jax.fit(**given)
    assert str(refused.value).startswith(message)


def test_options_without_gradients_are_none_of_its_own() -> None:
    """Those of PyTorch's layer are the same."""
    with pytest.raises(TypeError, match="unexpected keyword argument"):
        cadalign.jax.fit(*arrays(), method="epnp")
    options, of_torch = (signature(each.fit).parameters for each in (cadalign.jax, cadalign.torch))
    assert list(options) == list(of_torch)
