"""`cadalign.Library`: retrieval of annotated CAD models by an image's keypoints."""

from __future__ import annotations

import logging
import os
from bisect import bisect_left
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import IntArray
from cadalign.datasets.image_keypoints import first_names
from cadalign.datasets.model_keypoints import SUFFIX, ModelKeypoint, ModelKeypoints
from cadalign.errors import DataError, InputError
from cadalign.geometry.camera import Camera
from cadalign.io.files import as_path, list_folder
from cadalign.io.kinds import MESH_ENDINGS
from cadalign.retrieval.absence import none_probability
from cadalign.retrieval.by_shape import category_to_rank, rank_by_shape
from cadalign.retrieval.match import Match
from cadalign.retrieval.models import LibraryModel, ModelKey, ModelTable, check_key
from cadalign.retrieval.options import RetrievalOptions
from cadalign.retrieval.ranking import gather_candidates, make_matches, observe, rank
from cadalign.shapes.model import ShapeModel
from cadalign.shapes.parts import plain_name

logger = logging.getLogger("cadalign")
_FIX = f"`cadalign annotate PHOTO MODEL` marks keypoints, and writes MODEL{SUFFIX}"


class Library(ModelTable):
    """Annotated CAD models to retrieve from: keypoints, bounds and mesh paths.

    The models are sorted by category and id, so results do not depend on their order.
    `Library.from_models` and `Library.from_folder` make a library; `Library.open` reads its file.

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

    @classmethod
    def from_folder(cls, folder: str | os.PathLike[str]) -> Library:
        """Make a library from a folder of files ``NAME.keypoints.json`` and meshes.

        The category of a model is the name of its file's folder, the model's id is NAME. The mesh
        is the file named in the keypoints file, or the mesh file NAME beside it. Models without a
        mesh have the bounds of their keypoints. Keypoints of the same name correspond.

        Parameters
        ----------
        folder : str or path-like
            Searched with its subfolders.

        Raises
        ------
        DataError
            If there are no keypoints files, one cannot be read, or a name has two semantic ids.

        Examples
        --------
        >>> library = Library.from_folder("chairs")  # doctest: +SKIP
        >>> library.retrieve(points_2d, ["seat", "back"], camera)  # doctest: +SKIP
        """
        models, names = _read_own_models(as_path(folder))
        return cls.from_models(models, names=names)

    def __iter__(self) -> Iterator[LibraryModel]:
        return map(self.model, range(len(self)))

    def __getitem__(self, key: ModelKey) -> LibraryModel:
        """Return a model, as in ``library["chair", model_id]``; raises InputError if unknown."""
        category, model_id = check_key(key, "library")
        row = bisect_left(self.keys, (category, model_id))
        if self.keys[row : row + 1] != ((category, model_id),):
            raise InputError(f"no model {model_id!r} of {category!r}", where="library")
        return self.model(row)

    def __repr__(self) -> str:
        return f"Library({len(self)} models, categories={list(self.categories)})"

    @property
    def keypoints(self) -> ModelKeypoints:
        """Names and semantic ids of the models' keypoints, with all coordinates 0.

        A detector's keypoints are matched with them by name. Keypoints without a name are called
        "keypoint 3", with their id.
        """
        names = {number: name for name, number in self.names.items()}
        return ModelKeypoints(
            tuple(
                ModelKeypoint(names.get(number, f"keypoint {number}"), (0.0, 0.0, 0.0), number)
                for number in self.known_ids().tolist()
            )
        )

    def ids_of(self, names: Sequence[str]) -> IntArray:
        """Semantic ids (n,) of keypoint names; raises InputError for an unknown name.

        Case is ignored, and ``_`` and ``-`` are equal to a space.
        """
        known = {plain_name(each.name): each.semantic_id for each in self.keypoints.keypoints}
        unknown = [name for name in names if plain_name(name) not in known]
        if unknown:
            what = f"no model of the library has a keypoint {unknown[0]!r}"
            raise InputError(what, where="ids", fix=f"it has {first_names(self.keypoints.names)}")
        return np.array([known[plain_name(name)] for name in names], dtype=np.int64)

    @property
    def mesh_count(self) -> int:
        """Number of models that have a mesh."""
        return len(self) - self.meshes.count(None)

    def retrieve(
        self,
        points_2d: npt.ArrayLike,
        ids: npt.ArrayLike,
        camera: Camera,
        *,
        shape: ShapeModel | None = None,
        exclude: Collection[ModelKey] = (),
        workers: int = -1,
        **options: Any,
    ) -> list[Match]:
        """Rank the models by the likelihood of an image's keypoints at the best pose and stretch.

        Likelihoods of models with different keypoints are comparable; see
        `cadalign.retrieval.options`. A bound on the likelihood limits the search for poses to
        promising models: every match with a score above 1e-8 has the rank of an exhaustive search,
        and up to 768 more models are searched to fill the list. Ties are broken by category and id.

        Parameters
        ----------
        points_2d : (n, 2) float
            Keypoints in the image [px]; integers are pixel centres.
        ids : (n,) int or str
            Distinct semantic ids of the keypoints, or their names in the library. The meaning of
            an id depends on the category: without ``category``, it is that of each model's own.
        camera : Camera
            The calibrated camera, with its lens distortion.
        shape : ShapeModel, optional
            For objects that are not in the library: rank models by their similarity to the shape
            that this model estimates from the image. Only models of one category are ranked:
            ``category``, or by default the shape model's. See `cadalign.retrieval.by_shape`.
        exclude : collection of (str, str)
            Category and id of models to leave out; models that are not in the library are ignored.
        workers : int
            Number of threads; -1 for one per core.
        **options
            Fields of `cadalign.retrieval.options.RetrievalOptions`, which describes them: top,
            category, sigma, shape_sigma, loss, loss_scale, stretch.

        Returns
        -------
        list of Match
            The most likely first. Each has ``none_probability``, the probability that the object
            is none of the library's models.

        Raises
        ------
        InputError
            If the library is empty, shapes don't match, a value is NaN or infinite, a semantic id
            is unknown or occurs twice, an option is invalid, or the focal length is unknown.
        DegenerateError
            If no model shares at least 4 keypoints with the image.
        """
        try:
            chosen = RetrievalOptions(**options)
        except TypeError as error:
            raise InputError(f"unknown option ({error})", where="options") from None
        if (labels := np.asarray(ids)).dtype.kind == "U":
            ids = self.ids_of(labels.ravel().tolist())
        if isinstance(camera, Camera) and not camera.focal_known:
            fix = "estimate it first, as `cadalign fit` does with a learned shape, or give it"
            raise InputError("the focal length is unknown", where="camera", fix=fix)
        absent = None
        if shape is None:
            observed = observe(points_2d, ids, camera, chosen)
            candidates = gather_candidates(self, observed, chosen, exclude, workers)
            ranking = rank(candidates, observed, chosen, workers)
            absent = none_probability(self, candidates, observed, ranking)
        else:
            category = category_to_rank(shape, chosen, self)
            # Here shape_sigma is no noise of the keypoints; rank_by_shape uses it.
            plain = replace(chosen, shape_sigma=0.0, category=category)
            observed = observe(points_2d, ids, camera, plain)
            candidates = gather_candidates(self, observed, plain, exclude, workers)
            ranking = rank_by_shape(self, candidates, observed, chosen, shape)
        return make_matches(self, candidates, observed, ranking, chosen, absent)


def keypoint_files(folder: Path) -> list[Path]:
    """Keypoints files in a folder and its subfolders."""
    return list_folder(folder, f"**/*{SUFFIX}")


def _read_own_models(folder: Path) -> tuple[list[LibraryModel], dict[str, int]]:
    """Read a folder's models, and the semantic ids by name; see `Library.from_folder`."""
    files = keypoint_files(folder)
    if not files:
        fix = f"{_FIX}; or give the folder that holds a data set's annotations/"
        raise DataError("no model with keypoints", where=str(folder), fix=fix)
    read = [(path, ModelKeypoints.load(path)) for path in files]
    names = _semantic_ids(read)
    models = [_model(path, found, names) for path, found in read]
    meshes = [path for path in list_folder(folder, "**/*") if path.suffix.lower() in MESH_ENDINGS]
    used = {model.mesh_path for model in models}
    unused = [path for path in meshes if path.absolute() not in used]
    if unused:
        message = "%d meshes have no keypoints and are left out, the first is %s; %s"
        logger.warning(message, len(unused), unused[0], _FIX)
    return models, names


