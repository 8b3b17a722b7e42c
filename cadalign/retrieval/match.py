"""Result of a retrieval, and the best matches by keypoints ranked again by the object's mask.

The silhouette of each match's mesh, posed and stretched, is compared with the object's pixels. The
intersection over union of the correct model falls short of 1 by 0.05 on average, exponentially
distributed, so a match gains ``IoU / 0.05`` in log-likelihood over one without overlap. A match
without a mesh gains the mean of the others' gains, so that it is neither preferred nor rejected.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import cv2
import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.errors import CadalignError, InputError
from cadalign.estimation.result import Result
from cadalign.estimation.result_parts import Stated, ViewResult
from cadalign.geometry.alignment import Alignment, Box
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.io.meshes.files import load_mesh
from cadalign.io.observation import Observation
from cadalign.render import Geometry, Scene, cast_geometry, silhouette_iou
from cadalign.retrieval.models import ModelTable

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from cadalign.retrieval.models import LibraryModel


METHOD = "retrieve"
"""Method of a match's result."""


@dataclass(frozen=True, eq=False)
class Match:
    """A model of the library, posed and stretched to explain an image's keypoints."""

    category: str
    model_id: str
    alignment: Alignment
    rms: float
    """Root mean square length of the shared keypoints' residuals [px]."""
    log_likelihood: float
    """Log-likelihood of all keypoints, marked and missing; see `cadalign.retrieval.options`."""
    score: float
    """Probability that this is the model, given that it is in the library (in the category, if one
    was named) and that all are equally likely a priori: the likelihood over the sum of all models'.
    It is calibrated as far as the assumptions hold: nine in ten matches with the score 0.9 are
    correct."""
    box: Box
    """Box of the model in the camera frame."""
    bounds: FloatArray
    """Lowest and highest coordinates in the model's frame (2, 3)."""
    ids: IntArray
    """Ids of the shared keypoints (n,)."""
    points_3d: FloatArray
    """Shared keypoints on the model (n, 3)."""
    points_2d: FloatArray
    """Shared keypoints in the image (n, 2) [px]."""
    residuals: FloatArray
    """Projected minus observed (n, 2) [px]."""
    missing_ids: tuple[int, ...]
    """Ids of the image's keypoints that the model lacks."""
    mirrored: bool
    """True if the labels fit better with left and right exchanged."""
    mesh_path: Path | None
    silhouette_iou: float | None = None
    """With a mask: intersection over union with the model's silhouette; None without a mesh."""
    none_probability: float | None = None
    """Probability that the object is none of the library's models, not even stretched: the same in
    all matches of an image. See `cadalign.retrieval.absence`. None in a ranking by shape, which
    takes the object for none of them."""
    camera: Camera | None = field(default=None, repr=False)
    """The camera of the image."""

    @classmethod
    def of(cls, model: LibraryModel, alignment: Alignment, **fit: Any) -> Match:
        """A match of a library's model, with the other fields but box and bounds."""
        return cls(
            category=model.category,
            model_id=model.model_id,
            alignment=alignment,
            box=Box.from_model(model.bounds, alignment),
            bounds=model.bounds,
            mesh_path=model.mesh_path,
            **fit,
        )

    @property
    def shared(self) -> int:
        """Number of keypoints that model and image share."""
        return len(self.ids)

    @property
    def observed(self) -> int:
        """Number of keypoints in the image."""
        return self.shared + len(self.missing_ids)

    def __repr__(self) -> str:
        stretch = ", ".join(f"{value:.3g}" for value in self.alignment.scale)
        return (
            f"Match({self.category!r}, {self.model_id!r}, score={self.score:.3g}, "
            f"rms={self.rms:.3g} px, shared={self.shared}, scale=({stretch}))"
        )

    @property
    def result(self) -> Result:
        """The match in the form of every estimate: its pose, residuals, box, and JSON form.

        It states no uncertainty; `cadalign.fit` of the keypoints does.

        Raises
        ------
        InputError
            If the match has no camera.
        """
        if self.camera is None:
            raise InputError("the match has no camera", where="camera", fix="retrieve it again")
        ids, none = tuple(self.ids.tolist()), Stated(None)
        inliers = np.ones(self.shared, dtype=bool)
        seen = (self.camera, self.alignment, ids, self.points_2d, self.residuals, inliers, none)
        return Result(
            (ViewResult(*seen),), ids, self.points_3d, METHOD, none, own_bounds=self.bounds
        )

    def observation(self, seen: Observation) -> Observation:
        """The keypoints of an observation that the model has, paired with the model's."""
        given = cast(IntArray, seen.ids)
        kept = np.flatnonzero(np.isin(given, self.ids))
        ids = given[kept]
        own: dict[str, Any] = {name: getattr(seen, name) for name in ("sigma", "scores", "depths")}
        own = {name: None if each is None else each[kept] for name, each in own.items()}
        return replace(
            seen,
            points_3d=self.points_3d[np.searchsorted(self.ids, ids)],
            points_2d=seen.points_2d[kept],
            ids=ids,
            names=seen.names and tuple(seen.names[row] for row in kept.tolist()),
            camera=self.camera or seen.camera,
            model=self.mesh_path,
            others=(),
            **own,
        )

    def plot(
        self,
        image: npt.ArrayLike | str | os.PathLike[str] | None = None,
        *,
        axes: Axes | None = None,
    ) -> Axes:
        """Draw photo, model, box and keypoints; see `cadalign.Result.plot`."""
        return self.result.plot(image, self._mesh(), axes=axes)

    def export(
        self, path: str | os.PathLike[str], *, format: str | None = None, **of_the_object: Any
    ) -> Path:
        """Write the posed and stretched model for another tool; see `cadalign.Result.export`.

        Examples
        --------
        >>> library.retrieve(points_2d, ids, camera)[0].export("chair.glb")  # doctest: +SKIP
        """
        known = {"mesh": self._mesh(), "name": self.model_id} | of_the_object
        return self.result.export(path, format=format, **known)

    def _mesh(self) -> Any:
        return None if self.mesh_path is None else load_mesh(self.mesh_path)

    def to_dict(self) -> dict[str, Any]:
        """Write the match as plain lists and numbers, for JSON."""
        names = ("category", "model_id", "score", "log_likelihood", "rms", "shared")
        box = {name: getattr(self.box, name).tolist() for name in ("center", "rotation", "extents")}
        return {
            **{name: getattr(self, name) for name in names},
            "alignment": self.alignment.to_dict(),
            "box": box,
            "semantic_ids": self.ids.tolist(),
            "residuals": self.residuals.tolist(),
            "missing_ids": list(self.missing_ids),
            "mirrored": self.mirrored,
            "mesh": None if self.mesh_path is None else str(self.mesh_path),
            "camera": None if self.camera is None else self.camera.to_dict(),
            "silhouette_iou": self.silhouette_iou,
            "none_probability": self.none_probability,
        }


