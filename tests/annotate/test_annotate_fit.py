"""The live alignment: its values, outliers among the pairs, and the next keypoint."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from support.problems import problem_of

from cadalign import Alignment, Camera, fit
from cadalign.annotate.lines import Wireframe
from cadalign.annotate.live import LiveAlignment, facts_of, live_alignment, missing_text, notes_of
from cadalign.annotate.model import ClickableModel
from cadalign.annotate.models import KeypointRegistry, ObjectShape
from cadalign.annotate.photos import FocalChoice, Intrinsics
from cadalign.annotate.problem import Known, LiveProblem
from cadalign.annotate.suggestion import Suggestion, suggest
from cadalign.datasets import ModelKeypoint
from cadalign.errors import DegenerateError, InputError
from cadalign.evaluation.simulation import SimulatedProblem
from cadalign.geometry.camera import projection_jacobian
from cadalign.geometry.mesh import Mesh
from cadalign.io.evidence import ImageEvidence
from cadalign.io.images import write_image
from cadalign.io.observation import Observation
from cadalign.render import visible_keypoints

KNOWN = FocalChoice(known=True)
STRETCHED = ObjectShape()
UNKNOWN = FocalChoice(known=False)
BOX = Mesh(
    [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)],
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]],
)
LENS_CAMERA = Camera(640, 480, 300.0, 310.0, 310.0, 250.0, (-0.2, 0.05, 0.003, -0.002))


def live_of(
    problem: SimulatedProblem,
    *,
    choice: FocalChoice = KNOWN,
    points_2d: np.ndarray | None = None,
    intrinsics: Intrinsics | None = None,
    stretch: float | None = None,
) -> LiveAlignment:
    """The live alignment of a problem's pairs, as a session makes it."""
    intrinsics = intrinsics or Intrinsics(problem.camera, calibrated=True)
    count = len(problem.points_3d)
    observation = Observation(
        problem.points_3d,
        problem.points_2d if points_2d is None else points_2d,
        intrinsics.with_focal(choice),
        ids=np.arange(count),
        fit_options={} if stretch is None else {"stretch_sigma": stretch},
    )
    known = Known(STRETCHED, BOX, estimates_focal=not choice.known, focal_prior=intrinsics.prior)
    points = [
        ModelKeypoint(f"point {row}", xyz, row)
        for row, xyz in enumerate(map(tuple, problem.points_3d.tolist()))
    ]
    estimate = LiveAlignment.of(known, observation)
    lines = Wireframe.of_model(ClickableModel(BOX))
    return live_alignment(estimate, known, lines, observation, points, observation.points_2d)


# --- the alignment ---------------------------------------------------------------------------


def test_is_what_fit_finds() -> None:
    problem = problem_of(0, points=9, noise_px=1.0)
    live = live_of(problem)
    expected = fit(problem.points_3d, problem.points_2d, problem.camera)
    assert live.result is not None
    assert live.result.alignment == expected.alignment
    assert not live.provisional


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (0, "4 more pairs to the first alignment"),
        (2, "2 more pairs to the first alignment"),
        (3, "1 more pair to the first alignment"),
    ],
)
def test_says_how_many_pairs_are_missing(points: int, message: str) -> None:
    counts = np.ones(points, dtype=bool)
    assert missing_text(counts, STRETCHED, is_plain=True) == message
    assert missing_text(np.ones(4, dtype=bool), STRETCHED, is_plain=True) == ""
    beside = missing_text(np.ones(2, dtype=bool), STRETCHED, is_plain=False)
    assert beside == "1 more pair to the first alignment"


