"""`cadalign fit`: align the models of observation files; `export`: a fit for another tool."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from cadalign.batch.observation_fit import ObservationFit
from cadalign.cli.common import answer, beside, make_folder, say, waiting
from cadalign.cli.options import CameraOptions, ManyCommand, named_as_flags
from cadalign.errors import DataError, InputError, refuse_unused
from cadalign.export.aligned_object import AlignedObject, export_object, format_of
from cadalign.io.documents import in_file, read_json
from cadalign.io.files import keeping, write_text
from cadalign.io.kinds import FIT, OBSERVATION, is_of_many

if TYPE_CHECKING:
    from cadalign.estimation.result import Result
    from cadalign.io.observation import Observation
    from cadalign.render.canvas import ByteImage

_MOST_LISTED = 10


@dataclass(frozen=True, kw_only=True)
class Fit(ManyCommand, ObservationFit, CameraOptions):
    """Align a model to what an observation file holds, and draw the result.

    Keypoints in one image, or in several views; masks, depth, gravity, the camera's height and
    known lengths. Prints the alignment and how well each piece of evidence agrees with it. Further
    options, such as priors, stand in the file. Writes fit.json and overlay.png, overlay_1.png and
    so on for further views. Many observations, as of several objects of one photo, are a run, which
    goes on where it was killed: it writes results.parquet and results.csv with a row for each, and
    report.html. Exit codes of a run: 0 all are aligned, 3 some failed, 1 all failed or refused, 2 a
    wrong command line.
    """

    out: Path | None = None
    """Folder to write to; by default <observation>_fit beside the file or folder."""
    overlay: Path | None = None
    """Draw the aligned model over the photo, too, and write it to this picture; further views to
    FILE_1 and so on. The observation names the model."""
    focal: Literal["known", "estimate"] | float | None = None  # type: ignore[assignment]
    """Focal length [px], in the place of the file's, or: known (the file's) or estimate; by default
    known, if every view has one. Views of equal cameras share an estimated one."""

    @property
    def estimate(self) -> ObservationFit:
        """The options of the estimate."""
        given = {each.name: getattr(self, each.name) for each in fields(ObservationFit)}
        given["focal"] = self.focal if isinstance(self.focal, str) else None
        return ObservationFit(**given)

    def run(self) -> int:
        """Run the fit, or the fits; returns the exit code."""
        path = self.first()
        is_file = path.suffix.lower() == ".json" and os.path.isfile(path)
        data = read_json(path) if is_file else None
        if len(self.observations) > 1 or is_of_many(path, data):
            return self._fit_many()
        with named_as_flags(self):
            data = read_json(path, OBSERVATION) if data is None else data
            how = self.estimate
            how.check()
            seen = how.read(data, str(path), folder=path.parent, changes=self.changes)
            seen = how.changed(seen)
            self.refuse_of_many()
            if self.overlay is not None and seen.shape is None and seen.model is None:
                fix = "give the file's `model` a mesh, or leave out the option"
                raise InputError(f"{path} names no model to draw", where="overlay", fix=fix)
            with waiting("fitting"):
                result = how.fit(seen, str(path), note=say)
        self._write(path, seen, result)
        return 0

    def _write(self, path: Path, seen: Observation, result: Result) -> None:
        """Draw the fit of an observation file, and write and print what was found."""
        pictures, overlays = drawn(
            seen, result, picture=self.picture, overlay=self.overlay is not None
        )
        out = self.out or beside(path, "_fit")
        make_folder(out)
        fitted = seen.to_dict(folder=out.absolute())
        text = json.dumps(result.to_dict() | {"observation": fitted}, indent=2) + "\n"
        with keeping([path, *seen.files]):
            # First what somebody names, which may be refused.
            further = [] if self.overlay is None else write_pictures(self.overlay, overlays)
            write_text(out / "fit.json", text)
            paths = [*write_pictures(out / "overlay.png", pictures), *further]
        if self.json:
            sys.stdout.write(text)
            return
        answer(str(result))
        if paths:
            listed = ", ".join(map(str, paths))
            say(f"{'Picture' if len(paths) == 1 else 'Pictures'}: {listed}")

    def _fit_many(self) -> int:
        """Align all observations; returns the exit code."""
        from cadalign.batch.runs import FitRunOptions
        from cadalign.cli.runs import inputs_of, run_command

        with named_as_flags(self):
            refuse_unused(self, ["overlay"], "on many observations")
            options = FitRunOptions(estimate=self.estimate, **inputs_of(self))
            return run_command(self, options, done="aligned")


def drawn(
    observation: Observation, result: Result, *, picture: bool, overlay: bool
) -> tuple[list[ByteImage], list[ByteImage]]:
    """Pictures of all views, and the model over their photos; each photo is read once.

    The mesh of a stretched model fitted to keypoints alone is drawn as a box. Raises InputError for
    overlays without a mesh, DataError if a photo or the model cannot be read.
    """
    if not picture and not overlay:
        return [], []
    from cadalign.io.images import read_mask
    from cadalign.render import Scene, overlay_model
    from cadalign.render.overlay import draw_result, mesh_of, photo_of

    seen = list(zip(observation.views, result.views, strict=True))
    photos = [photo_of(image.image, view.camera) for image, view in seen]
    mesh = mesh_of(observation, result)
    bounds = mesh.bounds if mesh is not None and result.method != "align" else None
    masks = [each.evidence.mask for each in observation.views]
    pictures = [
        draw_result(
            photo,
            result,
            mesh=mesh if bounds is None else None,
            bounds=bounds,
            mask=None if mask is None else read_mask(mask),
            number=number,
        )
        for number, (photo, mask) in enumerate(zip(photos, masks, strict=True))
        if picture
    ]
    if not overlay:
        return pictures, []
    if mesh is None:
        raise InputError("no mesh of the object is known", where="--overlay")
    scene = Scene(mesh)
    return pictures, [
        overlay_model(photo, view.camera, scene, view.alignment)
        for photo, (_, view) in zip(photos, seen, strict=True)
    ]


def write_pictures(path: Path, pictures: Sequence[ByteImage]) -> list[Path]:
    """Write the first picture to a path, further ones to NAME_1 and so on; returns their paths."""
    if not pictures:
        return []
    from cadalign.io.images import write_image

    further = (path.with_stem(f"{path.stem}_{row}") for row in range(1, len(pictures)))
    paths = [path, *further]
    for each, picture in zip(paths, pictures, strict=True):
        write_image(each, picture)
    return paths


@dataclass(frozen=True)
class Export:
    """Write a fit for another tool.

    GLB holds the textured model, stretched or warped, the cameras and the photos behind it: it
    opens in Blender, three.js and viewers as the overlay shows it. OBJ and PLY hold the mesh.
    """

    fit: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FIT.JSON")]
    """Result of `cadalign fit`, or its folder."""
    to: Path
    """File to write, whose ending tells the format: .glb, .obj, .ply."""

    def run(self) -> int:
        """Write the file; returns the exit code."""
        fit = self.fit / "fit.json" if self.fit.is_dir() else self.fit
        with named_as_flags(self):
            about = format_of(self.to).about
            path = export_object(self.to, self._object(fit))
        say(f"{path}: {about}")
        return 0

    def _object(self, fit: Path) -> AlignedObject:
        """The aligned object of a fit's file, with the observation that it holds."""
        from cadalign.estimation.result import Result
        from cadalign.export.results import object_of
        from cadalign.io.observation import Observation
        from cadalign.render.overlay import mesh_of
        from cadalign.shapes.model import ShapeModel

        data = read_json(fit, FIT)
        if not isinstance(data, dict) or not isinstance(data.get("observation"), dict):
            what = "the file holds no fit with the observation that was fitted"
            raise DataError(what, where=str(fit), fix="give the fit.json of `cadalign fit`")
        with in_file(fit):
            seen = Observation.from_dict(data["observation"], folder=fit.parent, needs_xyz=False)
            result = Result.from_dict(data)
            if result.method == "align" and seen.shape is not None:
                model = ShapeModel.open(seen.shape)
                if tuple(model.ids) != result.ids:
                    what = f"{len(model.ids)} keypoints that are not the fit's {len(result.ids)}"
                    raise DataError(what, where=str(seen.shape), fix="fit the observation again")
                result = replace(result, model=model)
            exported = object_of(
                result,
                mesh=mesh_of(seen, result),
                photos=[view.image for view in seen.views],
                name="model" if seen.model is None else seen.model.stem,
            )
        return replace(exported, sources=(fit, *seen.files))