logger = logging.getLogger("cadalign")

_SHORTFALL = 0.05
_GRAB_ROUNDS = 5
_MARGIN = 0.15  # around keypoints and boxes, as a share of their extent


def rerank(
    table: ModelTable, matches: Sequence[Match], mask: npt.ArrayLike, camera: Camera
) -> list[Match]:
    """Rank the best matches by keypoints and silhouettes together.

    They get their ``silhouette_iou``, and ``score`` is redistributed among them. The likelihood
    remains that of the keypoints.
    """
    casts = (cast_match(match, camera, table.mesh_at) for match in matches)
    found = [None if cast is None else silhouette_iou(est=cast.mask, gt=mask) for cast in casts]
    known = [overlap for overlap in found if overlap is not None]
    if not known:
        logger.warning("none of the matches has a mesh: the mask is not used")
        return list(matches)
    mean = float(np.mean(known))
    gains = np.array([(mean if overlap is None else overlap) / _SHORTFALL for overlap in found])
    log_scores = np.array([match.log_likelihood for match in matches]) + gains
    weights = np.exp(log_scores - log_scores.max())
    weights *= sum(match.score for match in matches) / weights.sum()
    order = np.lexsort(([match.model_id for match in matches], -log_scores))
    return [
        replace(matches[k], score=float(weights[k]), silhouette_iou=found[k])
        for k in order.tolist()
    ]


