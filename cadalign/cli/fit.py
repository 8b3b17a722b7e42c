"""`cadalign fit`: align the models of observation files."""

from __future__ import annotations

import sys
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from cadalign.cli.common import (
    NOTHING_WORKED,
    answer,
    beside,
    exit_code,
    file_stem,
    file_stems,
    make_folder,
    print_json,
    say,
    waiting,
)
from cadalign.cli.fitted import FittedFile, list_in, overlay_style, written_files
from cadalign.cli.options import (
    CameraOptions,
    EvidenceOptions,
    FlaggedOptions,
    ManyCommand,
    flag_of,
    named_as_flags,
)
from cadalign.errors import CadalignError, DataError, InputError, quote, refuse_unused
from cadalign.estimation.focal import PriorOption
from cadalign.estimation.observation_fit import ObservationFit
from cadalign.estimation.options import FitOptions, RansacOptions, Sigma
from cadalign.geometry.camera import Camera
from cadalign.io.documents import read_json
from cadalign.io.files import keeping, remove_earlier, write_json
from cadalign.io.observation import (
    Observation,
    ObservationChanges,
    is_of_many,
    refuse_photo_or_mesh,
)

if TYPE_CHECKING:
    from cadalign.estimation.result import Result
    from cadalign.estimation.scene import AlignedScene
    from cadalign.estimation.scene_messages import SceneObject
    from cadalign.estimation.view import View
    from cadalign.render import OverlayStyle

_OBJECTS, _SHARE = "objects", "share"


@dataclass(frozen=True)
class _FitOptions(FlaggedOptions, FitOptions):
    """Method and model; the observation file supplies the other options."""

    sigma: tyro.conf.Suppress[Sigma | None] = FitOptions.sigma
    focal: tyro.conf.Suppress[str] = FitOptions.focal
    focal_prior: tyro.conf.Suppress[PriorOption] = FitOptions.focal_prior


@dataclass(frozen=True)
class _RansacOptions(FlaggedOptions, RansacOptions):
    """Search for outliers (LO-RANSAC), with --robust."""