@pytest.mark.parametrize(("stretch", "noise"), [(0.25, "settled"), (None, "given")])
def test_clicks_without_a_stated_noise_have_it_found_beside_other_evidence(
    stretch: float | None, noise: str
) -> None:
    """By the prior on the stretch, which residuals alone do not settle; a stated one counts."""
    problem = problem_of(3, points=8, noise_px=2.0)
    upright = ImageEvidence(up=problem.alignment.rotation[:, 1])
    given = problem.points_3d, problem.points_2d, problem.camera
    options = {} if stretch is None else {"stretch_sigma": stretch}
    for sigma, expected in ((None, noise), (np.full(8, 2.0), "given")):
        noted = {"sigma": sigma, "ids": np.arange(8), "evidence": upright}
        seen = Observation(*given, **noted, fit_options=options)
        assert LiveProblem.of(Known(STRETCHED, BOX), seen).noise == expected


@pytest.mark.parametrize("pairs", [1, 2])
def test_a_similar_model_needs_pairs_beside_a_mask(tmp_path: Path, pairs: int) -> None:
    problem = problem_of(3, points=8)
    mask = np.zeros((problem.camera.height, problem.camera.width), dtype=np.uint8)
    mask[200:280, 250:400] = 255
    write_image(tmp_path / "mask.png", mask)
    seen = Observation(
        problem.points_3d[:pairs],
        problem.points_2d[:pairs],
        problem.camera,
        ids=np.arange(pairs),
        evidence=ImageEvidence(mask=tmp_path / "mask.png"),
    )
    live = LiveProblem.of(Known(ObjectShape(sigma=0.05), BOX), seen)
    with pytest.raises(DegenerateError, match="give at least 3 keypoints"):
        live.align()


def test_standard_deviations_scale_with_the_residuals() -> None:
    problem = problem_of(3, points=12, noise_px=8.0)
    live = live_of(problem)
    assert live.result is not None
    assert 4 < live.sigma < 14
    at_one = fit(problem.points_3d, problem.points_2d, problem.camera)
    wider = at_one.fisher_covariance * live.sigma**2
    np.testing.assert_allclose(live.result.fisher_covariance, wider, rtol=1e-5)
    similar = fit(problem.points_3d, problem.points_2d, problem.camera, sigma=None)
    assert similar.sigma == pytest.approx(live.sigma, rel=1e-6)
    assert live_of(problem_of(3, points=12, noise_px=0.01)).sigma == 1.0


def test_pairs_in_one_plane_give_a_provisional_alignment_that_says_so() -> None:
    problem = problem_of(1, points=6, noise_px=1.0)
    flat = problem.points_3d * [1, 1, 0]
    points_2d = problem.camera.project(problem.alignment.apply(flat))
    live = live_of(replace(problem, points_3d=flat, points_2d=points_2d))
    assert live.provisional
    assert live.result is not None
    assert live.message.startswith("The stretch shown is assumed: the scale s_z is not determined")
    assert live.message.endswith("Add a pair elsewhere.")


def test_coinciding_pairs_give_no_alignment() -> None:
    problem = problem_of(0, points=5, noise_px=1.0)
    same = replace(problem, points_3d=np.zeros((5, 3)), points_2d=np.full((5, 2), 100.0))
    with pytest.raises(DegenerateError):
        live_of(same)


def test_unknown_focal_length_is_estimated_from_the_fifth_pair_on() -> None:
    problem = problem_of(5, points=12, noise_px=0.3)
    intrinsics = Intrinsics(problem.camera.with_focal(500.0), calibrated=False)
    live = live_of(problem, choice=UNKNOWN, intrinsics=intrinsics)
    assert live.result is not None
    expected = fit(
        problem.points_3d,
        problem.points_2d,
        Camera.without_focal(640, 480),
        focal="estimate",
        focal_prior=None,
    )
    assert live.result.alignment == expected.alignment
    assert live.result.camera == expected.camera
    assert live.result.camera.fx == pytest.approx(150, rel=5 * expected.std.focal)
    assert not live.provisional
    few = replace(problem, points_3d=problem.points_3d[:4], points_2d=problem.points_2d[:4])
    four = live_of(few, choice=UNKNOWN, intrinsics=intrinsics)
    assert four.provisional
    assert four.result.camera == intrinsics.camera
    assert four.message == (
        "The focal length is assumed: add a pair elsewhere to have it estimated."
    )


