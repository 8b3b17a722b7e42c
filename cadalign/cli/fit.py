"""`cadalign fit` and `cadalign export`: align models to observations, and write the result."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from cadalign.batch.observation_fit import ObservationFit
from cadalign.cli.common import answer, path_beside, say, show_status
from cadalign.cli.options import CameraOptions, ManyCommand, name_flags
from cadalign.errors import DataError
from cadalign.export.aligned_object import AlignedObject, export_object, format_of
from cadalign.io.documents import name_file, read_json
from cadalign.io.files import create_folder, protect_inputs, write_text
from cadalign.io.images import write_image
from cadalign.io.kinds import FIT

if TYPE_CHECKING:
    from cadalign.estimation.result import Result
    from cadalign.io.observation import Observation
    from cadalign.render.canvas import ByteImage


@dataclass(frozen=True, kw_only=True)
class Fit(ManyCommand, ObservationFit, CameraOptions):
    """Align a model to an observation, and draw the result.

    An observation holds keypoints in one or several views, and optionally masks, depth, gravity,
    the camera's height and known lengths. Further settings, such as priors, are fields of the
    observation file. Prints the alignment and how well each piece of evidence agrees with it.
    Writes fit.json and one picture per view: overlay.png, overlay_1.png and so on.

    Several observations, or a detector's file even of one object, are aligned as a run. Instead of
    fit.json it writes results.parquet and results.csv, with a row per observation, and report.html.
    A killed run continues when the same command is started again.

    Exit codes of a run: 0 all aligned, 3 some failed, 1 all failed or the input was refused, 2
    wrong command line.
    """

    out: Path | None = None
    """Output folder; by default <observation>_fit beside the observation file or folder."""
    focal: Literal["known", "estimate"] | float | None = None  # type: ignore[assignment]
    """Focal length [px]; or known, to use the file's value; or estimate. By default known if every
    view has a focal length, otherwise estimate. Views with equal cameras share one estimate."""

    @property
    def estimate(self) -> ObservationFit:
        """The options of the estimate."""
        given = {each.name: getattr(self, each.name) for each in fields(ObservationFit)}
        given["focal"] = self.focal if isinstance(self.focal, str) else None
        return ObservationFit(**given)

    def run(self) -> int:
        """Do the fit or the run; returns the exit code."""
        path, how = self.first, self.estimate
        with name_flags(self):
            data = self.read_single()
            if data is None:
                from cadalign.batch.runs import FitRunOptions  # takes time to import
                from cadalign.cli.runs import inputs_of, run_command

                options = FitRunOptions(estimate=how, **inputs_of(self))
                return run_command(self, options, done="aligned")
            how.check()
            seen = how.read(data, str(path), folder=path.parent, changes=self.changes)
            seen = how.override(seen)
            with show_status("fitting"):
                result = how.fit(seen, str(path), note=say)
        self._write(path, seen, result)
        return 0

    def _write(self, path: Path, seen: Observation, result: Result) -> None:
        """Draw, write and print the result of a fit."""
        pictures = draw_views(seen, result) if self.picture else []
        out = self.out or path_beside(path, "_fit")
        create_folder(out)
        fitted = seen.to_dict(folder=out.absolute())
        text = json.dumps(result.to_dict() | {"observation": fitted}, indent=2) + "\n"
        paths = [out / f"overlay{f'_{row}' if row else ''}.png" for row in range(len(pictures))]
        with protect_inputs([path, *seen.files]):
            write_text(out / "fit.json", text)
            for each, picture in zip(paths, pictures, strict=True):
                write_image(each, picture)
        if self.json:
            sys.stdout.write(text)
            return
        answer(str(result))
        if paths:
            listed = ", ".join(map(str, paths))
            say(f"{'Picture' if len(paths) == 1 else 'Pictures'}: {listed}")


def draw_views(observation: Observation, result: Result) -> list[ByteImage]:
    """Draw the result on all views; raises DataError if a photo or the model cannot be read.

    A stretched model fitted to keypoints alone is drawn as a box.
    """
    from cadalign.io.images import read_mask
    from cadalign.render.overlay import draw_result, mesh_of, photo_of

    mesh = mesh_of(observation, result)
    bounds = mesh.bounds if mesh is not None and result.method != "align" else None
    pictures = []
    for number, (image, view) in enumerate(zip(observation.views, result.views, strict=True)):
        mask = image.evidence.mask
        picture = draw_result(
            photo_of(image.image, view.camera),
            result,
            mesh=mesh if bounds is None else None,
            bounds=bounds,
            mask=None if mask is None else read_mask(mask),
            number=number,
        )
        pictures.append(picture)
    return pictures


@dataclass(frozen=True)
class Export:
    """Write a fit for another tool.

    GLB holds the aligned model with its texture, the cameras, and the photos behind the model.
    Blender, three.js and other viewers show the same scene as the overlay. OBJ and PLY hold only
    the mesh.
    """

    fit: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FIT.JSON")]
    """The fit.json of `cadalign fit`, or its folder."""
    to: Path
    """File to write. Its ending sets the format: .glb, .obj or .ply."""

    def run(self) -> int:
        """Write the file; returns the exit code."""
        fit = self.fit / "fit.json" if self.fit.is_dir() else self.fit
        with name_flags(self):
            about = format_of(self.to).about
            path = export_object(self.to, self._object(fit))
        say(f"{path}: {about}")
        return 0

    def _object(self, fit: Path) -> AlignedObject:
        """Read the aligned object of a fit.json; raises DataError if the file cannot be used."""
        from cadalign.estimation.result import Result
        from cadalign.export.results import object_of
        from cadalign.io.observation import Observation
        from cadalign.render.overlay import mesh_of
        from cadalign.shapes.model import ShapeModel

        data = read_json(fit, FIT)
        if not isinstance(data, dict) or not isinstance(data.get("observation"), dict):
            what = "the file holds no fit with its observation"
            raise DataError(what, where=str(fit), fix="give the fit.json of `cadalign fit`")
        with name_file(fit):
            seen = Observation.from_dict(data["observation"], folder=fit.parent, needs_xyz=False)
            result = Result.from_dict(data)
            if result.method == "align" and seen.shape is not None:
                model = ShapeModel.open(seen.shape)
                if tuple(model.ids) != result.ids:
                    what = f"its {len(model.ids)} keypoints are not the fit's {len(result.ids)}"
                    raise DataError(what, where=str(seen.shape), fix="fit the observation again")
                result = replace(result, model=model)
            mesh = mesh_of(seen, result)
            exported = object_of(
                result if mesh is None else replace(result, model=None),  # it is warped already
                mesh=mesh,
                photos=[view.image for view in seen.views],
                name="model" if seen.model is None else seen.model.stem,
            )
        return replace(exported, sources=(fit, *seen.files))
