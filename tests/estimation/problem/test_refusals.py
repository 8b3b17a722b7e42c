"""Exact messages of refused calls, listed in `refusals.json`."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from support.combinations import POINTS as ON_BOX
from support.combinations import TRANSLATION, box_mask, model_of, of_box, wide_view
from support.problems import LENS, problem_of
from support.refusals import assert_messages
from support.scenes import BOX, CAMERA, CORNERS, around, keypoints, rig, seen, truth_of

from cadalign import (
    Camera,
    FocalPrior,
    Library,
    Model,
    RansacOptions,
    Result,
    ShapeModel,
    Size,
    View,
    align,
    align_batch,
    fit,
    fit_batch,
)
from cadalign.metrics import rotation_error

FILE = Path(__file__).with_name("refusals.json")
PAGE = Path(__file__).parents[3] / "docs" / "how_to" / "what_to_ask.md"

# --- keypoints of one view ------------------------------------------------------------------------

GOOD = problem_of(3, points=8, noise_px=0.0)
UNKNOWN = Camera.from_size(640, 480)
BENT = Camera(640, 480, 500.0, 500.0, 319.5, 239.5, (-0.4, 0.0, 0.0, 0.0))
FAR = GOOD.points_2d.copy()
FAR[5] = [5000, 240]
LINE, PLACE = GOOD.points_3d * [1, 0, 0], np.full((8, 3), 0.3)
RANSAC = RansacOptions()


def changed(array: np.ndarray, row: int, value: float) -> np.ndarray:
    array = array.copy()
    array[row, 1] = value
    return array


def fitted(
    points_3d: Any = GOOD.points_3d,
    points_2d: Any = GOOD.points_2d,
    camera: Any = GOOD.camera,
    **options: Any,
) -> Callable[[], object]:
    return partial(fit, points_3d, points_2d, camera, **options)


def first(count: int, **options: Any) -> Callable[[], object]:
    return fitted(GOOD.points_3d[:count], GOOD.points_2d[:count], **options)


def imaged(points_3d: np.ndarray, **options: Any) -> Callable[[], object]:
    """A fit of points to their own projections."""
    return fitted(points_3d, GOOD.camera.project(GOOD.alignment.apply(points_3d)), **options)


def in_plane(axis: int, **options: Any) -> Callable[[], object]:
    points = GOOD.points_3d.copy()
    points[:, axis] = 0.1
    return imaged(points, **options)


def at_random(count: int, **options: Any) -> Callable[[], object]:
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (count, 3))
    return fitted(points, rng.uniform(0, 480, (count, 2)), UNKNOWN.replace_focal(600.0), **options)


KEYPOINTS = {
    "3 keypoints": first(3),
    "no keypoints": first(0),
    "5 keypoints, aepnp": first(5, method="aepnp"),
    "no keypoints, aepnp": first(0, method="aepnp"),
    "5 keypoints, aepnp-paper": first(5, method="aepnp-paper"),
    "3 keypoints, epnp": first(3, method="epnp"),
    "3 keypoints, ransac": first(3, ransac=RANSAC),
    "4 keypoints, focal length unknown": first(
        4, camera=UNKNOWN, focal="estimate", focal_prior=None
    ),
    "4 keypoints, sigma unknown": first(4, sigma=None),
    "no keypoints, sigma unknown": first(0, sigma=None),
    "no keypoints, sigma unknown, cauchy": first(0, sigma=None, loss="cauchy"),
    "no keypoints, sigma unknown, ransac": first(0, sigma=None, ransac=RANSAC),
    "4 keypoints twice, sigma unknown": fitted(
        np.tile(GOOD.points_3d[:4], (2, 1)), np.tile(GOOD.points_2d[:4], (2, 1)), sigma=None
    ),
    "fewer pixels": fitted(GOOD.points_3d, GOOD.points_2d[:5]),
    "two coordinates": fitted(GOOD.points_3d[:, :2]),
    "three coordinates of pixels": fitted(points_2d=GOOD.points_3d),
    "one point": fitted(GOOD.points_3d[0]),
    "NaN": fitted(changed(GOOD.points_3d, 6, np.nan)),
    "infinite pixel": fitted(points_2d=changed(GOOD.points_2d, 2, -np.inf)),
    "letters": fitted([["a", 0, 0]] * 8),
    "complex numbers": fitted(GOOD.points_3d.astype(complex)),
    "masked array": fitted(np.ma.masked_greater(GOOD.points_3d, 0.0)),
    "a matrix as camera": fitted(camera=np.eye(3)),
    "pixels beyond the lens": fitted(points_2d=FAR, camera=BENT),
    "4 pairs at random": at_random(4),
    "8 pairs at random, aepnp": at_random(8, method="aepnp"),
    "noise beyond all numbers": fitted(
        points_2d=1e200 * GOOD.points_2d, sigma=None, stretch_sigma=0.1
    ),
    **{
        f"plane {'xyz'[axis]}, {method}": in_plane(axis, method=method)
        for axis in range(3)
        for method in ("aepnp", "aepnp-paper")
    },
    "plane y": in_plane(1),
    "plane z": in_plane(2),
    "plane seen along its normal, focal length unknown": fitted(
        GOOD.points_3d * [1, 1, 0],
        UNKNOWN.replace_focal(935.0).project(GOOD.points_3d * [1, 1, 0] + [0.1, 0, 5]),
        UNKNOWN,
        focal="estimate",
        focal_prior=None,
        stretch="none",
    ),
    "line, aepnp": imaged(LINE, method="aepnp"),
    "place, aepnp": imaged(PLACE, method="aepnp"),
    "line": imaged(LINE),
    "place": imaged(PLACE),
    "place, ransac": imaged(PLACE, ransac=RANSAC),
    "place, focal length unknown": imaged(PLACE, camera=UNKNOWN, focal="estimate"),
}

# --- options --------------------------------------------------------------------------------------

OPTIONS: list[dict[str, Any]] = [
    {"sigma": 0},
    {"sigma": -1.0},
    {"sigma": np.nan},
    {"sigma": np.ones(5)},
    {"sigma": np.zeros(8)},
    {"sigma": changed(np.ones((8, 2)), 0, np.nan)[:, 1]},
    {"sigma": np.array([np.eye(2)] * 7 + [np.diag([1.0, -1.0])])},
    {"sigma": np.array([np.eye(2)] * 6 + [[[1, 0.5], [0, 1]]] + [np.eye(2)])},
    {"sigma": [[1.0], [1.0, 2.0]]},
    {"sigma": 10**400},
    {"method": "aepnp", "sigma": np.ones(5)},
    {"method": "epnp", "sigma": np.zeros(8)},
    {"ransac": RANSAC, "sigma": np.ones(3)},
    {"ransac": RansacOptions(refine=False), "sigma": np.ones(7)},
    {"ransac": RansacOptions(refine=False), "sigma": np.inf},
    {"ransac": RansacOptions(refine=False), "sigma": np.ones((2, 2, 8))},
    {"loss": "l1"},
    {"loss": ["huber"]},
    {"loss_scale": 0},
    {"loss_scale": np.nan},
    {"loss_scale": "2"},
    {"stretch": "x"},
    {"stretch": np.array(["y", "z"])},
    {"stretch": "a" * 300},
    {"stretch_sigma": -0.1},
    {"stretch_sigma": "0.3"},
    {"stretch_sigma": 1e-200},
    {"method": "best"},
    {"method": "aepnp", "loss": "huber"},
    {"method": "epnp", "stretch": "none"},
    {"method": "aepnp", "focal": "estimate"},
    {"method": "aepnp", "ransac": RANSAC},
    {"ransac": True},
    {"scores": np.ones(8)},
    {"ransac": RANSAC, "scores": -np.ones(8)},
    {"ransac": RANSAC, "scores": np.full(8, np.nan)},
    {"ransac": RANSAC, "scores": np.ones(9)},
    {"symmetry": "__SYM_ROTATE_UP_2"},
    {"symmetry": {"axis": [0, 1, 0], "fold": 2}},
    {"focal": "guess"},
    {"focal_prior": FocalPrior(500.0)},
    {"focal": "estimate", "focal_prior": 500.0},
    {"focal": "estimate", "focal_prior": np.ones(3)},
    {"camera": UNKNOWN},
    {"camera": UNKNOWN, "ransac": RANSAC},
    {"camera": LENS, "focal": "estimate"},
]
OF_RANSAC: list[dict[str, Any]] = [
    {"max_reproj_error": 0.0},
    {"max_iterations": 0},
    {"max_iterations": True},
    {"min_iterations": -1},
    {"seed": 1.5},
    {"success_prob": 1.0},
    {"minimal": "p3p"},
    {"refine": [1.0]},
    {"refine": np.array([])},
]


def name_of(options: dict[str, Any]) -> str:
    return ", ".join(
        f"{name}={' '.join(repr(value).split())[:60]}" for name, value in options.items()
    )


# --- batches --------------------------------------------------------------------------------------

PAIR = [GOOD.points_3d, GOOD.points_3d[:6]], [GOOD.points_2d, GOOD.points_2d[:6]]


def of_batch(points_3d: Any = PAIR[0], points_2d: Any = PAIR[1], **options: Any) -> Any:
    return partial(fit_batch, points_3d, points_2d, options.pop("camera", GOOD.camera), **options)


BATCHES = {
    "NaN in a batch": of_batch([GOOD.points_3d, changed(PAIR[0][1], 3, np.nan)]),
    "NaN in a stack": of_batch(
        np.stack([GOOD.points_3d, changed(GOOD.points_3d, 3, np.nan)]), np.ones((2, 8, 2))
    ),
    "one set of pixels for two": of_batch(points_2d=PAIR[1][:1]),
    "pixels of the other problem": of_batch(points_2d=PAIR[1][::-1]),
    "stacks of 7 and 8 points": of_batch(np.ones((3, 7, 3)), np.ones((3, 8, 2))),
    "two coordinates in a batch": of_batch([each[:, :2] for each in PAIR[0]]),
    "one camera for two": of_batch(camera=[LENS]),
    "no camera for the second": of_batch(camera=[LENS, None]),
    "one sigma for two": of_batch(sigma=[1.0]),
    **{f"second sigma {each}": of_batch(sigma=[1.0, each]) for each in (0.0, -1.0, np.nan)},
    **{f"{each!r} workers": of_batch(workers=each) for each in (0, -2, 2.5, "2")},
    "no sequence": of_batch(None),
    "scores without ransac": of_batch(scores=[np.ones(8), np.ones(6)]),
    "one set of scores for two": of_batch(scores=[np.ones(8)], ransac=RANSAC),
    "unknown method of a batch": of_batch(method="best"),
}

# --- models and views -----------------------------------------------------------------------------

BOX_MODEL = Model(points_3d=CORNERS, mesh=BOX)
PIXELS = CAMERA.project(truth_of().apply(CORNERS))
NOTHING, EVERYTHING = np.zeros((480, 640), dtype=bool), np.ones((480, 640), dtype=bool)
BODY = NOTHING.copy()
BODY[200:280, 280:360] = True
PHOTO = np.dstack([BODY * np.uint8(200)] * 3)
POINTS = keypoints(9)
PLAIN = Model(points_3d=POINTS)
SHOWN = seen(POINTS, truth_of(), around(0))
POSE = truth_of()


@cache
def result() -> Result:
    """A result, computed on demand."""
    return align(PLAIN, SHOWN)


def view(*points: Any, **fields: Any) -> Callable[[], object]:
    return partial(View, CAMERA, *(points or (PIXELS,)), **fields)


def moved(rows: slice | int, columns: slice | int, factor: float) -> Callable[[], object]:
    """A view whose pose in the rig is changed."""
    pose = around(30).copy()
    pose[rows, columns] *= factor
    return view(cam_from_rig=pose)


def aligned(model: Any, views: Any, **options: Any) -> Callable[[], object]:
    return partial(align, model, views, **options)


def batch(*objects: Any, **options: Any) -> Callable[[], object]:
    return partial(align_batch, PLAIN, objects, **options)


ARGUMENTS = {
    "views before the model": aligned(SHOWN, PLAIN),
    "a camera as view": aligned(PLAIN, CAMERA),
    "an array as model": aligned(POINTS, SHOWN),
    "an array as view": aligned(PLAIN, [POINTS]),
    "no views": aligned(PLAIN, []),
    "a number as size": aligned(PLAIN, SHOWN, size=3),
    "one start for two views": aligned(PLAIN, [SHOWN, SHOWN], init=[POSE]),
    "a number as start": aligned(PLAIN, [SHOWN, SHOWN], init=[None, 3]),
    "no workers": batch(SHOWN, workers=0),
    "two sizes for one object": batch(SHOWN, size=[Size(width=1.0)] * 2),
    "a number as size of a batch": batch(SHOWN, size=1.0),
    "a number as start of a batch": batch(SHOWN, init=[4]),
    "a view as batch": lambda: align_batch(PLAIN, SHOWN),
    "unknown id": aligned(PLAIN, View(CAMERA, PIXELS[:4], ids=[0, 1, 2, 77])),
    "fewer keypoints than the model has": aligned(PLAIN, View(CAMERA, PIXELS)),
    "ids that are needed": aligned(replace(PLAIN, ids=[*range(1, 9), 0]), SHOWN),
    "keypoints of a mesh": aligned(Model(mesh=BOX), SHOWN),
    "a path as mesh of a model": lambda: Model(points_3d=POINTS, mesh="chair.obj"),
    "shape_sigma without keypoints": lambda: Model(mesh=BOX, shape_sigma=0.05),
    "shape_sigma of zero": lambda: Model(points_3d=POINTS, shape_sigma=0.0),
    "no keypoints of a model": lambda: Model(points_3d=np.empty((0, 3))),
    "a number as ids": lambda: Model(points_3d=POINTS, ids=5),
    "a text as symmetry": lambda: Model(points_3d=POINTS, symmetry="__SYM_ROTATE_UP_4"),
    "no length": Size,
    "negative width": lambda: Size(width=-1),
    "sigma of zero of a size": lambda: Size(width=1, sigma=0),
    "infinite sigma of a size": lambda: Size(width=1.0, sigma=np.inf),
    "a number as mesh": lambda: result().mesh(3),
    "text as probability": lambda: result().radius("a"),
    "probability of one": lambda: result().radius(1.0),
    "text as dimension": lambda: result().radius(0.9, dimension="a"),
    "dimension of zero": lambda: result().radius(0.5, dimension=0),
    "a category as examples": lambda: ShapeModel.learn("chairs"),
    "a result as alignment": lambda: rotation_error(est=result(), gt=POSE),
    "a model in a library": lambda: Library.from_models([PLAIN]),
}
VIEWS = {
    "ids twice": view([[1, 2], [3, 4]], ids=["a", "a"]),
    "two ids for one keypoint": view([[1, 2]], ids=["a", "b"]),
    "text as ids": view([[9, 20], [300, 4]], ids="ab"),
    "negative depth": view([[1, 2]], depth=[-1.0]),
    "depth of another size": view([[1, 2]], depth=np.ones((3, 4))),
    "depth without keypoints": partial(View, CAMERA, mask=BODY, depth=np.ones((480, 640))),
    "depth of whole numbers": partial(View, CAMERA, depth=np.full((480, 640), 5, dtype=np.uint16)),
    "letters as depth_sigma": view(depth_sigma="a"),
    "two values of depth_sigma": view(depth_sigma=[0.1, 0.2]),
    "up of zeros": view(up=[0, 0, 0]),
    "up_sigma_deg of zeros": view(up=[0, 1, 0], up_sigma_deg=np.zeros((3, 3))),
    "camera at the ground": view(camera_height=0),
    "mask of another width": view(mask=NOTHING[:, 1:]),
    "mask of three channels": view(mask=np.dstack([NOTHING] * 3)),
    "mask beyond one": view(mask=EVERYTHING.astype(int) * 255),
    "mask of NaN": view(mask=np.full((480, 640), np.nan)),
    "photo of four channels": view(image=np.dstack([NOTHING / 1.0] * 4)),
    "photo of one channel": view(image=NOTHING.astype(np.uint8)),
    "photo of another size": view(image=np.zeros((10, 20, 3), np.uint8)),
    "rig with a scale": moved(slice(3), slice(3), 1.1),
    "rig that mirrors": moved(slice(3), 0, -1.0),
    "rig of NaN": moved(0, 3, np.nan),
}
EVIDENCE = {
    "empty mask": aligned(BOX_MODEL, [View(CAMERA, PIXELS), View(CAMERA, PIXELS, mask=NOTHING)]),
    "full mask": aligned(BOX_MODEL, View(CAMERA, PIXELS, mask=EVERYTHING)),
    "a photo alone": aligned(BOX_MODEL, View(CAMERA, image=PHOTO)),
    "a photo without a mesh": aligned(PLAIN, replace(SHOWN, image=PHOTO)),
    "a mask of one face": aligned(BOX_MODEL, View(CAMERA, mask=BODY)),
    "a mask of the background": aligned(BOX_MODEL, View(CAMERA, mask=~BODY)),
    "a mask alone, focal length unknown": aligned(
        BOX_MODEL, View(UNKNOWN, mask=BODY), focal="estimate"
    ),
    "a mask far from the start": aligned(
        BOX_MODEL,
        View(CAMERA, mask=BODY),
        init=replace(POSE, translation=POSE.translation + [3.0, 0, 0]),
    ),
    "a view that tells nothing": aligned(PLAIN, [SHOWN, View(CAMERA)]),
    "a view of a rig that tells nothing": aligned(
        PLAIN, [*rig(POINTS, truth_of(), [0, 30]), View(CAMERA, cam_from_rig=around(60))]
    ),
    "numbers of views behind one that is left out": aligned(
        PLAIN, [SHOWN, View(CAMERA, PIXELS[:2], ids=[0, 1]), View(CAMERA)]
    ),
}

# --- what cannot be combined: the table of the page ----------------------------------------------

EXACT, SIMILAR, LEARNED = (model_of(name, None) for name in ("exact", "similar", "learned"))
COMBINATIONS = {
    "a mask, no mesh": aligned(Model(points_3d=ON_BOX), of_box(mask=box_mask())),
    "a mask, no training model's mesh": aligned(LEARNED, of_box(mask=box_mask())),
    "a mask alone, similar model": aligned(SIMILAR, View(of_box().camera, mask=box_mask())),
    "gravity, no up axis": aligned(replace(LEARNED, up_axis=None), of_box(up=[0, -1, 0])),
    "two keypoints": aligned(LEARNED, of_box([0, 1])),
    "three keypoints, stretch unknown": aligned(EXACT, of_box([0, 1, 7])),
    "four keypoints, focal length unknown": aligned(
        EXACT, of_box([0, 1, 7, 10], is_known=False), focal="estimate", focal_prior=None
    ),
    "keypoints in a plane": aligned(EXACT, of_box([0, 1, 2, 3])),
    "keypoints in a plane, ransac": aligned(EXACT, of_box([0, 1, 2, 3]), ransac=RANSAC),
    "exact fit, sigma unknown": aligned(LEARNED, of_box([0, 1, 2], sigma=None)),
    "unknown camera, focal length known": aligned(SIMILAR, of_box(is_known=False)),
    "prior, focal length known": aligned(SIMILAR, of_box(), focal_prior=FocalPrior(500.0)),
    "fisheye, focal length unknown": aligned(SIMILAR, wide_view(TRANSLATION), focal="estimate"),
    "keypoints around the camera": aligned(SIMILAR, wide_view(np.zeros(3))),
    "keypoints around the camera, fit": fitted(
        ON_BOX, wide_view(np.zeros(3)).camera.project(ON_BOX), wide_view(TRANSLATION).camera
    ),
    "some views of a rig": aligned(EXACT, [of_box(cam_from_rig=np.eye(4)), of_box()]),
    "first view without a pose": aligned(EXACT, [of_box([0, 1]), of_box()]),
}


def test_every_refusal_has_its_message() -> None:
    calls = {**KEYPOINTS, **BATCHES, **ARGUMENTS, **VIEWS, **EVIDENCE, **COMBINATIONS}
    calls |= {name_of(each): fitted(**each) for each in OPTIONS}
    calls |= {
        f"RansacOptions: {name_of(each)}": partial(RansacOptions, **each) for each in OF_RANSAC
    }
    groups = KEYPOINTS, BATCHES, ARGUMENTS, VIEWS, EVIDENCE, COMBINATIONS, OPTIONS, OF_RANSAC
    assert len(calls) == sum(map(len, groups))
    assert_messages(FILE, calls)


def test_the_page_of_what_is_refused_quotes_these_messages() -> None:
    quoted = re.findall(r"\| ``(.*)`` \|", PAGE.read_text(encoding="utf-8"))
    messages = FILE.read_text(encoding="utf-8").replace('\\"', '"')
    assert len(quoted) > 10
    assert [each for each in quoted if f'Error: {each}"' not in messages] == []
