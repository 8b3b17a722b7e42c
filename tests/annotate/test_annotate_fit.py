"""The live alignment: its values, and outliers among the pairs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.problems import problem_of

from cadalign import Camera, fit
from cadalign.annotate.keypoints import ObjectShape
from cadalign.annotate.observations import LIKELY_STRETCH
from cadalign.annotate.page_state import facts_of
from cadalign.annotate.problem import LiveEstimate, LiveProblem
from cadalign.annotate.session import LiveAlignment, missing_text
from cadalign.evaluation.simulation import SimulatedProblem
from cadalign.geometry.mesh import Mesh
from cadalign.io.evidence import ImageEvidence
from cadalign.io.observation import Observation

STRETCHED = ObjectShape()
BOX = Mesh(
    [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)],
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]],
)
UNKNOWN = Camera.from_size(640, 480)
WEAK = 0.8  # prior on the stretch of simulated problems, whose scales are 0.5 to 2


def estimate_of(
    problem: SimulatedProblem,
    *,
    camera: Camera | None = None,
    points_2d: np.ndarray | None = None,
    stretch: float = WEAK,
) -> LiveEstimate:
    """The estimate of a problem's pairs, by default with its own camera."""
    observation = Observation(
        problem.points_3d,
        problem.points_2d if points_2d is None else points_2d,
        camera or problem.camera,
        ids=np.arange(len(problem.points_3d)),
        fit_options={"stretch_sigma": stretch},
    )
    return LiveProblem.make(None, BOX, observation, focal=500.0).estimate()


def live_of(problem: SimulatedProblem, **options: Any) -> LiveAlignment:
    """The live alignment of a problem, as the page shows it."""
    counts = np.ones(len(problem.points_3d), dtype=bool)
    return LiveAlignment(estimate_of(problem, **options), counts=counts)


# --- the alignment ---------------------------------------------------------------------------


def test_is_what_fit_finds_at_the_noise_of_its_pairs() -> None:
    problem = problem_of(0, points=9, noise_px=4.0)
    found = estimate_of(problem, stretch=LIKELY_STRETCH)
    assert found.sigma > 1
    expected = fit(
        problem.points_3d, problem.points_2d, problem.camera, stretch_sigma=LIKELY_STRETCH,
        **found.fit_options,
    )  # fmt: skip
    assert found.result.alignment == expected.alignment
    assert not found.message


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (0, "4 more pairs to the first alignment"),
        (2, "2 more pairs to the first alignment"),
        (3, "1 more pair to the first alignment"),
    ],
)
def test_says_how_many_pairs_are_missing(points: int, message: str) -> None:
    seen = Observation(np.zeros((0, 3)), np.zeros((0, 2)), UNKNOWN)
    upright = replace(seen, evidence=ImageEvidence(up=np.array([0.0, -1.0, 0.0])))
    assert missing_text(np.ones(points, dtype=bool), STRETCHED, seen) == message
    assert missing_text(np.ones(4, dtype=bool), STRETCHED, seen) == ""
    beside = missing_text(np.ones(2, dtype=bool), STRETCHED, upright)
    assert beside == "1 more pair to the first alignment"


def test_clicks_without_a_stated_noise_have_it_found_beside_other_evidence() -> None:
    """The noise is estimated unless the observation has a sigma."""
    problem = problem_of(3, points=8, noise_px=2.0)
    upright = ImageEvidence(up=problem.alignment.rotation[:, 1])
    given = problem.points_3d, problem.points_2d, problem.camera
    for sigma, estimates_noise in ((None, True), (np.full(8, 2.0), False)):
        noted = {"sigma": sigma, "ids": np.arange(8), "evidence": upright}
        seen = Observation(*given, **noted)
        assert LiveProblem.make(None, BOX, seen).estimates_noise == estimates_noise


def test_pairs_that_leave_the_stretch_open_have_its_prior() -> None:
    problem = problem_of(1, points=6, noise_px=1.0)
    flat = problem.points_3d * [1, 1, 0]
    points_2d = problem.camera.project(problem.alignment.apply(flat))
    plane = replace(problem, points_3d=flat, points_2d=points_2d)
    live = live_of(plane, stretch=LIKELY_STRETCH)
    facts = {fact["label"]: fact for fact in facts_of(live, STRETCHED, prior=LIKELY_STRETCH)}
    assert facts["Stretch z"]["value"] == "not determined"
    assert facts["Stretch z"]["note"] == "these pairs leave it open: 1 ± 25 % is assumed"


def test_unknown_focal_length_is_estimated() -> None:
    problem = problem_of(5, points=12, noise_px=0.3)
    found = estimate_of(problem, camera=UNKNOWN)
    assert found.result.focal == "estimate"
    assert found.result.camera.fx == pytest.approx(150, rel=5 * found.result.std.focal)
    assert not found.message


# --- outliers ------------------------------------------------------------------------------------


@pytest.mark.parametrize("wrong", [(4,), (0, 7), (1, 5, 9)])
def test_wrong_pairs_are_named_with_how_far_they_are_off(wrong: tuple[int, ...]) -> None:
    problem = problem_of(2, points=14, noise_px=1.0)
    points_2d = problem.points_2d.copy()
    for k, row in enumerate(wrong):
        points_2d[row] += [(37, 5), (-30, 25), (10, -45)][k]
    live = estimate_of(problem, points_2d=points_2d)
    assert set(live.outliers) == set(wrong)
    true = np.linalg.norm(points_2d - problem.points_2d, axis=1)
    for row in wrong:
        assert live.outliers[row] == pytest.approx(true[row], abs=12)


def test_too_few_pairs_accuse_nobody() -> None:
    problem = problem_of(0, points=5, noise_px=1.0)
    points_2d = problem.points_2d + [[90, 0], *[[0, 0]] * 4]
    assert estimate_of(problem, points_2d=points_2d).outliers == {}


# --- text -----------------------------------------------------------------------------------


def test_facts_give_stretch_pose_and_residuals_with_standard_deviations() -> None:
    problem = problem_of(7, points=15, noise_px=1.0)
    shown = facts_of(live_of(problem), STRETCHED, prior=WEAK)
    facts = {fact["label"]: fact for fact in shown}
    assert list(facts) == [
        *("Stretch y", "Stretch z", "Rotation", "Distance", "Focal length", "Residuals"),
    ]
    value, _, std = facts["Stretch y"]["value"].partition(" ± ")
    assert abs(float(value) - problem.alignment.scale[1]) < 5 * float(std)
    longer = problem.alignment.scale[1] > 1
    assert facts["Stretch y"]["note"].endswith(
        f"{'longer' if longer else 'shorter'} than the model"
    )
    assert facts["Focal length"]["value"] == "150 px"
    assert facts["Rotation"]["value"].startswith("± ")
    assert facts["Residuals"]["value"].endswith(" px")
