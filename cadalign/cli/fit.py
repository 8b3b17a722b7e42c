"""`cadalign fit`: align the models of observation files."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from cadalign.cli.evidence import CameraOptions, EvidenceOptions
from cadalign.cli.options import (
    ManyCommand,
    ObservationCommand,
    OptionError,
    flag_of,
    make_folder,
    named_as_flags,
    say,
    waiting,
)
from cadalign.errors import InputError
from cadalign.estimation.focal import PriorOption
from cadalign.estimation.observation_fit import ObservationFit, refuse_photo
from cadalign.estimation.options import FitOptions, RansacOptions, Sigma
from cadalign.io.documents import read_json, written_path
from cadalign.io.input_kinds import is_of_many

if TYPE_CHECKING:
    from cadalign.arrays import BoolArray, FloatArray
    from cadalign.estimation.result import Result
    from cadalign.estimation.view import View
    from cadalign.io.observation import Observation, ObservationChanges
    from cadalign.render import OverlayStyle
    from cadalign.render.drawing.canvas import ByteImage


@dataclass(frozen=True)
class _FitOptions(FitOptions):
    """Method and model; the observation file supplies the other options."""

    sigma: tyro.conf.Suppress[Sigma | None] = FitOptions.sigma
    focal: tyro.conf.Suppress[str] = FitOptions.focal
    focal_prior: tyro.conf.Suppress[PriorOption] = FitOptions.focal_prior

    def __post_init__(self) -> None:
        with named_as_flags(self, kind=OptionError):
            super().__post_init__()


@dataclass(frozen=True)
class _RansacOptions(RansacOptions):
    """Search for outliers (LO-RANSAC), with --robust."""

    def __post_init__(self) -> None:
        with named_as_flags(self, kind=OptionError):
            super().__post_init__()


@dataclass(frozen=True, kw_only=True)
class EstimateOptions(ObservationFit, ObservationCommand):
    """Model, noise, focal length and robust search of a fit."""

    # A group's own text: without it, tyro reads the documentation of all options for every fit.
    fitting: Annotated[
        _FitOptions, tyro.conf.OmitArgPrefixes, tyro.conf.arg(help=_FitOptions.__doc__)
    ] = _FitOptions()
    ransac: Annotated[
        _RansacOptions, tyro.conf.OmitArgPrefixes, tyro.conf.arg(help=_RansacOptions.__doc__)
    ] = _RansacOptions()

    focal: Literal["known", "estimate"] | float | None = None  # type: ignore[assignment]
    """Focal length [px], in the place of the file's, or: known (the file's) or estimate; by default
    known, if every view has one. Views of equal cameras share an estimated one."""
    named = staticmethod(flag_of)

    @property
    def estimate(self) -> ObservationFit:
        """The options of the estimate alone, without those of the command."""
        given = {field.name: getattr(self, field.name) for field in fields(ObservationFit)}
        if not isinstance(self.focal, str):  # a number is the camera's, see `CameraOptions`
            given["focal"] = None
        given["fitting"] = FitOptions(**vars(self.fitting))
        given["ransac"] = RansacOptions(**vars(self.ransac))
        return ObservationFit(**given)


@dataclass(frozen=True, eq=False)
class FittedFile:
    """Result of a fit of one file, its JSON form, a table, and pictures of each view.

    ``sources`` are the files of the observation and of the learned shape, which fit.json states;
    ``overlays`` are those of the model that were asked for.
    """

    result: Result
    data: dict[str, Any]
    table: str
    sources: dict[str, Path] = field(default_factory=dict)
    pictures: tuple[ByteImage, ...] = ()
    overlays: tuple[ByteImage, ...] = ()

    def text(self, out: Path) -> str:
        """The result as JSON text for a file in a folder, which its sources are relative to."""
        sources = {
            name: written_path(path.absolute(), folder=out.absolute())
            for name, path in self.sources.items()
        }
        return json.dumps(self.data | sources, indent=2) + "\n"

    def write(self, out: Path, *, overlay: Path | None = None) -> list[Path]:
        """Write fit.json and the pictures to a folder; returns the pictures' paths.

        The ``overlays`` go to ``overlay``, those of further views beside it.
        """
        from cadalign.io.files import write_text

        make_folder(out)
        write_text(out / "fit.json", self.text(out))
        paths = _write_pictures(out / "overlay.png", self.pictures)
        return paths if overlay is None else paths + _write_pictures(overlay, self.overlays)


def _write_pictures(path: Path, pictures: tuple[ByteImage, ...]) -> list[Path]:
    """Write the first picture to a path, further ones to NAME_1 and so on; returns their paths."""
    if not pictures:
        return []
    from cadalign.io.images import write_image

    paths = [
        path.with_name(f"{path.stem}_{row}{path.suffix}") if row else path
        for row in range(len(pictures))
    ]
    for each, picture in zip(paths, pictures, strict=True):
        write_image(each, picture)
    return paths


def overlay_style(path: Path, *, mode: Any, opacity: float, has_model: bool) -> OverlayStyle:
    """The style that the options ask for.

    Raises
    ------
    InputError
        If the opacity is out of range, or the observation, read from ``path``, names no model.
    """
    from cadalign.render import OverlayStyle

    if not has_model:
        raise InputError(
            f"{path} names no model to draw",
            where="--overlay",
            fix="give the file's `model` a mesh, or leave out the option",
        )
    try:
        return OverlayStyle(mode=mode, opacity=opacity)
    except InputError as error:
        flag = f"--overlay-{error.where}"
        raise InputError(error.what, where=flag, fix=error.fix) from None


def draw(
    observation: Observation,
    result: Result,
    *,
    views: tuple[View, ...] | None,
    picture: bool,
    style: OverlayStyle | None,
) -> tuple[tuple[ByteImage, ...], tuple[ByteImage, ...]]:
    """Draw the pictures of all views, and their overlays in a style; each photo is read once.

    ``views`` are those that were aligned, None for a stretched model and keypoints alone, whose
    mesh is drawn as a box.

    Raises
    ------
    InputError
        If there is a style, and no mesh.
    DataError
        If a photo or the model cannot be read.
    """
    if not picture and style is None:
        return (), ()
    from cadalign.io.meshes.load import load_mesh
    from cadalign.render.drawing.model_overlay import draw_result, mesh_of, photo_of

    photos = [
        photo_of(image, view.camera)
        for image, view in zip(observation.views, result.views, strict=True)
    ]
    shown = bounds = None
    masks: list[FloatArray | BoolArray | None] = [None]
    if views is not None:
        mesh = shown = mesh_of(observation, result)
        masks = [view.mask_image for view in views]
    else:
        mesh = None if observation.model is None else load_mesh(observation.model)
        bounds = None if mesh is None else mesh.bounds
    pictures = (
        draw_result(image, result, photo=photo, mesh=shown, bounds=bounds, mask=mask, number=number)
        for number, (image, photo, mask) in enumerate(
            zip(observation.views, photos, masks, strict=True)
        )
    )
    drawn = tuple(pictures) if picture else ()
    if style is None:
        return drawn, ()
    if mesh is None:
        raise InputError("no mesh of the object is known", where="--overlay")
    from cadalign.render import Scene, overlay_model

    scene = Scene(mesh)
    overlays = (
        overlay_model(photo, view.camera, scene, view.alignment, style=style)
        for photo, view in zip(photos, result.views, strict=True)
    )
    return drawn, tuple(overlays)


@dataclass(frozen=True, kw_only=True)
class Fit(ManyCommand, EstimateOptions, CameraOptions, EvidenceOptions):
    """Align a model to what an observation file holds, and draw the result.

    Keypoints in one image, or in several views; masks, depth, gravity, the camera's height and
    known lengths. Prints the alignment and, where there is more than keypoints of one image, the
    standard deviations without each piece of evidence. --mask, --model and --camera without any
    observation align the model to a mask alone. Writes fit.json and overlay.png,
    overlay_1.png and so on for further views; of a file with several objects of one photo, which
    share its camera, scene.json and a folder for each. Many observations are a run, which goes on
    where it was killed: it writes results.parquet and results.csv with a row for each, and
    report.html. Exit codes of a run: 0 all are aligned, 3 some failed, 1 all failed or refused, 2 a
    wrong command line.
    """

    out: Path | None = None
    """Folder to write to; by default <observation>_fit beside the file or folder."""
    overlay: Path | None = None
    """Draw the aligned model over the photo, too, and write it to this picture; further views to
    FILE_1 and so on. The observation names the model. Of many observations, a folder."""
    overlay_mode: Literal["shaded", "translucent", "lines", "box"] = "shaded"
    """Style of drawing: in its own colours, as a red veil, its outline and creases, or its box."""
    overlay_opacity: float = 0.6
    """Of the shaded or translucent model, 0 to 1."""

    def run(self) -> int:
        """Run the fit, or the fits; returns the exit code."""
        if not self.observations and "mask" in self.given and self.model is not None:
            return self._fit_mask(self.given["mask"])
        path = self.first()
        refuse_photo(path)
        is_read = len(self.observations) == 1 and path.suffix.lower() == ".json" and path.is_file()
        data = read_json(path) if is_read else None
        if len(self.observations) > 1 or is_of_many(path, data):
            return self._fit_many()
        if isinstance(data, dict) and "objects" in data:
            from cadalign.cli.fit_scene import fit_scene

            return fit_scene(self, path, data)
        return self._write(self._fit_file(path, data), path)

    def _write(self, fitted: FittedFile, path: Path) -> int:
        """Write and print what was fitted of a file; returns the exit code."""
        out = self.out or path.with_name(f"{path.stem}_fit")
        paths = fitted.write(out, overlay=self.overlay)
        if self.json:
            sys.stdout.write(fitted.text(out))
            return 0
        sys.stdout.write(f"{fitted.result}{fitted.table}\n")
        if paths:
            listed = ", ".join(str(path) for path in paths)
            say(f"{'Picture' if len(paths) == 1 else 'Pictures'}: {listed}")
        return 0

    def _fit_mask(self, mask: Path) -> int:
        """Align the model to a mask alone; returns the exit code."""
        from cadalign.geometry.camera import Camera
        from cadalign.io.images import photo_size
        from cadalign.io.observation import Observation

        width, height = photo_size(mask)
        nothing, camera = np.empty((0, 3)), Camera.without_focal(width, height)
        seen = Observation(nothing, nothing[:, :2], camera, model=self.model)
        with named_as_flags(self, self.fitting, self.ransac):
            observation = self.changes.applied_to(seen)
            style, status = self._style(observation, mask), waiting("fitting")
            result, views = self.fit(observation, str(mask), note=say, status=status)
        fitted = self.fitted(mask, observation, result, views, style=style)
        return self._write(replace(fitted, sources={"mask": mask}), mask)

    def _fit_many(self) -> int:
        """Align all observations; returns the exit code."""
        from cadalign.batch.options import FitRunOptions
        from cadalign.cli.many import inputs_of, run_command, run_folder, write_overlays
        from cadalign.cli.runs import NOTHING_WORKED

        style = None
        if self.overlay is not None:
            style = overlay_style(
                self.overlay, mode=self.overlay_mode, opacity=self.overlay_opacity, has_model=True
            )
        with named_as_flags(self, self.fitting, self.ransac):
            options = FitRunOptions(estimate=self.estimate, **inputs_of(self, self.changes))
            code = run_command(self, options, done="aligned")
        if self.overlay is not None and code != NOTHING_WORKED:
            write_overlays(run_folder(self, options), self.overlay, style)
        return code

    @property
    def changes(self) -> ObservationChanges:
        """Values of the options in the place of an observation's own."""
        return replace(self.of_camera, evidence=self.given, size=self.known_size)

    def _fit_file(self, path: Path, data: Any) -> FittedFile:
        """Fit what a file holds; ``data`` is its parsed content, if it was read already."""
        with named_as_flags(self, self.fitting, self.ransac):
            data = read_json(path) if data is None else data
            observation = self.read(data, str(path), folder=path.parent, changes=self.changes)
            style = self._style(observation, path)
            status = waiting("fitting")
            result, views = self.fit(observation, str(path), note=say, status=status)
        return self.fitted(path, observation, result, views, style=style)

    def _style(self, observation: Observation, path: Path) -> OverlayStyle | None:
        """The style of the overlay, where one is asked for."""
        if self.overlay is None:
            return None
        has_model = self.shape_of(observation) is not None or observation.model is not None
        return overlay_style(
            path, mode=self.overlay_mode, opacity=self.overlay_opacity, has_model=has_model
        )

    def fitted(
        self,
        path: Path,
        observation: Observation,
        result: Result,
        views: tuple[View, ...] | None,
        *,
        style: OverlayStyle | None = None,
    ) -> FittedFile:
        """The result of the observation in a file, its table and pictures; see `draw`."""
        found = FittedFile(result, result.to_dict(), "")
        if views is not None:
            from cadalign.cli.contributions import list_contributions, tabulate_contributions

            data = found.data | list_contributions(result)
            found = FittedFile(result, data, tabulate_contributions(result))
        pictures, overlays = draw(
            observation, result, views=views, picture=self.picture, style=style
        )
        shape = self.shape_of(observation)
        sources = {"observation": path} | ({} if shape is None else {"shape": shape})
        return replace(found, sources=sources, pictures=pictures, overlays=overlays)