def test_typed_focal_length_is_used() -> None:
    intrinsics = Intrinsics(LENS_CAMERA, calibrated=True)
    assert intrinsics.with_focal(FocalChoice(known=True, pixels=600.0)).fy == pytest.approx(620.0)
    assert intrinsics.with_focal(KNOWN) is LENS_CAMERA
    written = intrinsics.to_write(UNKNOWN)
    assert not written.focal_known
    assert (written.cx, written.cy, written.distortion) == (310.0, 250.0, LENS_CAMERA.distortion)
    assert intrinsics.to_write(KNOWN) is LENS_CAMERA


# --- outliers ------------------------------------------------------------------------------------


@pytest.mark.parametrize("wrong", [(4,), (0, 7), (1, 5, 9)])
def test_wrong_pairs_are_named_with_how_far_they_are_off(wrong: tuple[int, ...]) -> None:
    problem = problem_of(2, points=14, noise_px=1.0)
    points_2d = problem.points_2d.copy()
    for k, row in enumerate(wrong):
        points_2d[row] += [(37, 5), (-30, 25), (10, -45)][k]
    live = live_of(problem, points_2d=points_2d)
    assert set(live.outliers) == set(wrong)
    true = np.linalg.norm(points_2d - problem.points_2d, axis=1)
    for row in wrong:
        assert live.outliers[row] == pytest.approx(true[row], abs=12)


@pytest.mark.long
@pytest.mark.parametrize("choice", [KNOWN, UNKNOWN])
def test_pairs_that_agree_are_not_suspected(choice: FocalChoice) -> None:
    suspected = 0
    seeds = 60 if choice.known else 15
    for seed in range(seeds):
        for points, noise in ((6, 1.0), (10, 3.0), (20, 6.0)):
            live = live_of(problem_of(seed, points=points, noise_px=noise), choice=choice)
            suspected += len(live.outliers)
    assert suspected <= 0.005 * seeds * 36


@pytest.mark.long
def test_one_wrong_pair_is_found_among_few() -> None:
    found = alone = 0
    for seed in range(40):
        problem = problem_of(seed, points=8, noise_px=1.0)
        points_2d = problem.points_2d.copy()
        points_2d[3] += [0, 60]
        outliers = live_of(problem, points_2d=points_2d).outliers
        found += 3 in outliers
        alone += set(outliers) == {3}
    assert found >= 32
    assert alone >= 30


def test_too_few_pairs_accuse_nobody() -> None:
    problem = problem_of(0, points=5, noise_px=1.0)
    points_2d = problem.points_2d + [[90, 0], *[[0, 0]] * 4]
    assert live_of(problem, points_2d=points_2d).outliers == {}


# --- the next keypoint -----------------------------------------------------------------------


def refitted(
    problem: SimulatedProblem, result: Any, candidate: np.ndarray, focal: str
) -> np.ndarray:
    """The covariance of a fit to which the candidate was added, measured where it is predicted."""
    pixel = result.camera.project(result.alignment.apply(candidate[None]))
    again = fit(
        np.vstack([problem.points_3d, candidate]),
        np.vstack([problem.points_2d, pixel]),
        problem.camera,
        focal=focal,
    )
    assert again.fisher_covariance is not None
    return again.fisher_covariance


