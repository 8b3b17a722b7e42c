"""Each kind of evidence alone and all together, for exact, stretched and learned models."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from support.scenes import CAMERA, around

from cadalign import Alignment, Model, ShapeModel, Size, View, align
from cadalign.datasets import KeypointNet, write_sample_dataset
from cadalign.estimation.result import Result
from cadalign.metrics import rotation_error
from cadalign.render import Scene, cast_geometry, sample_view
from cadalign.shapes.examples import examples_of

KINDS = ("mask", "depth", "gravity", "size", "camera height", "rig")
MODELS = ("exact", "stretched", "learned")


class Case(NamedTuple):
    """A model, the object's keypoints before its stretch and its box, and two noisy views."""

    model: Model | ShapeModel
    truth: Alignment
    points_3d: np.ndarray
    bounds: np.ndarray
    ids: list[int]
    told: Mapping[str, Any]
    second: tuple[np.ndarray, np.ndarray]

    def align(self, *kinds: str) -> Result:
        """The alignment from keypoints and evidence of some kinds."""
        fields = {"gravity": ("up",), "camera height": ("up", "camera_height")}
        names = [name for kind in kinds for name in fields.get(kind, (kind,))]
        first = {name: self.told[name] for name in names if name in self.told}
        first |= {"depth_sigma": 0.005} if "depth" in names else {}
        pixels = self.told["points_2d"]
        if "rig" not in kinds:
            views = [View(CAMERA, pixels, ids=self.ids, **first)]
        else:
            seen, motion = self.second
            views = [
                View(CAMERA, pixels, ids=self.ids, cam_from_rig=np.eye(4), **first),
                View(CAMERA, seen, ids=self.ids, cam_from_rig=motion),
            ]
        size = Size(height=self.height) if "size" in kinds else None
        return align(self.model, views, size=size)

    @property
    def height(self) -> float:
        return float(np.ptp(self.bounds[:, 1]) * self.truth.scale[1])


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("evidence") / "sample"
    return write_sample_dataset(folder, per_category=16, categories=["bottle"])


@cache
def case_of(root: Path, kind: str) -> Case:
    rng = np.random.default_rng(4)
    bottles = KeypointNet(root)["bottle"]
    scene = Scene(bottles[0].load_mesh())
    points = bottles[0].keypoints.xyz
    scale = np.array([1.0, 0.8, 1.3]) if kind == "stretched" else np.ones(3)
    shown = sample_view(scene, points, CAMERA, rng=rng, min_visible=6, scale=scale, roll=10.0)
    truth = shown.cam_from_model
    rows = np.flatnonzero(shown.visible)
    motion = around(25.0)
    inside = truth.apply(points[rows])
    moved = inside @ motion[:3, :3].T + motion[:3, 3]
    noise = rng.normal(0, 1, (2, len(rows), 2))
    camera = -truth.rotation.T @ truth.translation
    told = {
        "points_2d": CAMERA.project(inside) + noise[0],
        "mask": cast_geometry(scene, CAMERA, truth).mask,
        "depth": inside[:, 2] * (1 + 0.005 * rng.normal(size=len(rows))),
        "up": truth.rotation[:, 1],
        "camera_height": abs(float(camera[1] - scale[1] * scene.bounds[0, 1])),
    }
    ids = bottles[0].keypoints.ids
    model: Model | ShapeModel
    if kind == "learned":
        examples = examples_of(bottles[1:], meshes=True, on_progress=lambda done, total: None)
        model = ShapeModel.learn(examples, category="bottle", components=1, up_axis="y")
    else:
        stretch = "none" if kind == "exact" else None
        model = Model(points_3d=points, ids=ids.tolist(), mesh=scene.mesh, stretch=stretch)
    second = (CAMERA.project(moved) + noise[1], motion)
    return Case(model, truth, points, scene.bounds, ids[rows].tolist(), told, second)


def check(case: Case, result: Result) -> None:
    """The estimate is near the truth, by its own covariance, and nothing contradicts."""
    error = rotation_error(est=result.alignment, gt=case.truth)
    assert error < 5 * result.std.rotation_deg + 0.1
    assert result.covariance.shape == (9, 9)
    assert np.linalg.eigvalsh(result.covariance)[0] > -1e-9
    assert not any("contradict" in text for text in result.warnings)


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("model", MODELS)
def test_each_kind_alone(root: Path, model: str, kind: str) -> None:
    case = case_of(root, model)
    result = case.align(kind)
    check(case, result)
    found = {(each.kind, each.view) for each in result.evidence}
    assert ("keypoints", 0) in found
    if kind != "rig":
        assert (kind, None if kind == "size" else 0) in found
    names = {each.kind for each in result.contributions()}
    assert {kind, "keypoints"} <= names


@pytest.mark.long
@pytest.mark.parametrize("model", MODELS)
def test_all_kinds_together(root: Path, model: str) -> None:
    case = case_of(root, model)
    result = case.align(*KINDS)
    check(case, result)
    alone = case.align("rig")
    assert result.std.rotation_deg <= 1.001 * alone.std.rotation_deg
    (lengths,) = [np.ptp(result.bounds, axis=0) * result.alignment.scale]
    true_lengths = np.ptp(case.bounds, axis=0) * case.truth.scale
    assert np.abs(np.log(lengths / true_lengths)).max() < (0.1 if model == "learned" else 0.01)
    kinds = {each.kind for each in result.evidence}
    assert kinds == {"keypoints", *KINDS} - {"rig"}
    assert all(np.isfinite(each.rms_sigmas) for each in result.evidence)
    without = {each.kind: each.without for each in result.contributions()}
    assert set(without) == {"keypoints", *KINDS}
    for each in without.values():
        assert each.rotation_deg > 0.98 * np.degrees(np.sqrt(np.trace(result.covariance[:3, :3])))
