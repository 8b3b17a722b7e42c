"""Gradients in PyTorch: their time and errors; coverage of calibrated detectors' noise."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

import cadalign
from benchmarks.section import (
    BenchmarkData,
    NotGivenError,
    RatioTable,
    Row,
    figure,
    medians_in_turns,
)
from cadalign.datasets import ImageKeypoints
from cadalign.datasets import open as open_data
from cadalign.datasets.photos.kitti_keypoints import car_keypoints, car_shape, yaw_of_car
from cadalign.errors import CadalignError
from cadalign.evaluation.simulation.problems import simulate_problem
from cadalign.geometry.box import Box
from cadalign.geometry.camera import Camera
from cadalign.shapes.model import ShapeModel

_LEAST_SCORE, _LEAST_KEYPOINTS, _BLOCK = 0.1, 6, 6
_WELL_KNOWN_DEG = 10.0


@dataclass
class TorchLayer:
    """Forward and backward pass of a batch of fits, beside Gauss-Newton unrolled in PyTorch.

    The unrolled one starts from the fit itself, perturbed: it searches nothing. Where PyPose is
    installed, its EPnP of the models, stretched as they truly are, stands beside them.
    """

    problems: int = 1000
    """Problems of a batch."""
    points: int = 10
    """Keypoints of each."""
    repeats: int = 7
    """Passes whose median counts."""
    iterations: int = 5
    """Steps of the unrolled Gauss-Newton."""

    def run(self, given: BenchmarkData) -> Iterator[RatioTable]:
        """Measure both on two threads."""
        try:
            import torch
        except ImportError:
            raise NotGivenError("pip install -e '.[torch]'") from None
        from cadalign.torch import fit

        torch.set_num_threads(2)
        rng = np.random.default_rng(given.seed)
        drawn = [
            simulate_problem(rng, points=self.points, noise_px=1.0) for _ in range(self.problems)
        ]
        points = torch.tensor(np.array([each.points_3d for each in drawn]))
        pixels = torch.tensor(np.array([each.points_2d for each in drawn]))
        camera = drawn[0].camera
        start = fit(points, pixels, camera, workers=2)

        def layer() -> float:
            seen = pixels.clone().requires_grad_()
            begun = time.perf_counter()
            found = fit(points, seen, camera, workers=2)
            (found.rotation.sum() + found.translation.sum() + found.scale.sum()).backward()
            return time.perf_counter() - begun

        def unrolled() -> float:
            seen = pixels.clone().requires_grad_()
            begun = time.perf_counter()
            unknowns = gauss_newton(points, seen, camera, start, self.iterations)
            unknowns.sum().backward()
            return time.perf_counter() - begun

        ways = {"layer": layer, "unrolled": unrolled}
        rigid = pypose_solver(camera)
        if rigid is not None:
            scales = torch.tensor(np.array([each.alignment.scale for each in drawn]))

            def pypose() -> float:
                seen = pixels.clone().requires_grad_()
                begun = time.perf_counter()
                rigid(points * scales[:, None], seen).tensor().sum().backward()
                return time.perf_counter() - begun

            ways["PyPose"] = pypose
        found = medians_in_turns(ways, self.repeats)
        name = f"{self.problems} fits of {self.points} points with gradients"
        ratio = found["layer"] / found["unrolled"]
        row = figure(name, 1e3 * found["layer"], "ms", ratio, "unrolled Gauss-Newton")
        others = {f"{each}, ms": 1e3 * found[each] for each in ways if each != "layer"}
        yield RatioTable("PyTorch", [row | others])


def pypose_solver(camera: Camera) -> Any:
    """PyPose's EPnP without refinement, which takes minutes; None where it is not installed."""
    try:
        import pypose
        import torch
    except ImportError:
        return None
    return pypose.module.EPnP(intrinsics=torch.tensor(np.array(camera.matrix)), refine=False)


