"""Replacements of an observation's own camera, evidence and size."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from cadalign.errors import InputError
from cadalign.geometry.camera import Camera
from cadalign.geometry.pixels import PixelOrigin
from cadalign.io.evidence import ImageEvidence, Size, as_arguments
from cadalign.io.observation import Observation


@dataclass(frozen=True)
class ObservationChanges:
    """Camera, evidence and size in the place of those of observations.

    Parameters
    ----------
    camera : Path, optional
        File of the calibrated camera; see `cadalign.io.camera_file.read_camera`.
    pixel_origin : {"center", "corner"}, optional
        Of that camera.
    evidence : mapping
        Fields of `ImageEvidence`.
    size : Size, optional
    """

    camera: Path | None = None
    pixel_origin: PixelOrigin | None = None
    evidence: Mapping[str, Any] = field(default_factory=dict)
    size: Size | None = None

    def read_camera(self, size: tuple[int, int] | None) -> Camera | None:
        """The camera, if there is one; ``size`` is the photo's, for a file of a matrix alone."""
        if self.camera is None:
            return None
        return _read_camera(self.camera, size, self.pixel_origin)

    def applied_to(self, observation: Observation) -> Observation:
        """The observation with all of this in the place of its own.

        Raises
        ------
        InputError
            If the observation has several views, which one camera or mask does not fit.
        """
        own = observation.camera
        camera = self.read_camera((own.width, own.height))
        changes: dict[str, Any] = {} if camera is None else {"camera": camera}
        if self.evidence:
            given = observation.evidence.given | dict(self.evidence)
            changes["evidence"] = ImageEvidence(**as_arguments(given))
        if self.size is not None:
            changes["size"] = self.size
        if changes and observation.others:
            raise InputError(
                f"the file has {len(observation.views)} views, the options are for one",
                fix="write camera, masks and other evidence into its `views`",
            )
        return replace(observation, **changes) if changes else observation


@lru_cache(maxsize=64)
def _read_camera(
    path: Path, size: tuple[int, int] | None, pixel_origin: PixelOrigin | None
) -> Camera:
    """Read a camera, which runs over many observations use again and again."""
    from cadalign.io.camera_file import read_camera

    return read_camera(path, size=size, pixel_origin=pixel_origin)
