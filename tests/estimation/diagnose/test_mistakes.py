"""Mirrored models, flipped photos and swapped coordinates are named by robust estimates."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from support.mistaken import said
from support.problems import with_outliers
from support.scenes import CAMERA as SCENE
from support.scenes import keypoints, truth_of, turned
from support.scenes import seen as seen_in_scene

from cadalign import Camera, Model, RansacOptions, Result, View, align, fit
from cadalign.errors import CadalignError, NoConsensusError
from cadalign.estimation.uncertainty.residuals import (
    Support,
    area_of,
    check_support,
    log_expected_by_chance,
    share_as_moderate,
)

CENTRED = Camera(640, 480, 935.0, 935.0, 319.5, 239.5)
OFF_CENTRE = Camera(640, 480, 935.0, 935.0, 190.0, 330.0)
CHAIR = np.array(  # feet, corners of the seat, top of the back, arms
    [(x, -0.4, z) for x in (-0.22, 0.22) for z in (-0.24, 0.21)]
    + [(x, 0.0, z) for x in (-0.25, 0.25) for z in (-0.26, 0.24)]
    + [(x, 0.42, -0.31) for x in (-0.23, 0.23)]
    + [(x, 0.15, z) for x in (-0.27, 0.27) for z in (-0.2, 0.12)]
)
BOTTLE = np.array(  # rings of four
    [
        (radius * np.cos(angle), height, radius * np.sin(angle))
        for radius, height in ((0.13, -0.45), (0.13, 0.1), (0.05, 0.25), (0.05, 0.45))
        for angle in np.arange(4) * np.pi / 2 + 0.3
    ]
)
NAMES = {
    "mirrored": "the model is mirrored",
    "swapped": "u and v are swapped",
    "flipped": "the photo is flipped",
    "upside down": "v counts from the bottom",
}


@dataclass(frozen=True)
class Seen:
    """Keypoints of an upright object in a photo."""

    points_3d: np.ndarray
    points_2d: np.ndarray
    camera: Camera

    def mistaken(self, mistake: str) -> Seen:
        model, pixels = self.points_3d, self.points_2d.copy()
        if mistake == "mirrored":
            model = model * [-1, 1, 1]
        elif mistake == "swapped":
            pixels = pixels[:, ::-1].copy()
        elif mistake == "flipped":
            pixels[:, 0] = self.camera.width - 1 - pixels[:, 0]
        elif mistake == "upside down":
            pixels[:, 1] = self.camera.height - 1 - pixels[:, 1]
        return Seen(model, pixels, self.camera)

    def fit(self) -> Result:
        return fit(self.points_3d, self.points_2d, self.camera, ransac=RansacOptions())

    def complaint(self) -> str:
        """The warning or the error of the fit; empty without either."""
        try:
            found = self.fit()
        except CadalignError as error:
            return str(error)
        return "; ".join(text for text in map(str, found.warnings) if "known only" not in text)


def photo(points: np.ndarray, rng: np.random.Generator, camera: Camera) -> np.ndarray:
    """Pixels of an upright object's points from a random side, with 1 px of noise."""
    while True:
        azimuth, elevation = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(-10, 50))
        flat = np.cos(elevation)
        backward = np.array([flat * np.sin(azimuth), np.sin(elevation), flat * np.cos(azimuth)])
        right = np.cross([0, 1, 0], backward) / flat
        rotation = np.array([right, np.cross(right, backward), -backward])
        in_camera = points @ rotation.T + [0, 0, rng.uniform(2, 4)]
        if in_camera[:, 2].min() > 0.3:
            return camera.project(in_camera) + rng.normal(0, 1, (len(points), 2))


def seen(
    seed: int, points: np.ndarray = CHAIR, *, count: int | None = None, camera: Camera = CENTRED
) -> Seen:
    """Some keypoints of a stretched object."""
    rng = np.random.default_rng(seed)
    count = count or int(rng.integers(7, min(len(points), 16) + 1))
    some = points[rng.choice(len(points), min(count, len(points)), replace=False)]
    scale = np.exp([0.0, *rng.normal(0, 0.25, 2)])
    return Seen(some, photo(some * scale, rng, camera), camera)


def spoiled(problem: Seen, seed: int) -> Seen:
    """Add up to 30 % outliers, which raise no warning."""
    rng = np.random.default_rng([seed, 1])
    count = len(problem.points_2d)
    wrong = rng.choice(count, int(0.3 * count), replace=False)
    pixels = with_outliers(problem.points_2d, wrong, rng)
    return Seen(problem.points_3d, pixels, problem.camera)


