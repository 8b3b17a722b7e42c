"""The page of a video's tracks: a table of the objects, and plots of their motion over time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.batch.spec import ROTATION_STD
from cadalign.batch.tracks import FoundTrack
from cadalign.evaluation.metrics.table import KEYPOINTS, RMS, Metric
from cadalign.evaluation.plots import COLORS, Plot, Trace, compact
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.io.files import write_text
from cadalign.report.headline import Headline, HeadlineRow
from cadalign.report.page import line_dict, page_payload, render_page

_TIME = Metric("time", "time", "s", log=False, better=None)
_BAND = "band: two standard deviations"
_WIDTH = 2.0  # of the bands, in standard deviations
_STEP = 1e-6  # of finite differences [rad]
_AXES = ("right", "down", "ahead")


def _length(key: str, label: str, unit: str = "units") -> Metric:
    return Metric(key, label, unit, 3, better=None, log=False)


_SIZES = tuple(_length(f"size_{axis}", f"size along {axis}") for axis in "xyz")
_DISTANCE, _SPEED = _length("distance", "distance"), _length("speed", "speed", "units / s")
_TURNING = _length("turning", "angular speed", "deg / s")
_FRAMES = Metric("frames", "frames", digits=0, better=None)
_COLUMNS = (
    *(_FRAMES, KEYPOINTS, replace(RMS, better=None), replace(ROTATION_STD, better=None)),
    *(_DISTANCE, _SPEED, _TURNING),
    *_SIZES,
)
_NOTE = (
    "Distance, speeds and uncertainty are medians over the frames. Sizes are those of the box, one "
    "for all frames. Lengths are in the model's units."
)


def write_track_page(
    path: Path,
    found: Sequence[FoundTrack],
    *,
    title: str,
    summary: str,
    settings: Mapping[str, str],
    failures: Mapping[str, str],
) -> None:
    """Write a page that needs no network on tracks.

    Parameters
    ----------
    path : Path
        The HTML file.
    found : sequence of FoundTrack
    title, summary : str
    settings : mapping
        Texts by name, shown beneath.
    failures : mapping
        Why tracks could not be estimated, by their name.
    """
    names = [*(each.track.name for each in found), *failures]
    run = {
        "name": title,
        "what": "track",
        "state": "finished",
        "done": len(names),
        "total": len(names),
        "settings": [*map(list, settings.items()), ["cadalign", version("cadalign")]],
    }
    payload = page_payload(
        title=title,
        summary=summary,
        runs=[run],
        methods=[
            line_dict(name, f"track {name}", COLORS[k % len(COLORS)])
            for k, name in enumerate(names)
        ],
        headline=Headline(
            group="shape",
            columns=_COLUMNS,
            rows=[_row(each) for each in found],
            failures=[
                {"run": 0, "category": "", "method": name, "reason": reason, "count": 1}
                for name, reason in failures.items()
            ],
            note=_NOTE,
        ),
        plots=_track_plots(found),
    )
    write_text(path, render_page(payload))


def _track_plots(found: Sequence[FoundTrack]) -> list[Plot]:
    plots = [
        _plot(_length(f"place_{name}", f"place {name}"), found, _part(_places, k), _BAND)
        for k, name in enumerate(_AXES)
    ]
    since = f"since the first frame, turned about z, then x, then y; {_BAND}"
    for k, axis in enumerate("xyz"):
        turn = _length(f"turn_{axis}", f"turn about the camera's {axis}", "deg")
        plots.append(_plot(turn, found, _part(_angles, k), since))
    for k, speed in enumerate((_SPEED, _TURNING)):
        plots.append(_plot(speed, found, _part(_speeds, k, least=0.0), _BAND))
    plots.append(_plot(replace(ROTATION_STD, log=False), found, _rotation_stds, ""))
    residuals = _length("residual", "residual of the keypoints", "px")
    note = "line: median of a frame's inliers, band: quartiles"
    return [*plots, _plot(residuals, found, _residuals, note)]


_Curve = tuple[FloatArray, FloatArray, FloatArray]  # middle, low and high end of the band, (P,)


def _plot(
    metric: Metric,
    found: Sequence[FoundTrack],
    curve: Callable[[FoundTrack], _Curve],
    note: str,
) -> Plot:
    traces = []
    for each in found:
        middle, low, high = map(compact, curve(each))
        x = [float(time) for time in each.path.times]
        has_band = low != middle or high != middle
        ends = (low, high) if has_band else (None, None)
        traces.append(Trace(0, each.track.name, x, middle, *ends))
    return Plot(metric.key, _TIME, metric, traces, note=note, title=metric.label)


def _part(
    curves: Callable[[FoundTrack], tuple[FloatArray, FloatArray]],
    column: int,
    *,
    least: float = -np.inf,
) -> Callable[[FoundTrack], _Curve]:
    """A column of values (P, k), with a band of standard deviations (P, k) down to a least."""

    def curve(each: FoundTrack) -> _Curve:
        values, stds = (array[:, column] for array in curves(each))
        low = np.maximum(values - _WIDTH * stds, least)
        return values, low, values + _WIDTH * stds

    return curve


def _places(each: FoundTrack) -> tuple[FloatArray, FloatArray]:
    variances = np.diagonal(each.path.frames, axis1=1, axis2=2)[:, 3:6]
    return each.path.translations, np.sqrt(variances)


def _angles(each: FoundTrack) -> tuple[FloatArray, FloatArray]:
    """Turns since the first frame about the camera's x, y and z (P, 3) [deg], and uncertainties."""
    turns = each.path.rotations @ each.path.rotations[0].T
    angles = _euler(turns)
    slopes = np.empty((len(turns), 3, 3))
    for k in range(3):
        moved = _euler(rotation_from_vector(_STEP * np.eye(3)[k]) @ turns)
        slopes[:, :, k] = (moved - angles + np.pi) % (2 * np.pi) - np.pi
    covariances = (slopes / _STEP) @ each.path.frames[:, :3, :3] @ (slopes / _STEP).swapaxes(1, 2)
    stds = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    return np.degrees(np.unwrap(angles, axis=0)), np.degrees(stds)


