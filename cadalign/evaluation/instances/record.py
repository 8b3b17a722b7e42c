"""What a run keeps of an instance besides its errors: enough to draw it and to judge its numbers.

An exhibit is a row of ``exhibits.parquet``: category, model id, view, and a JSON object ::

    {
      "camera": {"width": 640, "height": 480, "fx": 935.0, "fy": 935.0, "cx": 319.5, "cy": 239.5},
      "gt": {"rotation": [9, row by row], "translation": [3], "scale": [3]},
      "stretch": [1.0, s_y, s_z],
      "bounds": [[3 lowest], [3 highest]],
      "points_3d": [[3], ...], "points_2d": [[2], ...], "semantic_ids": [...],
      "estimates": [
        {"method": "optimal", "rotation": [9], "translation": [3], "scale": [3],
         "rms_px": 0.9, "sigma": 1.0,
         "std": {"rotation_deg": 0.6, "translation": [3], "scale": [3]},
         "warnings": ["..."],
         "alternatives": [{"rotation": [9], "translation": [3], "scale": [3], "likelihood": 0.1}]},
        {"method": "epnp", "reason": "why it failed"}
      ]
    }

``bounds`` and ``points_3d`` are those of the model that the methods were given, which is the
dataset's times ``stretch``. ``std`` and ``sigma`` are null for methods that have none.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError
from cadalign.evaluation.accuracy.outcome import OK, Outcome
from cadalign.evaluation.instances.instance import Instance
from cadalign.evaluation.runs.work import Columns, Row
from cadalign.fitting.result import Alternative, FitResult
from cadalign.fitting.uncertainty import Uncertainty
from cadalign.geometry.alignment import Alignment
from cadalign.io.files import dense_json

EXHIBIT_COLUMNS: Columns = (
    ("category", str),
    ("model_id", str),
    ("view", int),
    ("exhibit", str),
)
# More than any picture can show, and little enough to store.
_MODEL_DIGITS = 9
_PIXEL_DIGITS = 4
_LONGEST_NAME = 200  # bytes
_LIKE_A_VIEW = re.compile(r"_[1-9][0-9]*\Z")


@dataclass(frozen=True)
class Estimate:
    """What a method made of an instance.

    Parameters
    ----------
    alignment : Alignment
    sigma : float, optional
        Standard deviation of the keypoints that was reckoned with [px].
    std : Uncertainty, optional
        Predicted standard deviations; None for methods that have none.
    warnings : tuple of str
        What the keypoints do not determine.
    alternatives : tuple of Alternative
        Other alignments that explain the keypoints as well.
    """

    alignment: Alignment
    sigma: float | None = None
    std: Uncertainty | None = None
    warnings: tuple[str, ...] = ()
    alternatives: tuple[Alternative, ...] = ()

    @classmethod
    def of_fit(cls, result: FitResult) -> Estimate:
        """What a fit says of itself."""
        return cls(result.alignment, result.sigma, result.std, result.warnings, result.alternatives)


def exhibit_row(
    instance: Instance,
    outcomes: Sequence[Outcome],
    estimates: Sequence[Estimate | CadalignError],
) -> Row:
    """The row of an instance.

    Parameters
    ----------
    instance : Instance
    outcomes : sequence of Outcome
        One for each method.
    estimates : sequence of Estimate or CadalignError
        What these are the outcomes of, in the same order.
    """
    names = outcomes[0]
    camera = instance.camera
    exhibit = {
        "camera": {
            name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")
        },
        "gt": _pose(instance.gt),
        "stretch": _rounded(1 / instance.gt.scale),
        "bounds": _rounded(instance.bounds),
        "points_3d": _rounded(instance.points_3d),
        "points_2d": _rounded(instance.points_2d, _PIXEL_DIGITS),
        "semantic_ids": instance.semantic_ids.tolist(),
        "estimates": [
            _described(outcome, estimate)
            for outcome, estimate in zip(outcomes, estimates, strict=True)
        ],
    }
    return {
        "category": names.category,
        "model_id": names.model_id,
        "view": names.view,
        "exhibit": dense_json(exhibit),
    }


def exhibit_stem(category: str, model_id: str, view: int = 0) -> str:
    """The name, without an ending, of the files with an instance's pictures.

    Examples
    --------
    >>> exhibit_stem("chair", "88382b87", 2)
    'chair_88382b87_2'
    """
    name = f"{category}_{model_id}"
    stem = name.replace("/", "_").replace("\0", "_")
    coded = name.encode("utf-8", "replace")
    # What no file can be called, and what would read as another model's view.
    if stem != name or len(coded) > _LONGEST_NAME or _LIKE_A_VIEW.search(name):
        stem = f"{stem[:40]}-{hashlib.sha256(coded).hexdigest()[:12]}"
    return stem if view == 0 else f"{stem}_{view}"


def _described(outcome: Outcome, estimate: Estimate | CadalignError) -> dict[str, Any]:
    if outcome.status != OK or isinstance(estimate, CadalignError):
        return {"method": outcome.method, "reason": outcome.reason}
    return {
        "method": outcome.method,
        **_pose(estimate.alignment),
        "rms_px": None if outcome.rms_px is None else round(outcome.rms_px, _PIXEL_DIGITS),
        "sigma": estimate.sigma,
        "std": None if estimate.std is None else vars(estimate.std),
        "warnings": estimate.warnings,
        "alternatives": [
            {**_pose(other.alignment), "likelihood": other.relative_likelihood}
            for other in estimate.alternatives
        ],
    }


def _pose(alignment: Alignment) -> dict[str, Any]:
    # Rounded in one go: this is done for every estimate of every instance.
    packed = [alignment.rotation.ravel(), alignment.translation, alignment.scale]
    values = _rounded(np.concatenate(packed))
    return {"rotation": values[:9], "translation": values[9:12], "scale": values[12:]}


def _rounded(values: FloatArray, digits: int = _MODEL_DIGITS) -> Any:
    return values.round(digits).tolist()
