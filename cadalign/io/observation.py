"""Observations: one object's keypoints in one or more images, as a JSON file.

The file of one image holds one object::

    {
      "camera": {"model": "PINHOLE", "width": 640, "height": 480,
                 "params": [935.0, 935.0, 320.0, 240.0]},
      "keypoints": [
        {"xyz": [0.11, 0.42, -0.08], "uv": [351.2, 204.9], "sigma": 1.0, "semantic_id": 3,
         "name": "back, top left", "confidence": 0.93},
        ...
      ],
      "image": "photo.png",
      "model": "chair.obj",
      "fit": {"sigma": null, "loss": "linear"}
    }

``camera`` is COLMAP's form, principal point in COLMAP's convention (the top-left corner of the
image is (0, 0)), see `cadalign.Camera.from_dict`; an unknown focal length is ``null`` there, or
``{"width": 640, "height": 480}`` is all that is given. ``xyz`` is in model units, ``uv`` in pixels
with integers at pixel centres, of the photo as it is seen: turned upright where EXIF says so.
``sigma`` [px], ``semantic_id``, ``name`` and ``confidence`` (a detector's score, not negative) are
optional, each given for all keypoints or for none. ``image`` and ``model`` are optional paths,
relative to the file. ``fit`` holds options for `cadalign.fit` where they are not its defaults:
``method``, ``sigma`` (one for all keypoints or a list, in place of theirs; ``null`` estimates it),
``loss``, ``loss_scale``, ``stretch``, ``scale_prior_sigma``, ``known_axis`` and ``focal``; and
``shape_sigma`` of `cadalign.Model`, for a model that is only similar.

Evidence beyond keypoints stands beside them, each field optional, deviations and scales as
`cadalign.View` and `cadalign.Size` describe them::

      "mask": "photo.mask.png", "mask_sigma": 1.5,
      "depth": "photo.depth.png", "depth_scale": 0.001, "depth_sigma": 0.01,
      "up": [0.02, -0.97, 0.24], "up_sigma_deg": 1.0,
      "camera_height": 1.45, "camera_height_sigma": 0.02,
      "size": {"width": 0.45, "height": 0.91, "length": 0.52, "sigma": 0.01},
      "shape": "chair.shape"

``mask`` and ``depth`` are PNG files of the camera's size, ``depth`` of 16 bits with ``depth_scale``
units per count; in its place keypoints may have a ``depth`` [units], left out where unknown.
``shape`` is a file of `cadalign shape learn`, which takes the model's place. Several images of one
object stand in ``views``, each with camera, image, keypoints (or none) and evidence of its own; and
``cam_from_rig``, a 4 x 4 matrix by rows, for all of them or for none, if the cameras' motion is
known. Keypoints of the same ``semantic_id`` (or else ``name``, or else ``xyz``) are the same::

    {
      "model": "chair.obj",
      "views": [
        {"camera": ..., "image": "left.png", "keypoints": [...], "mask": "left.mask.png",
         "cam_from_rig": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]},
        {"camera": ..., "image": "right.png", "keypoints": [...], "cam_from_rig": [...]}
      ]
    }
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from cadalign.io.documents import in_file, path_from, read_json, within, written_path
from cadalign.io.files import write_json
from cadalign.io.observation_file import (
    fill_xyz,
    read_fields,
    read_image_fields,
    read_size,
    write_image_fields,
)
from cadalign.io.observed_image import KnownSize, ObservedImage


@dataclass(frozen=True, eq=False)
class Observation(ObservedImage):
    """An object in one image, or in several: this is the first one.

    Parameters
    ----------
    points_3d, points_2d, camera, sigma, semantic_ids, names, confidences, image, depths, evidence
        Of the first image, as for `ObservedImage`.
    model : Path, optional
        The CAD model.
    fit_options : mapping
        Keyword arguments for `cadalign.fit` where they are not its defaults; see the module.
    others : tuple of ObservedImage
        The other images.
    size : KnownSize, optional
        Known lengths of the object.
    shape : Path, optional
        File of the learned shape that takes the model's place.
    """

    model: Path | None = None
    fit_options: Mapping[str, Any] = field(default_factory=dict)
    others: tuple[ObservedImage, ...] = field(default=(), kw_only=True)
    size: KnownSize | None = field(default=None, kw_only=True)
    shape: Path | None = field(default=None, kw_only=True)

    @property
    def views(self) -> tuple[ObservedImage, ...]:
        """All images, the first one first."""
        return (self, *self.others)

    @property
    def is_plain(self) -> bool:
        """True where nothing but keypoints in one image is known."""
        return not self.others and self.size is None and not self.has_more

    @classmethod
    def load(cls, path: str | Path, *, needs_xyz: bool = True) -> Observation:
        """Read an observation file.

        Parameters
        ----------
        path : str or Path
        needs_xyz : bool
            Whether keypoints must have ``xyz``, which is zero otherwise where it is missing.

        Raises
        ------
        DataError
            If the file is missing, is not JSON, or a field is missing, unknown or invalid; the
            message names file and field.
        """
        path = Path(path)
        data = read_json(path)
        if not needs_xyz:
            data = fill_xyz(data)
        with in_file(path):
            return cls.from_dict(data, folder=path.parent)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], *, folder: Path | None = None) -> Observation:
        """Read the parsed form of an observation file; paths are relative to ``folder``."""
        read, fields = read_fields(data)
        images = []
        for number, each in enumerate(fields):
            with nullcontext() if each is read else within(f"views[{number}]"):
                images.append(read_image_fields(each, folder))
        first, *others = images
        return cls(
            **vars(first),
            model=None if read.model is None else path_from(read.model, folder),
            fit_options=msgspec.to_builtins(read.fit),
            others=tuple(others),
            size=read_size(read.size),
            shape=None if read.shape is None else path_from(read.shape, folder),
        )

    def to_dict(self, *, folder: Path | None = None) -> dict[str, Any]:
        """The parsed form of an observation file, its paths relative to ``folder``."""
        data: dict[str, Any]
        if self.others:
            data = {"views": [write_image_fields(view, folder) for view in self.views]}
        else:
            data = write_image_fields(self, folder)
        for name, path in (("model", self.model), ("shape", self.shape)):
            if path is not None:
                data[name] = written_path(path, folder=folder)
        if self.size is not None:
            data["size"] = self.size.given
        if self.fit_options:
            data["fit"] = dict(self.fit_options)
        return data

    def save(self, path: str | Path) -> None:
        """Write an observation file; paths are written relative to it."""
        write_json(Path(path), self.to_dict(folder=Path(path).parent))
