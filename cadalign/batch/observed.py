"""Models and views of observation files."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from contextlib import nullcontext

from cadalign.errors import InputError
from cadalign.estimation.model import Model
from cadalign.estimation.options import FitOptions, Sigma
from cadalign.estimation.view import View
from cadalign.geometry.mesh import Mesh
from cadalign.io.documents import within
from cadalign.io.evidence import ObservedImage
from cadalign.io.observation import Observation
from cadalign.shapes.model import ShapeModel
from cadalign.shapes.parts import KeypointId


def model_of(
    observation: Observation,
    *,
    options: FitOptions,
    shape_sigma: float | None = None,
    mesh: Mesh | None = None,
) -> Model:
    """The model of an observation's own keypoints, those of all its views.

    Of the options the stretch and the prior on it count. Raises InputError if views
    place the same keypoint at different points of the model.
    """
    points: dict[Hashable, tuple[float, ...]] = {}
    labels = own_ids(observation.views)
    for number, (view, names) in enumerate(zip(observation.views, labels, strict=True)):
        for row, (name, xyz) in enumerate(zip(names, view.points_3d.tolist(), strict=True)):
            if points.setdefault(name, tuple(xyz)) != tuple(xyz):
                raise InputError(
                    f"differs from that of keypoint {name!r} in a view before",
                    where=f"views[{number}].keypoints[{row}].xyz",
                    fix="give the same point of the model",
                )
    return Model(
        points_3d=list(points.values()),
        ids=list(points),
        mesh=mesh,
        shape_sigma=shape_sigma,
        stretch=options.stretch,
        stretch_sigma=options.stretch_sigma,
        symmetry=observation.symmetry,
        up_axis=observation.up_axis,
    )


def views_of(
    observation: Observation,
    model: Model | ShapeModel,
    *,
    with_photos: bool = False,
    **stated: Sigma | None,
) -> tuple[View, ...]:
    """Evidence of an observation's images about a model, at a stated ``sigma`` or at its own [px].

    A learned shape's keypoints are found by semantic id or by name, as the shape has them; a sigma
    is 1 where none is known. Photos themselves are evidence where these are asked for.

    Raises InputError if the shape has no such keypoints, the observation has no ids or names, one
    occurs twice, or what is said of an image is invalid; DataError if a file cannot be read.
    """
    labels = own_ids(observation.views)
    views = []
    for number, image in enumerate(observation.views):
        with within(f"views[{number}]") if observation.others else nullcontext():
            ids = shape_ids(image, model) if isinstance(model, ShapeModel) else labels[number]
            evidence = image.evidence.given
            if image.depths is not None:
                evidence["depth"] = image.depths
            own = {"sigma": 1.0 if image.sigma is None else image.sigma}
            view = View(
                image.camera,
                image.points_2d,
                ids=ids,
                scores=image.scores,
                image=image.image if with_photos else None,
                photo=image.image,
                **evidence | own | stated,
            )
            views.append(view)
    return tuple(views)


def shape_ids(image: ObservedImage, shape: ShapeModel) -> tuple[KeypointId, ...]:
    """The ids, or names, by which a learned shape knows an image's keypoints; see `views_of`."""
    if not len(image.points_2d):
        return ()
    named = isinstance(shape.ids[0], str)
    field, kind = ("name", "names") if named else ("semantic_id", "semantic ids")
    given = image.names if named else image.ids
    if given is None:
        raise InputError(
            f"the keypoints have no {field}",
            where="keypoints",
            fix=f"the shape of {shape.category} knows its keypoints by their {kind}",
        )
    ids = tuple(each if named else int(each) for each in given)
    shape.rows(ids, where=f"keypoints.{field}")
    return ids


def own_ids(images: Sequence[ObservedImage]) -> tuple[tuple[Hashable, ...], ...]:
    """Labels of the images' keypoints by which they are the same in several.

    Ids or names where these distinguish all; otherwise numbers, in several images of equal ``xyz``.
    """
    shown = [image for image in images if len(image.points_2d)]
    for field in ("ids", "names"):
        columns = [getattr(image, field) for image in shown]
        if all(column is not None and len(set(column)) == len(column) for column in columns):
            of_all = [getattr(image, field) if len(image.points_2d) else () for image in images]
            return tuple(
                tuple(each if isinstance(each, str) else int(each) for each in column)
                for column in of_all
            )
    if len(shown) < 2:
        return tuple(tuple(range(len(image.points_2d))) for image in images)
    numbers: dict[tuple[float, ...], int] = {}
    return tuple(
        tuple(numbers.setdefault(tuple(xyz), len(numbers)) for xyz in image.points_3d.tolist())
        for image in images
    )
