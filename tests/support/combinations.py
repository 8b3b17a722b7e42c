"""Every combination of model, evidence, unknowns, noise and outliers that `align` takes."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import combinations, product
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

MODELS = {
    "exact": "exact",
    "held": "exact, stretch held",
    "symmetric": "exact, symmetric",
    "similar": "similar (`shape_sigma`)",
    "learned": "learned",
    "mixture": "learned mixture",
}
EVIDENCE = {
    "keypoints": "keypoints alone",
    "mask": "mask",
    "depth": "depth at the keypoints",
    "depth image": "depth image",
    "gravity": "gravity (`up`)",
    "camera height": "gravity and camera height",
    "size": "known length (`Size`)",
    "rig": "two views, camera motion known",
    "rig, mask": "two views, camera motion known, one mask",
    "motion": "two views, camera motion unknown",
    "motion, mask": "two views, camera motion unknown, one mask",
    "weak view": "two views and one of two keypoints, camera motion unknown",
    "everything": "all of these in two views, camera motion known",
}
FOCALS = {
    "known": "known",
    "estimate": "estimated",
    "prior": "estimated with a prior",
}
NOISES = {
    "number": "`sigma` one number",
    "each": "`sigma` one per keypoint",
    "covariance": "`sigma` a covariance per keypoint",
    "none": "`sigma=None`",
}
OUTLIERS = {
    "linear": 'none, `loss="linear"`',
    "huber": '`loss="huber"`',
    "cauchy": '`loss="cauchy"`',
    "ransac": "`ransac=RansacOptions()`",
    "scores": "`ransac` and `scores`",
    "unrefined": "`RansacOptions(refine=False)`",
    "six": '`RansacOptions(minimal="aepnp")`',
}

FOCAL = 500.0
CAMERA = Camera(480, 360, FOCAL, FOCAL, 239.5, 179.5)
HALF = np.array([0.5, 0.35, 0.25])
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * HALF
_ON_FACES = np.array(
    [
        [-1.0, 0.3, 0.4],
        [-1.0, -0.5, -0.2],
        [-1.0, 0.6, -0.6],
        [0.2, 1.0, 0.5],
        [-0.6, 1.0, -0.3],
        [0.6, 1.0, 0.0],
        [0.3, 0.4, 1.0],
        [-0.4, -0.5, 1.0],
    ]
)
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


FACTORS: tuple[Mapping[str, str], ...] = (MODELS, EVIDENCE, FOCALS, NOISES, OUTLIERS)


class Problem(NamedTuple):
    """What `align` is given, and the truth in every view."""

    model: Model | ShapeModel
    views: list[View]
    options: dict[str, Any]
    truths: list[Alignment]
    symmetry: Symmetry | None

    def align(self) -> Result:
        return align(self.model, self.views, **self.options)


def covering(strength: int, factors: Sequence[Iterable[str]] = FACTORS) -> list[Cell]:
    """Cells that hold every combination of so many factors' values, chosen greedily."""
    values = [list(each) for each in factors]
    columns = list(combinations(range(len(values)), strength))
    missing = {
        (chosen, held) for chosen in columns for held in product(*(values[k] for k in chosen))
    }
    rng = np.random.default_rng(strength)
    cells: list[Cell] = []
    while missing:
        seeds = sorted(missing)
        best: tuple[int, list[str]] = (-1, [])
        for chosen, held in (seeds[k] for k in rng.integers(len(seeds), size=12)):
            row = [str(rng.choice(each)) for each in values]
            for column, value in zip(chosen, held, strict=True):
                row[column] = value
            for column in [k for k in range(len(row)) if k not in chosen]:
                gains = []
                for value in values[column]:
                    row[column] = value
                    gains.append(_gain(row, columns, missing))
                row[column] = values[column][int(np.argmax(gains))]
            best = max(best, (_gain(row, columns, missing), row))
        row = best[1]
        cells.append(Cell(*row))
        missing -= {(chosen, tuple(row[k] for k in chosen)) for chosen in columns}
    return cells


