"""Learning of a shape model's components; what is not given is chosen by held-out likelihood.

Likelihoods are those of the keypoints as an image shows them, at an accuracy of `_RESOLUTION`:
finer detail would decide otherwise, though no photo tells it.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.cluster.vq import kmeans2
from threadpoolctl import threadpool_limits

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.errors import InputError
from cadalign.shapes.basis import component_of_covariance
from cadalign.shapes.gaussians import (
    Gaussians,
    Vectors,
    learn_gaussian,
    learn_mixture,
    log_likelihoods,
)
from cadalign.shapes.parts import KeypointId, Reflection, ShapeComponent
from cadalign.shapes.reflections import find_reflection, mirrored_rows

LEAST_MODELS = 4
# Lengths relative to the models' median diagonal.
_FLOOR = 1e-3
_RESOLUTION = 5e-3  # 2 px where an object's diagonal has 400
_FOLDS = 3
_LEAST_TO_CHOOSE = 12  # models, below which nothing can be held out
_ROUNDS = 25
_STRENGTHS = (0.0, 0.1, 1.0, 10.0)
_MIXTURE_STRENGTH = 20.0
_MOST_COMPONENTS = 4  # each costs a search of its own when an image is aligned
_CLUSTER_MODES = 10
_CLUSTERINGS = 5
_STEPS = _FOLDS * (len(_STRENGTHS) + 3 + _MOST_COMPONENTS) + 1
_MODES = (5, 10, 15, 20, 30, 40, 50, 60, 80, 100)


@dataclass(frozen=True)
class LearnOptions:
    """Options of `cadalign.ShapeModel.learn`."""

    components: int | None = None
    modes: int | None = None
    reflection: bool = True

    def __post_init__(self) -> None:
        for name in ("components", "modes"):
            value = getattr(self, name)
            whole = isinstance(value, int) and not isinstance(value, bool)
            if value is not None and (not whole or value < 1):
                raise InputError(f"{value!r} is not a whole number >= 1", where=name)


@dataclass(frozen=True, eq=False)
class Learned:
    """Result of `learn_components`."""

    components: tuple[ShapeComponent, ...]
    reflection: Reflection | None


@dataclass(frozen=True)
class _Recipe:
    """Choices that are made before the components are learned."""

    strength: float = _STRENGTHS[1]
    reflection: Reflection | None = None
    components: int = 1


@dataclass(frozen=True, eq=False)
class _Models:
    """Models to learn from.

    Parameters
    ----------
    ids : (m,) int or str
    rows : (N, m + 2, 3) float
        Keypoints and box corners, NaN where missing.
    size : float
        Their median diagonal.
    """

    ids: Sequence[KeypointId]
    rows: FloatArray
    size: float

    def some(self, chosen: BoolArray) -> _Models:
        """A part of the models."""
        return replace(self, rows=self.rows[chosen])

    def completed(self) -> FloatArray:
        """The models with their expected missing keypoints, (N, m + 2, 3) float."""
        vectors = _vectors(self.rows, None, self.ids)
        common = learn_gaussian(vectors, strength=0.0, floor=_FLOOR * self.size, rounds=_ROUNDS)
        return vectors.completed(common).reshape(self.rows.shape)

    def mixture(self, recipe: _Recipe) -> Gaussians:
        """Learn by a recipe."""
        vectors = _vectors(self.rows, recipe.reflection, self.ids)
        floor = _FLOOR * self.size
        common = learn_gaussian(vectors, strength=recipe.strength, floor=floor, rounds=_ROUNDS)
        if recipe.components == 1:
            return common
        return learn_mixture(
            vectors,
            _clusters(vectors, common, recipe.components),
            common,
            strength=_MIXTURE_STRENGTH,
            floor=floor,
            rounds=_ROUNDS,
        )

    def log_likelihoods(self, model: Gaussians) -> FloatArray:
        """Log-likelihood of each model at the resolution of images, (N,) float."""
        seen = model.widened(_RESOLUTION * self.size)
        return log_likelihoods(self.rows.reshape(len(self.rows), -1), seen)


class _Trials:
    """Recipes compared by the likelihood of models that were held out."""

    def __init__(self, models: _Models, on_progress: Callable[[int, int], object]) -> None:
        self._models = models
        self._folds = np.random.default_rng(0).permutation(len(models.rows)) % _FOLDS
        self._on_progress, self._done = on_progress, 0

    def trained(self, recipe: _Recipe) -> list[Gaussians]:
        """What is learned without each fold."""
        return [
            self._stepping(self._models.some(self._folds != fold).mixture(recipe))
            for fold in range(_FOLDS)
        ]

    def scores(self, learned: list[Gaussians]) -> FloatArray:
        """Log-likelihood of each model under what was learned without its fold, (N,) float."""
        found = np.empty(len(self._folds))
        for fold, mixture in enumerate(learned):
            held_out = self._folds == fold
            found[held_out] = self._models.some(held_out).log_likelihoods(mixture)
        return found

    def _stepping(self, learned: Gaussians) -> Gaussians:
        self._done += 1
        self._on_progress(min(self._done, _STEPS - 1), _STEPS)
        return learned

    def recipe(self, options: LearnOptions) -> _Recipe:
        """Choose strength, reflection and number of components, in this order."""
        candidates = [_Recipe(strength=strength) for strength in _STRENGTHS]
        scored = [(self.scores(self.trained(each)), each) for each in candidates]
        scores, best = max(scored, key=_total)
        if options.reflection:
            completed = self._models.completed()
            mirrors = [find_reflection(completed, self._models.ids, axis) for axis in range(3)]
            candidates = [replace(best, reflection=each) for each in mirrors]
            scored = [(self.scores(self.trained(each)), each) for each in candidates]
            mirrored = max(scored, key=_total)
            # Of models about equally likely the symmetric one says more.
            if _gain(mirrored[0], scores) > -1:
                scores, best = mirrored
        if options.components is not None:
            return replace(best, components=options.components)
        for count in range(2, _MOST_COMPONENTS + 1):
            candidate = replace(best, components=count)
            tried = self.scores(self.trained(candidate))
            if _gain(tried, scores) < 1:
                break
            scores, best = tried, candidate
        return best

    def modes(self, recipe: _Recipe) -> int:
        """Choose the least number of modes that is about as likely as any."""
        learned = self.trained(recipe)
        full = self._models.rows[0].size
        counts = [*(count for count in _MODES if count < full), full]
        scores = [self.scores([_truncated(each, count) for each in learned]) for count in counts]
        best = max(scores, key=lambda each: float(each.sum()))
        enough = (
            count for count, each in zip(counts, scores, strict=True) if _gain(each, best) >= -1
        )
        return int(next(enough, full))


def learn_components(
    ids: Sequence[KeypointId],
    rows: FloatArray,
    options: LearnOptions,
    on_progress: Callable[[int, int], object],
) -> Learned:
    """Learn the components of models' rows, (N, m + 2, 3) float with NaN for what is missing."""
    extents = np.nanmax(rows, axis=1) - np.nanmin(rows, axis=1)
    models = _Models(ids, rows, float(np.median(np.linalg.norm(extents, axis=1))))
    # Threads of the linear algebra library make products of such small matrices 30 times slower.
    with threadpool_limits(1):
        if len(rows) < _LEAST_TO_CHOOSE:
            recipe, modes = _Recipe(components=options.components or 1), options.modes
        else:
            trials = _Trials(models, on_progress)
            recipe = trials.recipe(options)
            modes = options.modes or trials.modes(recipe)
        mixture = models.mixture(recipe)
    on_progress(_STEPS, _STEPS)
    return Learned(_components(mixture, modes), recipe.reflection)


