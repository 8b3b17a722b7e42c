"""Learning of a shape model's components, with hyperparameters chosen by cross-validation.

Likelihoods are computed at the accuracy of images, `_RESOLUTION`, so that details which no photo
shows do not decide.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray, require_counts
from cadalign.errors import InputError
from cadalign.shapes.basis import (
    Mirror,
    component_of_covariance,
    find_mirror,
    is_symmetry,
    mirror_rows,
)
from cadalign.shapes.calibration import ShapeCalibration, box_excesses, calibrate, learn_margins
from cadalign.shapes.examples import Example, tabulate
from cadalign.shapes.gaussians import (
    Gaussians,
    Vectors,
    learn_gaussian,
    learn_mixture,
    log_likelihoods,
)
from cadalign.shapes.parts import BoxMargins

# Lengths relative to the models' median diagonal.
_FLOOR = 1e-3
_RESOLUTION = 5e-3  # 2 px for an object's diagonal of 400 px
_UNLIKE = 0.01  # share of models that are outliers
_TOLERANCE = 0.5  # in the mean log-likelihood of models
_MODE_TOLERANCE = 0.1  # smaller, since modes cost little time
_FOLDS = 3
_MOST_CALIBRATED = 80  # models of a fold
_LEAST_TO_CHOOSE = 12  # fewer models are held out one by one, with fewer choices
_ROUNDS = 25
_STRENGTHS = (0.0, 0.1, 1.0, 10.0)
_STRENGTHS_OF_FEW = (0.1, 1.0)
_MIXTURE_STRENGTH = 10.0
_MOST_COMPONENTS = 4  # aligning an image takes one search for each
_CLUSTER_MODES = 10
_CLUSTERINGS = 5
_MODES = (5, 10, 15, 20, 30, 40, 50, 60, 80, 100)


@dataclass(frozen=True)
class _Recipe:
    """Hyperparameters of learning."""

    strength: float = _STRENGTHS[1]
    mirror: Mirror | None = None
    components: int = 1


@dataclass(frozen=True, eq=False)
class _Models:
    """Models to learn from."""

    rows: FloatArray  # (N, m + 2, 3), keypoints and box corners, NaN if missing
    size: float  # median diagonal
    _cache: dict[_Recipe, tuple[Vectors, Gaussians]] = field(default_factory=dict)

    def subset(self, chosen: BoolArray) -> _Models:
        """Select models by a mask (N,)."""
        return _Models(self.rows[chosen], self.size)

    @cached_property
    def vectors(self) -> Vectors:
        """The models, without mirror images."""
        return _vectors(self.rows, None)

    def complete(self) -> FloatArray:
        """Fill missing keypoints with their expectations, (N, m + 2, 3) float."""
        common = self.common(_Recipe(strength=0.0))[1]
        return self.vectors.complete(common).reshape(self.rows.shape)

    def common(self, recipe: _Recipe) -> tuple[Vectors, Gaussians]:
        """Vectors to learn from and the Gaussian of all, which all numbers of components share."""
        single = replace(recipe, components=1)
        if single not in self._cache:
            vectors = _vectors(self.rows, recipe.mirror)
            floor, strength = _FLOOR * self.size, recipe.strength
            gaussian = learn_gaussian(vectors, strength=strength, floor=floor, rounds=_ROUNDS)
            self._cache[single] = vectors, gaussian
        return self._cache[single]

    def mixture(self, recipe: _Recipe) -> Gaussians:
        """Learn a mixture by a recipe."""
        vectors, common = self.common(recipe)
        if recipe.components == 1:
            return common
        return learn_mixture(
            vectors,
            _clusters(vectors, common, recipe.components),
            common,
            strength=_MIXTURE_STRENGTH,
            floor=_FLOOR * self.size,
            rounds=_ROUNDS,
        )

    def log_likelihoods(self, mixture: Gaussians) -> FloatArray:
        """Log-likelihood of each model at the resolution of images, (N,) float.

        A broad component for 1 % of the models limits the influence of outliers on the choice
        between mixtures.
        """
        common = log_likelihoods(self.vectors, mixture.widen(_RESOLUTION * self.size))
        broad = Gaussians(
            np.ones(1),
            mixture.means.mean(axis=0)[None],
            self.size**2 * np.eye(mixture.means.shape[1])[None],
        )
        unlike = log_likelihoods(self.vectors, broad)
        return np.logaddexp(math.log1p(-_UNLIKE) + common, math.log(_UNLIKE) + unlike)


@dataclass(frozen=True, eq=False)
class _Trial:
    """Result of cross-validation of a recipe."""

    recipe: _Recipe
    learned: tuple[Gaussians, ...]  # one for each fold, learned from the other folds
    scores: FloatArray  # (N,), log-likelihood of each model, held out


class _CrossValidation:
    """Choice of a recipe by the likelihood of held-out models."""

    def __init__(self, models: _Models) -> None:
        self._models = models
        count = len(models.rows)
        folds = _FOLDS if count >= _LEAST_TO_CHOOSE else count
        self._folds = np.random.default_rng(0).permutation(count) % folds
        self._kept = [models.subset(self._folds != fold) for fold in range(folds)]
        self._held_out = [models.subset(self._folds == fold) for fold in range(folds)]

    def choose(self, components: int | None) -> tuple[_Recipe, int | None, dict[str, Any]]:
        """Choose a recipe and the number of modes, and calibrate them; returns also the fields."""
        count = len(self._models.rows)
        is_few, modes = count < _LEAST_TO_CHOOSE, None
        strengths = _STRENGTHS_OF_FEW if is_few else _STRENGTHS
        best = self._best(_Recipe(each) for each in strengths)
        if is_few:
            recipe = replace(best.recipe, components=components or 1)
            if recipe.components > 1:  # at most one for each model of a fold
                most = min(recipe.components, count - 1)
                best = self._try(replace(recipe, components=most))
        else:
            best = self._choose_components(self._try_mirrors(best), components)
            recipe, modes = best.recipe, self._choose_modes(best)
        figures = self._calibration(best, modes)._asdict()
        return recipe, modes, figures | {"box_margins": self._margins(best)}

    def _try_mirrors(self, best: _Trial) -> _Trial:
        completed = self._models.complete()
        found = [find_mirror(completed, axis) for axis in range(3)]
        mirrors = [each for each in found if is_symmetry(completed, each)]
        if not mirrors:
            return best
        mirrored = self._best(replace(best.recipe, mirror=each) for each in mirrors)
        # A mirror doubles the training data, so it may score slightly worse.
        return mirrored if _is_good(mirrored.scores, best.scores, _TOLERANCE) else best

    def _choose_components(self, single: _Trial, wanted: int | None) -> _Trial:
        if wanted is not None:
            return self._try(replace(single.recipe, components=wanted))
        counts = range(2, _MOST_COMPONENTS + 1)
        tried = [single, *(self._try(replace(single.recipe, components=each)) for each in counts)]
        return tried[_first_good([each.scores for each in tried], _TOLERANCE)]

    def _choose_modes(self, trial: _Trial) -> int:
        full = self._models.rows[0].size
        counts = [*(count for count in _MODES if count < full), full]
        parts = [[_truncate(each, count) for each in trial.learned] for count in counts]
        return int(counts[_first_good([self._scores(each) for each in parts], _MODE_TOLERANCE)])

    def _calibration(self, trial: _Trial, modes: int | None) -> ShapeCalibration:
        held_out = [
            (self._models.rows[self._folds == fold][:_MOST_CALIBRATED], _truncate(mixture, modes))
            for fold, mixture in enumerate(trial.learned)
        ]
        sigma = _RESOLUTION * self._models.size
        return calibrate(held_out, sigma=sigma, rng=np.random.default_rng(0))

    def _margins(self, trial: _Trial) -> BoxMargins | None:
        rows = self._models.rows
        excesses = np.empty((len(rows), 2, 3))
        for fold, mixture in enumerate(trial.learned):
            held_out = self._folds == fold
            excesses[held_out] = box_excesses(rows[held_out], mixture)
        return learn_margins(rows, excesses)

    def _best(self, recipes: Iterable[_Recipe]) -> _Trial:
        return max(map(self._try, recipes), key=lambda trial: float(trial.scores.sum()))

    def _try(self, recipe: _Recipe) -> _Trial:
        learned = tuple(kept.mixture(recipe) for kept in self._kept)
        return _Trial(recipe, learned, self._scores(learned))

    def _scores(self, learned: Sequence[Gaussians]) -> FloatArray:
        found = np.empty(len(self._folds))
        for fold, mixture in enumerate(learned):
            found[self._folds == fold] = self._held_out[fold].log_likelihoods(mixture)
        return found


def learn_parts(
    examples: Sequence[Example], category: str, components: int | None
) -> dict[str, Any]:
    """Learn the fields of a shape model except category, axis and unit; see `ShapeModel.learn`."""
    require_counts(components=1 if components is None else components)
    ids, rows, training = tabulate(examples, category)
    if (components or 1) > len(rows):
        what = f"{components} are more than the {len(rows)} models"
        raise InputError(what, where="components")
    extents = np.nanmax(rows, axis=1) - np.nanmin(rows, axis=1)
    models = _Models(rows, float(np.median(np.linalg.norm(extents, axis=1))))
    recipe, modes, calibration = _CrossValidation(models).choose(components)
    parts = sorted(zip(*models.mixture(recipe), strict=True), key=lambda part: -part[0])
    total = sum(weight for weight, _, _ in parts)
    learned = (
        component_of_covariance(
            mean.reshape(-1, 3), covariance, weight=float(weight / total), modes=modes
        )
        for weight, mean, covariance in parts
    )
    has = np.isfinite(rows[:, : len(ids), 0])
    return {
        "ids": ids,
        "components": tuple(learned),
        "training": training,
        "shares": tuple(has.mean(axis=0).round(3).tolist()),
        **calibration,
    }


def _vectors(rows: FloatArray, mirror: Mirror | None) -> Vectors:
    """Flatten models to vectors; with a mirror, add mirror images and halve the weights."""
    weight = 1.0
    if mirror is not None:
        rows = np.concatenate([rows, mirror_rows(rows, mirror)])
        weight = 0.5
    return Vectors(rows.reshape(len(rows), -1), np.full(len(rows), weight))


def _clusters(vectors: Vectors, common: Gaussians, count: int) -> IntArray:
    """Cluster the completed vectors by their main coefficients."""
    from scipy.cluster.vq import kmeans2

    _, directions = np.linalg.eigh(common.covariances[0])
    coefficients = (vectors.complete(common) - common.means[0]) @ directions[:, -_CLUSTER_MODES:]
    tries = []
    for seed in range(_CLUSTERINGS):
        with warnings.catch_warnings():
            # For empty clusters and for identical vectors.
            warnings.simplefilter("ignore", UserWarning)
            warnings.simplefilter("ignore", RuntimeWarning)
            centres, labels = kmeans2(coefficients, count, minit="++", seed=seed)
        tries.append((float(((coefficients - centres[labels]) ** 2).sum()), seed, labels))
    labels = min(tries)[2].astype(np.int64)
    labels[np.arange(count) % len(labels)] = np.arange(count)  # no cluster is empty
    return np.asarray(labels)


def _truncate(mixture: Gaussians, modes: int | None) -> Gaussians:
    """Reduce a mixture to a number of modes."""
    parts = [
        component_of_covariance(mean.reshape(-1, 3), covariance, modes=modes).covariance
        for mean, covariance in zip(mixture.means, mixture.covariances, strict=True)
    ]
    return Gaussians(mixture.weights, mixture.means, np.array(parts))


def _first_good(scores: Sequence[FloatArray], tolerance: float) -> int:
    """Index of the first scores that are about as good as the best; see `_is_good`."""
    best = max(scores, key=np.sum)
    return next(row for row, each in enumerate(scores) if _is_good(each, best, tolerance))


def _is_good(scores: FloatArray, best: FloatArray, tolerance: float) -> bool:
    """True if the mean loss is at most a tolerance or its standard error."""
    losses = best - scores
    return float(losses.mean()) <= max(tolerance, float(losses.std()) / math.sqrt(len(losses)))
