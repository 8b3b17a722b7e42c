"""`cadalign fit`: align the model of one observation file."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from cadalign.cli.output import make_folder, new_console

if TYPE_CHECKING:
    from cadalign.fitting.options import Sigma
    from cadalign.io.observation import Observation


@dataclass(frozen=True)
class Fit:
    """Align a model to one image's keypoints and draw the result.

    Prints the alignment; writes fit.json and overlay.png.
    """

    observation: Annotated[Path, tyro.conf.Positional]
    """JSON file with camera and keypoints, optionally image and model."""
    out: Path | None = None
    """Folder to write to; by default <observation>_fit beside the file."""
    json: bool = False
    """Print the result as JSON."""
    method: str = "optimal"
    """Which method fits: optimal, aepnp, aepnp-paper or epnp."""
    similar: bool = False
    """The model is only similar to the object: estimate the keypoints' noise from the residuals."""
    robust: bool = False
    """Some keypoints may be wrong: fit to those that agree (RANSAC)."""
    max_reproj_error: float = 4.0
    """With --robust, the largest reprojection error of a keypoint that is kept, in pixels."""
    focal: Literal["known", "estimate"] | None = None
    """Whether the file's focal length is right or is to be estimated too; by default it is right,
    where there is one."""
    exif: bool = True
    """Estimate the focal length with what the photo's EXIF data say of it, if they do."""

    def run(self) -> int:
        """Run the fit; returns the exit code."""
        from cadalign.fitting.fit import fit
        from cadalign.fitting.focal.prior import FocalPrior
        from cadalign.fitting.options import RansacOptions
        from cadalign.io.images import write_image
        from cadalign.io.observation import Observation
        from cadalign.render.drawing.fit_overlay import draw_observation

        observation = Observation.load(self.observation)
        console = new_console()
        focal = self.focal or ("known" if observation.camera.focal_known else "estimate")
        prior = None
        if focal == "estimate" and self.exif and observation.image is not None:
            prior = FocalPrior.from_exif(observation.image)
        if prior is not None:
            sigma = 100 * prior.relative_sigma
            text = f"Focal length by the photo's EXIF data: {prior.focal:.4g} px +-{sigma:.2g} %"
            console.print(text, markup=False)
        with console.status("fitting (the first time after an installation takes a minute)"):
            result = fit(
                observation.points_3d,
                observation.points_2d,
                observation.camera,
                method=self.method,
                sigma=self._sigma(observation),
                ransac=RansacOptions(max_reproj_error=self.max_reproj_error)
                if self.robust
                else None,
                confidences=observation.confidences if self.robust else None,
                focal=focal,
                focal_prior=prior,
            )
        picture = draw_observation(observation, result)
        out = self.out or self.observation.with_name(f"{self.observation.stem}_fit")
        make_folder(out)
        text = json.dumps(result.to_dict(), indent=2)
        (out / "fit.json").write_text(text + "\n", encoding="utf-8")
        write_image(out / "overlay.png", picture)
        if self.json:
            sys.stdout.write(text + "\n")
        else:
            new_console(stderr=False).print(str(result), markup=False)
            console.print(f"Picture: {out / 'overlay.png'}", markup=False)
        return 0

    def _sigma(self, observation: Observation) -> Sigma | None:
        """The keypoints' standard deviations: to be estimated, the file's, or 1 px."""
        if self.similar:
            return None
        return 1.0 if observation.sigma is None else observation.sigma
