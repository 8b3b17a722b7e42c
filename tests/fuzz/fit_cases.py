"""Problems for `cadalign.fit`: right ones, careless ones and hostile ones, each from a seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from fuzz.hostile import Call, draw_array, draw_value
from scipy.spatial.transform import Rotation

from cadalign import Alignment, Camera, FocalPrior, RansacOptions

CAMERA = Camera(640, 480, 500.0, 505.0, 319.5, 239.5)
LENS = Camera(640, 480, 500.0, 520.0, 310.0, 250.0, (-0.25, 0.08, 0.004, -0.003))
OPTIONS = (
    "method", "sigma", "loss", "loss_scale", "stretch", "stretch_sigma", "focal",
    "focal_prior", "ransac", "scores",
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One call of `fit`, of which camera and options may be a `Call`.

    ``kind`` names the function that drew it; ``truth`` and ``true_focal`` are the answer, where the
    data are free of noise and determine it.
    """

    kind: str
    points_3d: Any
    points_2d: Any
    camera: Any = CAMERA
    options: dict[str, Any] = field(default_factory=dict)
    truth: Alignment | None = None
    true_focal: float = CAMERA.fx


def draw_case(seed: int) -> Case:
    """Draw the case of a seed; the same on every machine."""
    rng = np.random.default_rng([seed, 20261])
    kind = rng.choice(list(_KINDS), p=_SHARES)
    return replace(_KINDS[kind][0](rng), kind=str(kind))


def draw_cases(seed: int, count: int) -> list[Case]:
    """Draw some cases of the kinds that a batch may hold together."""
    rng = np.random.default_rng([seed, 20262])
    kinds = [_KINDS[kind][0] for kind in ("noisy", "box", "repeated", "flat", "unrelated", "lens")]
    cases = [kinds[rng.integers(len(kinds))](rng) for _ in range(count)]
    if rng.random() < 0.1:
        cases[rng.integers(1, count)] = _KINDS["careless"][0](rng)
    return cases


# --- right problems, without noise ---------------------------------------------------------------


def draw_pose(rng: np.random.Generator, *, free: str = "yz") -> Alignment:
    """Draw a pose in front of the camera, stretched along the ``free`` axes."""
    rotation = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    scale = [float(np.exp(rng.uniform(-0.7, 0.7))) if axis in free else 1.0 for axis in "xyz"]
    return Alignment(rotation, [*rng.uniform(-1, 1, 2), rng.uniform(4, 9)], scale)


def _pixels(pose: Alignment, points: np.ndarray, camera: Camera = CAMERA) -> np.ndarray:
    in_camera = pose.apply(points)
    return camera.pixels_from_normalized(in_camera[:, :2] / in_camera[:, 2:])


def _cloud(rng: np.random.Generator, least: int, most: int) -> np.ndarray:
    return rng.uniform(-1, 1, (int(rng.integers(least, most)), 3))


def _exact(rng: np.random.Generator) -> Case:
    """Generic points, from 4 up, and options that change nothing of the answer."""
    free = str(rng.choice(["yz", "yz", "y", "z", "none"]))
    points = _cloud(rng, 4, 20)
    camera = LENS if rng.random() < 0.2 else CAMERA
    pose = draw_pose(rng, free=free)
    options: dict[str, Any] = {"stretch": free}
    if rng.random() < 0.5:
        options["sigma"] = float(10 ** rng.uniform(-2, 2))
    elif len(points) > 5 and rng.random() < 0.3:
        options["sigma"] = rng.uniform(0.1, 5, len(points))
    if len(points) > 5 and rng.random() < 0.2:
        options["loss"] = str(rng.choice(["huber", "cauchy"]))
    return Case("", points, _pixels(pose, points, camera), camera, options, pose)


def _exact_linear(rng: np.random.Generator) -> Case:
    points = _cloud(rng, 6, 30)
    pose = draw_pose(rng)
    options = {"method": "aepnp", "sigma": None if rng.random() < 0.3 else 1.0}
    return Case("", points, _pixels(pose, points), CAMERA, options, pose)


