"""`Library.retrieve`: likelihood, bound, contents of matches, and invalid arguments."""

from __future__ import annotations

import inspect
import re
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import eigh

from cadalign import Alignment, Box, Camera, Library, fit
from cadalign.errors import DegenerateError, InputError
from cadalign.estimation.options import LOSSES
from cadalign.evaluation.simulation import random_rotation
from cadalign.retrieval import LibraryModel, Match, ranking
from cadalign.retrieval.absence import shape_distance
from cadalign.retrieval.kernels import error_bound, search_all
from cadalign.retrieval.options import RetrievalOptions
from cadalign.retrieval.ranking import Ranking, apply_loss, gather_candidates, observe, rank

CAMERA = Camera(width=640, height=480, fx=935.0, fy=935.0, cx=319.5, cy=239.5)
LENS = replace(CAMERA, distortion=(-0.1, 0.03, 0.001, -0.002))
FISHEYE = Camera(900, 900, 250.0, 250.0, 449.5, 449.5, (0.01, -0.003, 0.0, 0.0), lens="fisheye")
IDS = np.arange(10)


def make_model(number: int, ids: Sequence[int] = tuple(IDS), category: str = "box") -> LibraryModel:
    """A model whose keypoints only depend on its number and their ids."""
    xyz = np.array([np.random.default_rng([number, i]).uniform(-0.3, 0.3, 3) for i in ids])
    bounds = np.array([[-0.3] * 3, [0.3] * 3])
    return LibraryModel(category, f"{number:03d}", xyz, np.array(ids), bounds)


MODELS = [make_model(number) for number in range(60)]
LIBRARY = Library.from_models(MODELS)


def pose_of(seed: int, scale: tuple[float, float] = (1.4, 0.7)) -> Alignment:
    rng = np.random.default_rng(seed)
    return Alignment(random_rotation(rng), np.array([0.05, -0.02, 2.3]), np.array([1.0, *scale]))


def view(
    model: LibraryModel, pose: Alignment, *, noise_px: float = 0.0, seed: int = 0, camera=CAMERA
) -> np.ndarray:
    pixels = camera.project(pose.apply(model.xyz))
    return pixels + noise_px * np.random.default_rng(seed).standard_normal(pixels.shape)


def names(matches: Sequence[Match]) -> list[str]:
    return [match.model_id for match in matches]


def same(one: Sequence[Match], other: Sequence[Match]) -> bool:
    return [m.to_dict() for m in one] == [m.to_dict() for m in other]


# --- what it finds ---------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("camera", [CAMERA, LENS, FISHEYE], ids=["pinhole", "lens", "fisheye"])
def test_the_model_is_found_with_pose_and_stretch(camera: Camera) -> None:
    for number in (0, 17, 59):
        pose = pose_of(number)
        if camera.is_wide:  # beside the camera, behind its plane
            pose = Alignment(pose.rotation, [1.6, 0.3, -0.2], pose.scale)
        pixels = view(MODELS[number], pose, camera=camera)
        best = LIBRARY.retrieve(pixels, IDS, camera)[0]
        assert best.model_id == f"{number:03d}"
        assert best.score > 0.999
        assert best.rms < 0.05
        np.testing.assert_allclose(best.alignment.scale, pose.scale, rtol=0.01)
        np.testing.assert_allclose(best.alignment.rotation, pose.rotation, atol=0.01)


def test_contents_of_a_match_agree_with_its_pose() -> None:
    model = MODELS[3]
    pixels = view(model, pose_of(3), noise_px=2.0)
    shown = [1, 2, 4, 5, 6, 7, 8, 9]
    best = LIBRARY.retrieve(pixels[shown], IDS[shown], CAMERA, sigma=2.0)[0]
    assert best.model_id == "003"
    assert best.shared == 8
    assert best.missing_ids == ()
    found = best.result
    assert list(found.ids) == shown
    np.testing.assert_array_equal(found.points_3d, model.xyz[shown])
    np.testing.assert_array_equal(found.views[0].points_2d, pixels[shown])
    projected = CAMERA.project(best.alignment.apply(model.xyz[shown]))
    np.testing.assert_allclose(found.residuals, projected - pixels[shown])
    box = Box.from_model(model.bounds, best.alignment)
    np.testing.assert_array_equal(best.box.corners, box.corners)
    assert repr(best).startswith("Match('box', '003', score=")


