"""`cadalign fit`: align the models of observation files."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from cadalign.cli.evidence import CameraOptions, EvidenceOptions
from cadalign.cli.fit_options import EstimateOptions
from cadalign.cli.options import UsageError, make_folder, named_as_flags, say, waiting
from cadalign.errors import InputError
from cadalign.io.documents import in_file, read_json

if TYPE_CHECKING:
    from cadalign.arrays import BoolArray, FloatArray
    from cadalign.estimation.model import Model
    from cadalign.estimation.options import FitOptions
    from cadalign.estimation.result import Result
    from cadalign.estimation.view import View
    from cadalign.io.observation import Observation
    from cadalign.render import OverlayStyle
    from cadalign.render.drawing.color import ByteImage
    from cadalign.shapes.model import ShapeModel

_PHOTOS = (".bmp", ".gif", ".heic", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp")


@dataclass(frozen=True, eq=False)
class FittedFile:
    """Result of a fit of one file, its JSON form, a table, and pictures of each view.

    ``overlays`` are those of the model that were asked for.
    """

    result: Result
    data: dict[str, Any]
    table: str
    pictures: tuple[ByteImage, ...] = ()
    overlays: tuple[ByteImage, ...] = ()

    @property
    def text(self) -> str:
        """The result as JSON text."""
        return json.dumps(self.data, indent=2) + "\n"

    def write(self, out: Path, *, overlay: Path | None = None) -> list[Path]:
        """Write fit.json and the pictures to a folder; returns the pictures' paths.

        The ``overlays`` go to ``overlay``, those of further views beside it.
        """
        from cadalign.io.files import write_text

        make_folder(out)
        write_text(out / "fit.json", self.text)
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
    from cadalign.render.drawing.result_overlay import draw_result, mesh_of, photo_of

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


@dataclass(frozen=True)
class Fit(EstimateOptions, CameraOptions, EvidenceOptions):
    """Align a model to what an observation file holds, and draw the result.

    Keypoints in one image, or in several views; masks, depth, gravity, the camera's height and
    known lengths. Prints the alignment and, where there is more than keypoints of one image, the
    deviations without each piece of evidence. Writes fit.json and overlay.png, overlay_1.png and so
    on for further views. Of several files, or a folder of them, a folder each, results.csv, and
    index.html with all pictures.
    """

    observations: Annotated[
        tuple[Path, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="OBSERVATION ...", help_behavior_hint="(required)"),
    ]
    """JSON files with camera and keypoints, optionally image, model and further evidence; or a
    folder of such files."""
    picture: bool = True
    """Draw box and keypoints over each photo, as overlay.png; of several files, on one page."""
    overlay: Path | None = None
    """Draw the aligned model over the photo, too, and write it to this picture; further views to
    FILE_1 and so on. The observation names the model. Of several observations, to a picture of this
    name in the folder of each."""
    overlay_mode: Literal["shaded", "translucent", "lines", "box"] = "shaded"
    """Style of drawing: in its own colours, as a red veil, its outline and creases, or its box."""
    overlay_opacity: float = 0.6
    """Of the shaded or translucent model, 0 to 1."""

    def run(self) -> int:
        """Run the fit, or the fits; returns the exit code."""
        if not self.observations:
            fix = "give a JSON file with camera and keypoints, or a folder of such files"
            raise UsageError("no observation is given", where="OBSERVATION", fix=fix)
        path = self.observations[0]
        if len(self.observations) > 1 or path.is_dir():
            from cadalign.cli.fit_many import fit_many

            return fit_many(
                self.observations,
                lambda path, data: self._fit_file(path, nullcontext(), data),
                out=self.out,
                picture=self.picture,
                overlay=self.overlay,
                json=self.json,
            )
        fitted = self._fit_file(path, waiting("fitting"))
        paths = fitted.write(self.out or path.with_name(f"{path.stem}_fit"), overlay=self.overlay)
        if self.json:
            sys.stdout.write(fitted.text)
            return 0
        sys.stdout.write(f"{fitted.result}{fitted.table}\n")
        if paths:
            listed = ", ".join(str(path) for path in paths)
            say(f"{'Picture' if len(paths) == 1 else 'Pictures'}: {listed}")
        return 0

    def _fit_file(
        self, path: Path, status: AbstractContextManager[Any], data: Any = None
    ) -> FittedFile:
        """Fit what a file holds, which is parsed already if ``data`` is given.

        ``status`` is entered while an alignment by `cadalign.align` is computed.
        """
        observation = self._load(path, data)
        is_learned = self.shape_of(observation) is not None
        style = None
        if self.overlay is not None:
            style = overlay_style(
                path,
                mode=self.overlay_mode,
                opacity=self.overlay_opacity,
                has_model=is_learned or observation.model is not None,
            )
        views = None
        if observation.is_plain and not is_learned and self.shape_sigma_of(observation) is None:
            result = self._fit(observation, path)
            found = FittedFile(result, result.to_dict(), "")
        else:
            from cadalign.cli.contributions import list_contributions, tabulate_contributions

            result, views = self._align(observation, path, status)
            data = result.to_dict() | list_contributions(result)
            found = FittedFile(result, data, tabulate_contributions(result))
        pictures, overlays = draw(
            observation, result, views=views, picture=self.picture, style=style
        )
        return replace(found, pictures=pictures, overlays=overlays)

    def _load(self, path: Path, data: Any) -> Observation:
        """Read a file; camera and evidence of the options take the place of its own."""
        from cadalign.io.observation import Observation
        from cadalign.io.observation_file import fill_xyz

        _refuse_photo(path)
        if data is None:
            data = read_json(path)
        has_shape = isinstance(data, dict) and data.get("shape") is not None
        if self.shape is not None or (has_shape and self.takes_stored_shape):
            data = fill_xyz(data)
        with in_file(path):
            observation = Observation.from_dict(data, folder=path.parent)
        previous = observation.camera
        camera = self.read_camera((previous.width, previous.height))
        changed = self.add_to(
            observation if camera is None else replace(observation, camera=camera)
        )
        if observation.others and changed is not observation:
            raise InputError(
                f"the file has {len(observation.views)} views, the options are for one",
                where=str(path),
                fix="write camera, masks and other evidence into its `views`",
            )
        return changed

    def _fit(self, observation: Observation, path: Path) -> Result:
        """Fit the stretched model to keypoints of one image."""
        from cadalign.estimation.fit import fit

        options = self.options_for(observation, path)
        with named_as_flags(self, options):
            return fit(
                observation.points_3d,
                observation.points_2d,
                observation.camera,
                **vars(options),
                ransac=self.ransac if self.robust else None,
                confidences=observation.confidences if self.robust else None,
                symmetry=observation.symmetry,
            )

    def _align(
        self, observation: Observation, path: Path, status: AbstractContextManager[Any]
    ) -> tuple[Result, tuple[View, ...]]:
        """Align any model to all evidence; returns the views of it, too."""
        from cadalign.estimation.align import align
        from cadalign.estimation.observed import views_of

        self.check_for(observation)
        options = self.options_for(observation, path)
        model = self._model(observation, path, options)
        stated = self.stated_sigma(observation)
        with in_file(path):
            views = views_of(observation, model, sigma=stated.get("sigma"))
            size = observation.size
        if "sigma" in stated and stated["sigma"] is None:
            views = tuple(replace(view, sigma=None) for view in views)
        with status, self._located(path):
            result = align(
                model,
                views,
                size=size,
                init=observation.init,
                loss=options.loss,
                loss_scale=options.loss_scale,
                ransac=self.ransac if self.robust else None,
                focal=options.focal,
                focal_prior=options.focal_prior,
            )
        return result, views

    def _model(
        self, observation: Observation, path: Path, options: FitOptions
    ) -> Model | ShapeModel:
        shape = self.shape_of(observation)
        if shape is not None:
            from cadalign.shapes.model import ShapeModel

            if observation.symmetry is not None:
                raise InputError(
                    "has no effect together with a learned shape",
                    where=f"{path}: symmetry",
                    fix="leave out one of the two",
                )
            return ShapeModel.open(shape)
        from cadalign.estimation.observed import model_of
        from cadalign.io.meshes.load import load_mesh

        mesh = None if observation.model is None else load_mesh(observation.model)
        sigma = self.shape_sigma_of(observation)
        with self._located(path):
            return model_of(observation, options=options, shape_sigma=sigma, mesh=mesh)

    @contextmanager
    def _located(self, path: Path) -> Iterator[None]:
        """Let errors about arguments name the command line's option, or else the file."""
        try:
            with named_as_flags(self, self.ransac):
                yield
        except InputError as error:
            if str(error.where).startswith("--"):
                raise
            with in_file(path):
                raise


def _refuse_photo(path: Path) -> None:
    """Refuse an image in the place of an observation, and say what makes one."""
    if path.suffix.lower() in _PHOTOS:
        raise InputError(
            "a photo, not an observation, which is a JSON file with camera and keypoints",
            where=str(path),
            fix=f"mark keypoints with `cadalign annotate {path.name} MODEL`, which writes one, or "
            "use a detector's with `cadalign observe`",
        )
