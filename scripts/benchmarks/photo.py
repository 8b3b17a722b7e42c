"""Photos as evidence beside rough clicks, on composites with exact truth and on real photos."""

from __future__ import annotations

import json
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks import section
from benchmarks.section import BenchmarkData, Row, Tables
from cadalign import Alignment, Camera, Mesh, Model, Result, Symmetry, View, align
from cadalign.annotate.evidence import grab_cut
from cadalign.arrays import FloatArray
from cadalign.datasets import AnnotatedModel
from cadalign.estimation.contours.photo_lines import bins_of, regions_of
from cadalign.evaluation.metrics.cramer_rao import probability_level
from cadalign.geometry.rotations import nearest_rotation
from cadalign.io.images import read_photo
from cadalign.io.meshes.files import load_mesh
from cadalign.metrics import nearest_truth, rotation_error
from cadalign.render import RaycastRenderer, Scene, Studio, cast_geometry, sample_view

_CAMERA = Camera(640, 480, 800.0, 800.0, 319.5, 239.5)
_LARGE = Camera(1632, 1224, 2040.0, 2040.0, 815.5, 611.5)
_CLICKS = 6
_CLICK_SHARE = 4.0 / 640.0  # standard deviation of a click, relative to the photo's width
_STRETCH_SIGMA = 0.3
_WORSE_DEG = 1.0
_AROUND = 12  # [px], of the background that contrast is about
_INNER = 0.95  # probability of the regions whose coverage is counted


