"""`cadalign.Library`: annotated models that an image's keypoints are compared with."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Collection, Iterable, Iterator
from typing import TYPE_CHECKING

import numpy.typing as npt

from cadalign.errors import DataError, InputError
from cadalign.fitting.options import Sigma
from cadalign.geometry.camera import Camera
from cadalign.retrieval.candidates import gather_field, observe
from cadalign.retrieval.library_file import fingerprint, read_library, write_library
from cadalign.retrieval.match import Match
from cadalign.retrieval.models import LibraryModel, ModelKey, ModelTable
from cadalign.retrieval.options import RetrievalOptions
from cadalign.retrieval.ranking import make_matches, rank

if TYPE_CHECKING:
    from cadalign.datasets import KeypointNet

logger = logging.getLogger("cadalign")


class Library:
    """Annotated CAD models to retrieve from: keypoints, symmetries, bounds and mesh paths.

    The models are kept sorted by category and id, so that nothing depends on the order in which
    they came. `Library.from_dataset` and `Library.from_models` make one, `Library.open` maps a
    saved one into memory.

    Parameters
    ----------
    table : ModelTable
        The models.

    Examples
    --------
    >>> import cadalign
    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> models = [
    ...     LibraryModel("box", f"{number}", rng.uniform(-0.3, 0.3, (9, 3)), np.arange(9),
    ...                  np.array([[-0.3] * 3, [0.3] * 3]))
    ...     for number in range(20)
    ... ]
    >>> library = Library.from_models(models)
    >>> camera = cadalign.Camera(640, 480, fx=935.0, fy=935.0, cx=319.5, cy=239.5)
    >>> pose = cadalign.Alignment(np.eye(3), [0, 0, 2], [1, 1.5, 0.7])
    >>> pixels = camera.project(pose.apply(models[7].xyz))
    >>> best = library.retrieve(pixels, np.arange(9), camera)[0]
    >>> best.model_id, [round(float(scale), 2) for scale in best.alignment.scale]
    ('7', [1.0, 1.5, 0.7])
    """

    def __init__(self, table: ModelTable) -> None:
        self._table = table

    @classmethod
    def from_models(cls, models: Iterable[LibraryModel]) -> Library:
        """A library of these models.

        Raises
        ------
        InputError
            If two have the same category and id.
        """
        return cls(ModelTable.of(models))

    @classmethod
    def from_dataset(
        cls,
        dataset: KeypointNet,
        *,
        categories: Iterable[str] | None = None,
        on_model: Callable[[], object] = lambda: None,
    ) -> Library:
        """A library of a data set's annotated models.

        Meshes are read for their bounds; of a model whose mesh is missing or cannot be read, with a
        warning (logger "cadalign"), the keypoints' bounds are taken. Malformed models are left out,
        as by the data set itself.

        Parameters
        ----------
        dataset : KeypointNet
        categories : iterable of str, optional
            Names or synset ids; by default all.
        on_model : callable
            Told of every model.

        Raises
        ------
        InputError
            If a category is unknown.
        DataError
            If there are no models.
        """
        models = []
        for model in dataset.subset(categories=categories):
            try:
                models.append(LibraryModel.of_annotated(model))
            except DataError as error:
                logger.warning("bounds are the keypoints': %s", error)
                models.append(LibraryModel.of_annotated(model, with_mesh=False))
            on_model()
        if not models:
            raise DataError("there are no models to make a library of", where=str(dataset.root))
        return cls.from_models(models)

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> Library:
        """Map a saved library into memory.

        Raises
        ------
        DataError
            If the file is missing, cut short, damaged, of another version, or something else.
        """
        return cls(read_library(path))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the library to a file; see `cadalign.retrieval.library_file`.

        Raises
        ------
        DataError
            If it cannot be written.
        """
        write_library(path, self._table)

    def __len__(self) -> int:
        return len(self._table)

    def __iter__(self) -> Iterator[LibraryModel]:
        return (self._table.model(row) for row in range(len(self)))

    def __getitem__(self, key: ModelKey) -> LibraryModel:
        """``library["chair", model_id]``

        Raises
        ------
        InputError
            If there is no such model.
        """
        row = self._table.find(key)
        if row is None:
            raise InputError(f"no model {key[1]!r} of {key[0]!r}", where="library")
        return self._table.model(row)

    def __repr__(self) -> str:
        return f"Library({len(self)} models, categories={list(self.categories)})"

    @property
    def categories(self) -> tuple[str, ...]:
        """The categories' names, sorted."""
        return self._table.categories

    @property
    def keys(self) -> tuple[ModelKey, ...]:
        """(category, model id) of every model, sorted."""
        return tuple(self._table.keys)

    @property
    def nbytes(self) -> int:
        """How much memory the models take; of an opened library, shared among processes."""
        return int(self._table.table.nbytes)

    @property
    def fingerprint(self) -> str:
        """A text that changes with anything that is in the library."""
        return fingerprint(self._table)

    def retrieve(
        self,
        points_2d: npt.ArrayLike,
        semantic_ids: npt.ArrayLike,
        camera: Camera,
        *,
        top: int = 10,
        category: str | None = None,
        method: str = "optimal",
        sigma: Sigma = 1.0,
        shape_sigma: float = 0.0,
        loss: str = "linear",
        loss_scale: float = 2.0,
        stretch: str | None = None,
        scale_prior_sigma: float | None = 0.4,
        max_stretch: float = 4.0,
        symmetries: bool = False,
        missing_prob: float = 0.5,
        spurious: float = 0.01,
        mask: npt.ArrayLike | None = None,
        image: npt.ArrayLike | None = None,
        exclude: Collection[ModelKey] = (),
        exhaustive: bool = False,
        workers: int = -1,
    ) -> list[Match]:
        """Rank the models by how well each, posed and stretched, explains an image's keypoints.

        The likelihood that models are compared by, also such with different sets of keypoints, is
        described in `cadalign.retrieval.options`. Only models whose best possible likelihood (a
        bound) leaves them a chance are searched for their pose: every match with a score above 1e-8
        is where it would be if all were searched, and up to 768 more are searched to fill the rest
        of the list. Ties are broken by category and id.

        Parameters
        ----------
        points_2d : (n, 2) float
            Keypoints in the image [px]; integers are pixel centres.
        semantic_ids : (n,) int
            What each keypoint means; every id at most once. An id means something else in every
            category, so without ``category`` each model reads them in its own category's sense.
        camera : Camera
            The calibrated camera. Lens distortion is honoured.
        top : int
            How many matches to return at most.
        category : str, optional
            Name or synset id of the only category to compare with.
        method : {"optimal", "epnp"}
            ``optimal`` stretches models; ``epnp`` is OpenCV's EPnP, which doesn't.
        sigma : float, (n,) float or (n, 2, 2) float
            Standard deviation of the keypoints, of each, or covariance of each [px].
        shape_sigma : float
            How far the keypoints of a model may lie off the object's, as a share of the extent of
            the keypoints in the image: for objects of which only similar models are in the library.
        loss : {"linear", "huber", "cauchy"}
            How the length of a residual counts: squared, or less beyond ``loss_scale``, so that
            some wrong keypoints are tolerated. Robust losses take all models' search.
        loss_scale : float
            Where a robust loss begins to bend [sigma].
        stretch : str, optional
            Axes that stretch: ``"yz"`` (the default), ``"y"``, ``"z"`` or ``"none"``.
        scale_prior_sigma : float, optional
            Standard deviation of the prior on the logarithm of each stretch; None for no prior.
        max_stretch : float
            No model is stretched beyond this, or below one over it.
        symmetries : bool
            Whether to try also labels with left and right (front and back) exchanged, by the
            models' reflections.
        missing_prob : float
            Probability that a keypoint of the object is not marked in the image.
        spurious : float
            How many keypoints an image shows, on average, that the object does not have.
        mask : (h, w) bool, optional
            The object's pixels: the best matches that have a mesh are compared with it, too, and
            ranked anew; see `cadalign.retrieval.silhouettes`.
        image : (h, w, 3) or (h, w, 4) uint8, optional
            The image, instead of a mask: its opacity, or what is cut out of it around the
            keypoints, is the mask.
        exclude : collection of (category, model id)
            Models to leave out.
        exhaustive : bool
            Search all models, bounds or not.
        workers : int
            How many threads share the search; -1 for as many as there are cores.

        Returns
        -------
        list of Match
            The most likely first.

        Raises
        ------
        InputError
            If the library is empty, shapes don't match, a value is NaN or infinite, a semantic id
            is unknown or occurs twice, or an option is invalid.
        DegenerateError
            If no model shares at least 4 keypoints with the image, or none can be aligned.
        """
        options = RetrievalOptions(
            top=top,
            category=category,
            method=method,
            sigma=sigma,
            shape_sigma=shape_sigma,
            loss=loss,
            loss_scale=loss_scale,
            stretch=stretch,
            scale_prior_sigma=scale_prior_sigma,
            max_stretch=max_stretch,
            symmetries=symmetries,
            missing_prob=missing_prob,
            spurious=spurious,
            exhaustive=exhaustive,
        )
        observed = observe(points_2d, semantic_ids, camera, options)
        field = gather_field(self._table, observed, options, exclude=exclude)
        ranking = rank(field, observed, options, workers=workers)
        matches = make_matches(self._table, field, observed, ranking, top=top)
        if mask is None and image is None:
            return matches
        from cadalign.retrieval.silhouettes import mask_of, rerank

        return rerank(matches, mask_of(mask, image, matches, camera), camera)