@dataclass(frozen=True, kw_only=True)
class Fit(ManyCommand, ObservationFit, CameraOptions, EvidenceOptions):
    """Align a model to what an observation file holds, and draw the result.

    Keypoints in one image, or in several views; masks, depth, gravity, the camera's height and
    known lengths. Prints the alignment and, where there is more than keypoints of one image, the
    standard deviations without each piece of evidence. --mask, --model and --camera without any
    observation align the model to a mask alone, and write one, fit.observation.json. Writes
    fit.json and overlay.png, overlay_1.png and so on for further views; of a file with several
    objects of one photo, which share its camera, scene.json and a folder for each. Many
    observations are a run, which goes on where it was killed: it writes results.parquet and
    results.csv with a row for each, and report.html. Exit codes of a run: 0 all are aligned, 3 some
    failed, 1 all failed or refused, 2 a wrong command line.
    """

    out: Path | None = None
    """Folder to write to; by default <observation>_fit beside the file or folder."""
    overlay: Path | None = None
    """Draw the aligned model over the photo, too, and write it to this picture; further views to
    FILE_1 and so on. The observation names the model. For many observations, a folder."""
    overlay_mode: Literal["shaded", "translucent", "lines", "box"] = "shaded"
    """Style of drawing: in its own colours, as a red veil, its outline and creases, or its box."""
    overlay_opacity: float = 0.6
    """Opacity of the shaded or translucent model, 0 to 1."""

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

    def run(self) -> int:
        """Run the fit, or the fits; returns the exit code."""
        if not self.robust:
            with named_as_flags(self.ransac):
                names = [each.name for each in fields(RansacOptions)]
                refuse_unused(self.ransac, names, "without --robust")
        if not self.observations and "mask" in self.given and self.model is not None:
            return self._fit_mask(self.given["mask"])
        path = self.first()
        refuse_photo_or_mesh(path)
        is_read = len(self.observations) == 1 and path.suffix.lower() == ".json" and path.is_file()
        data = read_json(path) if is_read else None
        if len(self.observations) > 1 or is_of_many(path, data):
            return self._fit_many()
        with named_as_flags(self):
            self.refuse_of_many()
        if isinstance(data, dict) and _OBJECTS in data:
            return _fit_scene(self, path, data)
        return self._write(self._fit_file(path, data), path)

    def _write(self, fitted: FittedFile, path: Path) -> int:
        """Write and print what was fitted of a file; returns the exit code."""
        out = self.out or beside(path, "_fit")
        paths = fitted.write(out, overlay=self.overlay)
        if self.json:
            sys.stdout.write(fitted.text(out))
            return 0
        answer(f"{fitted.result}{fitted.table}")
        if paths:
            listed = ", ".join(str(path) for path in paths)
            say(f"{'Picture' if len(paths) == 1 else 'Pictures'}: {listed}")
        return 0

    def _fit_mask(self, mask: Path) -> int:
        """Align the model to a mask alone; returns the exit code."""
        from cadalign.io.images import photo_size

        width, height = photo_size(mask)
        nothing, camera = np.empty((0, 3)), Camera.without_focal(width, height)
        seen = Observation(nothing, nothing[:, :2], camera, model=self.model)
        with named_as_flags(self, self.fitting, self.ransac):
            self.refuse_of_many("model")
            observation = self.changes.applied_to(seen)
            style, status = self._style(observation, mask), waiting("fitting")
            result, views = self.fit(observation, str(mask), note=say, status=status)
        # What was fitted, for the commands that go on from the fit.
        path = (self.out or beside(mask, "_fit")) / "fit.observation.json"
        with keeping(observation.files):
            make_folder(path.parent)
            observation.save(path)
        fitted = self.fitted(path, observation, result, views, style=style)
        return self._write(replace(fitted, sources={"mask": mask} | fitted.sources), mask)

    def _fit_many(self) -> int:
        """Align all observations; returns the exit code."""
        from cadalign.batch.experiment import FitRunOptions
        from cadalign.cli.runs import inputs_of, run_command, run_folder, write_overlays

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
        """The result of the observation in a file, with its pictures; see `FittedFile.drawn`."""
        shape = self.shape_of(observation)
        sources = {"observation": path} | ({} if shape is None else {"shape": shape})
        found = FittedFile(
            result,
            sources,
            is_tabulated=views is not None,
            inputs=(*observation.files, *sources.values()),
        )
        return found.drawn(observation, views=views, picture=self.picture, style=style)


def _fit_scene(command: Fit, path: Path, data: dict[str, Any]) -> int:
    """Align the objects of one photo in a file together; returns the exit code.

    Writes scene.json with what the objects share, and for every object a folder with its
    observation, fit.json and overlay.png.
    """
    from cadalign.estimation.scene import align_scene
    from cadalign.estimation.scene_messages import SceneObject

    fields_of_file = {"share": f"{path}: share"}
    with named_as_flags(command, command.fitting, command.ransac, others=fields_of_file):
        if command.overlay is not None:
            fix = "give it with an object's observation.json, which is written without it"
            raise InputError("draws one object, the file has several", where="overlay", fix=fix)
        seen = _observations(command, path, data)
        problems = [command.problem(each, name) for name, each in seen.items()]
        given = {name: own for name, (_, _, own) in zip(seen, problems, strict=True)}
        options = _common_options(command, given)
        objects = []
        for (name, each), (model, views, _) in zip(seen.items(), problems, strict=True):
            if len(views) != 1:
                fix = "give objects of one photo, or a file for each object"
                raise InputError(f"{len(views)} views", where=name, fix=fix)
            objects.append(SceneObject(model, views[0], each.size, each.init, name))
        with waiting("fitting"):
            scene = align_scene(
                objects,
                share=data.get(_SHARE, ("focal",)),
                focal=options.focal,
                focal_prior=options.focal_prior,
                loss=options.loss,
                loss_scale=options.loss_scale,
                ransac=command.ransac if command.robust else None,
            )
    folder = command.out or beside(path, "_fit")
    with keeping([path, *(file for each in seen.values() for file in each.files)]):
        texts, found = _write_scene(command, folder, scene, objects, list(seen.values()))
    if command.json:
        print_json(scene.to_dict() | {"objects": found})
    else:
        answer("\n".join([str(scene), *texts]))
    say(f"Objects: {folder}")
    return exit_code(len(scene.results.errors), len(objects))