def _vectors(rows: FloatArray, reflection: Reflection | None, ids: Sequence[KeypointId]) -> Vectors:
    """Models as vectors, beside each its mirror image of the same weight."""
    weight = 1.0
    if reflection is not None:
        rows = np.concatenate([rows, mirrored_rows(rows, ids, reflection)])
        weight = 0.5
    return Vectors(rows.reshape(len(rows), -1), np.full(len(rows), weight))


def _clusters(vectors: Vectors, common: Gaussians, count: int) -> IntArray:
    """Cluster the completed vectors by their main coefficients."""
    _, directions = np.linalg.eigh(common.covariances[0])
    coefficients = (vectors.completed(common) - common.means[0]) @ directions[:, -_CLUSTER_MODES:]
    tries = []
    for seed in range(_CLUSTERINGS):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of clusters without vectors
            centres, labels = kmeans2(coefficients, count, minit="++", seed=seed)
        tries.append((float(((coefficients - centres[labels]) ** 2).sum()), seed, labels))
    labels = min(tries)[2].astype(np.int64)
    labels[np.arange(count) % len(labels)] = np.arange(count)  # none is left out
    return np.asarray(labels)


def _components(mixture: Gaussians, modes: int | None) -> tuple[ShapeComponent, ...]:
    weights = mixture.weights / mixture.weights.sum()
    return tuple(
        component_of_covariance(mean.reshape(-1, 3), covariance, weight=float(weight), modes=modes)
        for weight, mean, covariance in sorted(
            zip(weights, mixture.means, mixture.covariances, strict=True),
            key=lambda part: -float(part[0]),
        )
    )


def _truncated(mixture: Gaussians, modes: int) -> Gaussians:
    """The mixture that is left of another one when only some modes are kept."""
    parts = [
        component_of_covariance(mean.reshape(-1, 3), covariance, modes=modes).covariance
        for mean, covariance in zip(mixture.means, mixture.covariances, strict=True)
    ]
    return Gaussians(mixture.weights, mixture.means, np.array(parts))


def _total(scored: tuple[FloatArray, _Recipe]) -> float:
    return float(scored[0].sum())


def _gain(scores: FloatArray, others: FloatArray) -> float:
    """Mean of the paired differences, in units of its standard error."""
    gains = scores - others
    error = float(gains.std() / np.sqrt(len(gains)))
    return float(gains.mean()) / error if error > 0 else 0.0
