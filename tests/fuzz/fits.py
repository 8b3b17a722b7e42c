"""Fuzz `cadalign.fit`: random problems, careless ones and hostile ones, each from a seed."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from cadalign import Alignment, CadalignError, Camera, FitResult, FocalPrior, RansacOptions, fit
from cadalign.metrics import rotation_error

CAMERA = Camera(640, 480, 500.0, 505.0, 319.5, 239.5)
LENS = Camera(640, 480, 500.0, 520.0, 310.0, 250.0, (-0.25, 0.08, 0.004, -0.003))
ROTATION_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Case:
    """One call of `fit`.

    Parameters
    ----------
    kind : str
        The name of the function that drew it.
    points_3d, points_2d, camera : as for `fit`
    options : dict
    truth : Alignment, optional
        The answer, where the data are free of noise and determine it.
    """

    kind: str
    points_3d: Any
    points_2d: Any
    camera: Camera
    options: dict[str, Any]
    truth: Alignment | None = None


def draw_case(seed: int) -> Case:
    """Draw the case of a seed; the same on every machine."""
    rng = np.random.default_rng([seed, 20261])
    kind = list(_KINDS)[rng.integers(len(_KINDS))]
    return _KINDS[kind](rng)


def run_case(case: Case) -> FitResult | None:
    """Fit a case and check what comes out.

    Returns
    -------
    FitResult or None
        None where the call was refused.

    Raises
    ------
    AssertionError
        If the result breaks a promise. Anything but a `CadalignError` passes through.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            result = fit(case.points_3d, case.points_2d, case.camera, **case.options)
        except CadalignError as error:
            assert len(str(error)) < 2000, "the message quotes its input at length"
            assert case.truth is None, f"a well-posed problem is refused: {error}"
            return None
        check_result(result)
        text = result.to_json()
        assert FitResult.from_json(text).to_json() == text
        str(result)
    if case.truth is not None:
        found = [result.alignment, *(other.alignment for other in result.alternatives)]
        assert any(_is_same(alignment, case.truth) for alignment in found), "the truth is missed"
    return result


def check_result(result: FitResult) -> None:
    """Check that all alignments of a result are rotations and that all its numbers are finite."""
    for alignment in (result.alignment, *(other.alignment for other in result.alternatives)):
        gap = np.abs(alignment.rotation @ alignment.rotation.T - np.eye(3)).max()
        assert gap < ROTATION_TOLERANCE, f"no rotation: off by {gap}"
        assert np.linalg.det(alignment.rotation) > 0, "a reflection"
        assert np.isfinite(alignment.translation).all()
        assert np.isfinite(alignment.scale).all()
        assert (alignment.scale > 0).all()
    assert np.isfinite(result.residuals[result.inliers]).all()
    if result.covariance is not None:
        assert np.isfinite(result.covariance).all()
        assert (result.covariance.diagonal() >= 0).all()


def _is_same(est: Alignment, gt: Alignment) -> bool:
    return rotation_error(est=est, gt=gt) < 1e-3 and np.allclose(est.scale, gt.scale, rtol=1e-3)


# --- cases ------------------------------------------------------------------------------------


def _pose(rng: np.random.Generator, *, stretch: bool = True, unit: float = 1.0) -> Alignment:
    rotation = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    scale = [1.0, *np.exp(rng.uniform(-0.7, 0.7, 2))] if stretch else [1.0, 1.0, 1.0]
    middle = np.array([*rng.uniform(-1, 1, 2), rng.uniform(4, 9)])
    return Alignment(rotation, middle * unit, scale)


def _pixels(pose: Alignment, points: np.ndarray, camera: Camera) -> np.ndarray:
    in_camera = pose.apply(points)
    rays = in_camera[:, :2] / in_camera[:, 2:]
    return camera.pixels_from_normalized(rays)


def _options(rng: np.random.Generator) -> dict[str, Any]:
    """Options of any kind that go together, most of them absent."""
    options: dict[str, Any] = {}
    if rng.random() < 0.2:
        options["stretch"] = str(rng.choice(["yz", "y", "z", "none"]))
    if rng.random() < 0.2:
        options["scale_prior_sigma"] = float(rng.choice([1e-3, 0.1, 0.3, 3.0]))
    if rng.random() < 0.2:
        options["loss"] = str(rng.choice(["linear", "huber", "cauchy"]))
    if rng.random() < 0.3:
        options["sigma"] = None if rng.random() < 0.5 else float(10 ** rng.uniform(-2, 2))
    if rng.random() < 0.1:
        options["ransac"] = RansacOptions(max_iterations=200, refine=bool(rng.random() < 0.7))
    if rng.random() < 0.1:
        options["focal"] = "estimate"
        if rng.random() < 0.3:
            options["focal_prior"] = FocalPrior(500.0, 0.1)
    return options


def _exact(rng: np.random.Generator) -> Case:
    """Noise-free generic data: the truth has to be found."""
    points = rng.uniform(-1, 1, (int(rng.integers(6, 20)), 3))
    camera = LENS if rng.random() < 0.2 else CAMERA
    pose = _pose(rng)
    return Case("exact", points, _pixels(pose, points, camera), camera, {}, pose)


def _noisy(rng: np.random.Generator) -> Case:
    points = rng.uniform(-1, 1, (int(rng.integers(4, 30)), 3))
    pixels = _pixels(_pose(rng), points, CAMERA)
    noise = rng.normal(0, 10 ** rng.uniform(-2, 2), pixels.shape)
    return Case("noisy", points, pixels + noise, CAMERA, _options(rng))


