"""Problems that combine model, evidence, unknowns, noise and outliers, of a box with keypoints."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import trimesh

from cadalign import (
    Alignment,
    Camera,
    FocalPrior,
    Mesh,
    Model,
    RansacOptions,
    ShapeModel,
    Size,
    Symmetry,
    View,
    align,
)
from cadalign.estimation.result import Result
from cadalign.render import Scene, cast_geometry
from cadalign.shapes.parts import ShapeComponent, TrainingShapes

MODELS = ("exact", "held", "symmetric", "similar", "learned", "mixture")
EVIDENCE = (
    *("keypoints", "mask", "depth", "depth image", "camera height", "size"),
    *("rig, mask", "motion, mask", "everything"),
)
FOCALS = ("known", "estimate", "prior")
NOISES = ("number", "each", "covariance", "none")
OUTLIERS = ("linear", "huber", "cauchy", "scores", "unrefined", "six")

FOCAL = 500.0
CAMERA = Camera(480, 360, FOCAL, FOCAL, 239.5, 179.5)
UNKNOWN = Camera.from_size(480, 360)
HALF = np.array([0.5, 0.35, 0.25])
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * HALF
_ON_FACES = [
    *([-1.0, 0.3, 0.4], [-1.0, -0.5, -0.2], [-1.0, 0.6, -0.6], [0.2, 1.0, 0.5]),
    *([-0.6, 1.0, -0.3], [0.6, 1.0, 0.0], [0.3, 0.4, 1.0], [-0.4, -0.5, 1.0]),
]
POINTS = np.concatenate([CORNERS, _ON_FACES * HALF])
SHOWN = [row for row in range(16) if row != 4]  # one corner is behind the box
LOOK = np.array([[0.8, 0.0, 0.6], [-0.36, -0.8, 0.48], [0.48, -0.6, -0.64]])
TRANSLATION = np.array([0.05, -0.03, 2.4])
_BACKGROUND = 6.0
_DEPTH_SIGMA = 0.005
_SHAPE_SIGMA = 0.01
_RESIDUAL = 0.004
# Of 15 keypoints 13 are right: six of these are not among 50 samples once in 10^9 cells. The usual
# number allows for as many outliers as inliers.
_SAMPLES = 50


class Cell(NamedTuple):
    """One combination, by its names in `MODELS`, `EVIDENCE`, `FOCALS`, `NOISES`, `OUTLIERS`."""

    model: str
    evidence: str
    focal: str
    noise: str
    outliers: str

    def __str__(self) -> str:
        return "; ".join(self)


class Problem(NamedTuple):
    """What `align` is given, and the truth in every view."""

    model: Model | ShapeModel
    views: list[View]
    options: dict[str, Any]
    truths: list[Alignment]
    symmetry: Symmetry | None

    def align(self) -> Result:
        return align(self.model, self.views, **self.options)


def all_pairs() -> list[Cell]:
    """Cells that hold every pair of values; each takes those of which most pairs are missing."""
    factors = (MODELS, EVIDENCE, FOCALS, NOISES, OUTLIERS)
    missing = {
        ((i, a), (j, b))
        for i, j in combinations(range(len(factors)), 2)
        for a in factors[i]
        for b in factors[j]
    }
    cells = []
    while missing:
        row = dict(min(missing))
        for k, values in enumerate(factors):
            if k not in row:
                rows = [row | {k: value} for value in values]
                row = max(rows, key=lambda each: len(missing & _pairs(each)))
        missing -= _pairs(row)
        cells.append(Cell(*(row[k] for k in range(len(factors)))))
    return cells


def _pairs(row: dict[int, str]) -> set[Any]:
    return set(combinations(sorted(row.items()), 2))


@cache
def box_mesh() -> Mesh:
    box = trimesh.creation.box(2 * HALF)
    return Mesh(np.asarray(box.vertices), np.asarray(box.faces))


@cache
def object_of(model: str) -> tuple[np.ndarray, np.ndarray]:
    """Scale of the box of an object that the model is of, and its displaced keypoints (16, 3)."""
    rng = np.random.default_rng(5)
    scale = {
        "exact": (1.0, 1.15, 0.9),
        "symmetric": (1.0, 1.15, 0.9),
        "held": (1.0, 1.0, 1.0),
        "similar": (1.0, 1.05, 0.95),
    }.get(model, (1.0, 1.1, 0.92))
    sigma = {"similar": _SHAPE_SIGMA, "learned": _RESIDUAL, "mixture": _RESIDUAL}.get(model, 0.0)
    return np.array(scale), POINTS + sigma * rng.normal(size=POINTS.shape)


def model_of(name: str, folder: Path | None) -> Model | ShapeModel:
    """The model with that name; a learned one has a mesh if a folder is given to write it to."""
    if name in ("learned", "mixture"):
        return _learned(name, folder)
    return Model(
        points_3d=POINTS,
        mesh=box_mesh(),
        stretch="none" if name == "held" else None,
        shape_sigma=_SHAPE_SIGMA if name == "similar" else None,
        symmetry=Symmetry.around((0, 1, 0), fold=2) if name == "symmetric" else None,
    )


def _learned(name: str, folder: Path | None) -> ShapeModel:
    stretches = [POINTS * np.eye(3)[axis] for axis in range(3)]
    model = ShapeModel.from_basis(
        POINTS, stretches, [0.02, 0.1, 0.1], residual_sigma=_RESIDUAL, up_axis="y"
    )
    if folder is not None:
        path = folder / "box.obj"
        if not path.exists():
            trimesh.creation.box(2 * HALF).export(path)
        training = TrainingShapes(("box",), POINTS[None].astype(np.float32), (path,))
        model = replace(model, training=training)
    if name == "learned":
        return model
    (box,) = model.components
    mean = np.array(box.mean)
    mean[:-2, [0, 2]] *= 1 - 0.5 * (mean[:-2, 1:2] > 0)  # a roof
    half = replace(box, weight=0.5)
    roof = ShapeComponent(0.5, mean, box.modes, box.residual_sigma)
    return replace(model, components=(half, roof))


def of_box(rows: Sequence[int] = SHOWN, *, is_known: bool = True, **fields: Any) -> View:
    """A view of the box as it is, without noise."""
    truth = Alignment(LOOK, TRANSLATION, np.ones(3))
    pixels = CAMERA.project(truth.apply(POINTS[rows]))
    return View(CAMERA if is_known else UNKNOWN, pixels, ids=rows, **fields)


def box_mask() -> np.ndarray:
    """The mask of that view."""
    return _images((1.0, 1.0, 1.0))[0]


def wide_view(translation: npt.ArrayLike) -> View:
    """A view of the box at some place through a fisheye lens."""
    camera = Camera(480, 360, 75.0, 75.0, 239.5, 179.5, lens="fisheye")
    seen = Alignment(LOOK, translation, np.ones(3)).apply(POINTS[SHOWN])
    return View(camera, camera.project(seen), ids=SHOWN)


@cache
def _around(angle_deg: float) -> np.ndarray:
    """The pose (4, 4) of a camera that went around the object, in the frame of the first."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    pose = np.eye(4)
    pose[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    pose[:3, 3] = TRANSLATION - pose[:3, :3] @ TRANSLATION
    return pose


@cache
def _images(scale: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """The mask of the box in the first view, and a depth image with noise."""
    truth = Alignment(LOOK, TRANSLATION, np.array(scale))
    seen = cast_geometry(Scene(box_mesh()), CAMERA, truth)
    depth = np.where(seen.mask, seen.depth, _BACKGROUND)
    noise = np.random.default_rng(6).normal(0, _DEPTH_SIGMA, depth.shape)
    return seen.mask, depth * (1 + noise)


def problem_of(cell: Cell, folder: Path) -> Problem:
    """The synthetic problem of a cell, always the same; ``folder`` is for a mesh."""
    rng = np.random.default_rng(zlib.crc32(str(cell).encode()))
    scale, points = object_of(cell.model)
    truth = Alignment(LOOK, TRANSLATION, scale)
    motions = [np.eye(4)]
    if cell.evidence.startswith(("rig", "motion", "everything")):
        motions.append(_around(25.0))
    truths, views = [], []
    for number, motion in enumerate(motions):
        pose = Alignment(motion[:3, :3] @ LOOK, motion[:3, :3] @ TRANSLATION + motion[:3, 3], scale)
        truths.append(pose)
        fields = _keypoints(cell, rng, CAMERA.project(pose.apply(points[SHOWN])))
        if cell.evidence.startswith(("rig", "everything")):
            fields["cam_from_rig"] = motion
        if number == 0:
            fields |= _evidence(cell, rng, truth, points[SHOWN])
        views.append(View(CAMERA if cell.focal == "known" else UNKNOWN, ids=SHOWN, **fields))
    options: dict[str, Any] = _robust(cell)
    if cell.focal != "known":
        options["focal"] = "estimate"
    if cell.focal == "prior":
        options["focal_prior"] = FocalPrior(FOCAL * 1.03, 0.05)
    if cell.evidence in ("size", "everything"):
        options["size"] = Size(height=float(2 * HALF[1] * scale[1]), sigma=0.01)
    model = model_of(cell.model, folder)
    return Problem(model, views, options, truths, getattr(model, "symmetry", None))


def _keypoints(cell: Cell, rng: np.random.Generator, exact: np.ndarray) -> dict[str, Any]:
    """Keypoints with noise and outliers, and what is told of both."""
    count = len(exact)
    standard = rng.normal(size=exact.shape)
    fields: dict[str, Any] = {"sigma": 1.0}
    noise = standard
    if cell.noise == "each":
        fields["sigma"] = rng.uniform(0.6, 1.4, count)
        noise = standard * fields["sigma"][:, None]
    elif cell.noise == "covariance":
        roots = np.array([np.diag(each) for each in rng.uniform(0.6, 1.4, (count, 2))])
        roots[:, 0, 1] = 0.3
        fields["sigma"] = roots @ roots.transpose(0, 2, 1)
        noise = (roots @ standard[:, :, None])[:, :, 0]
    elif cell.noise == "none":
        fields["sigma"] = None
    wrong = []
    if cell.outliers != "linear":
        wrong = [3] if cell.outliers == "huber" else [3, 9]
        noise[wrong] += 6.0 if cell.outliers == "huber" else [30.0, -25.0]
    if cell.outliers == "scores":
        fields["scores"] = np.where(np.isin(np.arange(count), wrong), 0.2, 0.9)
    return {"points_2d": exact + noise, **fields}


def _evidence(
    cell: Cell, rng: np.random.Generator, truth: Alignment, points: np.ndarray
) -> dict[str, Any]:
    """What the first view tells beside its keypoints."""
    kind, fields = cell.evidence, {}
    mask, depth = _images(tuple(truth.scale.tolist()))
    if kind in ("mask", "rig, mask", "motion, mask", "everything"):
        fields["mask"] = mask
    if kind in ("depth image", "everything"):
        fields |= {"depth": depth, "depth_sigma": _DEPTH_SIGMA}
    elif kind == "depth":
        noise = 1 + _DEPTH_SIGMA * rng.normal(size=len(points))
        fields |= {"depth": truth.apply(points)[:, 2] * noise, "depth_sigma": _DEPTH_SIGMA}
    if kind in ("camera height", "everything"):
        fields["up"] = truth.rotation[:, 1] + 0.01 * rng.normal(size=3)
        origin = -truth.rotation.T @ truth.translation
        height = float(origin[1] + HALF[1] * truth.scale[1])
        fields |= {"camera_height": height * (1 + 0.01 * rng.normal()), "camera_height_sigma": 0.01}
    return fields


def _robust(cell: Cell) -> dict[str, Any]:
    if cell.outliers in ("linear", "huber", "cauchy"):
        return {"loss": cell.outliers}
    refine, minimal = cell.outliers != "unrefined", "aepnp" if cell.outliers == "six" else "ap4p"
    count = {"min_iterations": _SAMPLES, "max_iterations": _SAMPLES}
    return {"ransac": RansacOptions(refine=refine, minimal=minimal, **count)}


def has_covariance(cell: Cell) -> bool:
    """False for the unrefined hypothesis of a minimal solver, which is no optimum."""
    is_plain = cell.evidence == "keypoints" and cell.model in ("exact", "held", "symmetric")
    return not (is_plain and cell.focal == "known" and cell.outliers == "unrefined")