@pytest.mark.long
def test_the_alignment_is_the_optimum_that_fit_finds() -> None:
    for number in range(6):
        pixels = view(MODELS[number], pose_of(number), noise_px=2.0, seed=number)
        best = LIBRARY.retrieve(pixels, IDS, CAMERA, sigma=2.0)[0]
        fitted = fit(MODELS[number].xyz, pixels, CAMERA, sigma=2.0, stretch_sigma=0.4)
        np.testing.assert_allclose(best.alignment.rotation, fitted.alignment.rotation, atol=1e-6)
        np.testing.assert_allclose(best.alignment.scale, fitted.alignment.scale, rtol=1e-6)


@pytest.mark.parametrize("camera", [CAMERA, FISHEYE], ids=["pinhole", "fisheye"])
@pytest.mark.parametrize("loss", ["linear", "cauchy"])
def test_std_of_a_match_is_that_of_a_fit(camera: Camera, loss: str) -> None:
    pixels = view(MODELS[1], pose_of(1), noise_px=2.0, camera=camera)
    options: dict[str, Any] = {"sigma": 2.0, "loss": loss}
    best = LIBRARY.retrieve(pixels, IDS, camera, **options)[0]
    fitted = fit(MODELS[1].xyz, pixels, camera, stretch_sigma=0.4, **options)
    np.testing.assert_allclose(best.result.covariance, fitted.covariance, rtol=0.01, atol=1e-7)
    assert best.result.uncertain == fitted.uncertain
    assert best.stretch_texts[0].endswith(f" +- {100 * fitted.std.scale[1]:.2g} %")


def test_log_likelihood_follows_the_documented_formula() -> None:
    """For a model that lacks keypoints of the image, and has keypoints that the image lacks."""
    model = make_model(5, ids=(0, 1, 2, 3, 4, 5, 8, 9))
    library = Library.from_models([model, make_model(6, ids=(6, 7))])
    whole = make_model(5)
    shown = [0, 1, 2, 3, 4, 5, 6, 7]
    pixels = view(whole, pose_of(2), noise_px=1.5)[shown]
    sigma = np.linspace(1.0, 2.0, 8)
    (match,) = library.retrieve(pixels, shown, CAMERA, sigma=sigma)
    shared = slice(0, 6)
    residuals = CAMERA.project(match.alignment.apply(model.xyz[shared])) - pixels[shared]
    gaussian = -((residuals / sigma[shared, None]) ** 2).sum(axis=1) / 2
    gaussian -= np.log(2 * np.pi * sigma[shared] ** 2)
    logs = np.log(match.alignment.scale[1:])
    prior = -(logs**2 / (2 * 0.4**2)) - np.log(0.4 * np.sqrt(2 * np.pi))
    expected = (
        (np.log(0.5) + gaussian).sum()
        + 2 * np.log(0.5)
        + 2 * np.log(0.01 / (640 * 480))
        + prior.sum()
    )
    assert match.log_likelihood == pytest.approx(expected, abs=1e-9)
    assert match.missing_ids == (6, 7)


def test_scores_are_likelihoods_over_their_sum() -> None:
    pixels = view(MODELS[8], pose_of(8), noise_px=30.0)[:6]
    matches = LIBRARY.retrieve(pixels, IDS[:6], CAMERA, sigma=30.0, top=60)
    assert len(matches) == 60
    scores = np.array([match.score for match in matches])
    assert scores.sum() == pytest.approx(1.0)
    logs = np.array([match.log_likelihood for match in matches])
    np.testing.assert_allclose(scores, np.exp(logs - logs[0]) * scores[0], rtol=1e-9)
    assert (np.diff(scores) <= 0).all()
    assert 0.02 < scores[0] < 0.98  # otherwise the test is trivial


