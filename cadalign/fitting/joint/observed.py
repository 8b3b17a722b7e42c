"""Models and views of observation files, for `align`."""

from __future__ import annotations

from collections.abc import Hashable

from cadalign.errors import InputError
from cadalign.fitting.joint.model import Model
from cadalign.fitting.joint.view import View
from cadalign.fitting.options import FitOptions, Sigma
from cadalign.geometry.mesh import Mesh
from cadalign.io.observation import Observation
from cadalign.shapes.model import ShapeModel
from cadalign.shapes.parts import KeypointId


def similar_model(
    observation: Observation, *, shape_sigma: float, options: FitOptions, mesh: Mesh | None = None
) -> Model:
    """The model of an observation's own keypoints, which is only similar to the object.

    Parameters
    ----------
    observation : Observation
    shape_sigma : float
        See `cadalign.Model`.
    options : FitOptions
        Of these the known axis, the stretch and the prior on it count.
    mesh : Mesh, optional
        That of the model.
    """
    return Model(
        points_3d=observation.points_3d,
        ids=own_ids(observation),
        mesh=mesh,
        shape_sigma=shape_sigma,
        stretch=options.stretch,
        scale_prior_sigma=options.scale_prior_sigma,
        known_axis=options.known_axis,
    )


def view_of(observation: Observation, model: Model | ShapeModel, *, sigma: Sigma) -> View:
    """Evidence of an observation's image about a model.

    A learned shape's keypoints are found by semantic id or by name, as the shape has them.

    Raises
    ------
    InputError
        If the shape has no such keypoints, the observation has no ids or names, or one of them
        occurs twice.
    """
    ids = own_ids(observation) if isinstance(model, Model) else shape_ids(observation, model)
    return View(
        observation.camera,
        observation.points_2d,
        ids=ids,
        sigma=sigma,
        confidences=observation.confidences,
    )


def shape_ids(observation: Observation, shape: ShapeModel) -> tuple[KeypointId, ...]:
    """The ids, or names, by which a learned shape knows an observation's keypoints.

    Raises
    ------
    InputError
        As `view_of`.
    """
    named = isinstance(shape.ids[0], str)
    field, kind = ("name", "names") if named else ("semantic_id", "semantic ids")
    given = observation.names if named else observation.semantic_ids
    if given is None:
        raise InputError(
            f"the keypoints have no {field}",
            where="keypoints",
            fix=f"the shape of {shape.category} knows its keypoints by their {kind}",
        )
    ids = tuple(each if named else int(each) for each in given)
    shape.rows(ids, where=f"keypoints.{field}")
    twice = next((each for row, each in enumerate(ids) if each in ids[:row]), None)
    if twice is not None:
        raise InputError(
            f"{twice!r} occurs twice", where=f"keypoints.{field}", fix="give each once"
        )
    return ids


def own_ids(observation: Observation) -> tuple[Hashable, ...] | None:
    """Semantic ids or names of an observation's keypoints, where these tell them apart."""
    ids = observation.semantic_ids
    for given in (None if ids is None else ids.tolist(), observation.names):
        if given is not None and len(set(given)) == len(given):
            return tuple(given)
    return None