def _exact_focal(rng: np.random.Generator) -> Case:
    points = _cloud(rng, 7, 20)
    pose = draw_pose(rng)
    camera = (
        Camera.from_size(640, 480) if rng.random() < 0.5 else Camera(640, 480, 90, 90, 319.5, 239.5)
    )
    focal = float(np.exp(rng.uniform(np.log(150), np.log(2000))))
    seen = _pixels(pose, points, Camera(640, 480, focal, focal, 319.5, 239.5))
    options: dict[str, Any] = {"focal": "estimate", "focal_prior": None}
    if rng.random() < 0.3:
        options["focal_prior"] = FocalPrior(focal, 0.05)
    return Case("", points, seen, camera, options, pose, focal)


def _exact_outliers(rng: np.random.Generator) -> Case:
    """Exact points, and up to 40 % that are anywhere."""
    points = _cloud(rng, 15, 60)
    pose = draw_pose(rng)
    pixels = _pixels(pose, points)
    wrong = int(rng.uniform(0, 0.4) * len(points))
    pixels[:wrong] = rng.uniform(0, 1, (wrong, 2)) * [640, 480]
    options: dict[str, Any] = {"ransac": RansacOptions(seed=int(rng.integers(1000)))}
    if rng.random() < 0.3:
        options["scores"] = rng.uniform(0, 1, len(points))
    # An outlier may come to lie within the threshold by chance, and then shifts the optimum.
    in_reach = np.linalg.norm(_pixels(pose, points[:wrong]) - pixels[:wrong], axis=1) < 40
    truth = None if in_reach.any() else pose
    return Case("", points, pixels, CAMERA, options, truth)


# --- hard problems -------------------------------------------------------------------------------


def _options(rng: np.random.Generator) -> dict[str, Any]:
    """Options of any kind, which may exclude each other; most of them absent."""
    options: dict[str, Any] = {}
    if rng.random() < 0.05:
        options["method"] = str(rng.choice(["aepnp", "aepnp-paper", "epnp"]))
        return options
    if rng.random() < 0.2:
        options["stretch"] = str(rng.choice(["yz", "y", "z", "none"]))
    if rng.random() < 0.2:
        options["stretch_sigma"] = float(rng.choice([1e-3, 0.1, 0.3, 3.0]))
    if rng.random() < 0.2:
        options["loss"] = str(rng.choice(["linear", "huber", "cauchy"]))
        options["loss_scale"] = float(10 ** rng.uniform(-2, 2))
    if rng.random() < 0.3:
        options["sigma"] = None if rng.random() < 0.5 else float(10 ** rng.uniform(-2, 2))
    if rng.random() < 0.08:
        options["ransac"] = RansacOptions(
            max_iterations=200,
            max_reproj_error=float(10 ** rng.uniform(-1, 2)),
            refine=bool(rng.random() < 0.6),
            minimal="aepnp" if rng.random() < 0.3 else "ap4p",
        )
    if rng.random() < 0.08:
        options["focal"] = "estimate"
        if rng.random() < 0.5:
            options["focal_prior"] = FocalPrior(float(10 ** rng.uniform(1, 4)), 0.1)
    return options


def _noisy(rng: np.random.Generator) -> Case:
    points = _cloud(rng, 4, 30)
    pixels = _pixels(draw_pose(rng), points)
    noise = rng.normal(0, 10 ** rng.uniform(-2, 2), pixels.shape)
    return Case("", points, pixels + noise, CAMERA, _options(rng))


def _unrelated(rng: np.random.Generator) -> Case:
    """Pairs that have nothing to do with each other."""
    points = _cloud(rng, 4, 21)
    pixels = rng.uniform(0, 1, (len(points), 2)) * [640, 480]
    return Case("", points, pixels, CAMERA, _options(rng))


