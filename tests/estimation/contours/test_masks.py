"""`align` with masks: accuracy, damaged masks, masks of other objects, starts."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest
from benchmarks.evidence import damaged_mask

from cadalign import Alignment, Camera, Model, Result, View, align
from cadalign.datasets import KeypointNet
from cadalign.geometry.rotations import rotation_from_vector, vector_from_rotation
from cadalign.metrics import rotation_error
from cadalign.render import Scene, cast_geometry, sample_view

pytestmark = pytest.mark.long

CAMERA = Camera(640, 480, 935, 935, 319.5, 239.5)


class Case(NamedTuple):
    scene: Scene
    model: Model
    truth: Alignment
    ids: list[int]
    points_2d: np.ndarray
    mask: np.ndarray

    def view(self, **options: object) -> View:
        return View(CAMERA, self.points_2d, ids=self.ids, **options)


def case_of(model: object, seed: int, *, noise_px: float = 1.0) -> Case:
    """A random view of a stretched model with its exact mask."""
    rng = np.random.default_rng(seed)
    scene = Scene(model.load_mesh())
    points = model.keypoints.xyz
    scale = np.array([1.0, *np.exp(rng.uniform(-0.6, 0.6, 2))])
    view = sample_view(scene, points, CAMERA, rng=rng, min_visible=6, scale=scale, roll=10.0)
    ids = np.flatnonzero(view.visible).tolist()
    truth = view.cam_from_model
    pixels = CAMERA.project(truth.apply(points[ids])) + rng.normal(0, noise_px, (len(ids), 2))
    exact = Model(points_3d=points, mesh=scene.mesh)
    return Case(scene, exact, truth, ids, pixels, cast_geometry(scene, CAMERA, truth).mask)


@cache
def chair(root: Path) -> Case:
    return case_of(KeypointNet(root)["chair"][0], 1)


def stretch_error(case: Case, estimate: Alignment) -> float:
    return float(np.abs(estimate.scale / case.truth.scale - 1).max())


def with_disc(mask: np.ndarray, kind: str, rng: np.random.Generator) -> np.ndarray:
    """The mask with a hole in it, or with a blob of the background at its edge."""
    pixels = mask.astype(np.uint8)
    edge = (pixels > 0) & (cv2.erode(pixels, np.ones((3, 3), np.uint8)) == 0)
    places = np.argwhere(edge if kind == "blob" else pixels > 0)
    row, column = places[rng.integers(len(places))].tolist()
    radius = round(0.13 * float(np.sqrt(pixels.sum())))
    cv2.circle(pixels, (column, row), radius, int(kind == "blob"), thickness=-1)
    return pixels > 0


def moved(alignment: Alignment, angle_deg: float, shift: float, stretch: float) -> Alignment:
    turn = rotation_from_vector(np.radians(angle_deg) * np.array([0.6, -0.64, 0.48]))
    return Alignment(
        turn @ alignment.rotation,
        alignment.translation * (1 + shift),
        alignment.scale * [1, 1 + stretch, 1 - stretch],
    )


class TestExactMasks:
    def test_the_sample_chair_and_what_the_result_says(self, sample_root: Path) -> None:
        case = chair(sample_root)
        alone = align(case.model, case.view())
        result = align(case.model, case.view(mask=case.mask))
        error = rotation_error(est=result.alignment, gt=case.truth)
        assert error < 0.2
        assert error < 4 * result.std.rotation_deg
        assert result.std.rotation_deg < alone.std.rotation_deg / 3
        (summary,) = [each for each in result.evidence if each.kind == "mask"]
        assert summary.view == 0
        assert summary.count > 180
        assert summary.rms < 0.5
        assert summary.rms_sigmas < 1.5

    def test_probabilities_and_files_serve_as_well(self, sample_root: Path, tmp_path: Path) -> None:
        import cv2

        case = chair(sample_root)
        path = tmp_path / "mask.png"
        cv2.imwrite(str(path), case.mask.astype(np.uint8) * 255)
        expected = align(case.model, case.view(mask=case.mask)).alignment
        of_file = align(case.model, case.view(mask=str(path))).alignment
        of_probabilities = align(case.model, case.view(mask=case.mask * 0.9)).alignment
        assert of_file == expected
        assert rotation_error(est=of_probabilities, gt=case.truth) < 0.3


@pytest.mark.parametrize("kind", ["dilated", "hole", "blob"])
def test_damaged_masks_still_help(sample_root: Path, kind: str) -> None:
    case = chair(sample_root)
    damage = with_disc if kind in ("hole", "blob") else damaged_mask
    mask = damage(case.mask, kind, np.random.default_rng(0))
    alone = align(case.model, case.view())
    result = align(case.model, case.view(mask=mask))
    error = rotation_error(est=result.alignment, gt=case.truth)
    assert error < (0.5 if kind == "dilated" else 1.1) * alone.std.rotation_deg
    assert np.isfinite(result.evidence[-1].rms)


def test_deviations_are_those_of_the_errors(sample_root: Path) -> None:
    dataset = KeypointNet(sample_root)
    whitened = []
    for category in ("chair", "vessel", "car"):
        for seed, kind in enumerate(("exact", "dilated", "smoothed", "dilated")):
            case = case_of(dataset[category][0], seed)
            mask = damaged_mask(case.mask, kind, np.random.default_rng(seed))
            result = align(case.model, case.view(mask=mask))
            turn = result.alignment.rotation @ case.truth.rotation.T
            errors = np.concatenate(
                [
                    vector_from_rotation(turn),
                    result.alignment.translation - case.truth.translation,
                    np.log(result.alignment.scale / case.truth.scale)[1:],
                ]
            )
            deviations = np.sqrt(result.covariance.diagonal())[[0, 1, 2, 3, 4, 5, 7, 8]]
            whitened.append(np.abs(errors / deviations))
    assert np.mean(np.array(whitened) < 1.96) > 0.9
    assert 0.4 < np.sqrt(np.mean(np.square(whitened))) < 1.3


class TestOtherObjects:
    def test_the_mask_of_a_neighbour_is_named_and_left_out(self, sample_root: Path) -> None:
        case = chair(sample_root)
        neighbour = np.roll(case.mask, 150, axis=1)
        alone = align(case.model, case.view())
        result = align(case.model, case.view(mask=neighbour))
        assert any(each.kind == "mask" for each in result.warnings)
        assert np.isnan(result.evidence[-1].rms)
        assert rotation_error(est=result.alignment, gt=alone.alignment) < 1e-3
        elsewhere = np.zeros_like(case.mask)
        elsewhere[:20, :20] = True
        unmet = align(case.model, case.view(mask=elsewhere))
        read = Result.from_dict(unmet.to_dict())
        assert "NaN" not in json.dumps(unmet.to_dict())
        assert [each.name for each in read.evidence] == ["views[0].points_2d", "views[0].mask"]
        assert np.isnan(read.evidence[1].rms)

    def test_neighbours_of_all_kinds_are_named(self, sample_root: Path) -> None:
        dataset = KeypointNet(sample_root)
        models = [dataset[category][0] for category in ("bottle", "car", "chair", "vessel")]
        cases = [case_of(model, 0) for model in models]
        named = []
        for number, case in enumerate(cases):
            columns = np.flatnonzero(case.mask.any(axis=0))
            step = (len(columns) if number % 2 else -len(columns)) * 3 // 4
            neighbour = np.roll(cases[(number + 1) % len(cases)].mask, step, axis=1)
            warnings = align(case.model, case.view(mask=neighbour)).warnings
            named.append(any("mask contradicts" in each.text for each in warnings))
        assert all(named)


class TestStarts:
    def test_a_mask_alone_with_a_start(self, sample_root: Path) -> None:
        case = chair(sample_root)
        start = moved(case.truth, 3.0, 0.01, 0.02)
        result = align(case.model, View(CAMERA, mask=case.mask), init=start)
        assert rotation_error(est=result.alignment, gt=case.truth) < 0.3
        assert stretch_error(case, result.alignment) < 0.01

    def test_a_mask_and_three_keypoints_with_a_start(self, sample_root: Path) -> None:
        case = chair(sample_root)
        view = View(CAMERA, case.points_2d[:3], ids=case.ids[:3], mask=case.mask)
        result = align(case.model, view, init=moved(case.truth, 6.0, 0.03, 0.05))
        assert rotation_error(est=result.alignment, gt=case.truth) < 0.3
