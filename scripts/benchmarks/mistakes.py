"""Mirrored models, flipped photos and swapped coordinates: what robust estimates say of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from benchmarks.section import BenchmarkData, Row, Tables, percent, seen_in
from cadalign import CadalignError, Model, RansacOptions, Result, View, align, fit
from cadalign.arrays import FloatArray
from cadalign.datasets import KeypointNet
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.geometry.pixels import PIXEL_CENTRE
from cadalign.geometry.rotations import angle_between
from cadalign.render import look_at
from cadalign.solvers.constants import UNKNOWNS

_CATEGORIES = ("chair", "bottle", "airplane", "mug", "bathtub", "guitar")
_SIMILAR = ("chair", "bottle", "mug")
_SHAPE_SIGMA = 0.02  # of similar models [diagonals]
_NOISE_PX, _OUTLIERS = 1.0, 0.3
_FEWEST, _MOST = 7, 16  # keypoints
_STRETCH_SIGMA = 0.25  # of log scales
_DISTANCE, _ELEVATION_DEG = (2.0, 4.0), (-10.0, 50.0)
_WRONG_DEG = 10.0
_CLAUSES = ("is mirrored", "are swapped", "is flipped", "from the bottom")
_SIZE = KEYPOINT_CAMERA.width, KEYPOINT_CAMERA.height


def mistakes(given: BenchmarkData) -> Tables:
    """Shares of mistakes that stay unnoticed, and of right keypoints that raise an alarm [%].

    Keypoints of KeypointNet's models, stretched, with 1 px of noise. Unnoticed is an estimate
    without a warning but for uncertainties, and with a rotation that is more than 10 degrees off.
    """
    dataset, models = KeypointNet(given.needed()), {}
    for category in _CATEGORIES:
        points = (each.keypoints.xyz for each in dataset[category])
        models[category] = [each for each in points if len(each) >= _FEWEST]
    for title, names, count, sigma in (
        ("mistakes [%]", _CATEGORIES, given.count or 300, 0.0),
        ("of similar models [%]", _SIMILAR, given.count or 100, _SHAPE_SIGMA),
    ):
        rows = [
            {"category": name} | _shares(models[name], given.seed, count, sigma) for name in names
        ]
        yield title, rows


class SeenModel(NamedTuple):
    """Keypoints of a stretched, upright object in a photo, and its rotation."""

    points_3d: FloatArray
    points_2d: FloatArray
    rotation: FloatArray

    def changed(self) -> dict[str, SeenModel]:
        """The same with the model mirrored, u from the other side, and u and v swapped."""
        last = KEYPOINT_CAMERA.width - 2 * PIXEL_CENTRE
        return {
            "mirrored": self._replace(points_3d=self.points_3d * [-1, 1, 1]),
            "flipped": self._replace(points_2d=self.points_2d * [-1, 1] + [last, 0]),
            "swapped": self._replace(points_2d=self.points_2d[:, ::-1].copy()),
        }

    def with_outliers(self, rng: np.random.Generator) -> SeenModel:
        """The same, some keypoints anywhere in the image."""
        count = len(self.points_2d)
        wrong = rng.choice(count, round(_OUTLIERS * count), replace=False)
        pixels = self.points_2d.copy()
        pixels[wrong] = rng.uniform(0, _SIZE, (len(wrong), 2))
        return self._replace(points_2d=pixels)


def _shares(models: list[FloatArray], seed: int, problems: int, shape_sigma: float) -> Row:
    said: dict[str, list[tuple[bool, bool, bool, bool]]] = {}
    for number in range(problems):
        rng = np.random.default_rng([seed, number])
        seen, few = _seen(models, rng), _seen(models, rng, _FEWEST)
        moved = rng.normal(0, shape_sigma, seen.points_3d.shape)
        seen = seen._replace(points_3d=seen.points_3d + moved)
        given = seen.changed() | {"right": seen, "outliers": seen.with_outliers(rng)}
        if not shape_sigma:
            given["7 keypoints"] = few.with_outliers(rng)
        for kind, each in given.items():
            said.setdefault(kind, []).append(_said(each, shape_sigma))
    row: Row = {}
    unnoticed = explained = 0
    for kind, found in said.items():
        silent, named, refused, fits = np.transpose(found)
        if kind in ("mirrored", "flipped", "swapped"):
            row[f"{kind} unnoticed"] = percent(silent)
            unnoticed, explained = unnoticed + silent.sum(), explained + (silent & fits).sum()
        else:
            row[f"{kind} named"], row[f"{kind} refused"] = percent(named), percent(refused)
    return row | {"of the unnoticed, all keypoints fit": f"{explained} of {unnoticed}"}


def _seen(
    models: list[FloatArray], rng: np.random.Generator, count: int | None = None
) -> SeenModel:
    points = models[rng.integers(len(models))]
    size = count or int(rng.integers(_FEWEST, min(len(points), _MOST) + 1))
    points = points[rng.choice(len(points), size, replace=False)]
    azimuth, elevation = rng.uniform(0, 360), rng.uniform(*_ELEVATION_DEG)
    stretched = points * np.exp([0.0, *rng.normal(0, _STRETCH_SIGMA, 2)])
    pose = look_at(azimuth=azimuth, elevation=elevation, distance=rng.uniform(*_DISTANCE))
    seen = seen_in(KEYPOINT_CAMERA, pose, stretched, _NOISE_PX, rng)
    return SeenModel(points, seen.points_2d, pose.rotation)


def _said(seen: SeenModel, shape_sigma: float) -> tuple[bool, bool, bool, bool]:
    """True for a wrong rotation without a word, for a mistake that is named, and for a refusal.

    Last, if all keypoints fit the estimate within their noise, at 1 %: nothing contradicts it.
    """
    try:
        found = _estimate(seen, shape_sigma)
    except CadalignError as error:
        return False, any(each in str(error) for each in _CLAUSES), True, False
    kinds = {warning.kind for warning in found.warnings} - {"focal"}
    turn = angle_between(found.alignment.rotation, seen.rotation)
    square, count = (found.residuals**2).sum() / _NOISE_PX**2, found.residuals.size
    fits = found.inliers.all() and square < chi2.isf(0.01, max(count - UNKNOWNS, 1))
    return not kinds and turn > _WRONG_DEG, "mistake" in kinds, False, bool(fits)


def _estimate(seen: SeenModel, shape_sigma: float) -> Result:
    if not shape_sigma:
        return fit(seen.points_3d, seen.points_2d, KEYPOINT_CAMERA, ransac=RansacOptions())
    model = Model(points_3d=seen.points_3d, shape_sigma=shape_sigma)
    return align(model, View(KEYPOINT_CAMERA, seen.points_2d), ransac=RansacOptions())
