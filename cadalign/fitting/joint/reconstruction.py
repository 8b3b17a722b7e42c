"""Views of photos whose cameras and poses a reconstruction knows."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from cadalign.errors import CadalignError, InputError, quote
from cadalign.fitting.joint.view import View
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera


class Photo(Protocol):
    """A photo of a reconstruction, such as `cadalign.datasets.Correspondences`."""

    @property
    def camera(self) -> Camera:
        """The calibrated camera."""

    @property
    def cam_from_world(self) -> Alignment:
        """Its pose."""


class Reconstruction(Protocol):
    """Photos by their names, such as `cadalign.datasets.Colmap`."""

    def __getitem__(self, name: str, /) -> Photo:
        """One photo."""


Keypoints = tuple[npt.ArrayLike, Sequence[Hashable] | None]


def views_from(
    images: Reconstruction, keypoints: Mapping[str, Keypoints], **options: Any
) -> list[View]:
    """Views with the cameras and the known poses of a reconstruction's photos.

    The reconstruction's frame and unit are those of the result: `AlignResult.rig_from_model` is the
    alignment in its world.

    Parameters
    ----------
    images : Colmap, Bundler or another mapping
        The reconstruction's photos, of `cadalign.datasets`.
    keypoints : mapping of str to ((n, 2) float, sequence of n ids or None)
        For each photo used, by its name: pixels of the object's keypoints, integers being pixel
        centres, and their ids. One keypoint in a photo counts.
    **options
        Further arguments of every `View`, such as ``sigma``.

    Returns
    -------
    list of View
        In the order of ``keypoints``.

    Raises
    ------
    InputError
        If there is no such photo, or its keypoints are invalid.
    DataError
        If the reconstruction describes a photo wrongly.

    Examples
    --------
    >>> from cadalign.datasets import Colmap
    >>> images = Colmap("reconstruction")  # doctest: +SKIP
    >>> views = views_from(images, {"00.jpg": (clicks, ["seat", "leg"])})  # doctest: +SKIP
    >>> cadalign.align(chair, views).rig_from_model  # doctest: +SKIP
    """
    views = []
    for name, pair in keypoints.items():
        given: Any = pair
        image = images[name]
        pose = np.eye(4)
        pose[:3, :3] = image.cam_from_world.rotation
        pose[:3, 3] = image.cam_from_world.translation
        if not isinstance(given, tuple) or len(given) != 2:
            what = f"expected (points_2d, ids), got {quote(given)}"
            raise InputError(what, where=f"keypoints[{quote(name)}]")
        points_2d, ids = given
        try:
            views.append(View(image.camera, points_2d, ids=ids, cam_from_rig=pose, **options))
        except CadalignError as error:
            where = f"keypoints[{quote(name)}]{'.' + error.where if error.where else ''}"
            raise InputError(error.what, where=where, fix=error.fix) from None
    return views