def _box(rng: np.random.Generator) -> Case:
    """Corners of a cuboid, often a flat one, held stiff though the object is stretched."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    points = corners * rng.uniform(0.02 if rng.random() < 0.5 else 0.3, 1, 3)
    if rng.random() < 0.3:
        points[:, rng.integers(3)] *= 0.02
    pixels = _pixels(draw_pose(rng), points)
    options = _options(rng)
    if "method" not in options:
        options["stretch"] = str(rng.choice(["none", "none", "y", "z", "yz"]))
    return Case(
        "", points, pixels + rng.normal(0, rng.choice([0, 1, 5]), pixels.shape), CAMERA, options
    )


def _symmetric_box(rng: np.random.Generator) -> Case:
    """Corners of a square box, their pixels rounded: as people click them."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    points = corners * rng.choice([0.25, 0.5, 1.0], 3)
    pixels = np.round(_pixels(draw_pose(rng), points))
    return Case("", points, pixels, CAMERA, _options(rng) | {"method": "optimal"})


def _repeated(rng: np.random.Generator) -> Case:
    """The same few points several times."""
    points = _cloud(rng, 2, 6)
    pixels, times = _pixels(draw_pose(rng), points), int(rng.integers(2, 4))
    tiled = np.tile(pixels, (times, 1))
    return Case("", np.tile(points, (times, 1)), tiled, CAMERA, _options(rng))


def _flat(rng: np.random.Generator) -> Case:
    """Points in a plane or on a line, exactly or nearly."""
    points = _cloud(rng, 4, 15)
    thin = rng.choice([0.0, 1e-12, 1e-6, 1e-2])
    points[:, rng.integers(3)] *= thin
    if rng.random() < 0.3:
        points[:, rng.integers(3)] *= thin
    if rng.random() < 0.3:
        points = points @ Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    pixels = _pixels(draw_pose(rng), points)
    return Case("", points, pixels + rng.normal(0, 1, pixels.shape), CAMERA, _options(rng))


def _extreme(rng: np.random.Generator) -> Case:
    """Coordinates of any magnitude, in the model, the image or the camera."""
    wide = 200 if rng.random() < 0.5 else 12
    points = _cloud(rng, 4, 12) * 10.0 ** rng.uniform(-wide, wide)
    if rng.random() < 0.5:
        points = points + 10.0 ** rng.uniform(-3, 0.8 * wide)
    if rng.random() < 0.3:
        points = points * 10.0 ** rng.uniform(-wide, 0, 3)
    pixels = rng.uniform(0, 1, (len(points), 2)) * 10.0 ** rng.uniform(-10, wide)
    focal = 10.0 ** rng.uniform(-5, 9)
    camera = Camera(640, 480, focal, focal * 10 ** rng.uniform(-1, 1), 319.5, 239.5)
    options = _options(rng)
    if rng.random() < 0.2:
        options["sigma"] = float(10 ** rng.uniform(-wide, wide))
    return Case("", points, pixels, camera, options)


def _special(rng: np.random.Generator) -> Case:
    """Values that are no coordinates, among others that are."""
    points = rng.uniform(-1, 1, (8, 3))
    pixels = _pixels(draw_pose(rng), points)
    for array in (points, pixels):
        if rng.random() < 0.7:
            value = rng.choice([np.nan, np.inf, -np.inf, 1e308, -1e308, 1e150, 1e20, 5e-324, 0.0])
            array[rng.integers(len(array)), rng.integers(array.shape[1])] = value
    return Case("", points, pixels, CAMERA, _options(rng))


def _lens(rng: np.random.Generator) -> Case:
    """Distortion of any strength, of which few lenses can be inverted everywhere."""
    points = _cloud(rng, 4, 20)
    strength = 10.0 ** rng.uniform(-4, 3)
    lens = tuple((rng.normal(0, 1, rng.choice([4, 5, 8])) * strength).tolist())
    pixels = _pixels(draw_pose(rng), points) + rng.normal(0, 1, (len(points), 2))
    camera = Camera(640, 480, 500.0, 505.0, 319.5, 239.5, lens)
    return Case("", points, pixels * 10 ** rng.uniform(-1, 1), camera, _options(rng))