def gauss_newton(points: Any, pixels: Any, camera: Camera, start: Any, iterations: int) -> Any:
    """Unknowns (B, 8) after steps of plain Gauss-Newton, by automatic differentiation."""
    import torch

    axes = torch.tensor(
        [[[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 0, 0], [-1, 0, 0]],
         [[0, -1, 0], [1, 0, 0], [0, 0, 0]]], dtype=pixels.dtype,
    )  # fmt: skip
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


@dataclass
class GradientErrors:
    """Gradients beside finite differences, of well-determined problems of every kind.

    The gradient of a random combination of pose, stretch and focal length, along random steps of
    all pixels, relative to the root mean square of such products. Well-determined are problems
    whose rotation is known to 10 degrees; of learned shapes, all with a solution.
    """

    problems: int = 1000
    """Problems of each kind."""
    points: int = 12
    """Keypoints of each."""
    step: float = 1e-4
    """Step of the differences [px]."""

    def run(self, given: BenchmarkData) -> Iterator[RatioTable]:
        """Measure every kind."""
        try:
            import torch
        except ImportError:
            raise NotGivenError("pip install -e '.[torch]'") from None
        from cadalign.torch import align, fit

        rng = np.random.default_rng(given.seed)
        drawn = [
            simulate_problem(rng, points=self.points, noise_px=1.0) for _ in range(self.problems)
        ]
        points = torch.tensor(np.array([each.points_3d for each in drawn]))
        pixels = torch.tensor(np.array([each.points_2d for each in drawn]))
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
            self._row(name, partial(fit, points, camera=camera, **options), pixels, rng)
            for name, options in kinds.items()
        ]
        mean = rng.uniform(-1, 1, (self.points, 3))
        modes = 0.1 * rng.standard_normal((3, self.points, 3))
        shape = ShapeModel.from_basis(mean, modes, np.ones(3), residual_sigma=0.01)
        weights = rng.standard_normal((self.problems, 3, 1, 1))
        objects = mean + (weights * modes).sum(axis=1)
        seen = np.array(
            [
                camera.project(replace(each.alignment, scale=np.ones(3)).apply(own))
                for each, own in zip(drawn, objects, strict=True)
            ]
        )
        noisy = torch.tensor(seen + rng.standard_normal(seen.shape))
        for name, loss in (("learned shape", "linear"), ("learned shape, cauchy", "cauchy")):
            layer = partial(align, shape, camera=camera, loss=loss)
            rows.append(self._row(name, layer, noisy, rng))
        yield RatioTable("Gradients beside finite differences, relative errors", rows)

    def _row(
        self, name: str, layer: Callable[..., Any], pixels: Any, rng: np.random.Generator
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
        after, before = (parts(pixels + sign * self.step * steps) for sign in (1.0, -1.0))
        expected = ((after[0] - before[0]) * weights).sum(dim=1) / (2.0 * self.step)
        slopes = (seen.grad * steps).sum(dim=(1, 2))
        size = seen.grad.flatten(1).norm(dim=1)
        known = found.valid & after[1].valid & before[1].valid
        if found.covariance is not None:
            turn = found.covariance.diagonal(dim1=1, dim2=2)[:, :3].sum(dim=1).sqrt()
            known &= turn < np.radians(_WELL_KNOWN_DEG)
        errors = ((slopes - expected).abs() / size)[known].detach().numpy()
        return {
            "kind": name,
            "problems": int(known.sum()),
            "median": float(np.median(errors)),
            "99 %": float(np.quantile(errors, 0.99)),
            "worst": float(errors.max()),
        }


@dataclass
class NoiseOfDetector:
    """Coverage of the yaw of KITTI's cars with an hourglass network's keypoints, by their noise.

    "left out" is calibrated without the block of 6 successive cars that it is used for; "without a
    common shift" takes the errors' correlation as a shift of all keypoints, which the translation
    follows.
    """

    def run(self, given: BenchmarkData) -> Iterator[RatioTable]:
        """Align all cars with each noise."""
        if given.keypointnet is None:
            raise NotGivenError("set CADALIGN_DATA to the folder of the data")
        folder = given.keypointnet.parent / "real" / "kitti_cars"
        model = car_shape(folder)
        assert model is not None
        seen, true, placed = [], [], []
        for photo in open_data(folder):
            for car in photo.objects:
                found = car.keypoints
                if found is None or found.scores is None or photo.camera is None:
                    continue
                assert car.truth is not None
                assert car.truth.box is not None
                scores = np.where(found.scores >= _LEAST_SCORE, found.scores, 0.0)
                seen.append(ImageKeypoints(found.points_2d, scores, names=found.names))
                true.append(car_keypoints(model, car.truth.box, photo.camera))
                placed.append((photo.camera, car.truth.box))
        yield RatioTable("Yaw of cars", list(self._rows(model, seen, true, placed)))

    def _rows(
        self,
        model: cadalign.ShapeModel,
        seen: list[ImageKeypoints],
        true: list[ImageKeypoints],
        placed: list[tuple[Camera, Box]],
    ) -> Iterator[Row]:
        noise = cadalign.calibrate_detector(seen, true)
        blocks = np.arange(len(seen)) // _BLOCK
        without = [
            cadalign.calibrate_detector(
                [seen[k] for k in np.flatnonzero(blocks != block)],
                [true[k] for k in np.flatnonzero(blocks != block)],
            )
            for block in range(blocks[-1] + 1)
        ]
        ways = {f"{sigma:g} px": [{"sigma": sigma}] * len(seen) for sigma in (1.0, 3.0, 5.0)}
        ways["calibrated"] = [{"noise": noise}] * len(seen)
        ways["left out"] = [{"noise": without[block]} for block in blocks]
        ways["left out, without a common shift"] = [
            {"noise": without_shift(without[block])} for block in blocks
        ]
        for name, fields in ways.items():
            rows = [
                yaw_of_view(model, *each)
                for each in zip(seen, placed, fields, strict=True)
                if (each[0].scores > 0).sum() >= _LEAST_KEYPOINTS
            ]
            errors, held = np.array([each for each in rows if each is not None]).T
            yield {
                "noise": name,
                "cars": len(errors),
                "yaw, deg": (float(np.median(errors)), float(np.percentile(errors, 90))),
                "95 % regions hold, %": 100 * float(held.mean()),
            }


def without_shift(noise: cadalign.DetectorNoise) -> cadalign.DetectorNoise:
    """The noise of each keypoint beside what all of an object have in common.

    An unknown shift of all keypoints is one of the pose's translation, which nothing else tells.
    """
    share = np.sqrt(1 - noise.correlation)
    return replace(noise, sigmas=share * np.asarray(noise.sigmas), correlation=0.0)


def yaw_of_view(
    model: cadalign.ShapeModel,
    seen: ImageKeypoints,
    placed: tuple[Camera, Box],
    fields: dict[str, Any],
) -> tuple[float, bool] | None:
    """Error of yaw [deg], and if the 95 % region holds the truth; None without an alignment."""
    camera, box = placed
    assert seen.scores is not None
    assert seen.names is not None
    kept = np.flatnonzero(seen.scores > 0)
    ids = [seen.names[row] for row in kept]
    scores = seen.scores[kept]
    view = cadalign.View(camera, seen.points_2d[kept], ids=ids, scores=scores, **fields)
    try:
        result = cadalign.align(model, view)
    except CadalignError:
        return None
    forward = -result.alignment.rotation[:, 1]
    moved = np.cross(np.eye(3), forward)  # by a turn about each axis
    across = float((forward[[0, 2]] ** 2).sum())
    slope = (moved[:, 0] * forward[2] - moved[:, 2] * forward[0]) / across
    assert result.covariance is not None
    std = float(np.sqrt(slope @ result.covariance[:3, :3] @ slope))
    turn = yaw_of_car(result.alignment.rotation) - yaw_of_car(box.rotation)
    error = abs(float(np.arctan2(np.sin(turn), np.cos(turn))))
    return float(np.degrees(error)), bool(error < result.radius(0.95) * std)
