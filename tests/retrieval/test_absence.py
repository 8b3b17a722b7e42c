"""The probability that the object is none of the library's models."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cadalign import Alignment, Camera, Library
from cadalign.retrieval import LibraryModel, Match
from cadalign.retrieval.absence import distances, shape_distance

CAMERA = Camera(640, 480, 935.0, 935.0, 319.5, 239.5)
BOUNDS = np.array([[-0.3] * 3, [0.3] * 3])
BASE = np.random.default_rng(7).uniform(-0.3, 0.3, (10, 3))


def shape(seed: int) -> np.ndarray:
    """Keypoints of a model or an object: the category's, with noise of about 3 % of the extent."""
    return BASE + np.random.default_rng([5, seed]).normal(0, 0.03, BASE.shape)


LIBRARY = Library.from_models(
    LibraryModel("box", f"{seed:02}", shape(seed), np.arange(len(BASE)), BOUNDS)
    for seed in range(30)
)


def retrieve(seed: int, *, count: int = 10, **options: object) -> list[Match]:
    """Matches of a view of the stretched object of a seed; seeds below 30 are in LIBRARY."""
    rng = np.random.default_rng([6, seed])
    scale = np.array([1.0, *rng.uniform(0.7, 1.4, 2)])
    pose = Alignment(Rotation.random(random_state=rng).as_matrix(), [0.0, 0.0, 2.0], scale)
    pixels = CAMERA.project(pose.apply(shape(seed)))[:count]
    pixels += rng.normal(0, 1, pixels.shape)
    return LIBRARY.retrieve(pixels, np.arange(count), CAMERA, **options)


@pytest.mark.long
def test_objects_outside_the_library_are_detected() -> None:
    inside = np.array([retrieve(seed)[0].none_probability for seed in range(30)])
    outside = np.array([retrieve(seed)[0].none_probability for seed in range(30, 60)])
    assert (inside > 0.5).mean() <= 0.1  # false positives
    assert (outside < 0.5).mean() <= 0.1  # false negatives


@pytest.mark.slow
def test_all_matches_have_the_same_probability() -> None:
    matches = retrieve(31)
    assert len({match.none_probability for match in matches}) == 1
    assert matches[0].to_dict()["none_probability"] == matches[0].none_probability


def test_keypoints_that_fit_any_model_are_undecided() -> None:
    probabilities = [retrieve(seed, count=4)[0].none_probability for seed in (1, 2, 40, 41)]
    np.testing.assert_allclose(probabilities, 0.5, atol=0.15)


def test_top_does_not_change_the_probability() -> None:
    assert retrieve(40, top=1)[0].none_probability == pytest.approx(
        retrieve(40, top=20)[0].none_probability, rel=1e-6
    )


def test_distances_of_a_category_are_those_of_its_pairs_of_models() -> None:
    models = [
        replace(model, xyz=model.xyz[keep], ids=model.ids[keep])
        for seed, model in enumerate(LIBRARY)
        for keep in [np.random.default_rng(seed).permutation(10)[: 3 + seed % 8]]
    ]
    library = Library.from_models(models)
    _, points = library.keypoints_of("box")
    rows = np.array([0, 4, 17])
    every = list(library)
    for row in rows:
        found = distances(points, points[row], least=4)
        for model, distance in zip(every, found, strict=True):
            shared = np.intersect1d(model.ids, every[row].ids)
            if len(shared) < 4:
                assert np.isnan(distance)
                continue
            # Distances are shares of the extent of all keypoints of the true model.
            part = np.isin(every[row].ids, shared)
            extents = [
                np.linalg.norm(np.ptp(xyz, axis=0))
                for xyz in (every[row].xyz[part], every[row].xyz)
            ]
            expected = shape_distance(model, every[row]) * extents[0] / extents[1]
            assert distance == pytest.approx(expected, abs=1e-7)