def test_a_model_that_lacks_keypoints_of_the_image_has_to_fit_much_better() -> None:
    """Fewer keypoints are easier to fit, but must not rank higher."""
    few = [make_model(100 + n, ids=(0, 1, 2, 3)) for n in range(200)]
    library = Library.from_models([MODELS[0], *few])
    matches = library.retrieve(view(MODELS[0], pose_of(1), noise_px=2.0), IDS, CAMERA, sigma=2.0)
    assert matches[0].model_id == "000"
    assert matches[0].score > 0.999
    assert matches[1].shared == 4
    assert matches[1].missing_ids == (4, 5, 6, 7, 8, 9)
    assert matches[1].rms < matches[0].rms


def test_hidden_keypoints_hardly_count() -> None:
    """Each keypoint of a model that the image lacks costs log 2."""
    model = make_model(7, ids=range(8))
    library = Library.from_models([model, replace(make_model(7), model_id="more")])
    pixels = view(model, pose_of(4), noise_px=1.0)
    first, second = library.retrieve(pixels, np.arange(8), CAMERA)
    assert names([first, second]) == ["007", "more"]
    assert first.log_likelihood - second.log_likelihood == pytest.approx(2 * np.log(2))


@pytest.mark.long
def test_each_keypoint_may_have_its_own_sigma_or_covariance() -> None:
    pixels = view(MODELS[2], pose_of(2), noise_px=2.0)
    one = LIBRARY.retrieve(pixels, IDS, CAMERA, sigma=2.0)
    each = LIBRARY.retrieve(pixels, IDS, CAMERA, sigma=np.full(10, 2.0))
    full = LIBRARY.retrieve(pixels, IDS, CAMERA, sigma=np.tile(4.0 * np.eye(2), (10, 1, 1)))
    assert names(one) == names(each) == names(full)
    assert one[0].log_likelihood == pytest.approx(each[0].log_likelihood)
    assert one[0].log_likelihood == pytest.approx(full[0].log_likelihood)
    pixels[4] += (60.0, 0.0)
    sigma = np.where(IDS == 4, 50.0, 2.0)
    assert LIBRARY.retrieve(pixels, IDS, CAMERA, sigma=sigma)[0].model_id == "002"


def test_shape_sigma_adds_a_share_of_the_extent_to_the_noise() -> None:
    pixels = view(MODELS[2], pose_of(2), noise_px=2.0)
    extent = np.linalg.norm(np.ptp(pixels, axis=0))
    one = LIBRARY.retrieve(pixels, IDS, CAMERA, sigma=2.0, shape_sigma=0.03)
    sigma = float(np.hypot(2.0, 0.03 * extent))
    other = LIBRARY.retrieve(pixels, IDS, CAMERA, sigma=sigma)
    assert names(one) == names(other)
    assert one[0].log_likelihood == pytest.approx(other[0].log_likelihood)


@pytest.mark.long
def test_a_robust_loss_tolerates_outliers() -> None:
    found = {"linear": 0, "cauchy": 0}
    for number in range(8):
        pixels = view(MODELS[number], pose_of(number), noise_px=1.0, seed=number)
        pixels[[2, 5, 7]] = pixels[[5, 7, 2]] + [[90.0, -50.0], [-60.0, 80.0], [40.0, 60.0]]
        for loss in found:
            best = LIBRARY.retrieve(pixels, IDS, CAMERA, loss=loss)[0]
            found[loss] += best.model_id == f"{number:03d}"
    assert found["cauchy"] == 8
    assert found["linear"] <= 4


