"""`cadalign.ShapeModel`: the shapes of a category as a mixture of Gaussians."""

from __future__ import annotations

import os
from collections.abc import Collection, Hashable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, IntArray, as_floats, is_number
from cadalign.errors import InputError, quote
from cadalign.io.files import as_path, once_per_file
from cadalign.io.pretrained import pretrained_path, shape_path
from cadalign.shapes.basis import component_of_basis
from cadalign.shapes.gaussians import Gaussians
from cadalign.shapes.outputs import read_shape, write_shape
from cadalign.shapes.parts import (
    BOX_ROWS,
    BoxMargins,
    FewKeypoints,
    KeypointId,
    ShapeComponent,
    TrainingShapes,
    check_axis,
    check_ids,
    check_text,
    plain_name,
)

if TYPE_CHECKING:
    from cadalign.shapes.examples import Dataset, Example


@dataclass(frozen=True, eq=False)
class ShapeModel:
    """Shapes of a category: a Gaussian, or a mixture, over keypoints and bounding box.

    `ShapeModel.learn` and `ShapeModel.from_dataset` learn a shape model from CAD models,
    `ShapeModel.from_basis` makes one from a mean and modes, `ShapeModel.open` reads a file.

    Raises
    ------
    InputError
        If the numbers of keypoints don't match, or the weights don't sum to 1.

    Examples
    --------
    >>> from cadalign import Example
    >>> rng = np.random.default_rng(0)
    >>> names = ["origin", "right", "top", "front"]
    >>> corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=float)
    >>> models = [
    ...     Example(f"box {row}", names, corners * rng.uniform(0.8, 1.2, 3)) for row in range(50)
    ... ]
    >>> boxes = ShapeModel.learn(models, category="box")
    >>> boxes
    ShapeModel('box', 4 keypoints, 1 component, 50 models)
    >>> order = [names.index(name) for name in boxes.ids]
    >>> boxes.nearest(models[7].points_3d[order])
    7
    """

    category: str
    ids: tuple[KeypointId, ...]
    """Semantic ids or names of the m keypoints, in the order of the components' rows; sorted if
    they were learned."""
    components: tuple[ShapeComponent, ...]
    """Components of the mixture; their weights sum to 1."""
    has_box: bool = True
    """True if the box was learned or given. Otherwise the box of an estimate is the extent of its
    keypoints."""
    up_axis: Literal["x", "y", "z"] | None = None
    """Model axis that points up, None if unknown."""
    training: TrainingShapes | None = None
    """Models that the shape model was learned from."""
    unit: str = "model units"
    """Unit of lengths: "diagonal" for KeypointNet's models, "m" for metres."""
    inflation: float = 1.0
    """Factor of the shape's standard deviations in the covariances of results, calibrated on
    held-out models. Estimates don't depend on it."""
    degrees_of_freedom: float | None = None
    """Degrees of freedom, more than 2, of the t distribution of the errors, calibrated likewise;
    None for Gaussian errors. Covariances are the errors' covariances in both cases."""
    box_margins: BoxMargins | None = None
    """Distances of the box's faces from the keypoints. If None, the learned box is enlarged to hold
    the given keypoints."""
    few_keypoints: FewKeypoints | None = None
    """Decrease of the inflation for few given keypoints, calibrated likewise; None for none."""
    names: tuple[str, ...] = ()
    """Names of the keypoints, in the order of ``ids``, accepted wherever an id is; may be empty.
    The part of a keypoint is its name up to the first comma."""
    lines: tuple[tuple[int, int], ...] = ()
    """Rows of keypoints that belong together, such as the ends of a leg, for skeletons."""
    shares: tuple[float, ...] = ()
    """Share of the learned models that have each keypoint, in the order of ``ids``; may be empty.
    """

    def __post_init__(self) -> None:
        ids = check_ids(self.ids, "ids")
        if not self.components:
            raise InputError("there are none", where="components")
        for row, each in enumerate(self.components):
            if len(each.mean) != len(ids) + BOX_ROWS:
                what = f"{len(each.mean)} rows, expected {len(ids) + BOX_ROWS}: "
                what += f"{len(ids)} keypoints and {BOX_ROWS} box corners"
                raise InputError(what, where=f"components[{row}]")
        total = sum(each.weight for each in self.components)
        if abs(total - 1) > 1e-6:
            raise InputError(f"weights sum to {total:.6g}, not to 1", where="components")
        if self.up_axis is not None:
            check_axis(self.up_axis, "up_axis")
            object.__setattr__(self, "up_axis", str(self.up_axis))
        if self.training is not None and self.training.points_3d.shape[1] != len(ids):
            what = f"{self.training.points_3d.shape[1]} keypoints for {len(ids)} ids"
            raise InputError(what, where="training")
        if not is_number(self.inflation) or self.inflation <= 0:
            raise InputError(f"{self.inflation!r} is not a positive number", where="inflation")
        freedom = self.degrees_of_freedom
        if freedom is not None and (not is_number(freedom) or freedom <= 2):
            what = f"{freedom!r} is not a number above 2, nor None"
            raise InputError(what, where="degrees_of_freedom")
        object.__setattr__(self, "degrees_of_freedom", freedom and float(freedom))
        object.__setattr__(self, "inflation", float(self.inflation))
        for name in ("category", "unit"):
            object.__setattr__(self, name, check_text(getattr(self, name), name))
        names = tuple(check_text(name, f"names[{row}]") for row, name in enumerate(self.names))
        if names and len(check_ids(names, "names")) != len(ids):
            raise InputError(f"{len(names)} for {len(ids)} keypoints", where="names")
        if self.shares and len(self.shares) != len(ids):
            raise InputError(f"{len(self.shares)} for {len(ids)} keypoints", where="shares")
        for row, line in enumerate(self.lines):
            if len(line) != 2 or not {*line} <= {*range(len(ids))}:
                what = f"{quote(line)} is not a pair of rows below {len(ids)}"
                raise InputError(what, where=f"lines[{row}]")
        object.__setattr__(self, "ids", ids)
        object.__setattr__(self, "names", names)
        object.__setattr__(self, "lines", tuple((int(one), int(two)) for one, two in self.lines))
        object.__setattr__(self, "components", tuple(self.components))
        self.resolve(ids)  # refuses a name or id of two keypoints

    @classmethod
    def learn(
        cls,
        models: Iterable[Example],
        *,
        category: str = "object",
        up_axis: Literal["x", "y", "z"] | None = None,
        unit: str = "model units",
        components: int | None = None,
    ) -> ShapeModel:
        """Learn a shape model from models of a category.

        Models may lack keypoints; expectation maximisation completes them. The likelihood of
        held-out models chooses the numbers of Gaussians and modes. It also decides whether the
        category has a mirror symmetry; if so, the mirrored models are learned from, too. Keypoints
        that few models have keep large standard deviations.

        Parameters
        ----------
        models : iterable of Example
            At least 4. If fewer than half have bounds, the extents of the keypoints are used.
        category, up_axis, unit
            See `ShapeModel`.
        components : int, optional
            Number of Gaussians. Aligning an image takes one search for each.

        Raises
        ------
        InputError
            If there are too few models, a model id occurs twice, keypoint ids are numbers in some
            models and names in others, or an option is out of range.
        """
        from cadalign.shapes.learning import learn_parts  # not needed for estimates

        learned = learn_parts(list(models), category, components)
        return cls(category=category, up_axis=up_axis, unit=unit, **learned)

    @classmethod
    def from_dataset(
        cls,
        dataset: Dataset,
        category: str,
        *,
        split: str | None = None,
        meshes: bool = True,
        components: int | None = None,
    ) -> ShapeModel:
        """Learn a shape model from a category of `cadalign.datasets.KeypointNet`.

        Parameters
        ----------
        dataset : KeypointNet
        category : str
            Name or synset id.
        split : str, optional
            Learn from the models of this split only.
        meshes : bool
            Read the bounding boxes from the meshes if at least half of the models have one.
            Otherwise the extents of the keypoints are used.
        components
            See `ShapeModel.learn`.

        Raises
        ------
        InputError
            If category or split is unknown, or the category has too few models.
        """
        from cadalign.shapes.examples import examples_of  # not needed for estimates

        models = dataset.subset(categories=[category], split=split)[category]
        return cls.learn(
            examples_of(models, meshes=meshes),
            category=models[0].category if models else category,
            up_axis="y",
            unit="diagonal",
            components=components,
        )

    @classmethod
    def from_basis(
        cls,
        mean: npt.ArrayLike,
        modes: npt.ArrayLike,
        deviations: npt.ArrayLike,
        *,
        ids: Sequence[KeypointId] | None = None,
        box: npt.ArrayLike | None = None,
        residual_sigma: float = 0.0,
        category: str = "object",
        up_axis: Literal["x", "y", "z"] | None = None,
        unit: str = "model units",
    ) -> ShapeModel:
        """Make a shape model from a mean and modes of deformation.

        Parameters
        ----------
        mean : (m, 3) float
            Keypoints of the mean shape.
        modes : (K, m, 3) float
            Directions of deformation; ``mean * [1, 0, 0]`` is a stretch along x.
        deviations : (K,) float
            Standard deviations of their coefficients, 0 or more.
        ids : (m,) int or str, optional
            Semantic ids or names of the keypoints; by default ``0 ... m - 1``.
        box : (2, 3) float, optional
            Least and greatest corner of the mean shape's bounding box. Each mode shifts and
            stretches the box along its axes by the best fit to the keypoints' motion. By default
            the box of an estimate is the extent of its keypoints.
        residual_sigma : float
            Standard deviation per coordinate of the residual from the modes [model units].
        category, up_axis, unit
            See `ShapeModel`.

        Raises
        ------
        InputError
            If a shape is wrong, a value is NaN or infinite, a sigma is negative, or an id occurs
            twice.

        Examples
        --------
        >>> mean = [[0, 0, 0], [4, 0, 0], [4, 2, 0], [0, 2, 1]]
        >>> longer = [[0, 0, 0], [1, 0, 0], [1, 0, 0], [0, 0, 0]]
        >>> cars = ShapeModel.from_basis(mean, [longer], [0.5], ids=["a", "b", "c", "d"], unit="m")
        >>> cars.components[0].modes.shape
        (1, 6, 3)
        """
        component = component_of_basis(
            mean, modes, deviations, box=box, residual_sigma=residual_sigma
        )
        count = len(component.mean) - BOX_ROWS
        labels = check_ids(range(count) if ids is None else list(ids), "ids")
        if len(labels) != count:
            raise InputError(f"{len(labels)} for {count} keypoints", where="ids")
        return cls(
            category=category,
            ids=labels,
            components=(component,),
            has_box=box is not None,
            up_axis=up_axis,
            unit=unit,
        )

    @classmethod
    def pretrained(cls, category: str) -> ShapeModel:
        """Open the learned shape of a category that comes with the package.

        The shapes are learned from KeypointNet's annotations. Lengths are in diagonals of the
        bounding box, y points up and the front is at -z.

        Parameters
        ----------
        category : str
            airplane, bathtub, bed, bottle, cap, chair, guitar, helmet, knife, laptop, motorcycle,
            mug, skateboard, table or vessel.

        Raises
        ------
        InputError
            If there is no such category; the message lists the categories.

        Examples
        --------
        >>> chair = ShapeModel.pretrained("chair")
        >>> chair.names[4], chair.rows(["seat, front right"]).tolist()
        ('seat, front right', [4])
        """
        return read_shape(pretrained_path(category), cls)

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> ShapeModel:
        """Read a file written by `ShapeModel.save`, or the pretrained shape of a category's name.

        A file of that name is preferred, with a warning.

        Raises
        ------
        DataError
            If the file is missing, truncated, damaged, of another version, or of another format.
        InputError
            If there is neither a file nor a category of that name.
        """
        return read_shape(shape_path(as_path(path)), cls)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the shape model to a file atomically; raises DataError on failure."""
        write_shape(path, self)

    def __repr__(self) -> str:
        count = len(self.components)
        text = f"{len(self.ids)} keypoints, {count} component{'s' if count > 1 else ''}"
        models = "" if self.training is None else f", {len(self.training)} models"
        return f"ShapeModel({self.category!r}, {text}{models})"

    @property
    def mean(self) -> FloatArray:
        """Mean of the mixture: keypoints, then the box's two corners, (m + 2, 3) float."""
        return np.asarray(sum(each.weight * each.mean for each in self.components))

    @cached_property
    def gaussians(self) -> Gaussians:
        """The components as arrays: means (G, m + 2, 3), and covariances of the stacked rows."""
        parts = [(each.weight, each.mean, each.covariance) for each in self.components]
        return Gaussians(*map(np.array, zip(*parts, strict=True)))

    def resolve(
        self,
        ids: Collection[Hashable] | None = None,
        names: Collection[str] | None = None,
        *,
        where: str | None = "ids",
    ) -> tuple[KeypointId | None, ...]:
        """Find the shape's ids of all keypoints of an object.

        Parameters
        ----------
        ids : (n,) int or str, optional
            Ids, or names in their place.
        names : (n,) str, optional
            Names. If the shape has one of them, they count and not the ids, which may be a file's
            own numbers. Case is ignored; ``_`` and ``-`` are equal to a space.
        where : str or None
            Place that errors name. None: return None for keypoints that the shape lacks.

        Raises
        ------
        InputError
            If the shape lacks a keypoint; the message names it.

        Examples
        --------
        >>> ShapeModel.pretrained("chair").resolve(names=["seat, front left", "Back, top-left"])
        (5, 1)
        """
        labels: list[Any] = list(names or ())
        if ids is not None and not any(plain_name(each) in self._id_of for each in labels):
            labels = [each.item() if isinstance(each, np.generic) else each for each in ids]
        elif names is None:
            raise InputError("the keypoints have no semantic_id and no name", where=where)
        found = tuple(self._id_of.get(plain_name(each)) for each in labels)
        missing = [quote(each) for each, own in zip(labels, found, strict=True) if own is None]
        if missing and where is not None:
            what = f"{self.category} has no keypoint {', '.join(missing[:8])}"
            fix = f"leave out what it lacks, or give one of {quote(list(self.names or self.ids))}"
            raise InputError(what, where=where, fix=fix)
        return found

    def rows(self, ids: Collection[Hashable], *, where: str = "ids") -> IntArray:
        """Rows of the keypoints with the given ids or names, (n,) int; see `resolve`."""
        return np.array(list(map(self.ids.index, self.resolve(ids, where=where))), dtype=np.int64)

    @cached_property
    def _id_of(self) -> dict[Hashable, KeypointId]:
        """Ids by id and by name, in plain form."""
        id_of = dict[Hashable, KeypointId]()
        for row, label in (*enumerate(self.ids), *enumerate(self.names)):
            if id_of.setdefault(plain_name(label), self.ids[row]) != self.ids[row]:
                what, fix = f"{quote(label)} is also another keypoint", "give each keypoint its own"
                raise InputError(what, where="names" if self.names else "ids", fix=fix)
        return id_of

    def nearest(self, points_3d: npt.ArrayLike) -> int:
        """Row in ``training`` of the model with the nearest keypoints.

        Parameters
        ----------
        points_3d : (m, 3) float
            All keypoints in the order of ``ids``, in the model's coordinates [model units].

        Raises
        ------
        InputError
            If there are no training models, a shape is wrong, or a value is NaN or infinite.
        """
        if self.training is None or not len(self.training):
            raise InputError("the shape model has no training models", where=self.category)
        points = as_floats(points_3d, name="points_3d", shape=(len(self.ids), 3))
        known = self.training.points_3d
        squares = ((known.astype(np.float64) - points) ** 2).sum(axis=2)
        # Expected squared distance between two objects of the category, for missing keypoints.
        expected = 2 * np.nanvar(known, axis=0).sum(axis=1)
        distances = np.where(np.isnan(squares), expected, squares).mean(axis=1)
        return int(np.argmin(distances))


open_shape = once_per_file(4)(ShapeModel.open)
"""`ShapeModel.open`, cached: a run opens its file once."""
