"""Photos as evidence beside rough clicks, on composites with exact truth and on real photos."""

from __future__ import annotations

import json
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks import section
from benchmarks.section import BenchmarkData, Row, Tables
from cadalign import Alignment, Camera, Mesh, Model, Result, Symmetry, View, align
from cadalign.arrays import FloatArray
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
_INNER = 0.95  # probability of the regions whose coverage is counted


def photo(given: BenchmarkData) -> Tables:
    """Rough clicks alone, and with the photo.

    Six clicks with an error of 4 px in a photo 640 px wide. Composites are models of ShapeNet and
    of the sample dataset, rendered before real photos with varied light, blur and noise, a quarter
    of them partly hidden; their truth is exact. Real photos are those of HANDAL, LINEMOD and
    Linemod-Occluded, whose stated truth is off by some pixels in places, with several draws of the
    clicks on each.
    """
    draws = given.count or 25
    cases = [(case, 1) for case in _composites(given, 8 * draws)]
    cases += [(case, draws) for case in _real_cases(given, "bop_samples")]
    cases += [(case, max(draws // 5, 1)) for case in _real_cases(given, "lmo_multiview")]
    for stretched in (False, True):
        rows: dict[str, list[Row]] = defaultdict(list)
        for number, (case, count) in enumerate(cases):
            for draw in range(count):
                rng = np.random.default_rng([given.seed, 3, number, draw])
                rows[case.group].append(_compared(case.clicked(rng, stretched=stretched)))
        title = "an unknown stretch" if stretched else "a rigid model"
        table = [{"photos": name, **section.summary(found)} for name, found in rows.items()]
        yield f"photos beside rough clicks, {title}: medians", table


def _compared(clicks: PhotoClicks) -> Row:
    first, _, alone = section.clocked(clicks.aligned)
    second, _, joint = section.clocked(partial(clicks.aligned, image=clicks.case.pixels))
    before, after = clicks.errors(alone), clicks.errors(joint)
    row: Row = {}
    for error, *values in zip(("R", "t", "stretch"), before, after, strict=True):
        row |= dict(zip((f"{error} clicks", f"{error} photo"), values, strict=True))
    row["better"] = after[0] < before[0]
    row["warned"] = any(each.kind == "photo" for each in joint.warnings)
    row["silently worse"] = not row["warned"] and after[0] > before[0] + _WORSE_DEG
    row["covered R"], row["covered t"] = clicks.covered_by(joint)
    return row | {"seconds": second - first}


@dataclass(frozen=True)
class PhotoCase:
    """An object in a photo: its model, the true alignment, and clicks on visible points."""

    group: str
    camera: Camera
    pixels: np.ndarray
    mesh: Mesh
    truth: Alignment
    symmetry: Symmetry = field(default_factory=Symmetry.none)

    def clicked(self, rng: np.random.Generator, *, stretched: bool) -> PhotoClicks:
        """Rough clicks on points spread over the visible surface."""
        scale = np.exp(rng.normal(0, _STRETCH_SIGMA, 3) * [0, 1, 1]) if stretched else np.ones(3)
        truth = replace(self.truth, scale=scale)
        mesh = Mesh(self.mesh.vertices / scale, self.mesh.faces)
        geometry = cast_geometry(Scene(mesh), self.camera, truth)
        places = _spread_places(geometry.mask, rng)
        rays = self.camera.normalize(places.astype(float))
        depths = geometry.depth[places[:, 1], places[:, 0]]
        seen = np.column_stack([rays, np.ones(len(rays))]) * depths[:, None]
        sigma = _CLICK_SHARE * self.camera.width
        model = Model(
            points_3d=(seen - truth.translation) @ truth.rotation / scale,
            mesh=mesh,
            stretch="yz" if stretched else "none",
            stretch_sigma=_STRETCH_SIGMA if stretched else None,
        )
        return PhotoClicks(self, model, truth, places + rng.normal(0, sigma, places.shape), sigma)


@dataclass(frozen=True)
class PhotoClicks:
    """Clicks in a photo, the model that they are on, and the true alignment."""

    case: PhotoCase
    model: Model
    truth: Alignment
    pixels: FloatArray
    sigma: float

    def aligned(self, **evidence: Any) -> Result:
        """The estimate by the clicks, and further evidence of the view."""
        return align(self.model, View(self.case.camera, self.pixels, sigma=self.sigma, **evidence))

    def true_for(self, est: Alignment) -> Alignment:
        """The true alignment, of those that are equal under the symmetry the nearest."""
        return nearest_truth(est=est, gt=self.truth, symmetry=self.case.symmetry)

    def errors(self, result: Result) -> tuple[float, float, float]:
        """Rotation [deg], translation [diagonals], larger stretch error."""
        est, gt = result.alignment, self.true_for(result.alignment)
        diagonal = float(np.linalg.norm(np.ptp(self.case.mesh.vertices, axis=0)))
        shift = float(np.linalg.norm(est.translation - gt.translation)) / diagonal
        stretch = float(np.abs(est.scale / gt.scale - 1).max())
        return rotation_error(est=est, gt=gt), shift, stretch

    def covered_by(self, result: Result) -> list[bool]:
        """True where the truth lies in the regions of rotation and of translation."""
        error = section.deviation(est=result.alignment, gt=self.true_for(result.alignment))
        levels = (
            probability_level(error[rows], result.covariance[rows, rows])
            for rows in (slice(3), slice(3, 6))
        )
        return [level is not None and level < _INNER for level in levels]


def _spread_places(mask: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Pixels (6, 2) inside a mask, each far from those before it."""
    inside = cv2.erode(mask.astype(np.uint8), np.ones((5, 5), np.uint8))
    rows, columns = np.nonzero(inside if inside.sum() > 10 * _CLICKS else mask)
    places = np.column_stack([columns, rows])
    some = places[rng.permutation(len(places))[:400]]
    chosen = [some[0]]
    for _ in range(_CLICKS - 1):
        gaps = np.linalg.norm(some[:, None] - np.array(chosen), axis=2).min(axis=1)
        # Among the farthest: people click on what is marked, not on the extremes alone.
        likely = np.argsort(-gaps)[: max(len(some) // 50, 1)]
        chosen.append(some[rng.choice(likely)])
    return np.array(chosen)


# Real photos --------------------------------------------------------------------------------------


def _real_cases(given: BenchmarkData, folder: str) -> Iterator[PhotoCase]:
    """The objects of real photos: bop_samples (HANDAL, LINEMOD), lmo_multiview (occluded ones)."""
    is_sample = folder == "bop_samples"
    entries = (_posed if is_sample else _lmo)(given.folder("real", folder))
    for photo, fields, model, rotation, shift in entries:
        group = photo.parent.name if is_sample else "lmo"
        camera = Camera(*(fields[name] for name in ("width", "height", "fx", "fy", "cx", "cy")))
        truth = Alignment(nearest_rotation(rotation), shift, np.ones(3))
        yield PhotoCase(group, camera, read_photo(photo), load_mesh(model), truth)


_Posed = tuple[Path, dict[str, Any], Path, np.ndarray, np.ndarray]
"""Photo, camera's fields, model, and its rotation and translation [mm]."""


def _posed(root: Path) -> Iterator[_Posed]:
    """The objects of `poses.json`: {photo: {"model", "cam_from_model", "camera"}}."""
    for name, entry in json.loads((root / "poses.json").read_text()).items():
        pose = np.array(entry["cam_from_model"])
        yield root / name, entry["camera"], root / entry["model"], pose[:3, :3], pose[:3, 3]


def _lmo(root: Path) -> Iterator[_Posed]:
    """The objects of `scene_gt.json`: {photo: [{"cam_R_m2c", "cam_t_m2c", "obj_id"}]}."""
    camera = json.loads((root / "camera.json").read_text())
    for number, objects in json.loads((root / "scene_gt.json").read_text()).items():
        for each in objects:
            model = root / "models" / f"obj_{each['obj_id']:06d}.ply"
            rotation, shift = np.reshape(each["cam_R_m2c"], (3, 3)), np.array(each["cam_t_m2c"])
            yield root / "rgb" / f"{int(number):06d}.png", camera, model, rotation, shift


# Composites ---------------------------------------------------------------------------------------


def _composites(given: BenchmarkData, count: int) -> Iterator[PhotoCase]:
    """Models of ShapeNet and of the sample, rendered before real photos; some partly hidden."""
    root = given.folder()
    with tempfile.TemporaryDirectory() as folder:
        sample, real = section.meshed_models(given, folder, per_category=2)
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
            drawn = _hidden(drawn, frame.mask, behind[rng.integers(len(behind))], rng)
        group = f"composite {'hidden' if is_hidden else 'clear'}"
        photo = _blurred(drawn, rng)
        yield PhotoCase(group, _CAMERA, photo, scene.mesh, truth, model.symmetry)


def _blurred(drawn: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    drawn = cv2.GaussianBlur(drawn, (0, 0), rng.uniform(0.4, 1.5))
    noisy = drawn + rng.normal(0, rng.uniform(2, 10), drawn.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def _hidden(
    drawn: np.ndarray, mask: np.ndarray, other: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Cover about a fifth of the object by a round patch of another photo."""
    rows, columns = np.nonzero(mask)
    at = rng.integers(len(rows))
    radius = float(np.sqrt(0.3 * len(rows) / np.pi))
    y, x = np.mgrid[: mask.shape[0], : mask.shape[1]]
    covered = np.hypot(x - columns[at], y - rows[at]) < radius
    return np.where(covered[:, :, None], other, drawn)
