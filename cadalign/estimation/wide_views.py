"""Views of wide lenses: turned to their keypoints for an alignment, which is turned back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.estimation.facing import (
    faced,
    rays_ahead,
    turned_alignment,
    turned_covariance,
)
from cadalign.estimation.result import Result
from cadalign.estimation.uncertainty.stated import Stated, Statistics
from cadalign.estimation.view import View
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import needs_facing

_REFUSED = {
    "mask": "the outline of a mask is not measured through a wide lens",
    "image": "the outline in a photo is not measured through a wide lens",
    "depth": "depths are not measured along the rays of a wide lens",
}


def facing_view(view: View, number: int = 0) -> View:
    """The view in the frame that faces its keypoints; ``up`` and the like stay in the lens's.

    Raises
    ------
    InputError
        If the view, with a wide lens, has a mask or depths.
    """
    if not needs_facing([view.camera]):
        return view
    for name, what in _REFUSED.items():
        if getattr(view, name) is not None:
            fix = "leave it away, or undistort the photo to a pinhole's"
            raise InputError(what, where=f"views[{number}].{name}", fix=fix)
    camera, rig = faced(view.camera, cast(FloatArray, view.points_2d)), view.cam_from_rig
    if rig is not None:
        turn = np.eye(4)
        turn[:3, :3] = camera.lens_from_camera.T
        rig = turn @ np.asarray(rig)
    return replace(view, camera=camera, cam_from_rig=rig)


def check_sides(views: Sequence[View]) -> None:
    """Refuse keypoints all around a camera, in views that `facing_view` made.

    Raises
    ------
    InputError
        If a wide lens has them.
    """
    for view in views:
        if view.camera.is_wide:
            rays_ahead(cast(FloatArray, view.points_2d), view.camera)


def facing_inits(
    inits: Sequence[Alignment | None], views: Sequence[View]
) -> list[Alignment | None]:
    """Starts in the frames of `facing_view`; a start in the rig's frame stays."""
    if views[0].cam_from_rig is not None:
        return list(inits)
    return [
        None if init is None else turned_alignment(init, view.camera.lens_from_camera.T)
        for init, view in zip(inits, views, strict=True)
    ]


def turned_back(result: Result, given: Sequence[View]) -> Result:
    """The result in the frames of the views that were given, from that of their `facing_view`s."""
    statistics = _turned(result.statistics, result.camera.lens_from_camera)
    views = []
    for number, (own, view) in enumerate(zip(result.views, given, strict=True)):
        turn = own.camera.lens_from_camera if view.camera.is_wide else np.eye(3)
        views.append(
            replace(
                own,
                camera=view.camera if view.camera.is_wide else own.camera,
                alignment=turned_alignment(own.alignment, turn),
                statistics=_turned(own.statistics, turn) if number else statistics,
            )
        )
    turn = result.camera.lens_from_camera
    others = [
        replace(each, alignment=turned_alignment(each.alignment, turn), camera=views[0].camera)
        for each in result.alternatives
    ]
    return replace(result, views=tuple(views), statistics=statistics, alternatives=tuple(others))


def _turned(statistics: Statistics, turn: FloatArray) -> Stated:
    stated = Stated.of(statistics)
    own, fisher = stated.covariance, stated.fisher_covariance
    seen = stated.points_cam_covariance
    return replace(
        stated,
        covariance=None if own is None else turned_covariance(own, turn),
        fisher_covariance=None if fisher is None else turned_covariance(fisher, turn),
        basis=stated.basis and replace(stated.basis, turn=turn),
        points_cam_covariance=None if seen is None else turn @ seen @ turn.T,
    )