def warning_of(problem: Seen) -> str:
    """The mistake that is named, if any."""
    complaint = problem.complaint()
    return complaint if any(name in complaint for name in NAMES.values()) else ""


@pytest.mark.parametrize("mistake", NAMES)
def test_no_mistake_stays_unnoticed(mistake: str) -> None:
    complaints = [seen(seed).mistaken(mistake).complaint() for seed in range(60)]
    assert all(complaints)
    first = [text.partition("(or")[0] for text in complaints]
    assert np.mean([NAMES[mistake] in text for text in first]) > 0.8


@pytest.mark.parametrize("mistake", NAMES)
def test_principal_point_tells_flips_and_mirrored_models_apart(mistake: str) -> None:
    complaint = seen(3, count=12, camera=OFF_CENTRE).mistaken(mistake).complaint()
    assert complaint.startswith(NAMES[mistake])


def test_the_warning_tells_what_was_rejected_and_what_would_agree() -> None:
    problem = seen(0, count=12).mistaken("mirrored")
    found = problem.fit()
    rejected = 12 - int(found.inliers.sum())
    assert found.warnings[0].text.startswith("the model is mirrored or the photo is flipped")
    assert found.warnings[0].text.endswith(
        "corrected, 12 of 12 keypoints agree; "
        f"as given, {rejected} ({100 * rejected / 12:.0f} %) are rejected"
    )
    assert found.warnings == Result.from_dict(found.to_dict()).warnings


def test_right_keypoints_raise_no_alarm() -> None:
    assert not any(warning_of(seen(seed)) for seed in range(100))


def test_outliers_raise_no_alarm() -> None:
    for seed in range(100):
        problem = spoiled(seen(seed, count=8 + seed % 5), seed)
        assert not problem.complaint()


def test_moderate_alignments_of_few_keypoints_are_no_chance() -> None:
    """2 outliers of 7 keypoints are found, and random keypoints are refused by their stretch."""
    refused = doubted = accepted = 0
    for seed in range(100):
        problem = seen(seed, BOTTLE, count=7)
        said = spoiled(problem, seed).complaint()
        refused += "no alignment is supported" in said
        doubted += "5 of 7 keypoints agree, hardly more than chance gives" in said
        pixels = np.random.default_rng([seed, 3]).uniform(
            problem.points_2d.min(axis=0), problem.points_2d.max(axis=0), (7, 2)
        )
        scattered = replace(problem, points_2d=pixels).complaint()
        accepted += "no alignment is supported" not in scattered
    assert refused <= 20
    assert doubted >= 8, "these would be refused if chance were not stretched"
    assert not any("hardly more" in seen(seed, count=12).complaint() for seed in range(20))
    assert accepted <= 2


def test_the_share_of_chance_rises_with_the_stretch() -> None:
    shares = [share_as_moderate(np.array([1.0, 1.0, factor]), 2) for factor in (1.1, 2, 10, 1e4)]
    assert 0 < shares[0] < 0.05 > shares[1]
    assert sorted(shares) == shares
    assert shares[-1] > 0.9
    errors, chance = np.full(5, 1.0), Support(np.full(5, 1.0), 7, 5000.0)
    assert log_expected_by_chance(chance, 4, 2.3) > np.log(0.1)
    options = {"max_reproj_error": 3.0, "score": 5.0, "where": "points_2d", "solutions": 2.3}
    with pytest.raises(NoConsensusError):
        check_support([chance], 4, **options)  # type: ignore[arg-type]
    check_support([chance], 4, share=shares[0], **options)  # type: ignore[arg-type]
    few = Support(errors[:4], 7, 5000.0)
    with pytest.raises(NoConsensusError):
        check_support([few], 4, share=shares[0], **options)  # type: ignore[arg-type]


def test_a_flip_about_another_point_than_the_middle_is_named() -> None:
    """The mirrored model is not named there."""
    for seed in range(10):
        problem = seen(seed, camera=OFF_CENTRE).mistaken("flipped")
        found = fit(problem.points_3d, problem.points_2d, problem.camera)
        assert NAMES["flipped"] in found.warnings[0].text


def test_outliers_beside_a_mistake_hide_it_not() -> None:
    for seed in range(20):
        problem = spoiled(seen(seed, count=12), seed).mistaken("swapped")
        assert NAMES["swapped"] in problem.complaint()