def _unrelated(rng: np.random.Generator) -> Case:
    """Pairs that have nothing to do with each other."""
    count = int(rng.integers(4, 21))
    pixels = rng.uniform(0, 1, (count, 2)) * [640, 480]
    return Case("unrelated", rng.uniform(-1, 1, (count, 3)), pixels, CAMERA, _options(rng))


def _box(rng: np.random.Generator) -> Case:
    """Corners of a cuboid, possibly a flat one, fitted with all kinds of options."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    points = corners * rng.uniform(0.02 if rng.random() < 0.5 else 0.3, 1, 3)
    pixels = _pixels(_pose(rng), points, CAMERA)
    options = _options(rng) | {"stretch": str(rng.choice(["none", "y", "z", "yz"]))}
    return Case("box", points, pixels + rng.normal(0, 1, pixels.shape), CAMERA, options)


def _repeated(rng: np.random.Generator) -> Case:
    """The same few points several times."""
    points = rng.uniform(-1, 1, (int(rng.integers(2, 6)), 3))
    pixels = _pixels(_pose(rng), points, CAMERA)
    times = int(rng.integers(2, 4))
    return Case(
        "repeated", np.tile(points, (times, 1)), np.tile(pixels, (times, 1)), CAMERA, _options(rng)
    )


def _flat(rng: np.random.Generator) -> Case:
    """Points in a plane or on a line, exactly or nearly."""
    points = rng.uniform(-1, 1, (int(rng.integers(4, 15)), 3))
    thin = rng.choice([0.0, 1e-12, 1e-6, 1e-2])
    points[:, rng.integers(3)] *= thin
    if rng.random() < 0.3:
        points[:, rng.integers(3)] *= thin
    pixels = _pixels(_pose(rng), points, CAMERA)
    return Case("flat", points, pixels + rng.normal(0, 1, pixels.shape), CAMERA, _options(rng))


def _extreme(rng: np.random.Generator) -> Case:
    """Coordinates of any magnitude, in the model, the image or the camera."""
    count = int(rng.integers(4, 12))
    points = rng.uniform(-1, 1, (count, 3)) * 10.0 ** rng.uniform(-200, 200)
    if rng.random() < 0.5:
        points = points + 10.0 ** rng.uniform(-3, 160)
    pixels = rng.uniform(0, 1, (count, 2)) * 10.0 ** rng.uniform(-10, 200)
    focal = 10.0 ** rng.uniform(-5, 9)
    camera = Camera(640, 480, focal, focal * 10 ** rng.uniform(-1, 1), 319.5, 239.5)
    return Case("extreme", points, pixels, camera, _options(rng))


def _special(rng: np.random.Generator) -> Case:
    """Values that are no coordinates, among others that are."""
    points = rng.uniform(-1, 1, (8, 3))
    pixels = _pixels(_pose(rng), points, CAMERA)
    for array in (points, pixels):
        if rng.random() < 0.7:
            value = rng.choice([np.nan, np.inf, -np.inf, 1e308, -1e308, 5e-324, 0.0])
            array[rng.integers(len(array)), rng.integers(array.shape[1])] = value
    return Case("special", points, pixels, CAMERA, _options(rng))


def _careless(rng: np.random.Generator) -> Case:
    """Arguments of another type or shape."""
    points = rng.uniform(-1, 1, (8, 3))
    pixels = _pixels(_pose(rng), points, CAMERA)
    wrong: list[Any] = [None, "x", [], {}, 3, points[:, :2], points.T, points[:3], [[1, 2], [3]]]
    wrong += [points.astype(complex), points.astype(object), points.astype(str), np.empty((0, 3))]
    wrong += [np.ma.masked_greater(points, 0.5), np.asmatrix(points), True, b"", object()]
    options: list[dict[str, Any]] = [
        {"sigma": "1"}, {"sigma": -1.0}, {"sigma": [1.0]}, {"sigma": np.ones(3)}, {"sigma": np.nan},
        {"loss": ["huber"]}, {"loss": "l2"}, {"loss_scale": 0}, {"loss_scale": "2"},
        {"ransac": True},
        {"scale_prior_sigma": "0.3"}, {"scale_prior_sigma": 1e-200}, {"scale_prior_sigma": np.inf},
        {"stretch": "x"}, {"stretch": 3}, {"known_axis": 0}, {"known_axis": None}, {"focal": True},
        {"focal_prior": 500.0}, {"method": None}, {"confidences": "high"}, {"method": "epnp"},
        {"ransac": RansacOptions(), "sigma": np.ones(5)},
        {"ransac": RansacOptions(), "confidences": np.ones(5)},
        {"loss_scale": np.float32(2.0)}, {"sigma": np.float32(1.0)}, {"sigma": 10**400},
    ]  # fmt: skip
    chosen = options[rng.integers(len(options))] if rng.random() < 0.6 else {}
    if rng.random() < 0.4:
        points = wrong[rng.integers(len(wrong))]
    if rng.random() < 0.3:
        pixels = wrong[rng.integers(len(wrong))]
    return Case("careless", points, pixels, CAMERA, chosen)


_KINDS: dict[str, Callable[[np.random.Generator], Case]] = {
    "exact": _exact,
    "noisy": _noisy,
    "unrelated": _unrelated,
    "box": _box,
    "repeated": _repeated,
    "flat": _flat,
    "extreme": _extreme,
    "special": _special,
    "careless": _careless,
}