def _gain(row: list[str], columns: list[tuple[int, ...]], missing: set[Any]) -> int:
    return sum((chosen, tuple(row[k] for k in chosen)) in missing for chosen in columns)


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
    motions, shown = [np.eye(4)], [SHOWN]
    if cell.evidence.startswith(("rig", "motion", "weak", "everything")):
        motions, shown = [np.eye(4), _around(25.0)], [SHOWN, SHOWN]
    if cell.evidence == "weak view":
        motions, shown = [*motions, _around(-20.0)], [*shown, [1, 6]]
    truths, views = [], []
    for number, (motion, rows) in enumerate(zip(motions, shown, strict=True)):
        pose = Alignment(motion[:3, :3] @ LOOK, motion[:3, :3] @ TRANSLATION + motion[:3, 3], scale)
        truths.append(pose)
        fields = _keypoints(cell, rng, CAMERA.project(pose.apply(points[rows])))
        if cell.evidence.startswith(("rig", "everything")):
            fields["cam_from_rig"] = motion
        if number == 0:
            fields |= _evidence(cell, rng, truth, points[rows])
        camera = CAMERA if cell.focal == "known" else Camera.without_focal(480, 360)
        views.append(View(camera, ids=rows, **fields))
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
    if cell.outliers != "linear" and count > 4:
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
    if kind in ("gravity", "camera height", "everything"):
        fields["up"] = truth.rotation[:, 1] + 0.01 * rng.normal(size=3)
    if kind in ("camera height", "everything"):
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


class Request(NamedTuple):
    """A request beside the cells that cannot be met: what is asked, why not, and the message."""

    asked: str
    reason: str
    message: str
    act: Callable[[], object]


def has_covariance(cell: Cell) -> bool:
    """False for the unrefined hypothesis of a minimal solver, which is no optimum."""
    is_plain = cell.evidence == "keypoints" and cell.model in ("exact", "held", "symmetric")
    return not (is_plain and cell.focal == "known" and cell.outliers == "unrefined")


def _seen(rows: Sequence[int] = SHOWN, *, is_known: bool = True, **fields: Any) -> View:
    truth = Alignment(LOOK, TRANSLATION, np.ones(3))
    camera = CAMERA if is_known else Camera.without_focal(480, 360)
    return View(camera, CAMERA.project(truth.apply(POINTS[rows])), ids=rows, **fields)


def _wide(translation: npt.ArrayLike = TRANSLATION, **fields: Any) -> View:
    camera = Camera(480, 360, 75.0, 75.0, 239.5, 179.5, lens="fisheye")
    seen = Alignment(LOOK, translation, np.ones(3)).apply(POINTS[SHOWN])
    return View(camera, camera.project(seen), ids=SHOWN, **fields)


