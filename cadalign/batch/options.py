"""Options of runs over many observations, and what a run asks of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import MISSING, asdict, dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from cadalign.errors import DataError
from cadalign.estimation.detector_noise import opened_noise
from cadalign.estimation.observation_fit import ObservationFit
from cadalign.estimation.result import Result
from cadalign.estimation.result_parts import Stated
from cadalign.evaluation.options import ExperimentOptions, plain_value
from cadalign.evaluation.runs.work import Columns, Row, fingerprint
from cadalign.io.evidence import ObservedImage
from cadalign.io.files import read_bytes
from cadalign.io.images import photo_size
from cadalign.io.observation import DetectorOptions, Observation, ObservationChanges
from cadalign.shapes.model import ShapeModel


class Estimated(NamedTuple):
    """Result of an observation, what it is the alignment of, and cells that the tables add."""

    observation: Observation
    result: Result
    cells: Row
    record: Row


@dataclass(frozen=True, kw_only=True)
class ManyOptions(ExperimentOptions):
    """A run over many observations, whatever is estimated of each."""

    columns: ClassVar[Columns] = ()
    """Columns of the table beside those of every run."""
    record_columns: ClassVar[Columns] = ()
    """Columns of the records beside those of every run."""

    inputs: tuple[Path, ...]
    """Observation files, folders and patterns of such, JSON lines, files of detectors."""
    changes: ObservationChanges = field(default_factory=ObservationChanges)
    """Takes the place of the observations' own."""
    detector: DetectorOptions = field(default_factory=DetectorOptions)
    pictures: int = 0
    """Number of observations whose photos the page shows, the first ones."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_least(pictures=0)

    @property
    def learned(self) -> Path | None:
        """The learned shape that keypoints of detectors may be named after."""
        raise NotImplementedError

    def warm_up(self, seen: Observation) -> Result:
        """Compile the kernels by the estimate of a model's points."""
        raise NotImplementedError

    def read(self, data: Any, where: str, *, folder: Path) -> Observation:
        """Read the parsed form of an observation, which messages call ``where``."""
        raise NotImplementedError

    def estimate_of(self, seen: Observation, where: str) -> Estimated:
        """Estimate the object of an observation; raises CadalignError if it cannot be."""
        raise NotImplementedError

    def contents(self) -> dict[str, Any]:
        """Entries of a run's configuration that change with the contents of the options' files."""
        paths = (path for path in _paths({**self._given(), "inputs": ()}) if path.is_file())
        found = {str(path.absolute()): fingerprint(read_bytes(path)) for path in paths}
        return {"files": found} if found else {}

    def as_config(self) -> dict[str, Any]:
        """The options in a run's configuration, without those that are at their defaults."""
        return {name: plain_value(value) for name, value in self._given().items()}

    def _given(self) -> dict[str, Any]:
        given: dict[str, Any] = {}
        for each in fields(self):
            value = getattr(self, each.name)
            given |= _changed(value) if is_dataclass(value) else {each.name: value}
        return given


@dataclass(frozen=True, kw_only=True)
class FitRunOptions(ManyOptions):
    """A run that aligns many observations, as ``estimate`` says; see `ManyOptions`."""

    experiment: ClassVar[str] = "fit"
    command: ClassVar[str] = "fit"

    estimate: ObservationFit = field(default_factory=ObservationFit)

    @property
    def learned(self) -> Path | None:
        return self.estimate.shape

    def warm_up(self, seen: Observation) -> Result:
        return replace(self.estimate, shape=None).fit(seen, "warm-up")[0]

    def read(self, data: Any, where: str, *, folder: Path) -> Observation:
        return self.estimate.read(data, where, folder=folder, changes=self.changes)

    def estimate_of(self, seen: Observation, where: str) -> Estimated:
        result, _ = self.estimate.fit(seen, where)
        doubts = [doubt for view in seen.views if (doubt := _photo_doubt(view))]
        if doubts:
            statistics = Stated.of(result.statistics, warnings=(*doubts, *result.warnings))
            result = replace(result, statistics=statistics)
        return Estimated(seen, result, {}, {})

    def contents(self) -> dict[str, Any]:
        shape, noise = self.estimate.shape, self.estimate.noise
        category = None if shape is None else ShapeModel.open(shape).category
        found = super().contents() | {"shapes": category}
        return found if noise is None else found | {"noise": str(opened_noise(noise))}


def _photo_doubt(view: ObservedImage) -> str:
    """Warning about a photo, if it is there, of another size than its camera's images."""
    if view.image is None or not view.image.is_file():
        return ""
    try:
        width, height = photo_size(view.image)
    except DataError:  # which whoever draws it will name
        return ""
    if (width, height) == (view.camera.width, view.camera.height):
        return ""
    return (
        f"{view.image.name} is {width} x {height} px, the camera {view.camera.width} x "
        f"{view.camera.height}: give camera and keypoints of its resolution "
        "(`Camera.resized`, `Camera.cropped`)"
    )


def _changed(part: Any) -> dict[str, Any]:
    """The fields of some of the options that are not at their defaults."""
    found, values = {}, asdict(part)
    for each in fields(part):
        default: Any = each.default if each.default_factory is MISSING else each.default_factory()
        plain = asdict(default) if hasattr(default, "__dataclass_fields__") else default
        if values[each.name] != plain:
            found[each.name] = values[each.name]
    return found


def _paths(value: Any) -> Iterator[Path]:
    """All paths in mappings and lists."""
    if isinstance(value, Path):
        yield value
    elif isinstance(value, dict | list | tuple):
        for each in value.values() if isinstance(value, dict) else value:
            yield from _paths(each)