class TestStretch:
    def test_no_model_is_stretched_beyond_the_limit(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("cadalign.retrieval.options.STRETCH_SIGMA", 10.0)
        pixels = view(MODELS[4], pose_of(4, scale=(6.0, 1.0)))
        found = LIBRARY.retrieve(pixels, IDS, CAMERA, top=60)
        held = next(match for match in found if match.model_id == "004")
        assert held.alignment.scale[1] == pytest.approx(4.0)
        fitted = fit(MODELS[4].xyz * [1, 4, 1], pixels, CAMERA, stretch="z")
        assert held.rms == pytest.approx(fitted.rms, rel=1e-3)
        scales = np.array([match.alignment.scale[1:] for match in found])
        assert np.abs(np.log(scales)).max() <= np.log(4.0) + 1e-12

    def test_the_prior_keeps_a_model_from_being_flattened_to_win(self) -> None:
        """Two models, one the other squeezed to a third: the nearer one to the object wins."""
        tall = MODELS[0]
        flat = replace(tall, model_id="flat", xyz=tall.xyz * [1, 1 / 3, 1])
        library = Library.from_models([tall, flat])
        pixels = view(tall, pose_of(1, scale=(1.1, 1.0)))
        first, second = library.retrieve(pixels, IDS, CAMERA)
        assert names([first, second]) == ["000", "flat"]
        assert second.alignment.scale[1] == pytest.approx(3.3, rel=0.02)
        # The density of log 3.3 over that of log 1.1.
        ratio = np.exp((np.log(1.1) ** 2 - np.log(3.3) ** 2) / (2 * 0.4**2))
        assert second.score / first.score == pytest.approx(ratio, rel=0.1)

    def test_axes_can_be_held(self) -> None:
        pixels = view(MODELS[4], pose_of(4, scale=(1.5, 1.0)))
        (best, *_) = LIBRARY.retrieve(pixels, IDS, CAMERA, stretch="y")
        assert best.model_id == "004"
        assert best.alignment.scale[2] == 1
        (best, *_) = LIBRARY.retrieve(
            view(MODELS[4], pose_of(4, (1, 1))), IDS, CAMERA, stretch="none"
        )
        assert best.model_id == "004"
        assert best.alignment.scale.tolist() == [1, 1, 1]

    def test_flat_models_can_be_retrieved(self) -> None:
        models = [replace(m, xyz=m.xyz * [1, 1, 0]) for m in MODELS[:20]]
        pixels = view(models[5], pose_of(5, scale=(1.2, 1.0)), noise_px=0.5)
        best = Library.from_models(models).retrieve(pixels, IDS, CAMERA)[0]
        assert best.model_id == "005"
        assert best.alignment.scale[1] == pytest.approx(1.2, rel=0.05)


class TestCategories:
    LIBRARY = Library.from_models(
        [*MODELS, *(make_model(n, category="can") for n in range(60, 90))]
    )

    @pytest.mark.slow
    def test_without_a_name_all_are_compared(self) -> None:
        for number, category in ((3, "box"), (70, "can")):
            pixels = view(make_model(number), pose_of(number), noise_px=0.5)
            best = self.LIBRARY.retrieve(pixels, IDS, CAMERA)[0]
            assert (best.category, best.model_id) == (category, f"{number:03d}")

    def test_a_named_one_is_the_only_one(self) -> None:
        pixels = view(make_model(70), pose_of(7), noise_px=0.5)
        alone = self.LIBRARY.retrieve(pixels, IDS, CAMERA, category="box")
        assert {match.category for match in alone} == {"box"}
        assert same(alone, LIBRARY.retrieve(pixels, IDS, CAMERA))

    @pytest.mark.long
    def test_models_can_be_excluded(self) -> None:
        pixels = view(MODELS[3], pose_of(3), noise_px=0.5)
        rest = self.LIBRARY.retrieve(pixels, IDS, CAMERA, exclude=[("box", "003")], top=90)
        assert ("box", "003") not in {(match.category, match.model_id) for match in rest}
        assert same(
            rest[:5],
            Library.from_models([m for m in self.LIBRARY if m.key != ("box", "003")]).retrieve(
                pixels, IDS, CAMERA, top=5
            ),
        )
        with pytest.raises(InputError, match="exclude: all models are excluded"):
            self.LIBRARY.retrieve(pixels, IDS, CAMERA, exclude=self.LIBRARY.keys)

    @pytest.mark.parametrize("key", ["003", ("box", 3), ["box"]])
    def test_what_names_no_model_to_exclude_is_refused(self, key: Any) -> None:
        pixels = view(self.LIBRARY["box", "003"], pose_of(3))
        with pytest.raises(InputError, match="is not a model's category and id"):
            self.LIBRARY.retrieve(pixels, IDS, CAMERA, exclude=[key])


# --- the bound and the order -----------------------------------------------------------------


@pytest.mark.slow
@given(
    seed=st.integers(0, 10_000),
    count=st.integers(6, 12),
    depth=st.floats(0.4, 5.0),
    noise_px=st.floats(0.0, 200.0),
    own_sigmas=st.booleans(),
    loss=st.sampled_from(["linear", "huber", "cauchy"]),
)
def test_no_pose_has_errors_below_the_bound(
    seed: int, count: int, depth: float, noise_px: float, own_sigmas: bool, loss: str
) -> None:
    """Also for close poses, with large ratios of depths."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-0.3, 0.3, (count, 3)) * rng.uniform(0.02, 1.0, 3)
    pose = Alignment(
        random_rotation(rng), np.array([0, 0, depth]), np.array([1, *rng.uniform(0.3, 3, 2)])
    )
    inside = pose.apply(xyz)
    if inside[:, 2].min() < 0.02:
        return
    pixels = CAMERA.project(inside)
    seen = pixels + noise_px * rng.standard_normal(pixels.shape)
    covariances = np.tile(np.eye(2), (count, 1, 1))
    if own_sigmas:
        factors = rng.normal(size=(count, 2, 2)) + 2 * np.eye(2)
        covariances = factors @ factors.transpose(0, 2, 1)
    options = RetrievalOptions(sigma=covariances, loss=loss, loss_scale=1.5)
    model = LibraryModel("box", "1", xyz, np.arange(count), np.zeros((2, 3)))
    field = gather_candidates(
        Library.from_models([model]),
        observe(seen, np.arange(count), CAMERA, options),
        options,
        exclude=(),
    )
    errors = pixels - seen
    squares = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors)
    cost = apply_loss(squares, LOSSES[loss], 1.5).sum()
    assert field.bounds[0] <= cost * (1 + 1e-9) + 1e-9


def depth_variances(
    a: np.ndarray, rays: np.ndarray, multipliers: np.ndarray
) -> tuple[np.ndarray, float, float]:
    """a_i' S^-1 a_i of the linear problem S, its least eigenvalue, and the largest leverage."""
    (u, v), w = rays.T, multipliers
    p = (a.T * w) @ a
    p_u, p_v = (a.T * (w * u)) @ a, (a.T * (w * v)) @ a
    s = (a.T * (w * (u**2 + v**2))) @ a
    s -= p_u @ np.linalg.solve(p, p_u) + p_v @ np.linalg.solve(p, p_v)
    least = eigh(s, p, eigvals_only=True)[0]
    leverage = np.einsum("ni,ij,nj->n", a, np.linalg.inv(p), a).max()
    return np.einsum("ni,ij,nj->n", a, np.linalg.inv(s), a), least, leverage


def test_the_bound_is_the_least_error_of_the_linear_problem() -> None:
    for seed in range(10):
        rng = np.random.default_rng(seed)
        points, rays = rng.uniform(-0.3, 0.3, (9, 3)), rng.uniform(-0.2, 0.2, (9, 2))
        seen, weights = rng.permutation(9), rng.uniform(1, 4, 9)
        a, w = np.hstack([np.ones((9, 1)), points]), weights[seen]
        multipliers, bounds = w, []
        for _ in range(3):
            variances, least, leverage = depth_variances(a, rays[seen], multipliers)
            bounds.append((w / (multipliers * variances)).min())
            if multipliers is w:  # the eigenvalue over the leverage is a bound, too, but lower
                assert bounds[0] >= least / leverage
            multipliers = 1 / variances
        in_image = points[np.argsort(seen)]
        assert error_bound(in_image, seen, rays, weights) == pytest.approx(max(bounds), rel=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("loss", ["linear", "huber", "cauchy"])
def test_the_bound_saves_most_searches_and_changes_no_likely_match(
    loss: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    searched: list[int] = []

    def counted(query: Any, keypoints: Any, chosen: np.ndarray, *how: Any) -> Any:
        searched.append(len(chosen))
        return search_all(query, keypoints, chosen, *how)

    monkeypatch.setattr(ranking, "search_all", counted)
    many = Library.from_models([make_model(number) for number in range(1500)])
    options = RetrievalOptions(top=1, loss=loss, loss_scale=3.0)
    observed = observe(view(MODELS[3], pose_of(3), noise_px=1.0), IDS, CAMERA, options)
    candidates = gather_candidates(many, observed, options, ())
    assert (candidates.bounds > 0).all()
    found = rank(candidates, observed, options, -1)
    assert sum(searched) < 500
    every = rank(replace(candidates, bounds=np.full(1500, -np.inf)), observed, options, -1)
    assert sum(searched) > 1500
    assert likely(found) == likely(every)


def likely(found: Ranking) -> list[int]:
    return found.candidates[found.scores > 1e-8].tolist()


@pytest.mark.long
def test_results_do_not_depend_on_orders_or_workers() -> None:
    rng = np.random.default_rng(0)
    shuffled = Library.from_models([MODELS[k] for k in rng.permutation(60)])
    for noise_px in (1.0, 8.0):
        pixels = view(MODELS[5], pose_of(5), noise_px=noise_px)
        one = LIBRARY.retrieve(pixels, IDS, CAMERA, sigma=noise_px, workers=1)
        order = rng.permutation(10)
        assert same(one, shuffled.retrieve(pixels, IDS, CAMERA, sigma=noise_px))
        assert same(one, LIBRARY.retrieve(pixels[order], IDS[order], CAMERA, sigma=noise_px))
        for workers in (2, 5):
            found = LIBRARY.retrieve(pixels, IDS, CAMERA, sigma=noise_px, workers=workers)
            assert same(one, found)


def test_ties_are_broken_by_the_id() -> None:
    twins = [replace(MODELS[3], model_id=name) for name in ("c", "a", "d", "b")]
    for models in (twins, twins[::-1]):
        library = Library.from_models([*MODELS[10:30], *models])
        matches = library.retrieve(view(MODELS[3], pose_of(3), noise_px=1.0), IDS, CAMERA)
        assert names(matches)[:4] == ["a", "b", "c", "d"]
        assert [match.score for match in matches[:4]] == pytest.approx([0.25] * 4)


# --- refusals --------------------------------------------------------------------------------

PIXELS = view(MODELS[0], pose_of(0))


def test_unknown_ids_raise_and_known_ids_are_named() -> None:
    with pytest.raises(InputError, match="library: the library is empty"):
        Library.from_models([]).retrieve(PIXELS, IDS, CAMERA)
    models = [
        make_model(1, ids=(0, 1, 2, 3, 7, 8)),
        make_model(2, ids=range(30, 36), category="can"),
    ]
    library = Library.from_models(models)
    with pytest.raises(
        InputError,
        match=r"no model of the library has .* the semantic id 5; it has 0, 1, 2, 3, 7 and 7 more$",
    ):
        library.retrieve(PIXELS[:6], [0, 1, 2, 3, 7, 5], CAMERA)
    with pytest.raises(InputError, match=r"no model of the category 'box' .* the semantic id 30;"):
        library.retrieve(PIXELS[:6], [0, 1, 2, 3, 7, 30], CAMERA, category="box")


def test_too_few_shared_keypoints_are_refused() -> None:
    models = [make_model(1, ids=range(5)), make_model(2, ids=range(5, 10))]
    with pytest.raises(
        DegenerateError, match=r"no model shares more than 3 keypoints .* at least 4"
    ):
        Library.from_models(models).retrieve(PIXELS[2:8], IDS[2:8], CAMERA)
    with pytest.raises(DegenerateError, match=r"no model shares more than 0 keypoints"):
        LIBRARY.retrieve(np.empty((0, 2)), [], CAMERA)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points_2d": PIXELS[:9]}, r"ids: int64 of shape \(10,\), expected .* \(9,\)"),
        ({"points_2d": PIXELS * np.nan}, "points_2d: NaN or infinite values in rows 0, 1"),
        ({"ids": np.r_[IDS[:9], 3]}, "ids: the semantic id 3 occurs twice"),
        ({"ids": IDS + 0.5}, "ids: float64 of shape"),
        ({"camera": "none"}, "camera: expected a cadalign.Camera, got str"),
        ({"camera": Camera.from_size(640, 480)}, "camera: the focal length is unknown; est"),
        ({"top": 0}, "top: must be a whole number >= 1, not 0"),
        ({"tops": 3}, "unknown option.*'tops'"),
        ({"sigma": 0.0}, "sigma: all values must be > 0"),
        ({"sigma": None}, "sigma: the noise must be known"),
        ({"sigma": np.ones(9)}, r"sigma: shape \(9,\)"),
        ({"shape_sigma": -1.0}, "shape_sigma: must be >= 0, not -1.0"),
        ({"loss": "tukey"}, "loss: unknown loss 'tukey'; known are linear, huber, cauchy"),
        ({"loss_scale": -1}, "loss_scale: -1 is not positive"),
        ({"category": "boxx"}, "category: unknown category 'boxx', did you mean 'box'"),
        ({"stretch": "x"}, "stretch: unknown stretch 'x'"),
        ({"workers": 0}, "workers: must be >= 1, or -1 for all cores, not 0"),
    ],
)
def test_invalid_arguments_are_refused(change: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {"points_2d": PIXELS, "ids": IDS, "camera": CAMERA}
    with pytest.raises(InputError, match=message):
        LIBRARY.retrieve(**{**arguments, **change})


def test_retrieve_names_every_option() -> None:
    text = inspect.getdoc(Library.retrieve) or ""
    assert all(re.search(rf"\b{field.name}\b", text) for field in fields(RetrievalOptions))


# --- shapes ----------------------------------------------------------------------------------


@given(seed=st.integers(0, 1000), y=st.floats(0.3, 3.0), z=st.floats(0.3, 3.0))
def test_shape_distance_ignores_place_and_stretch(seed: int, y: float, z: float) -> None:
    rng = np.random.default_rng(seed)
    model = MODELS[seed % 60]
    order = rng.permutation(10)
    moved = replace(
        model,
        model_id="moved",
        xyz=(model.xyz * [1, y, z] + rng.normal(size=3))[order],
        ids=model.ids[order],
    )
    assert shape_distance(moved, model) < 1e-9
    wider = replace(model, xyz=model.xyz * [1.2, 1, 1])
    assert shape_distance(wider, model) > 0.01


def test_shape_distance_is_a_share_of_the_extent() -> None:
    xyz = np.array([[0.0, 0, 0], [4, 0, 0], [0, 3, 0], [4, 3, 0]])
    gt = LibraryModel("box", "gt", xyz, np.arange(4), np.zeros((2, 3)))
    narrow = replace(gt, xyz=xyz * [0.95, 1, 1])  # each 0.1 off along x, of an extent of 5
    assert shape_distance(narrow, gt) == pytest.approx(0.02)
    with pytest.raises(InputError, match="the categories 'can' and 'box' differ"):
        shape_distance(replace(gt, category="can"), gt)
