"""What a fit returns, as text and as JSON."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.problems import fit_problem, problem_of

from cadalign import Alignment, FitResult, FocalPrior
from cadalign.errors import InputError
from cadalign.estimation.result import Alternative, FitStats
from cadalign.evaluation.simulation.problems import SIMULATION_CAMERA

MADE = FitResult(
    alignment=Alignment(
        Rotation.from_rotvec([0, np.pi / 3, 0]).as_matrix(), [0.5, -0.25, 6], [1, 0.75, 1.25]
    ),
    points_3d=np.array([[0.0, 0, 1], [1, 0, -1], [0, 1, 1], [1, 1, 1], [1, 0, 1], [0, 0, -1]]),
    residuals=np.array([[3.0, 4.0]] + [[0.0, 0.0]] * 5),
    inliers=np.array([False, True, True, True, True, True]),
    method="optimal",
    camera=SIMULATION_CAMERA,
    sigma=1.0,
    covariance=np.diag([1e-4, 1e-4, 1e-4, 0.0004, 0.0009, 0.01, 0.0001, 0.0225]),
    known_axis="x",
    stretched_axes="yz",
    focal="known",
    focal_prior=None,
    alternatives=(
        Alternative(Alignment(np.eye(3), [0, 0, 5], [1, 2, 0.5]), 0.125, SIMULATION_CAMERA),
    ),
    stats=FitStats(12, 34, 0.5),
)


def test_text_of_a_result() -> None:
    assert str(MADE) == (
        "optimal: 5 of 6 keypoints, rms 0 px\n"
        "  rotation     60 deg from the camera's axes, +- 0.99 deg\n"
        "  translation  (0.5, -0.25, 6) +- (0.02, 0.03, 0.1)\n"
        "  scale        (1, 0.75 +- 1 %, 1.25 +- 15 %)\n"
        "  also likely  (0.12 x): scale (1, 2, 0.5)\n"
        "  warning      s_z is known only to +-15 %: there are few keypoints for their noise"
    )


def test_text_of_a_result_without_statistics() -> None:
    plain = replace(
        MADE,
        inliers=np.ones(6, dtype=bool),
        method="aepnp",
        sigma=None,
        covariance=None,
        alternatives=(),
    )
    assert str(plain) == (
        "aepnp: 6 keypoints, rms 2.04 px\n"
        "  rotation     60 deg from the camera's axes\n"
        "  translation  (0.5, -0.25, 6)\n"
        "  scale        (1, 0.75, 1.25)"
    )


@pytest.mark.parametrize(
    "result",
    [
        MADE,
        fit_problem(problem_of(0, points=5, noise_px=1.0), sigma=np.full(5, 1.5)),
        fit_problem(problem_of(0), method="aepnp"),
        fit_problem(problem_of(0), known_axis="y", stretch="x"),
        fit_problem(problem_of(0), focal="estimate", focal_prior=FocalPrior(140.0, 0.1)),
    ],
    ids=["made", "alternatives", "linear", "known axis", "unknown focal length"],
)
def test_json_brings_back_the_same_result(result: FitResult) -> None:
    text = result.to_json()
    again = FitResult.from_json(text)
    assert again.to_json() == text
    assert str(again) == str(result)
    assert again.alignment == result.alignment
    assert again.camera == result.camera
    assert again.stats == result.stats
    assert again.inliers.dtype == bool
    json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))


def test_residuals_behind_the_camera_are_null_in_json() -> None:
    behind = replace(MADE, residuals=np.array([[np.inf, np.inf]] + [[0.0, 0.0]] * 5))
    text = behind.to_json()
    assert json.loads(text)["residuals"][0] is None
    np.testing.assert_array_equal(FitResult.from_json(text).residuals, behind.residuals)
    # As earlier versions wrote it.
    older = text.replace("null", "[Infinity, Infinity]", 1)
    assert '"residuals": [[Infinity' in older
    np.testing.assert_array_equal(FitResult.from_json(older).residuals, behind.residuals)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("{", "fit result: not valid JSON: "),
        ("[]", "fit result: [] is not an object"),
        ("{}", "fit result: alignment: missing"),
        (
            json.dumps(MADE.to_dict() | {"alignment": {"scale": [1, 1, 1]}}),
            "fit result: alignment: missing rotation, translation",
        ),
        (
            json.dumps(MADE.to_dict() | {"residuals": [[1, 2, 3]]}),
            "fit result: residuals[0]: [1, 2, 3] is not a list of 2",
        ),
        (
            json.dumps(MADE.to_dict() | {"residuals": [None] * 6}),
            "fit result: residuals[1]: an inlier's residual is not finite",
        ),
        (
            json.dumps(MADE.to_dict() | {"inliers": [True]}),
            f"fit result: inliers: 1 entries, but points_3d has {len(MADE.points_3d)}",
        ),
        (
            json.dumps(MADE.to_dict() | {"known_axis": "q"}),
            "fit result: known_axis: 'q' is not one of 'x', 'y', 'z'",
        ),
        (
            json.dumps(MADE.to_dict() | {"sigma": "1"}),
            "fit result: sigma: '1' is not a finite number",
        ),
        (
            json.dumps(MADE.to_dict() | {"stats": {"speed": 1}}),
            "fit result: stats.iterations: missing",
        ),
    ],
)
def test_malformed_json_is_refused(text: str, expected: str) -> None:
    with pytest.raises(InputError) as caught:
        FitResult.from_json(text)
    assert str(caught.value).startswith(expected)


def test_warnings_look_at_the_inliers_alone() -> None:
    in_plane = MADE.points_3d * [1, 1, 0] + [0, 0, 0.25]
    points_3d = np.concatenate([in_plane, [[0.5, 0.5, 3.0]]])
    result = replace(
        MADE,
        points_3d=points_3d,
        residuals=np.zeros((7, 2)),
        inliers=np.array([True] * 6 + [False]),
        alternatives=(),
    )
    assert result.warnings == (
        "s_z is known only to +-15 %: the keypoints lie nearly in the plane z = 0.25",
    )
