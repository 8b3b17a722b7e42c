"""Result of a retrieval."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import InputError
from cadalign.estimation.result import Result
from cadalign.estimation.result_parts import Posterior, ViewResult
from cadalign.geometry.alignment import Alignment, Box, Uncertainty, deviation_text, uncertainty_of
from cadalign.geometry.camera import Camera
from cadalign.io.meshes.files import load_mesh
from cadalign.io.observation import Observation

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
    mesh_path: Path | None
    none_probability: float | None = None
    """Probability that the object is none of the library's models, not even stretched: the same in
    all matches of an image. See `cadalign.retrieval.absence`. None in a ranking by shape, which
    takes the object for none of them."""
    camera: Camera | None = field(default=None, repr=False)
    """The camera of the image."""
    posterior: Posterior = field(default_factory=Posterior, repr=False)
    """The uncertainty of the pose and stretch, if this is the model; see `result`."""

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
    def std(self) -> Uncertainty | None:
        """Standard deviations of pose and stretch; see `result`."""
        found = self.posterior.covariance
        return None if found is None else uncertainty_of(found)

    @property
    def stretch_texts(self) -> tuple[str, str]:
        """The stretches along y and z with their standard deviations, as tables show them."""
        std = (0.0, 0.0, 0.0) if self.std is None else self.std.scale
        _, y, z = map("{:.3f}{}".format, self.alignment.scale, map(deviation_text, std))
        return y, z

    @property
    def result(self) -> Result:
        """The match in the form of every estimate: its pose, residuals, box, and JSON form.

        Its ``std`` is that of `cadalign.fit` of the keypoints or, in a ranking by shape, that of
        the estimated shape, in the model's unit. A match by OpenCV's EPnP has none.

        Raises
        ------
        InputError
            If the match has no camera.
        """
        if self.camera is None:
            raise InputError("the match has no camera", where="camera", fix="retrieve it again")
        ids, own = tuple(self.ids.tolist()), self.posterior
        inliers = np.ones(self.shared, dtype=bool)
        seen = (self.camera, self.alignment, ids, self.points_2d, self.residuals, inliers, own)
        return Result(
            (ViewResult(*seen),), ids, self.points_3d, METHOD, own, own_bounds=self.bounds
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
            "mesh": None if self.mesh_path is None else str(self.mesh_path),
            "camera": None if self.camera is None else self.camera.to_dict(),
            "none_probability": self.none_probability,
            "std": self.std
            and {name: np.asarray(each).tolist() for name, each in vars(self.std).items()},
        }