def requests() -> list[Request]:
    """Everything that is refused, with its reason."""
    exact, learned = model_of("exact", None), model_of("learned", None)
    similar = model_of("similar", None)
    mask, _ = _images((1.0, 1.0, 1.0))
    held_first = [_seen(cam_from_rig=np.eye(4)), _seen()]
    return [
        Request(
            "a mask, `Model` without a mesh",
            "keypoints have no outline",
            "views[0].mask: the model has no mesh, which a mask needs; "
            "give it: Model(..., mesh=cadalign.load_mesh(path))",
            lambda: align(Model(points_3d=POINTS), _seen(mask=mask)),
        ),
        Request(
            "a mask, `ShapeModel` without the mesh of any training model",
            "keypoints have no outline",
            "views[0].mask: no training model has a mesh, which a mask needs; "
            "learn it from a data set with meshes, such as KeypointNet beside ShapeNet's models",
            lambda: align(learned, _seen(mask=mask)),
        ),
        Request(
            "a mask without keypoints and `init`, `Model` with `shape_sigma` or `ShapeModel`",
            "other shapes in other poses have outlines alike",
            "views: no pose with the keypoints in front of the camera follows from the evidence; "
            "give at least 3 keypoints in one view, or `init`, and check which is which",
            lambda: align(similar, View(CAMERA, mask=mask)),
        ),
        Request(
            "gravity or camera height, `ShapeModel` without `up_axis`",
            "the model does not say which of its directions is up",
            "views[0].up: the model has no up axis; learn it with an up axis, or leave `up` away",
            lambda: align(replace(learned, up_axis=None), _seen(up=[0, -1, 0])),
        ),
        Request(
            "two keypoints or fewer in one view, no `init`",
            "6 unknowns of the pose, 4 equations",
            "views: no pose with the keypoints in front of the camera follows from the evidence; "
            "give at least 3 keypoints in one view, or `init`, and check which is which",
            lambda: align(learned, _seen([0, 1])),
        ),
        Request(
            "three keypoints of an exact model whose stretch is estimated",
            "8 unknowns, 6 equations",
            "points_3d: 3 keypoints are too few for 8 unknowns; "
            "give at least 4, fewer unknowns by stretch=, or a prior",
            lambda: align(exact, _seen([0, 1, 7])),
        ),
        Request(
            "four keypoints of it, unknown focal length, `focal_prior=None`",
            "9 unknowns, 8 equations",
            "points_3d: 4 keypoints are too few for 9 unknowns; "
            "give at least 5, fewer unknowns by stretch=, or a prior",
            lambda: align(
                exact, _seen([0, 1, 7, 10], is_known=False), focal="estimate", focal_prior=None
            ),
        ),
        Request(
            "keypoints of it in one plane",
            "the stretch across the plane changes nothing in the image",
            "points_3d: the scale s_z is not determined: the points lie in the plane x = -0.5; add "
            "keypoints elsewhere, hold scales fixed with stretch=, or give stretch_sigma",
            lambda: align(exact, _seen([0, 1, 2, 3])),
        ),
        Request(
            "keypoints of it in one plane, `ransac`",
            "the samples' stretch is not determined",
            "points_3d: the points lie in the plane x = -0.5: the samples of ransac determine "
            "nothing; leave ransac away: use loss='cauchy', with stretch= or stretch_sigma=",
            lambda: align(exact, _seen([0, 1, 2, 3]), ransac=RansacOptions()),
        ),
        Request(
            "`sigma=None`, as many equations as unknowns",
            "residuals are zero whatever the noise is",
            "sigma: 3 keypoints fit exactly, so their noise cannot be estimated; "
            "give sigma, or more keypoints",
            lambda: align(learned, _seen([0, 1, 2], sigma=None)),
        ),
        Request(
            'camera of unknown focal length, `focal="known"`',
            "the two contradict",
            "camera: the focal length is unknown; "
            'estimate it with focal="estimate", or give it: camera.with_focal(...)',
            lambda: align(similar, _seen(is_known=False)),
        ),
        Request(
            '`focal_prior`, `focal="known"`',
            "the two contradict",
            'focal_prior: given for a known focal length; give focal="estimate" with it',
            lambda: align(similar, _seen(), focal_prior=FocalPrior(FOCAL)),
        ),
        Request(
            'a lens with distortion, `focal="estimate"`',
            "the focal length and the lens's coefficients bend the image alike",
            "focal: the focal length of a lens with distortion is not estimated; "
            'calibrate it, and give focal="known"',
            lambda: align(similar, _wide(), focal="estimate"),
        ),
        Request(
            "keypoints on all sides of a camera",
            "rays are compared in the image of a pinhole that faces them",
            "points_2d: the keypoints surround the camera: 6 of 15 lie more than 85 degrees off "
            "the direction amid them, the first is point 4; give keypoints on one side of the "
            "camera, or, if these are outliers, ransac",
            lambda: align(similar, _wide(np.zeros(3))),
        ),
        Request(
            "`cam_from_rig` of some views alone",
            "known and unknown camera motion exclude each other",
            "views[1].cam_from_rig: only some views have a known pose; "
            "give it for all views, or for none",
            lambda: align(exact, held_first),
        ),
        Request(
            "first view without a pose of its own, camera motion unknown",
            "the result is in the first camera's frame",
            "views[0]: its keypoints do not determine its pose, and the result is in its camera's "
            "frame; give at least 3 keypoints, not on one line, or another view first",
            lambda: align(exact, [_seen([0, 1]), _seen()]),
        ),
    ]


BEGIN, END = "<!-- begin: cells -->", "<!-- end: cells -->"


def written(page: str) -> str:
    """The page with the tables of all cells between its markers written anew."""
    before, rest = page.split(BEGIN)
    _, after = rest.split(END)
    return f"{before}{BEGIN}\n{_tables()}{END}{after}"


def _tables() -> str:
    lines = ["| evidence |" + "".join(f" {label} |" for label in MODELS.values())]
    lines.append("|---|" + "---|" * len(MODELS))
    for evidence, label in EVIDENCE.items():
        marks = [_mark(model, evidence) for model in MODELS]
        lines.append(f"| {label} |" + "".join(f" {mark} |" for mark in marks))
    lines += ["", "Each of these with every one of", "", "| | |", "|---|---|"]
    for name, values in (("focal length", FOCALS), ("noise", NOISES), ("outliers", OUTLIERS)):
        lines.append(f"| {name} | {', '.join(values.values())} |")
    lines += ["", "## What is refused", "", "| asked for | reason | message |", "|---|---|---|"]
    for each in requests():
        lines.append(f"| {each.asked} | {each.reason} | ``{each.message}`` |")
    return "\n".join(lines) + "\n"


def _mark(model: str, evidence: str) -> str:
    """How the cells of a model and a piece of evidence end."""
    cells = [Cell(model, evidence, *each) for each in product(FOCALS, NOISES, OUTLIERS)]
    return "yes" if all(has_covariance(each) for each in cells) else "yes (1)"