@pytest.mark.long
@pytest.mark.parametrize("choice", [KNOWN, UNKNOWN])
@given(st.integers(0, 10_000))
@settings(max_examples=15)
def test_the_suggestion_is_that_of_brute_force_refitting(choice: FocalChoice, seed: int) -> None:
    problem = problem_of(seed, points=9, noise_px=0.5)
    live, focal = live_of(problem, choice=choice), "known" if choice.known else "estimate"
    result = live.result
    assume(result is not None and not live.message and live.sigma == 1.0)
    # The prediction is of first order: a focal length that is open by more than its own size, at
    # the end of its range, is beyond it.
    assume(result.std is not None and result.std.focal < 1)
    model, rng = ClickableModel(BOX), np.random.default_rng(seed + 1)
    points = [
        ModelKeypoint(f"corner {k}", tuple(xyz), k)
        for k, xyz in enumerate(rng.permutation(BOX.vertices).tolist())
    ]
    scene = Wireframe.of_model(model).scene
    xyz = np.array([point.xyz for point in points])
    seen = visible_keypoints(scene, xyz, result.camera, result.alignment)
    assume(np.count_nonzero(seen) > 1)
    found = suggest(live, KeypointRegistry(points), (), STRETCHED)
    assert found is not None
    left = {
        point.name: np.linalg.slogdet(refitted(problem, result, np.array(point.xyz), focal))[1]
        for point in np.array(points, dtype=object)[seen]
    }
    assert left[found.point.name] <= min(left.values()) + 0.02


def test_without_visible_keypoints_none_is_suggested() -> None:
    live = live_of(problem_of(7, points=10, noise_px=0.5))
    hidden = KeypointRegistry([ModelKeypoint("inside", (0.0, 0.0, 0.0), 3)])
    assert suggest(live, hidden, (), STRETCHED) is None
    assert suggest(LiveAlignment(), KeypointRegistry(), (), STRETCHED) is None


# --- derivatives -----------------------------------------------------------------------------


def test_projection_jacobian_refuses_what_it_cannot_do() -> None:
    pose = Alignment(np.eye(3), [0, 0, 4], [1, 1, 1])
    with pytest.raises(InputError, match=r"^points_3d: a point lies behind the camera$"):
        projection_jacobian(np.array([[0, 0, -5.0]]), LENS_CAMERA, pose)


# --- text -----------------------------------------------------------------------------------


def test_facts_give_stretch_pose_and_residuals_with_standard_deviations() -> None:
    problem = problem_of(7, points=15, noise_px=1.0)
    facts = {fact.label: fact for fact in facts_of(live_of(problem), STRETCHED)}
    assert list(facts) == [
        "Stretch along y",
        "Stretch along z",
        "Rotation",
        "Distance",
        "Focal length",
        "Pairs agree to",
    ]
    value, _, std = facts["Stretch along y"].value.partition(" ± ")
    assert abs(float(value) - problem.alignment.scale[1]) < 5 * float(std)
    longer = problem.alignment.scale[1] > 1
    assert facts["Stretch along y"].note.endswith(
        f"{'longer' if longer else 'shorter'} than the model"
    )
    assert facts["Focal length"].value == "150 px"
    assert facts["Rotation"].value.startswith("known to ± ")
    assert facts["Pairs agree to"].value.endswith(" px")
    assert facts_of(LiveAlignment(), STRETCHED) == ()


def test_estimated_focal_length_has_a_standard_deviation() -> None:
    facts = {
        fact.label: fact
        for fact in facts_of(
            live_of(problem_of(7, points=15, noise_px=1.0), choice=UNKNOWN), STRETCHED
        )
    }
    assert " ± " in facts["Focal length"].value
    assert facts["Focal length"].note == "estimated"


def test_notes_name_alternatives() -> None:
    problem = problem_of(0, points=4, noise_px=0.0)
    notes = notes_of(live_of(problem), STRETCHED)
    assert any("one more pair tells them apart" in note for note in notes)
    assert notes_of(LiveAlignment(message="wait"), STRETCHED) == ()


def test_text_names_the_point_and_what_is_known_of_it() -> None:
    point = ModelKeypoint("left arm", (0.0, 0.0, 0.0), 3)
    assert Suggestion(point, (1.0, 2.0), 3.44).text == (
        "left arm: so far known to ± 3.4 px; it would tell most"
    )