def _semantic_ids(read: Sequence[tuple[Path, ModelKeypoints]]) -> dict[str, int]:
    """Semantic ids by name: from the files if all keypoints have one, else in order of names."""
    entries = [(path, each) for path, found in read for each in found.keypoints]
    if any(each.semantic_id is None for _, each in entries):
        return {name: k for k, name in enumerate(sorted({each.name for _, each in entries}))}
    names: dict[str, int] = {}
    first: dict[str, Path] = {}
    for path, each in entries:
        number, before = each.semantic_id or 0, first.setdefault(each.name, path)
        if names.setdefault(each.name, number) != number:
            what = f"{each.name!r} has semantic_id {number}, and {names[each.name]} in {before}"
            raise DataError(what, where=str(path), fix="give a name one id, or leave ids out")
    return names


def _model(path: Path, found: ModelKeypoints, names: dict[str, int]) -> LibraryModel:
    stem, mesh = path.name.removesuffix(SUFFIX), found.model
    if mesh is None:
        beside = (path.with_name(stem + suffix) for suffix in MESH_ENDINGS)
        mesh = next((each for each in beside if each.is_file()), None)
    ids = np.array([names[name] for name in found.names], dtype=np.int64)
    return LibraryModel.from_mesh(path.absolute().parent.name, stem, found.xyz, ids, mesh)