def _euler(turns: FloatArray) -> FloatArray:
    """Angles (P, 3) about x, y and z of rotations that are turns about z, then x, then y [rad]."""
    about_x = np.arcsin(np.clip(-turns[:, 1, 2], -1.0, 1.0))
    about_y = np.arctan2(turns[:, 0, 2], turns[:, 2, 2])
    about_z = np.arctan2(turns[:, 1, 0], turns[:, 1, 1])
    return np.column_stack([about_x, about_y, about_z])


def _speeds(each: FoundTrack) -> tuple[FloatArray, FloatArray]:
    """Speed and angular speed [deg / s] (P, 2), and their uncertainties."""
    columns = []
    for rows, factor in ((slice(3, 6), 1.0), (slice(0, 3), np.degrees(1.0))):
        velocities = each.path.velocities[:, rows]
        covariances = each.path.frames[:, 6:, 6:][:, rows, rows]
        sizes = np.linalg.norm(velocities, axis=1)
        along = velocities / np.maximum(sizes, 1e-300)[:, None]
        variances = np.einsum("pi,pij,pj->p", along, covariances, along)
        columns.append(factor * np.array([sizes, np.sqrt(np.maximum(variances, 0.0))]))
    (speeds, speed_stds), (turns, turn_stds) = columns
    return np.column_stack([speeds, turns]), np.column_stack([speed_stds, turn_stds])


def _rotation_stds(each: FoundTrack) -> _Curve:
    variances = np.diagonal(each.path.frames, axis1=1, axis2=2)[:, :3]
    stds = np.degrees(np.sqrt(variances.sum(axis=1)))
    return stds, stds, stds


def _residuals(each: FoundTrack) -> _Curve:
    """Median and quartiles of the lengths of all residuals at each time [px]."""
    times = np.array([float(view.time or 0.0) for view in each.track.views])
    found = np.full((3, len(each.path)), np.nan)
    for k, time in enumerate(each.path.times):
        lengths = [
            np.linalg.norm(each.result.views[row].residuals[each.result.views[row].inliers], axis=1)
            for row in np.flatnonzero(times == time)
        ]
        if sum(map(len, lengths)):
            found[:, k] = np.percentile(np.concatenate(lengths), [50, 25, 75])
    return found[0], found[1], found[2]


def _row(each: FoundTrack) -> HeadlineRow:
    path, result = each.path, each.result
    (speeds, turns), (stds, _, _) = _speeds(each)[0].T, _rotation_stds(each)
    numbers = {
        _FRAMES.key: len(path),
        KEYPOINTS.key: len(result.inliers) / len(path),
        RMS.key: result.rms,
        ROTATION_STD.key: np.median(stds),
        _DISTANCE.key: np.median(np.linalg.norm(path.translations, axis=1)),
        _SPEED.key: np.median(speeds),
        _TURNING.key: np.median(turns),
        **dict(zip((size.key for size in _SIZES), result.box.extents, strict=True)),
    }
    cells = {column.key: column.shown(float(numbers[column.key])) for column in _COLUMNS}
    category = getattr(result.model, "category", "") or "object"
    return HeadlineRow(0, category, each.track.name, cells)
