"""The result of every estimate: its values, its text, pictures, files and exports."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from cadalign.estimation.result_data import ResultData
from cadalign.io.files import as_path, write_json

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from cadalign.export.aligned_object import Frame
    from cadalign.geometry.mesh import Mesh


@dataclass(frozen=True, eq=False)
class Result(ResultData):
    """Pose, stretch and shape of an object, with their uncertainty.

    What `cadalign.fit`, `cadalign.align`, batches, retrieval and the annotator return. Its values
    are those of `cadalign.estimation.result_data.ResultData`.
    """

    def __str__(self) -> str:
        return _text_of(self)

    def __repr__(self) -> str:
        stretch = ", ".join(f"{value:.3g}" for value in self.stretch)
        views = "" if len(self.views) == 1 else f"views={len(self.views)}, "
        return (
            f"Result({self.method!r}, {views}keypoints={int(self.inliers.sum())}/"
            f"{len(self.inliers)}, rms={self.rms:.3g} px, stretch=({stretch}), "
            f"warnings={len(self.warnings)})"
        )

    def plot(
        self,
        image: npt.ArrayLike | str | os.PathLike[str] | None = None,
        mesh: Mesh | None = None,
        *,
        view: int = 0,
        axes: Axes | None = None,
    ) -> Axes:
        """Draw photo, model, box, and keypoints with their residuals on matplotlib axes.

        Parameters
        ----------
        image : (h, w, 3) uint8 or path, optional
            The photo; grey by default.
        mesh : Mesh, optional
            As for `mesh`, drawn shaded with its outline; by default that of the model, if it has
            one. Without any the box is the object's, or the keypoints'.
        view : int
            Number of the view to draw.
        axes : matplotlib.axes.Axes, optional
            The axes to draw on; those of a new figure by default.

        Returns
        -------
        matplotlib.axes.Axes
            In pixels: x right, y down.

        Raises
        ------
        InputError
            If there is no such view, or the photo is not of its camera's size.

        Examples
        --------
        >>> from matplotlib.figure import Figure
        >>> from cadalign import Camera, fit
        >>> camera = Camera(640, 480, 900, 900, 319.5, 239.5)
        >>> corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
        >>> result = fit(corners, camera.project(corners + [0.1, 0.2, 5.0]), camera)
        >>> axes = result.plot(axes=Figure().add_subplot())
        >>> [float(y) for y in axes.get_ylim()]
        [479.5, -0.5]
        """
        from cadalign.estimation.outputs import plot_result

        return plot_result(self, image, mesh, view=view, axes=axes)

    def export(
        self,
        path: str | os.PathLike[str],
        *,
        format: str | None = None,
        frame: Frame = "camera",
        **of_the_object: Any,
    ) -> Path:
        """Write the aligned object for another tool; see `cadalign.export.export_object`.

        Parameters
        ----------
        path : path-like
            Its ending chooses the format: ``.glb``, ``.obj`` or ``.ply``.
        format, frame
            As for `cadalign.export.export_object`.
        **of_the_object
            ``mesh``, ``image`` or ``images``, ``world_from_cam``, ``name`` and ``metres`` of
            `cadalign.estimation.object_of`.

        Examples
        --------
        >>> result.export("chair.glb", mesh=mesh, image="chair.jpg")  # doctest: +SKIP
        """
        from cadalign.estimation.outputs import object_of
        from cadalign.export import export_object

        exported = object_of(self, **of_the_object)
        return export_object(path, exported, format=format, frame=frame)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the result as JSON, as `cadalign fit` does.

        Raises
        ------
        DataError
            If the file cannot be written.
        """
        write_json(as_path(path), self.to_dict())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Result:
        """Read what `save` or `cadalign fit` wrote.

        Raises
        ------
        DataError
            If the file cannot be read, or a field is missing or invalid; the message names both.
        """
        from cadalign.io.documents import in_file, read_json

        path = as_path(path)
        data = read_json(path)
        with in_file(path):
            return cls.from_dict(data)

    def to_dict(self) -> dict[str, Any]:
        """Write the result as plain lists and numbers, for JSON, without the model."""
        from cadalign.estimation.document import write_result  # takes the validation library along

        return write_result(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Result:
        """Read what `to_dict` wrote.

        Raises
        ------
        InputError
            If a field is missing or invalid.
        """
        from cadalign.estimation.document import read_result

        return read_result(data, cls)


def _text_of(result: ResultData) -> str:
    """Keypoints, rotation, translation, stretch, focal length, alternatives, warnings."""
    count, of = int(result.inliers.sum()), len(result.inliers)
    some = f"{count}" if count == of else f"{count} of {of}"
    views = "" if len(result.views) == 1 else f" in {len(result.views)} views"
    std, pose = result.std, result.alignment
    angle = np.degrees(np.arccos(np.clip((np.trace(pose.rotation) - 1) / 2, -1, 1)))
    rotation = f"{angle:.4g} deg from the camera's axes"
    translation = f"({', '.join(f'{value:.4g}' for value in pose.translation)})"
    stretch = [f"{value:.4g}" for value in result.stretch]
    known_to = ""
    if std is not None:
        rotation += f", +- {std.rotation_deg:.2g} deg"
        translation += f" +- ({', '.join(f'{value:.2g}' for value in std.translation)})"
        stretch = [
            text if deviation == 0 else f"{text} +- {100 * deviation:.2g} %"
            for text, deviation in zip(stretch, std.scale, strict=True)
        ]
        known_to = f" +- {100 * std.focal:.2g} %"
    lines = [
        f"{result.method}: {some} keypoints{views}, rms {result.rms:.3g} px",
        f"  rotation     {rotation}",
        f"  translation  {translation}",
        f"  stretch      ({', '.join(stretch)})",
    ]
    if result.focal == "estimate":
        prior = "" if result.focal_prior is None else f" (prior: {result.focal_prior})"
        lines.append(f"  focal length {result.camera.fx:.4g} px{known_to}{prior}")
    lines.extend(
        f"  also likely  ({other.relative_likelihood:.2g} x): scale "
        f"({', '.join(f'{value:.4g}' for value in other.alignment.scale)})"
        for other in result.alternatives
    )
    if len(result.evidence) > 1:
        lines.extend(f"  evidence     {each}" for each in result.evidence)
    lines.extend(f"  warning      {text}" for text in result.warnings)
    return "\n".join(lines)
