"""Photos as evidence beside rough clicks, on composites with exact truth and on real photos."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.section import BenchmarkData, NotGivenError, RatioTable, Row, clocked
from cadalign import Camera, Mesh, Model, Result, View, align
from cadalign.datasets import KeypointNet, load_mesh, write_sample_dataset
from cadalign.errors import RenderError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.metrics import nearest_truth
from cadalign.geometry.rotations import vector_from_rotation
from cadalign.geometry.symmetry import Symmetry
from cadalign.io.images import read_photo
from cadalign.metrics import rotation_error
from cadalign.render import RaycastRenderer, Scene, Studio, cast_geometry, sample_view

_CAMERA = Camera(640, 480, 800.0, 800.0, 319.5, 239.5)
_CLICKS = 6
_CLICK_SHARE = 4.0 / 640.0  # standard deviation of a click, relative to the photo's width
_STRETCH_SIGMA = 0.3
_WORSE_DEG = 1.0
_INNER = 0.95  # probability of the regions whose coverage is counted


@dataclass
class Photos:
    """Rough clicks alone, and with the photo.

    Six clicks with an error of 4 px in a photo 640 px wide. Composites are models of ShapeNet and
    of the sample dataset, rendered before real photos with varied light, blur and noise, a quarter
    of them partly hidden; their truth is exact. Real photos are those of HANDAL, LINEMOD and
    Linemod-Occluded, whose stated truth is off by some pixels in places.
    """

    composites: int = 200
    """Number of composites."""
    draws: int = 10
    """Draws of the clicks on every real photo."""

    def run(self, given: BenchmarkData) -> Iterator[RatioTable]:
        """Measure with the stretch held, and with an unknown one."""
        if given.keypointnet is None:
            raise NotGivenError("give --keypointnet, or CADALIGN_DATA")
        root = given.keypointnet.parent
        cases = [(case, 1) for case in composite_cases(root, self.composites, given.seed)]
        cases += [(case, self.draws) for case in bop_cases(root)]
        cases += [(case, max(self.draws // 5, 1)) for case in occluded_cases(root)]
        for stretched in (False, True):
            rows: dict[str, list[PhotoOutcome]] = {}
            for number, (case, draws) in enumerate(cases):
                for draw in range(draws):
                    rng = np.random.default_rng([given.seed, 3, number, draw])
                    clicks = case.clicked(rng, stretched=stretched)
                    rows.setdefault(f"{case.group} {case.kind}", []).append(clicks.outcome())
            title = "an unknown stretch" if stretched else "a rigid model"
            table = [_summary(name, outcomes) for name, outcomes in rows.items()]
            yield RatioTable(f"photos beside rough clicks, {title}: medians", table)


@dataclass(frozen=True)
class PhotoOutcome:
    """Errors of clicks alone and with the photo, and what was said about the latter."""

    alone: tuple[float, float, float]
    joint: tuple[float, float, float]
    is_warned: bool
    covered: tuple[bool, bool]
    seconds: float


def _summary(name: str, outcomes: Sequence[PhotoOutcome]) -> Row:
    alone, joint = (
        np.array([getattr(each, field) for each in outcomes]) for field in ("alone", "joint")
    )
    warned = np.array([each.is_warned for each in outcomes])
    worse = ~warned & (joint[:, 0] > alone[:, 0] + _WORSE_DEG)
    row: Row = {"photos": name, "count": len(outcomes)}
    for number, error in enumerate(("R", "t", "stretch")):
        row |= {f"{error} clicks": float(np.median(alone[:, number]))}
        row |= {f"{error} photo": float(np.median(joint[:, number]))}
    row["better"] = float((joint[:, 0] < alone[:, 0]).mean())
    row["silently worse"] = float(worse.mean())
    row["warned"] = float(warned.mean())
    covered = np.array([each.covered for each in outcomes]).mean(axis=0)
    row |= {"covered R": float(covered[0]), "covered t": float(covered[1])}
    return row | {"seconds": float(np.median([each.seconds for each in outcomes]))}


@dataclass(frozen=True)
class PhotoCase:
    """An object in a photo: its model, the true alignment, and clicks on visible points."""

    group: str
    name: str
    camera: Camera
    pixels: np.ndarray
    mesh: Mesh
    truth: Alignment
    kind: str = ""
    symmetry: Symmetry | None = None

    def clicked(
        self, rng: np.random.Generator, *, stretched: bool, count: int = _CLICKS
    ) -> PhotoClicks:
        """Rough clicks on points spread over the visible surface."""
        scale = np.exp(rng.normal(0, _STRETCH_SIGMA, 3) * [0, 1, 1]) if stretched else np.ones(3)
        truth = Alignment(self.truth.rotation, self.truth.translation, scale)
        mesh = Mesh(self.mesh.vertices / scale, self.mesh.faces)
        scene = Scene(mesh)
        geometry = cast_geometry(scene, self.camera, truth)
        places = _spread(geometry.mask, rng, count)
        rays = self.camera.normalize(places.astype(float))
        depths = geometry.depth[places[:, 1], places[:, 0]]
        seen = np.column_stack([rays, np.ones(len(rays))]) * depths[:, None]
        points = (seen - truth.translation) @ truth.rotation / scale
        sigma = _CLICK_SHARE * self.camera.width
        pixels = places + rng.normal(0, sigma, places.shape)
        model = Model(
            points_3d=points,
            mesh=mesh,
            stretch="yz" if stretched else "none",
            stretch_sigma=_STRETCH_SIGMA if stretched else None,
        )
        return PhotoClicks(self, model, truth, pixels, sigma)


@dataclass(frozen=True)
class PhotoClicks:
    """Clicks in a photo, the model that they are on, and the true alignment."""

    case: PhotoCase
    model: Model
    truth: Alignment
    pixels: np.ndarray
    sigma: float

    def aligned(self, *, with_photo: bool) -> Result:
        """The estimate by the clicks alone, or with the photo."""
        return self.aligned_with(image=self.case.pixels if with_photo else None)

    def aligned_with(self, **evidence: Any) -> Result:
        """The estimate by the clicks, and further evidence of the view."""
        return align(self.model, View(self.case.camera, self.pixels, sigma=self.sigma, **evidence))

    def first(self, count: int) -> PhotoClicks:
        """The first clicks."""
        assert self.model.points_3d is not None
        model = replace(self.model, points_3d=np.asarray(self.model.points_3d)[:count])
        return replace(self, model=model, pixels=self.pixels[:count])

    def outcome(self) -> PhotoOutcome:
        """Both estimates compared with the truth."""
        first, _, alone = clocked(partial(self.aligned, with_photo=False))
        second, _, joint = clocked(partial(self.aligned, with_photo=True))
        return PhotoOutcome(
            self.errors(alone),
            self.errors(joint),
            any("image" in text for text in joint.warnings),
            self.covered_by(joint),
            second - first,
        )

    def true_for(self, est: Alignment) -> Alignment:
        """The true alignment, of those that are equal under the symmetry the nearest."""
        if self.case.symmetry is None:
            return self.truth
        return nearest_truth(est=est, gt=self.truth, symmetry=self.case.symmetry)

    def errors(self, result: Result) -> tuple[float, float, float]:
        """Rotation [deg], translation [diagonals], larger stretch error."""
        est, gt = result.alignment, self.true_for(result.alignment)
        diagonal = float(np.linalg.norm(np.ptp(self.case.mesh.vertices, axis=0)))
        shift = float(np.linalg.norm(est.translation - gt.translation)) / diagonal
        stretch = float(np.abs(est.scale / gt.scale - 1).max())
        return rotation_error(est=est, gt=gt), shift, stretch

    def covered_by(self, result: Result) -> tuple[bool, bool]:
        """True where the truth lies in the regions of rotation and of translation."""
        from scipy.stats import chi2

        est, gt = result.alignment, self.true_for(result.alignment)
        turn = vector_from_rotation(gt.rotation @ est.rotation.T)
        shift = gt.translation - est.translation
        limit = chi2.ppf(_INNER, 3)
        blocks = result.covariance[:3, :3], result.covariance[3:6, 3:6]
        first, second = (
            bool(step @ np.linalg.solve(block, step) < limit)
            for step, block in zip((turn, shift), blocks, strict=True)
        )
        return first, second


def _spread(mask: np.ndarray, rng: np.random.Generator, count: int) -> np.ndarray:
    """Pixels (count, 2) inside a mask, each far from those before it."""
    inside = cv2.erode(mask.astype(np.uint8), np.ones((5, 5), np.uint8))
    rows, columns = np.nonzero(inside if inside.sum() > 10 * count else mask)
    places = np.column_stack([columns, rows])
    some = places[rng.permutation(len(places))[:400]]
    chosen = [some[0]]
    for _ in range(count - 1):
        gaps = np.linalg.norm(some[:, None] - np.array(chosen), axis=2).min(axis=1)
        # Among the farthest: people click on what is marked, not on the extremes alone.
        likely = np.argsort(-gaps)[: max(len(some) // 50, 1)]
        chosen.append(some[rng.choice(likely)])
    return np.array(chosen)


# Real photos --------------------------------------------------------------------------------------


@cache
def _mesh(path: Path) -> Mesh:
    return load_mesh(path)


def bop_cases(root: Path) -> Iterator[PhotoCase]:
    """The photos of HANDAL and LINEMOD."""
    folder = root / "real" / "bop_samples"
    for name, entry in json.loads((folder / "poses.json").read_text()).items():
        pose = np.array(entry["cam_from_model"])
        given = {key: entry["camera"][key] for key in ("width", "height", "fx", "fy", "cx", "cy")}
        yield PhotoCase(
            name.split("/")[0],
            name,
            Camera(**given),
            read_photo(folder / name),
            _mesh(folder / entry["model"]),
            _rigid(pose[:3, :3], pose[:3, 3]),
        )


def occluded_cases(root: Path) -> Iterator[PhotoCase]:
    """The objects of Linemod-Occluded, some of which hide others."""
    folder = root / "real" / "lmo_multiview"
    given = json.loads((folder / "camera.json").read_text())
    given.pop("depth_scale")
    camera = Camera(**given)
    for number, entries in json.loads((folder / "scene_gt.json").read_text()).items():
        pixels = read_photo(folder / "rgb" / f"{int(number):06d}.png")
        for entry in entries:
            path = folder / "models" / f"obj_{entry['obj_id']:06d}.ply"
            if not path.exists():
                continue
            rotation = np.array(entry["cam_R_m2c"]).reshape(3, 3)
            truth = _rigid(rotation, np.array(entry["cam_t_m2c"]))
            name = f"{number}/{entry['obj_id']}"
            yield PhotoCase("lmo", name, camera, pixels, _mesh(path), truth)


def _rigid(rotation: np.ndarray, translation: np.ndarray) -> Alignment:
    left, _, right = np.linalg.svd(rotation)
    return Alignment(left @ right, translation, np.ones(3))


# Composites ---------------------------------------------------------------------------------------


def composite_cases(root: Path, count: int, seed: int) -> Iterator[PhotoCase]:
    """Models of ShapeNet and of the sample, rendered before real photos; some partly hidden."""
    with tempfile.TemporaryDirectory() as folder:
        sample = list(KeypointNet(write_sample_dataset(Path(folder) / "sample", per_category=2)))
        real = [m for m in KeypointNet(root / "keypointnet") if m.mesh_path is not None]
        models = [m for m in real if m.mesh_path.suffix == ".obj"] + sample
        scenes = [(m, Scene(m.load_mesh())) for m in models]
    photos = sorted((root / "sfm").rglob("*.jpg")) + sorted((root / "real").rglob("rgb/*.png"))
    behind = [cv2.resize(read_photo(p), (640, 480), interpolation=cv2.INTER_AREA) for p in photos]
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        model, scene = scenes[number % len(scenes)]
        try:
            view = sample_view(
                scene,
                model.keypoints.xyz,
                _CAMERA,
                rng=rng,
                min_visible=0,
                fill=(0.4, 0.8),
                roll=15.0,
            )
        except RenderError:
            continue
        truth = view.cam_from_model
        pixels = behind[rng.integers(len(behind))]
        if rng.random() < 0.5:
            pixels = pixels[:, ::-1]
        light = rng.normal(size=3) * [1, 0.6, 0.3] + [0, -0.6, -0.7]
        studio = Studio(key=tuple(light / np.linalg.norm(light)), key_power=rng.uniform(0.3, 0.8))
        frame = RaycastRenderer(studio=studio).render(scene, _CAMERA, truth, samples=8)
        drawn = frame.composite(np.ascontiguousarray(pixels))
        is_hidden = number % 4 == 3
        if is_hidden:
            drawn = _hidden(drawn, frame.mask, behind[rng.integers(len(behind))], rng)
        drawn = cv2.GaussianBlur(drawn, (0, 0), rng.uniform(0.4, 1.5))
        noisy = drawn + rng.normal(0, rng.uniform(2, 10), drawn.shape)
        yield PhotoCase(
            "composite",
            f"{number} {model.category}",
            _CAMERA,
            np.clip(np.rint(noisy), 0, 255).astype(np.uint8),
            scene.mesh,
            truth,
            "hidden" if is_hidden else "clear",
            model.symmetry,
        )


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