def _observations(command: Fit, path: Path, data: dict[str, Any]) -> dict[str, Observation]:
    """The observation of every object, by its name; what stands beside them holds for all."""
    listed = data[_OBJECTS]
    if not isinstance(listed, list) or not listed:
        fix = "give a list of observations without camera and image"
        raise DataError("expected a list of objects", where=f"{path}: objects", fix=fix)
    common = {name: value for name, value in data.items() if name not in (_OBJECTS, _SHARE)}
    found: dict[str, Observation] = {}
    for number, own in enumerate(listed):
        where = f"{path}: objects[{number}]"
        if not isinstance(own, dict):
            raise DataError("expected an object", where=where)
        seen = command.read({**common, **own}, where, folder=path.parent, changes=command.changes)
        name = seen.object_name or f"object_{number}"
        if name in found:
            fix = "give each a name of its own in `object`"
            raise DataError(f"two objects are named {name!r}", where=where, fix=fix)
        found[name] = seen
    return found


def _common_options(command: Fit, options: dict[str, FitOptions]) -> FitOptions:
    """The options of the fit of all objects, given by their names; refuses others."""
    first, common = next(iter(options.items()))
    for name, own in options.items():
        for option, value in own.of_views.items():
            if value != getattr(common, option):
                what = f"{quote(value)}, but {quote(getattr(common, option))} for {first}"
                fix = "give objects of one photo the same options, beside `objects`"
                raise InputError(what, where=f"{name}: fit.{option}", fix=fix)
    return common


def _write_scene(
    command: Fit,
    folder: Path,
    scene: AlignedScene,
    objects: list[SceneObject],
    observations: list[Observation],
) -> tuple[list[str], list[dict[str, Any]]]:
    """Write the files of the scene; returns the texts and documents of its objects.

    What an earlier one wrote of objects that have no fit now is removed.
    """
    make_folder(folder)
    texts, documents = [], list[dict[str, Any]]()
    stems = file_stems(["scene.json", *(each.name for each in objects)], "object")[1:]
    results = zip(stems, scene.results, strict=True)
    fitted = {stem for stem, result in results if not isinstance(result, CadalignError)}
    for own in _earlier_objects(folder):
        if own.name not in fitted:
            remove_earlier(folder, [own / "observation.json", *written_files(own)])
    for each, seen, result, stem in zip(objects, observations, scene.results, stems, strict=True):
        if isinstance(result, CadalignError):
            texts.append(f"{each.name}: {result}")
            documents.append({"name": each.name, "error": str(result)})
            continue
        own = folder / stem
        make_folder(own)
        seen.save(own / "observation.json")
        file = command.fitted(own / "observation.json", seen, result, (each.view,))
        file.write(own)
        texts.append(f"{each.name}: {result}")
        documents.append({"name": each.name, "folder": own.name, "fit": file.document(own)})
    # Their folders have the fits.
    entries = [{key: each[key] for key in each if key != "fit"} for each in documents]
    write_json(folder / "scene.json", scene.to_dict() | {"objects": entries})
    return texts, documents


def _earlier_objects(folder: Path) -> list[Path]:
    """The folders of the objects that the folder's scene.json lists."""
    listed = list_in(folder / "scene.json", "objects")
    names = [each.get("folder") for each in listed if isinstance(each, dict)]
    # As `file_stems` makes them: no file of other text is to lead out of the folder.
    return [
        folder / name for name in names if isinstance(name, str) and name == file_stem(name, "")
    ]
