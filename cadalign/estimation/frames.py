"""Results of batches as pandas DataFrames with the same columns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from cadalign.errors import CadalignError, InputError
from cadalign.estimation.align_result import AlignResult
from cadalign.estimation.batch import BatchResult
from cadalign.estimation.result import FitResult
from cadalign.geometry.camera import Camera

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = (
    *("solved", "rms", "keypoints", "inliers"),
    *(f"{name}_{axis}" for name in ("rotation", "translation", "scale") for axis in "xyz"),
    *("focal_length", "error"),
)
Results = BatchResult | Sequence[FitResult | AlignResult | CadalignError]
"""What `cadalign.fit_batch` or `cadalign.align_batch` returned, or results of single calls."""


def to_dataframe(results: Results) -> pd.DataFrame:
    """One row for each result, as a pandas DataFrame.

    Parameters
    ----------
    results : BatchResult or sequence of FitResult, AlignResult or CadalignError
        Of `cadalign.fit_batch`, `cadalign.align_batch`, or of single calls.

    Returns
    -------
    pandas.DataFrame
        Columns: ``solved``, ``rms`` of the inliers' residuals [px], ``keypoints``, ``inliers``,
        ``rotation_x`` to ``rotation_z`` (rotation vector [degrees]), ``translation_x`` to ``_z``
        [model units], ``scale_x`` to ``_z``, ``focal_length`` [px], and ``error``, the reason where
        there is no result. Of several views, the pose and the focal length are those of the first.

    Raises
    ------
    InputError
        If something among the results is neither a result nor an error.

    Examples
    --------
    >>> import cadalign
    >>> corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    >>> camera = cadalign.Camera(640, 480, 900, 900, 319.5, 239.5)
    >>> seen = camera.project(corners + [0.1, 0.2, 5.0])
    >>> view, model = cadalign.View(camera, seen), cadalign.Model(points_3d=corners)
    >>> frame = cadalign.to_dataframe(cadalign.align_batch(model, [view, view]))
    >>> frame[["solved", "keypoints"]].to_numpy().tolist()
    [[True, 8], [True, 8]]
    """
    import pandas as pd

    if isinstance(results, BatchResult):
        return results.to_dataframe()
    given: Sequence[object] = results
    for number, result in enumerate(given):
        if not isinstance(result, FitResult | AlignResult | CadalignError):
            what = f"expected a result or an error, got {type(result).__name__}"
            raise InputError(what, where=f"results[{number}]")
    rows = [_row_of(result) for result in results]
    return pd.DataFrame(rows, columns=list(COLUMNS))


def _row_of(result: FitResult | AlignResult | CadalignError) -> dict[str, Any]:
    from scipy.spatial.transform import Rotation

    if isinstance(result, CadalignError):
        return {"solved": False, "keypoints": 0, "inliers": 0, "error": str(result)}
    pose = result.alignment
    vectors = {
        "rotation": Rotation.from_matrix(pose.rotation).as_rotvec(degrees=True),
        "translation": pose.translation,
        "scale": pose.scale,
    }
    camera: Camera | None
    if isinstance(result, FitResult):
        inliers, camera = result.inliers, result.camera
    else:  # a result that an earlier version wrote has no cameras
        inliers, camera = np.concatenate(result.inliers), next(iter(result.cameras), None)
    return {
        "solved": True,
        "rms": result.rms,
        "keypoints": len(inliers),
        "inliers": int(inliers.sum()),
        **{f"{n}_{a}": v[k] for n, v in vectors.items() for k, a in enumerate("xyz")},
        "focal_length": np.nan if camera is None else camera.fx,
        "error": "",
    }
