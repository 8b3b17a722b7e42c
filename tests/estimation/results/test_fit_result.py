"""The result of a fit, as text and as JSON."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.problems import fit_problem, problem_of

from cadalign import Alignment, FocalPrior, Result
from cadalign.errors import InputError
from cadalign.estimation.result_parts import (
    Alternative,
    EstimateWarning,
    FitStats,
    Posterior,
    ViewResult,
)
from cadalign.evaluation.simulation import SIMULATION_CAMERA

COVARIANCE = np.diag([1e-4, 1e-4, 1e-4, 0.0004, 0.0009, 0.01, 0, 0.0001, 0.0225])
WARNING = "another pose is likely"
STATED = Posterior(
    COVARIANCE,
    fisher_covariance=COVARIANCE,
    warnings=(EstimateWarning("alternative", WARNING),),
)
POINTS = np.array([[0.0, 0, 1], [1, 0, -1], [0, 1, 1], [1, 1, 1], [1, 0, 1], [0, 0, -1]])
POSE = Alignment(
    Rotation.from_rotvec([0, np.pi / 3, 0]).as_matrix(), [0.5, -0.25, 6], [1, 0.75, 1.25]
)


def made(
    residuals: list[list[float]],
    inliers: list[bool],
    stated: Posterior = STATED,
    **changes: Any,
) -> Result:
    """A result of the six points."""
    ids, camera = tuple(range(6)), SIMULATION_CAMERA
    arrays = SIMULATION_CAMERA.project(POSE.apply(POINTS)), np.array(residuals), np.array(inliers)
    view = ViewResult(camera, POSE, ids, *arrays, stated)
    other = Alternative(Alignment(np.eye(3), [0, 0, 5], [1, 2, 0.5]), 0.125, camera, POINTS)
    fields: dict[str, Any] = {
        "method": "optimal",
        "sigma": 1.0,
        "alternatives": (other,),
        "stats": FitStats(12, 34, 0.5),
    }
    return Result((view,), ids, POINTS, posterior=stated, **{**fields, **changes})


NEAR = [[0.0, 0.0]] * 5
MADE = made([[3.0, 4.0], *NEAR], [False, *[True] * 5])


def test_text_of_a_result() -> None:
    assert str(MADE) == (
        "optimal: 5 of 6 keypoints, rms 0 px\n"
        "  rotation     60 deg from the camera's axes, +- 0.99 deg\n"
        "  translation  (0.5, -0.25, 6) +- (0.02, 0.03, 0.1)\n"
        "  stretch      (1, 0.75 +- 1 %, 1.25 +- 15 %)\n"
        "  also likely  (0.12 x): scale (1, 2, 0.5)\n"
        "  warning      another pose is likely"
    )


def test_text_of_a_result_without_statistics() -> None:
    plain = made(
        [[3.0, 4.0], *NEAR], [True] * 6, Posterior(), method="aepnp", sigma=None, alternatives=()
    )
    assert str(plain) == (
        "aepnp: 6 keypoints, rms 2.04 px\n"
        "  rotation     60 deg from the camera's axes\n"
        "  translation  (0.5, -0.25, 6)\n"
        "  stretch      (1, 0.75, 1.25)"
    )


@pytest.mark.parametrize(
    "options",
    [
        {"sigma": np.full(5, 1.5)},
        {"method": "aepnp"},
        {"stretch": "z"},
        {"focal": "estimate", "focal_prior": FocalPrior(140.0, 0.1)},
    ],
    ids=["alternatives", "linear", "one stretch", "unknown focal length"],
)
def test_json_brings_back_the_same_result(options: dict[str, Any]) -> None:
    points = 5 if "sigma" in options else 12
    result = fit_problem(problem_of(0, points=points, noise_px=1.0), **options)
    text = json.dumps(result.to_dict())
    again = Result.from_dict(json.loads(text))
    assert json.dumps(again.to_dict()) == text
    assert str(again) == str(result)
    assert again.alignment == result.alignment
    assert again.camera == result.camera
    assert again.stats == result.stats
    assert again.inliers.dtype == bool
    json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))


def test_residuals_behind_the_camera_are_null_in_json() -> None:
    behind = made([[np.inf, np.inf], *NEAR], [False, *[True] * 5])
    text = json.dumps(behind.to_dict())
    assert json.loads(text)["views"][0]["residuals"][0] is None
    np.testing.assert_array_equal(Result.from_dict(json.loads(text)).residuals, behind.residuals)


def changed(**changes: Any) -> str:
    return json.dumps(MADE.to_dict() | changes)


def with_view(**changes: Any) -> str:
    (view,) = MADE.to_dict()["views"]
    return changed(views=[view | changes])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[]", "result: [] is not an object"),
        ("{}", "result: version: missing"),
        ('{"version": 1}', "result: method: missing"),
        (changed(version=3), "result: version: 3 is not one of 1"),
        (
            with_view(alignment={"scale": [1, 1, 1]}),
            "result: views[0].alignment.rotation: missing",
        ),
        (
            with_view(residuals=[[1, 2, 3]]),
            "result: views[0].residuals[0]: [1, 2, 3] is not a list of 2",
        ),
        (
            with_view(residuals=[None] * 6),
            "result: views[0].residuals[1]: an inlier's residual is not finite",
        ),
        (with_view(inliers=[True]), "result: views[0].inliers: 1 entries, but residuals has 6"),
        (changed(focal="q"), "result: focal: 'q' is not one of 'estimate', 'known'"),
        (changed(sigma="1"), "result: sigma: '1' is not a finite number"),
        (changed(stats={"speed": 1}), "result: stats.iterations: missing"),
        (
            changed(fisher_covariance=[[1.0]]),
            "result: fisher_covariance: shape (1, 1), expected (9, 9)",
        ),
        (changed(views=[]), "result: views: there are none"),
        (changed(ids=[1]), "result: ids: 1 entries, but points_3d has 6"),
    ],
)
def test_malformed_json_is_refused(text: str, expected: str) -> None:
    with pytest.raises(InputError) as caught:
        Result.from_dict(json.loads(text))
    assert str(caught.value).startswith(expected)


def test_what_is_uncertain_has_a_line_with_its_reason_and_no_warning() -> None:
    """Standard deviations of 1.5 and of 1.7 in 6; the reason is that of the inliers alone."""
    in_plane = POINTS * [1, 1, 0] + [0, 0, 0.25]
    off = np.vstack([in_plane[:5], [[0.5, 0.5, 3.0]]])
    stated = Posterior(100 * COVARIANCE)
    near: list[list[float]] = [[0.0, 0.0]] * 6
    result = replace(made(near, [True] * 5 + [False], stated), points_3d=off)
    assert result.uncertain == ("s_z",)
    assert result.warnings == ()
    text = str(result)
    assert "  stretch      (1, 0.75 +- 10 %, 1.25 (not determined))\n" in text
    assert "  uncertain    s_z (the keypoints lie nearly in the plane z = 0.25)" in text
    rough = replace(result, posterior=Posterior(1e7 * COVARIANCE))
    rough = replace(rough, views=(replace(rough.views[0], posterior=rough.posterior),))
    assert rough.uncertain == ("s_y", "s_z", "distance", "rotation")
    assert "  rotation     60 deg from the camera's axes, not determined\n" in str(rough)
    assert "  translation  (0.5, -0.25, 6) (not determined)\n" in str(rough)
    assert "e+" not in str(rough)
