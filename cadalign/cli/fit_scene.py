"""`cadalign fit` of a file with several objects of one photo."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cadalign.cli.options import make_folder, named_as_flags, say, waiting
from cadalign.cli.runs import NOTHING_WORKED, SOME_FAILED, SUCCESS, print_json
from cadalign.errors import CadalignError, DataError, InputError
from cadalign.estimation.scene import AlignedScene, SceneObject, align_scene
from cadalign.io.files import write_json
from cadalign.io.observation import Observation

if TYPE_CHECKING:
    from cadalign.cli.fit import Fit

OBJECTS, SHARE = "objects", "share"


def fit_scene(command: Fit, path: Path, data: dict[str, Any]) -> int:
    """Align the objects of a file together; returns the exit code.

    Writes scene.json, which tells what the objects share, and for every object a folder with its
    observation, fit.json and overlay.png.
    """
    with named_as_flags(command, command.fitting, command.ransac):
        seen = _observations(command, path, data)
        problems = [command.problem(each, name) for name, each in seen.items()]
        options = problems[0][2]
        objects = [
            SceneObject(model, _only(views, name), each.size, each.init, name)
            for (name, each), (model, views, _) in zip(seen.items(), problems, strict=True)
        ]
        with waiting("fitting"):
            scene = align_scene(
                objects,
                share=data.get(SHARE, ("focal",)),
                focal_prior=options.focal_prior,
                loss=options.loss,
                loss_scale=options.loss_scale,
                ransac=command.ransac if command.robust else None,
            )
    folder = command.out or path.with_name(f"{path.stem}_fit")
    texts = _write(command, folder, scene, objects, list(seen.values()))
    if command.json:
        print_json(scene.to_dict())
    else:
        sys.stdout.write("\n".join([str(scene), *texts]) + "\n")
    say(f"Objects: {folder}")
    if len(scene.results.errors) == len(objects):
        return NOTHING_WORKED
    return SOME_FAILED if scene.results.errors else SUCCESS


def _observations(command: Fit, path: Path, data: dict[str, Any]) -> dict[str, Observation]:
    """The observation of every object, by its name; what stands beside them holds for all."""
    listed = data[OBJECTS]
    if not isinstance(listed, list) or not listed:
        fix = "give a list of observations without camera and image"
        raise DataError("expected a list of objects", where=f"{path}: objects", fix=fix)
    common = {name: value for name, value in data.items() if name not in (OBJECTS, SHARE)}
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


def _only(views: tuple[Any, ...], name: str) -> Any:
    if len(views) != 1:
        fix = "give objects of one photo, or a file for each object"
        raise InputError(f"{len(views)} views", where=name, fix=fix)
    return views[0]


def _write(
    command: Fit,
    folder: Path,
    scene: AlignedScene,
    objects: list[SceneObject],
    observations: list[Observation],
) -> list[str]:
    """Write the files of the scene; returns the texts of its objects."""
    make_folder(folder)
    texts, entries = [], []
    for each, seen, result in zip(objects, observations, scene.results, strict=True):
        if isinstance(result, CadalignError):
            texts.append(f"{each.name}: {result}")
            entries.append({"name": each.name, "error": str(result)})
            continue
        own = folder / (re.sub(r"[^\w.-]+", "_", each.name) or "object")
        make_folder(own)
        seen.save(own / "observation.json")
        command.fitted(own / "observation.json", seen, result, (each.view,)).write(own)
        texts.append(f"{each.name}: {result}")
        entries.append({"name": each.name, "folder": own.name})
    write_json(folder / "scene.json", scene.to_dict() | {"objects": entries})
    return texts
