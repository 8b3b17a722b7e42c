"""Photos as evidence beside rough clicks: composites with exact truth, and real photos."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from benchmarks import section
from benchmarks.section import BenchmarkData, Row, Tables
from cadalign import Alignment, Camera, Mesh, Model, Result, Symmetry, View, align
from cadalign.arrays import FloatArray
from cadalign.datasets import KeypointNet, write_sample_dataset
from cadalign.evaluation.metrics.errors import probability_level
from cadalign.geometry.rotations import nearest_rotation
from cadalign.io.images import read_photo
from cadalign.io.meshes.files import load_mesh
from cadalign.metrics import nearest_truth, rotation_error
from cadalign.render import RaycastRenderer, Scene, Studio, cast_geometry, sample_view

_CAMERA = Camera(640, 480, 800.0, 800.0, 319.5, 239.5)
_CLICKS = 6
_CLICK_SHARE = 4.0 / 640.0  # standard deviation of a click, relative to the photo's width
_STRETCH_SIGMA = 0.3
_WORSE_DEG = 1.0
_INNER = 0.95  # probability of the regions for coverage


def photo(given: BenchmarkData) -> Tables:
    """Errors with rough clicks only, and with the photo.

    Each photo has six clicks with an error of 4 px at a width of 640 px. Composites are models of
    ShapeNet and of the sample dataset, rendered in front of real photos with varied light, blur and
    noise; a quarter are partly hidden. Their truth is exact. Real photos are from HANDAL, LINEMOD
    and Linemod-Occluded, with several draws of clicks each. Their annotated poses are off by some
    pixels in places.
    """
    draws = given.count or 25
    cases = [(case, 1) for case in _composites(given, 8 * draws)]
    cases += [(case, draws) for case in _samples(given.folder("real", "bop_samples"))]
    occluded = _occluded(given.folder("real", "lmo_multiview"))
    cases += [(case, max(draws // 5, 1)) for case in occluded]
    rows = [
        {"model": model, "photos": case.group} | _compare(case, _draw_clicks(case, rng, model))
        for model in ("rigid", "stretched")
        for number, (case, count) in enumerate(cases)
        for rng in (np.random.default_rng([given.seed, 3, number, draw]) for draw in range(count))
    ]
    yield "photos beside rough clicks", section.summaries(rows, "photos", "model")


@dataclass(frozen=True)
class PhotoCase:
    """An object in a photo: its mesh and true alignment."""

    group: str
    camera: Camera
    pixels: np.ndarray
    mesh: Mesh
    truth: Alignment
    symmetry: Symmetry = field(default_factory=Symmetry.none)


class Clicks(NamedTuple):
    """Clicks (6, 2) in a photo [px], the model with the clicked points, and the true alignment."""

    model: Model
    truth: Alignment
    pixels: FloatArray
    sigma: float


def _draw_clicks(case: PhotoCase, rng: np.random.Generator, model: str) -> Clicks:
    """Draw rough clicks on points spread over the visible surface."""
    is_stretched = model == "stretched"
    scale = np.exp(rng.normal(0, _STRETCH_SIGMA, 3) * [0, 1, 1]) if is_stretched else np.ones(3)
    truth = replace(case.truth, scale=scale)
    mesh = Mesh(case.mesh.vertices / scale, case.mesh.faces)
    geometry = cast_geometry(Scene(mesh), case.camera, truth)
    places = _spread_places(geometry.mask, rng)
    rays = case.camera.normalize(places.astype(float))
    depths = geometry.depth[places[:, 1], places[:, 0]]
    seen = np.column_stack([rays, np.ones(len(rays))]) * depths[:, None]
    sigma = _CLICK_SHARE * case.camera.width
    clicked = Model(
        points_3d=(seen - truth.translation) @ truth.rotation / scale,
        mesh=mesh,
        stretch="yz" if is_stretched else "none",
        stretch_sigma=_STRETCH_SIGMA if is_stretched else None,
    )
    return Clicks(clicked, truth, places + rng.normal(0, sigma, places.shape), sigma)


def _compare(case: PhotoCase, clicks: Clicks) -> Row:
    """Errors without and with the photo: rotation [deg], stretch; and coverage with the photo."""

    def aligned(**evidence: Any) -> Result:
        view = View(case.camera, clicks.pixels, sigma=clicks.sigma, **evidence)
        return align(clicks.model, view)

    first, _, alone = section.clock(aligned)
    second, _, joint = section.clock(partial(aligned, image=case.pixels))
    row: Row = {}
    for name, result in (("clicks", alone), ("photo", joint)):
        est = result.alignment
        gt = nearest_truth(est=est, gt=clicks.truth, symmetry=case.symmetry)
        error = section.deviation(est=est, gt=gt)
        row[f"R {name}"] = rotation_error(est=est, gt=gt)
        row[f"stretch {name}"] = float(np.abs(est.scale / gt.scale - 1).max())
    row["better"] = row["R photo"] < row["R clicks"]
    row["warned"] = any(each.kind == "photo" for each in joint.warnings)
    is_worse = row["R photo"] > row["R clicks"] + _WORSE_DEG
    row["silently worse"] = not row["warned"] and is_worse
    for name, part in (("R", slice(3)), ("t", slice(3, 6))):
        level = probability_level(error[part], joint.covariance[part, part])
        row[f"covered {name}"] = level is not None and level < _INNER
    return row | {"seconds": second - first}


def _spread_places(mask: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Pixels (6, 2) inside a mask, far from each other."""
    inside = cv2.erode(mask.astype(np.uint8), np.ones((5, 5), np.uint8))
    rows, columns = np.nonzero(inside if inside.sum() > 10 * _CLICKS else mask)
    places = np.column_stack([columns, rows])
    some = places[rng.permutation(len(places))[:400]]
    chosen = [some[0]]
    for _ in range(_CLICKS - 1):
        gaps = np.linalg.norm(some[:, None] - np.array(chosen), axis=2).min(axis=1)
        # One of the farthest 2 %: people do not only click on extreme points.
        likely = np.argsort(-gaps)[: max(len(some) // 50, 1)]
        chosen.append(some[rng.choice(likely)])
    return np.array(chosen)


# Real photos --------------------------------------------------------------------------------------


def _samples(root: Path) -> Iterator[PhotoCase]:
    """Objects of HANDAL and LINEMOD; poses.json: {photo: {model, cam_from_model, camera}}."""
    for name, entry in json.loads((root / "poses.json").read_text()).items():
        pose, group = np.array(entry["cam_from_model"]), (root / name).parent.name
        yield _read_case(root / name, group, entry["camera"], root / entry["model"], pose)


def _occluded(root: Path) -> Iterator[PhotoCase]:
    """Objects of Linemod-Occluded; scene_gt.json: {photo: [{cam_R_m2c, cam_t_m2c, obj_id}]}."""
    camera = json.loads((root / "camera.json").read_text())
    for number, objects in json.loads((root / "scene_gt.json").read_text()).items():
        for each in objects:
            model = root / "models" / f"obj_{each['obj_id']:06d}.ply"
            pose = np.column_stack([np.reshape(each["cam_R_m2c"], (3, 3)), each["cam_t_m2c"]])
            yield _read_case(root / "rgb" / f"{int(number):06d}.png", "lmo", camera, model, pose)


def _read_case(photo: Path, group: str, fields: Row, model: Path, pose: FloatArray) -> PhotoCase:
    camera = Camera(*(fields[name] for name in ("width", "height", "fx", "fy", "cx", "cy")))
    truth = Alignment(nearest_rotation(pose[:3, :3]), pose[:3, 3], np.ones(3))
    return PhotoCase(group, camera, read_photo(photo), load_mesh(model), truth)


# Composites ---------------------------------------------------------------------------------------


def _composites(given: BenchmarkData, count: int) -> Iterator[PhotoCase]:
    """Render models of ShapeNet and of the sample dataset in front of real photos."""
    root = given.folder()
    with tempfile.TemporaryDirectory() as folder:
        sample = KeypointNet(write_sample_dataset(Path(folder) / "sample", per_category=2))
        real = [m for m in KeypointNet(root / "keypointnet") if str(m.mesh_path).endswith(".obj")]
        scenes = [(m, Scene(m.load_mesh())) for m in (*real, *sample)]
    photos = sorted((root / "sfm").rglob("*.jpg")) + sorted((root / "real").rglob("rgb/*.png"))
    size = _CAMERA.width, _CAMERA.height
    behind = [cv2.resize(read_photo(p), size, interpolation=cv2.INTER_AREA) for p in photos]
    for number in range(count):
        rng = np.random.default_rng([given.seed, number])
        model, scene = scenes[number % len(scenes)]
        how: dict[str, Any] = {"min_visible": 0, "fill": (0.4, 0.8), "roll": 15.0}
        view = section.attempt(sample_view, scene, model.keypoints.xyz, _CAMERA, rng=rng, **how)
        if view is None:
            continue
        pixels = behind[rng.integers(len(behind))]
        if rng.random() < 0.5:
            pixels = pixels[:, ::-1]
        light = rng.normal(size=3) * [1, 0.6, 0.3] + [0, -0.6, -0.7]
        studio = Studio(key=tuple(light / np.linalg.norm(light)), key_power=rng.uniform(0.3, 0.8))
        renderer, truth = RaycastRenderer(studio=studio), view.cam_from_model
        frame = renderer.render(scene, _CAMERA, truth, samples=8)
        drawn = frame.composite(np.ascontiguousarray(pixels))
        is_hidden = number % 4 == 3
        if is_hidden:
            drawn = _hide(drawn, frame.mask, behind[rng.integers(len(behind))], rng)
        group = f"composite {'hidden' if is_hidden else 'clear'}"
        drawn = cv2.GaussianBlur(drawn, (0, 0), rng.uniform(0.4, 1.5))
        noisy = drawn + rng.normal(0, rng.uniform(2, 10), drawn.shape)
        photo = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
        yield PhotoCase(group, _CAMERA, photo, scene.mesh, truth, model.symmetry)


def _hide(
    drawn: np.ndarray, mask: np.ndarray, other: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Hide about a fifth of the object behind a disc of another photo."""
    rows, columns = np.nonzero(mask)
    at = rng.integers(len(rows))
    radius = float(np.sqrt(0.3 * len(rows) / np.pi))
    y, x = np.mgrid[: mask.shape[0], : mask.shape[1]]
    covered = np.hypot(x - columns[at], y - rows[at]) < radius
    return np.where(covered[:, :, None], other, drawn)
