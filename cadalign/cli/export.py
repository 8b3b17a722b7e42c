"""`cadalign export`: a fit in the format of another tool."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from cadalign.cli.common import say
from cadalign.cli.options import named_as_flags
from cadalign.errors import DataError
from cadalign.export.aligned_object import FORMATS, AlignedObject, export_object, format_of
from cadalign.io.documents import in_file, read_json
from cadalign.io.kinds import FIT


@dataclass(frozen=True)
class Export:
    """Write a fit for another tool.

    GLB holds the textured model, stretched or warped, the cameras and the photos behind it: it
    opens in Blender, three.js and viewers as the overlay shows it. OBJ and PLY hold the mesh.
    """

    fit: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FIT.JSON")]
    """Result of `cadalign fit`, or its folder."""
    to: Path
    """File to write."""
    format: str | None = None
    """Format, by default what the name's ending tells: glb, obj, ply."""
    metres: float = 1.0
    """Length of one unit of the model [m]. Written are metres."""
    frame: Literal["camera", "rig", "model"] = "camera"
    """Frame of the exported coordinates: the first photo's camera, the frame that cameras of known
    motion share, or the stretched model's own."""

    def run(self) -> int:
        """Write the file; returns the exit code."""
        fit = self.fit / "fit.json" if self.fit.is_dir() else self.fit
        with named_as_flags(self):
            name = self.format or format_of(self.to)
            path = export_object(self.to, self._object(fit), format=name, frame=self.frame)
        say(f"{path}: {FORMATS[name].about}")
        return 0

    def _object(self, fit: Path) -> AlignedObject:
        """The aligned object of a fit's file, with the observation that it holds."""
        from cadalign.estimation.result import Result
        from cadalign.export.results import object_of
        from cadalign.io.observation import Observation
        from cadalign.render.drawing.model_overlay import mesh_of
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
                images=[view.image for view in seen.views],
                name="model" if seen.model is None else seen.model.stem,
                metres=self.metres,
            )
        return replace(exported, sources=(fit, *seen.files))