def test_a_refusal_names_the_mistake() -> None:
    refused = []
    for seed in range(60):
        try:
            seen(seed).mistaken("swapped").fit()
        except NoConsensusError as error:
            refused.append(error)
    named = [error for error in refused if NAMES["swapped"] in str(error)]
    assert len(named) > 0.8 * len(refused) > 0
    assert named[0].what.startswith("no alignment is supported")


@pytest.mark.parametrize("mistake", ["mirrored", "swapped"])
def test_several_views_share_the_check(mistake: str) -> None:
    named = refused = 0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        views = []
        for _ in range(2):
            pixels = photo(CHAIR * [1.0, 1.1, 0.9], rng, CENTRED)
            wrong = Seen(CHAIR, pixels, CENTRED).mistaken(mistake)
            views.append(View(CENTRED, wrong.points_2d))
        try:
            found = align(Model(points_3d=wrong.points_3d), views, ransac=RansacOptions())
        except NoConsensusError:
            refused += 1
            continue
        named += NAMES[mistake] in found.warnings[0].text
    assert named > 0
    assert named + refused == 10


def test_views_of_a_learned_or_similar_shape_share_it() -> None:
    rng = np.random.default_rng(5)
    model = CHAIR + rng.normal(0, 0.005, CHAIR.shape)
    right = Seen(model, photo(CHAIR, rng, CENTRED), CENTRED)
    options = RansacOptions(max_reproj_error=8.0)
    for problem, wanted in ((right.mistaken("swapped"), True), (spoiled(right, 0), False)):
        view = View(CENTRED, problem.points_2d)
        found = align(Model(points_3d=model, shape_sigma=0.005), view, ransac=options)
        assert (NAMES["swapped"] in " ".join(map(str, found.warnings))) == wanted


@pytest.mark.parametrize("mistake", ["mirrored", "swapped"])
def test_likelihoods_tell_mistakes_that_a_similar_model_follows(mistake: str) -> None:
    named = alarms = followed = 0
    for seed in range(16):
        rng = np.random.default_rng([seed, 2])
        right = seen(seed, count=8)
        similar = replace(right, points_3d=right.points_3d + rng.normal(0, 0.02, (8, 3)))
        for problem in (similar, similar.mistaken(mistake)):
            model = Model(points_3d=problem.points_3d, shape_sigma=0.02)
            found = align(model, View(CENTRED, problem.points_2d), ransac=RansacOptions())
            texts = [text for text in map(str, found.warnings) if NAMES[mistake] in text]
            if problem is similar:
                alarms += bool(texts)
            elif found.inliers.mean() > 0.9:
                followed += 1
                named += bool(texts)
    assert alarms == 0
    assert named >= 0.3 * followed > 0


@pytest.mark.parametrize(
    "view",
    [{"sigma": 1.0}, {"sigma": 3.0}, {}, {"sigma": 3.0, "spread": 0.03}, {"ransac": True}],
    ids=["1 px", "3 px", "unknown noise", "similar model", "robust"],
)
def test_an_up_that_points_down_is_told_to_be_the_opposite(view: dict[str, Any]) -> None:
    """It is not named if gravity is correct, or wrong by another angle."""
    view = dict(view)
    spread, noise = view.pop("spread", None), view.get("sigma", 3.0)
    more = {"ransac": RansacOptions()} if view.pop("ransac", False) else {}
    for seed in range(4):
        rng = np.random.default_rng(seed)
        points = keypoints(10, seed)
        truth = truth_of((1.0, 0.8, 1.3))
        pixels = seen_in_scene(points, truth, np.eye(4)).pixels
        pixels = pixels + rng.normal(0, noise, pixels.shape)
        model = Model(points_3d=points, shape_sigma=spread)
        up = truth.rotation[:, 1]
        told = {}
        for name, each in {"down": -up, "right": up, "aside": turned(up, 25, rng)}.items():
            told[name] = said(partial(align, model, View(SCENE, pixels, up=each, **view), **more))
        assert "opposite" in told["down"]
        assert "opposite" not in told["right"] + told["aside"]


def test_an_endless_extent_of_keypoints_is_cut_to_the_image() -> None:
    points = np.array([[0.0, 0.0], [1e308, 275.0], [-1e308, 100.0]])
    assert area_of(points, CENTRED, 2.0) == 640 * 480