def photos(given: BenchmarkData, *, composites: int = 200, draws: int = 10) -> Tables:
    """Rough clicks alone, and with the photo.

    Six clicks with an error of 4 px in a photo 640 px wide. Composites are models of ShapeNet and
    of the sample dataset, rendered before real photos with varied light, blur and noise, a quarter
    of them partly hidden; their truth is exact. They are listed by thirds of their contrast and
    texture as well. Real photos are those of HANDAL, LINEMOD and Linemod-Occluded, whose stated
    truth is off by some pixels in places.

    Parameters
    ----------
    composites : int
        Number of composites.
    draws : int
        Draws of the clicks on every real photo.
    """
    cases = [(case, 1) for case in _composites(given, composites)]
    cases += [(case, draws) for case in real_cases(given, "bop_samples")]
    cases += [(case, max(draws // 5, 1)) for case in real_cases(given, "lmo_multiview")]
    for stretched in (False, True):
        rows: dict[str, list[Row]] = defaultdict(list)
        for clicks in drawn_clicks(cases, given.seed, 3, stretched=stretched):
            case = clicks.case
            rows[f"{case.group} {case.kind}"].append(_compared(clicks) | case.looks)
        made = [row for name, found in rows.items() if "composite" in name for row in found]
        for look in ("contrast", "texture"):
            thirds = np.array_split(sorted(made, key=lambda row: row[look]), 3)
            for name, third in zip(("low", "middle", "high"), thirds, strict=True):
                rows[f"composite, {name} {look}"] = list(third)
        title = "an unknown stretch" if stretched else "a rigid model"
        table = [{"photos": name, **section.summary(found)} for name, found in rows.items()]
        yield f"photos beside rough clicks, {title}: medians", table


def photo_times(given: BenchmarkData, *, composites: int = 12) -> Tables:
    """Time [s of a processor] that a photo takes beyond six rough clicks.

    Parameters
    ----------
    composites : int
        Composites of 2 megapixels.
    """
    rows: dict[str, list[Row]] = defaultdict(list)
    for number, case in enumerate(_composites(given, composites, _LARGE)):
        for stretched in (False, True):
            rng = np.random.default_rng([given.seed, 7, number])
            clicks = case.clicked(rng, stretched=stretched)
            first = section.processor_seconds(clicks.aligned)
            row, second = _compared(clicks), -first
            second += section.processor_seconds(partial(clicks.aligned, image=case.pixels))
            kept = {name: row[name] for name in ("R clicks", "R photo", "seconds")}
            rows["stretched" if stretched else "rigid"].append(kept | {"processor": second})
    table = []
    for name, found in rows.items():
        late = float(np.percentile([row["processor"] for row in found], 90))
        table.append({"model": name, **section.summary(found), "processor, 90 %": late})
    yield "photos of 2 megapixels beside six clicks: medians", table


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
    kind: str = ""
    symmetry: Symmetry = field(default_factory=Symmetry.none)
    looks: Row = field(default_factory=dict)

    def clicked(
        self, rng: np.random.Generator, *, stretched: bool, count: int = _CLICKS
    ) -> PhotoClicks:
        """Rough clicks on points spread over the visible surface."""
        scale = np.exp(rng.normal(0, _STRETCH_SIGMA, 3) * [0, 1, 1]) if stretched else np.ones(3)
        truth = replace(self.truth, scale=scale)
        mesh = Mesh(self.mesh.vertices / scale, self.mesh.faces)
        geometry = cast_geometry(Scene(mesh), self.camera, truth)
        places = _spread_places(geometry.mask, rng, count)
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

    def first(self, count: int) -> PhotoClicks:
        """The first clicks."""
        points = np.asarray(self.model.points_3d)[:count]
        model = replace(self.model, points_3d=points, ids=None)
        return replace(self, model=model, pixels=self.pixels[:count])

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


def drawn_clicks(
    cases: Iterable[tuple[PhotoCase, int]], seed: int, stream: int, **how: Any
) -> Iterator[PhotoClicks]:
    """So many draws of clicks on each of the cases."""
    for number, (case, draws) in enumerate(cases):
        for draw in range(draws):
            rng = np.random.default_rng([seed, stream, number, draw])
            yield case.clicked(rng, **how)


def _spread_places(mask: np.ndarray, rng: np.random.Generator, count: int) -> np.ndarray:
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


def real_cases(given: BenchmarkData, folder: str) -> Iterator[PhotoCase]:
    """The objects of real photos: bop_samples (HANDAL, LINEMOD), lmo_multiview (occluded ones)."""
    is_sample = folder == "bop_samples"
    entries = (_posed if is_sample else _lmo)(given.real(folder))
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


def _scenery(
    given: BenchmarkData, camera: Camera
) -> tuple[list[tuple[AnnotatedModel, Scene]], list[np.ndarray]]:
    """Models of ShapeNet and of the sample, and real photos of a camera's size."""
    root = given.needed().parent
    with tempfile.TemporaryDirectory() as folder:
        sample, real = section.meshed_models(given, folder, per_category=2)
        scenes = [(m, Scene(m.load_mesh())) for m in (*real, *sample)]
    photos = sorted((root / "sfm").rglob("*.jpg")) + sorted((root / "real").rglob("rgb/*.png"))
    size = camera.width, camera.height
    behind = [cv2.resize(read_photo(p), size, interpolation=cv2.INTER_AREA) for p in photos]
    return scenes, behind


def _composites(given: BenchmarkData, count: int, camera: Camera = _CAMERA) -> Iterator[PhotoCase]:
    """Models of ShapeNet and of the sample, rendered before real photos; some partly hidden."""
    scenes, behind = _scenery(given, camera)
    for number in range(count):
        rng = np.random.default_rng([given.seed, number])
        model, scene = scenes[number % len(scenes)]
        how: dict[str, Any] = {"min_visible": 0, "fill": (0.4, 0.8), "roll": 15.0}
        view = section.attempt(sample_view, scene, model.keypoints.xyz, camera, rng=rng, **how)
        if view is None:
            continue
        pixels = behind[rng.integers(len(behind))]
        if rng.random() < 0.5:
            pixels = pixels[:, ::-1]
        light = rng.normal(size=3) * [1, 0.6, 0.3] + [0, -0.6, -0.7]
        studio = Studio(key=tuple(light / np.linalg.norm(light)), key_power=rng.uniform(0.3, 0.8))
        renderer, truth = RaycastRenderer(studio=studio), view.cam_from_model
        frame = renderer.render(scene, camera, truth, samples=8)
        drawn = frame.composite(np.ascontiguousarray(pixels))
        is_hidden = number % 4 == 3
        if is_hidden:
            drawn = _hidden(drawn, frame.mask, behind[rng.integers(len(behind))], rng)
        photo = _blurred(drawn, rng)
        kind, looks = "hidden" if is_hidden else "clear", _looks_of(photo, frame.mask)
        yield PhotoCase("composite", camera, photo, scene.mesh, truth, kind, model.symmetry, looks)


def _looks_of(photo: np.ndarray, mask: np.ndarray) -> Row:
    """Contrast of the object with what is around it [nats], and its texture [grey levels].

    The texture is the root mean square of what a blur by 3 px takes away, noise included.
    """
    around = cv2.dilate(mask.astype(np.uint8), np.ones((2 * _AROUND + 1,) * 2, np.uint8)) > 0
    _, contrast = regions_of(bins_of(photo[mask]), bins_of(photo[around & ~mask]))
    gray = cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY).astype(np.float32)
    inside = cv2.erode(mask.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    details = (gray - cv2.GaussianBlur(gray, (0, 0), 3.0))[inside if inside.any() else mask]
    return {"contrast": contrast, "texture": float(np.sqrt((details**2).mean()))}


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


# Clicks -------------------------------------------------------------------------------------------

_FEWEST = 3
_MARGIN = 0.05  # of a box that is dragged around an object, relative to its larger side

Estimator = Callable[[PhotoClicks], Alignment | None]


def clicks(given: BenchmarkData, *, draws: int = 3, most: int = 12, within: float = 3.0) -> Tables:
    """Clicks needed until the rotation is within a limit and stays there, scripted.

    On the photos of HANDAL and LINEMOD, a rigid model; clicks with an error of 4 px in a photo 640
    px wide are added one by one. By the clicks alone, with the photo, and with the mask that
    GrabCut makes of a box around the object, which is aligned without a click as well. The mean
    takes one more than the most where these are not enough.

    Parameters
    ----------
    draws : int
        Draws of the clicks on every photo.
    most : int
        Most clicks that are tried.
    within : float
        Limit of the rotation's error [degrees].
    """
    methods: dict[str, tuple[Estimator, int]] = {
        "keypoints": (_by_clicks, _FEWEST),
        "with the photo": (_by_photo, _FEWEST),
        "with box and mask": (_by_box, 0),
    }
    needed: dict[str, list[int]] = defaultdict(list)
    cases = ((case, draws) for case in real_cases(given, "bop_samples"))
    for clicks in drawn_clicks(cases, given.seed, 4, stretched=False, count=most):
        for name, (method, least) in methods.items():
            count = _needed(clicks, method, least, most, within)
            needed[f"{clicks.case.group}, {name}"].append(count)
    rows = [
        {
            "photos": name,
            "median": float(np.median(counts)),
            "mean": float(np.mean(counts)),
            "enough": float(np.mean(np.array(counts) <= most)),
            "count": len(counts),
        }
        for name, counts in needed.items()
    ]
    yield f"clicks until the rotation stays within {within:g} deg", rows


def _needed(clicks: PhotoClicks, method: Estimator, least: int, most: int, within: float) -> int:
    enough = most + 1
    for count in (*range(most, _FEWEST - 1, -1), 0):
        est = section.attempt(method, clicks.first(count)) if count >= least else None
        if est is None or rotation_error(est=est, gt=clicks.true_for(est)) >= within:
            break
        enough = count
    return enough


def _by_clicks(clicks: PhotoClicks) -> Alignment:
    return clicks.aligned().alignment


def _by_photo(clicks: PhotoClicks) -> Alignment:
    return clicks.aligned(image=clicks.case.pixels).alignment


def _by_box(clicks: PhotoClicks) -> Alignment | None:
    """By the mask that GrabCut makes of a box around the object, and clicks where there are any."""
    case, truth = clicks.case, _outline(clicks, clicks.truth)
    box = _box_of(truth)
    margin = _MARGIN * np.ptp(box, axis=0).max()
    (left, top), (right, bottom) = np.maximum(box + margin * np.array([[-1], [1]]), 0).astype(int)
    labels = np.full(truth.shape, cv2.GC_BGD, dtype=np.uint8)
    labels[top : bottom + 1, left : right + 1] = cv2.GC_PR_FGD
    mask = grab_cut(case.pixels, labels)
    if not mask.any():
        return None
    if len(clicks.pixels):
        return clicks.aligned(mask=mask).alignment
    return align(Model(mesh=case.mesh, stretch="none"), View(case.camera, mask=mask)).alignment


def _outline(clicks: PhotoClicks, pose: Alignment) -> np.ndarray:
    return cast_geometry(Scene(clicks.case.mesh), clicks.case.camera, pose).mask


def _box_of(mask: np.ndarray) -> np.ndarray:
    """Left and top, right and bottom (2, 2)."""
    rows, columns = np.nonzero(mask)
    return np.array([[columns.min(), rows.min()], [columns.max(), rows.max()]])