def _many(rng: np.random.Generator) -> Case:
    """As many as 5,000 points, related or not."""
    points = _cloud(rng, 500, 5001)
    pixels = _pixels(draw_pose(rng), points)
    wrong = rng.random(len(points)) < rng.choice([0.0, 0.3, 0.8, 1.0])
    pixels[wrong] = rng.uniform(0, 1, (int(wrong.sum()), 2)) * [640, 480]
    options = _options(rng)
    if wrong.any() and rng.random() < 0.5:
        options = {"ransac": RansacOptions()}
    return Case("", points, pixels + rng.normal(0, 1, pixels.shape), CAMERA, options)


# --- calls that are wrong ------------------------------------------------------------------------


def _careless(rng: np.random.Generator) -> Case:
    """Points of another type, shape or layout, and options of any type and value."""
    points = rng.uniform(-1, 1, (8, 3))
    pixels: Any = _pixels(draw_pose(rng), points)
    model: Any = points
    camera: Any = CAMERA
    options = _options(rng)
    for name in rng.choice(OPTIONS, int(rng.integers(0, 3)), replace=False):
        options[str(name)] = draw_value(rng)
    if rng.random() < 0.15:
        options["sigma"] = draw_array(rng, ((8,), (8, 2, 2), (7,), (8, 1))[rng.integers(4)])
    if rng.random() < 0.1:
        options["ransac"] = _call(rng, RansacOptions, {"max_iterations": 200}, (
            "max_reproj_error", "max_iterations", "min_iterations", "success_prob", "seed",
            "minimal", "refine",
        ))  # fmt: skip
        if rng.random() < 0.3:
            options["scores"] = draw_array(rng, (8,))
    if rng.random() < 0.1:
        options["focal"] = "estimate"
        options["focal_prior"] = _call(
            rng, FocalPrior, {"focal": 500.0}, ("focal", "relative_sigma")
        )
    if rng.random() < 0.2:
        model = draw_array(rng, (8, 3)) if rng.random() < 0.5 else draw_value(rng)
    if rng.random() < 0.2:
        pixels = draw_array(rng, (8, 2)) if rng.random() < 0.5 else draw_value(rng)
    if rng.random() < 0.1:
        plain = {"width": 640, "height": 480, "fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0}
        camera = _call(rng, Camera, plain, (*plain, "distortion", "focal_known"))
    elif rng.random() < 0.02:
        camera = draw_value(rng)
    return Case("", model, pixels, camera, options)


def _call(
    rng: np.random.Generator,
    kind: Callable[..., Any],
    plain: dict[str, Any],
    names: tuple[str, ...],
) -> Call:
    """A call with one or two arguments of any value."""
    wrong = rng.choice(names, int(rng.integers(1, 3)), replace=False)
    return Call(kind, plain | {str(name): draw_value(rng) for name in wrong})


_KINDS: dict[str, tuple[Callable[[np.random.Generator], Case], float]] = {
    "exact": (_exact, 10),
    "exact linear": (_exact_linear, 3),
    "exact focal": (_exact_focal, 1),
    "exact outliers": (_exact_outliers, 1),
    "noisy": (_noisy, 10),
    "unrelated": (_unrelated, 10),
    "box": (_box, 15),
    "symmetric box": (_symmetric_box, 5),
    "repeated": (_repeated, 5),
    "flat": (_flat, 10),
    "extreme": (_extreme, 10),
    "special": (_special, 5),
    "lens": (_lens, 5),
    "many": (_many, 0.3),
    "careless": (_careless, 15),
}
_SHARES = np.array([share for _, share in _KINDS.values()]) / sum(
    share for _, share in _KINDS.values()
)
