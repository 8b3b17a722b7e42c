"""Functions of users, which worker processes can import: methods and metrics, good and bad ones."""

from __future__ import annotations

from typing import Any

import numpy as np

import cadalign
from cadalign import Alignment, Camera, Result


def linear(points_3d: Any, points_2d: Any, camera: Camera) -> Alignment:
    return cadalign.fit(points_3d, points_2d, camera, method="aepnp").alignment


def weighted(points_3d: Any, points_2d: Any, camera: Camera, *, sigma: float) -> Result:
    assert sigma == 2.0
    return cadalign.fit(points_3d, points_2d, camera, sigma=sigma)


def raising(points_3d: Any, points_2d: Any, camera: Camera) -> Alignment:
    raise RuntimeError("out of luck")


def leaving(points_3d: Any, points_2d: Any, camera: Camera) -> Alignment:
    raise SystemExit(4)


def of_one(points: Any) -> Alignment:
    raise AssertionError


def mapping(points_3d: Any, points_2d: Any, camera: Camera) -> Any:
    return {"R": np.eye(3)}


def unchecked(points_3d: Any, points_2d: Any, camera: Camera) -> Alignment:
    points_2d *= np.nan
    return Alignment(points_3d[:3] * np.nan, np.zeros(3), np.ones(3), is_valid=True)


BAD = {
    raising: "RuntimeError: out of luck",
    leaving: "it called sys.exit (4)",
    of_one: "TypeError: of_one() takes 1 positional argument but 3 were given",
    mapping: "method: it returned dict, no alignment; return a cadalign.Alignment, or the result "
    "of cadalign.fit or cadalign.align",
    unchecked: "rotation: NaN or infinite values in rows 0, 1, 2; remove or repair these",
}


def depth_error(*, est: Any, gt: Any) -> float:
    return abs(est.translation[2] - gt.translation[2])


def spread(*, result: Any, points_3d: Any, sigma: float) -> float | None:
    assert sigma > 0
    return None if result is None else float(result.std.rotation_deg) * len(points_3d)


def broken(*, est: Any) -> float:
    raise RuntimeError("divided")