def mask_of(
    mask: npt.ArrayLike | None,
    image: npt.ArrayLike | None,
    matches: Sequence[Match],
    camera: Camera,
) -> npt.NDArray[Any]:
    """Choose the object's pixels: the given mask, the image's opacity, or a segmentation.

    The segmentation (OpenCV's GrabCut) starts from the box around the keypoints and the best match.
    The parameters are those of `cadalign.Library.retrieve`.
    """
    if (mask is None) == (image is None):
        raise InputError("give a mask or an image, not both", where="mask")
    where = "image" if mask is None else "mask"
    found = np.asarray(image if mask is None else mask)
    if mask is None:
        if found.dtype != np.uint8 or found.ndim != 3 or found.shape[2] not in (3, 4):
            what = f"{found.dtype} of shape {found.shape}, expected an RGB or RGBA image of uint8"
            raise InputError(what, where="image")
        found = found[:, :, 3] if found.shape[2] == 4 else _segment(found, matches, camera)
    if found.shape != (camera.height, camera.width):
        size = f"{camera.height} high and {camera.width} wide"
        what = f"shape {found.shape}, but the camera's image is {size}"
        raise InputError(what, where=where)
    if np.isnan(silhouette_iou(est=found, gt=found)):
        raise InputError("contains no pixel of the object", where=where)
    return found


def cast_match(
    match: Match, camera: Camera, mesh_at: Callable[[Path], Mesh] = load_mesh
) -> Geometry | None:
    """Cast rays at a match's mesh; None if there is none or, with a warning, it is unreadable."""
    if match.mesh_path is None:
        return None
    try:
        return cast_geometry(Scene(mesh_at(match.mesh_path)), camera, match.alignment)
    except CadalignError as error:
        logger.warning("no silhouette: %s", error)
        return None


def _segment(pixels: npt.NDArray[Any], matches: Sequence[Match], camera: Camera) -> BoolArray:
    corners = camera.project(matches[0].box.corners)
    points = np.concatenate([matches[0].points_2d, corners])
    margin = _MARGIN * np.ptp(points, axis=0)
    last = np.array(pixels.shape[1::-1]) - 1
    left, top = np.clip(points.min(axis=0) - margin, 0, last).astype(int).tolist()
    right, bottom = np.clip(points.max(axis=0) + margin, 0, last).astype(int).tolist()
    labels: npt.NDArray[Any] = np.full(pixels.shape[:2], cv2.GC_BGD, dtype=np.uint8)
    labels[top : bottom + 1, left : right + 1] = cv2.GC_PR_FGD
    is_split = (labels == cv2.GC_BGD).any() and (labels != cv2.GC_BGD).any()
    return grab_cut(pixels, labels) if is_split else labels == cv2.GC_PR_FGD


def grab_cut(pixels: npt.NDArray[Any], labels: npt.NDArray[Any]) -> BoolArray:
    """Segment an image (h, w, 3) by its colours, from OpenCV's labels (h, w) of a part of it.

    Rother, Kolmogorov, Blake, "GrabCut: interactive foreground extraction using iterated graph
    cuts" (2004).
    """
    cv2.setRNGSeed(0)
    bgr = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    colors = np.zeros((2, 1, 65))
    whole = (0, 0, 1, 1)  # not used with labels
    cv2.grabCut(bgr, labels, whole, colors[0], colors[1], _GRAB_ROUNDS, cv2.GC_INIT_WITH_MASK)
    return np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD))
