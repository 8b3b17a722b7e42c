"""Evidence beyond a photo's keypoints: kept as the observation file has it, and used."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from cadalign.errors import DataError
from cadalign.geometry.symmetry import Symmetry
from cadalign.io.evidence import LENGTHS, ImageEvidence, Size
from cadalign.io.observation import Observation
from cadalign.io.observed_image import ObservedImage

_LABELS = {
    "mask": "mask",
    "depth": "depth",
    "up": "gravity",
    "camera_height": "camera height",
    "cam_from_rig": "known camera poses",
}


@dataclass(frozen=True, eq=False)
class FurtherEvidence:
    """Evidence of an observation file beside the keypoints of the photo that is annotated.

    Parameters
    ----------
    image : ImageEvidence
        Of the photo.
    others : tuple of ObservedImage
        The file's other images.
    place : int
        The photo's number among all of them.
    size : Size, optional
        Known lengths of the object.
    sigma : float, optional
        Stored standard deviation of all keypoints in place of their own [px].
    symmetry : Symmetry, optional
        The model's; kept, but without effect while pairs are marked.
    """

    image: ImageEvidence = field(default_factory=ImageEvidence)
    others: tuple[ObservedImage, ...] = ()
    place: int = 0
    size: Size | None = None
    sigma: float | None = None
    symmetry: Symmetry | None = None

    @classmethod
    def of(cls, observation: Observation, photo: Path, *, where: Path) -> FurtherEvidence:
        """The evidence of a file that shows a photo; raises DataError if none of its views does."""
        views = observation.views
        place = _place_of(photo, views, where=where)
        options = observation.fit_options
        # Beside a prior on the stretch it is the annotator's own, from the pairs of that time.
        sigma = None if "scale_prior_sigma" in options else options.get("sigma")
        return cls(
            views[place].evidence,
            views[:place] + views[place + 1 :],
            place,
            observation.size,
            sigma if isinstance(sigma, float) else None,
            observation.symmetry,
        )

    def labels(self, observation: Observation) -> tuple[str, ...]:
        """Name what an observation holds beyond the photo's keypoints, for the page."""
        views = observation.views
        given = set().union(*(view.evidence.given for view in views))
        if any(view.depths is not None for view in views):
            given.add("depth")
        labels = [label for name, label in _LABELS.items() if name in given]
        count = len(self.others)
        if count:
            labels.append(f"{count} other view{'s' if count > 1 else ''}")
        if observation.size is not None:
            labels.append(f"known {' and '.join(_lengths(observation.size))}")
        return tuple(labels)

    def added_to_image(self, photo: ObservedImage) -> ObservedImage:
        """The photo's keypoints with what else is known of the photo."""
        evidence = self.image
        if photo.depths is None and evidence.depth is None and evidence.depth_sigma is not None:
            evidence = replace(evidence, depth_sigma=None)  # all keypoints with depths are gone
        return replace(photo, evidence=evidence)

    def added_to(self, photo: ObservedImage, **of_the_object: object) -> Observation:
        """The observation of the photo's keypoints and of all that is known beside them.

        ``of_the_object`` are the fields of `Observation` beyond those of an image.
        """
        photo = self.added_to_image(photo)
        views = [*self.others[: self.place], photo, *self.others[self.place :]]
        kept = {"others": tuple(views[1:]), "symmetry": self.symmetry}
        fields = {**vars(views[0]), **kept, **of_the_object}
        return Observation(**fields)


def _place_of(photo: Path, views: tuple[ObservedImage, ...], *, where: Path) -> int:
    """The number of the view that shows a photo; of a single view its own."""
    if len(views) == 1:
        return 0
    for number, view in enumerate(views):
        if view.image is not None and view.image.exists() and view.image.samefile(photo):
            return number
    raise DataError(
        f"none of its {len(views)} views has the image {photo.name}",
        where=str(where),
        fix="annotate the image of one of them, or give another --observation",
    )


def _lengths(size: Size) -> list[str]:
    return [name for name in LENGTHS if getattr(size, name) is not None]


def known_depths(depths: list[float | None]) -> np.ndarray | None:
    """Depths (n,) of keypoints, NaN where unknown; None where all are."""
    if all(depth is None for depth in depths):
        return None
    return np.array([np.nan if depth is None else depth for depth in depths])
