"""Synthetic payloads of report pages."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from PIL import Image
from scipy.spatial.transform import Rotation

from cadalign import Alignment, Mesh
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.evaluation.instances.pictures import preview_of
from cadalign.evaluation.metrics import INSTANCE_METRICS as METRICS
from cadalign.evaluation.metrics import Metric
from cadalign.evaluation.plots import Plot, Trace
from cadalign.render import look_at
from cadalign.report.page import method_dict, render_page

HOSTILE = "<img src=x onerror=alert(1)><b>&lt;"
METHODS = ("optimal", "aepnp", "aepnp-paper")
REASON = "too few keypoints: 3, needs 4"
WARNING = "the stretch along z is known to 5 % only: that axis is seen end-on"
STD = {"rotation_deg": 0.7, "translation": [0.003, 0.003, 0.02], "scale": [0, 0.02, 0.05]}
HEADED = METRICS[:5]
SPREAD = {"optimal": 1.0, "aepnp": 3.0, "aepnp-paper": 9.0}
_SEED = 7
_COLUMNS = (*("id", "run", "category", "model", "view", "keypoints", "exhibit", "thumb"),)
# A seat, a back, four legs: lowest corner and size of each.
_PARTS = (
    ((-0.25, 0.0, -0.25), (0.5, 0.06, 0.5)),
    ((-0.25, 0.06, -0.25), (0.5, 0.44, 0.06)),
    *(((x, -0.4, z), (0.06, 0.4, 0.06)) for x in (-0.25, 0.19) for z in (-0.25, 0.19)),
)
_SIDES = np.array(
    [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
)


def chair() -> Mesh:
    """A chair of boxes, 72 triangles."""
    unit = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)])
    vertices = np.concatenate([np.array(low) + unit * size for low, size in _PARTS])
    quads = np.concatenate([_SIDES + 8 * part for part in range(len(_PARTS))])
    return Mesh(vertices, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]))


@dataclass
class Recipe:
    """Content of a synthetic payload."""

    instances: int = 24
    runs: int = 1
    failures: float = 0.08  # share of failed fits
    pictures: int = 6  # number of different pictures, which instances share in turn
    exhibits: bool = True
    models: list[str] = field(default_factory=list)  # ids of the first models; others are generated
    categories: tuple[str, ...] = ("bottle", "chair", "vessel")
    done: int | None = None  # of an unfinished run


def payload_of(recipe: Recipe) -> dict[str, Any]:
    """Make the payload of a recipe, deterministically."""
    return _Maker(recipe).payload()


def write_page(path: Path, recipe: Recipe, **changes: Any) -> str:
    """Write the page of a recipe, with changes of its payload; returns its URL."""
    path.write_text(render_page({**payload_of(recipe), **changes}), encoding="utf-8")
    return path.as_uri()


def listed(payload: dict[str, Any], metric: str, method: int = 0) -> list[dict[str, Any]]:
    """List the payload's instances, each with a method's value of a metric."""
    tables = payload["tables"]
    values = {
        instance: value
        for instance, of, value in zip(
            tables["rows"]["instance"],
            tables["rows"]["method"],
            tables["rows"][metric],
            strict=True,
        )
        if of == method
    }
    columns = tables["instances"]
    return [
        {
            **{name: column[i] for name, column in columns.items()},
            "model": tables["strings"][columns["model"][i]],
            "category": tables["strings"][columns["category"][i]],
            "error": values[i],
        }
        for i in range(len(columns["id"]))
    ]


class _Maker:
    def __init__(self, recipe: Recipe) -> None:
        self.recipe = recipe
        self.rng = np.random.default_rng(_SEED)
        self.mesh = chair()
        self.strings: list[str] = []
        self.places: dict[str, int] = {}
        self.scenes = _scenes(self.rng, max(recipe.pictures, 6))

    def payload(self) -> dict[str, Any]:
        recipe = self.recipe
        instances: dict[str, list[Any]] = {name: [] for name in _COLUMNS}
        names = ("instance", "method", "status", "reason", *(metric.key for metric in METRICS))
        rows: dict[str, list[Any]] = {name: [] for name in names}
        exhibits: dict[str, Any] = {}
        for run in range(recipe.runs):
            for index in range(recipe.instances):
                self._add(run, index, instances, rows, exhibits)
        shown = range(recipe.pictures)
        return {
            "format": 1,
            "title": "A report of chairs",
            "summary": f"{recipe.instances} views of chairs, made up; seed 7; cadalign 1.0.",
            "runs": [
                {
                    "name": f"runs/{'ab'[run]}",
                    "what": "keypointnet",
                    "state": "finished" if recipe.done is None else "unfinished",
                    "done": recipe.instances if recipe.done is None else recipe.done,
                    "total": recipe.instances,
                    "settings": [["noise", f"{run + 1} px"], ["seed", "7"]],
                }
                for run in range(recipe.runs)
            ],
            "methods": [method_dict(name, place) for place, name in enumerate(METHODS)],
            "metrics": [metric.page() for metric in METRICS],
            "headline": self._headline(rows, instances),
            "tables": {"strings": self.strings, "instances": instances, "rows": rows},
            "plots": [_plot(recipe.runs, metric) for metric in METRICS[:2]],
            "pictures": {str(i): _picture(i, (640, 480)) for i in shown},
            "thumbs": {str(i): _picture(i, (240, 180)) for i in shown},
            "exhibits": exhibits,
            "meshes": {"0": preview_of(self.mesh)},
        }

    def _string(self, text: str) -> int:
        if text not in self.places:
            self.places[text] = len(self.strings)
            self.strings.append(text)
        return self.places[text]

    def _add(self, run: int, index: int, instances: Any, rows: Any, exhibits: Any) -> None:
        recipe, rng = self.recipe, self.rng
        place = len(instances["id"])
        gt, stretch = self.scenes[index % len(self.scenes)]
        models = recipe.models
        # Digits that begin alike are as hard to search as real ids.
        model = models[index] if index < len(models) else f"{(index + 1) * 2654435761 % 2**32:08x}"
        keypoints = int(rng.integers(4, 12))
        for name, value in {
            "id": index,
            "run": run,
            "category": self._string(recipe.categories[index % len(recipe.categories)]),
            "model": self._string(model),
            "view": index % 3,
            "keypoints": keypoints,
            "exhibit": place if recipe.exhibits else -1,
            "thumb": index % recipe.pictures if recipe.pictures else -1,
        }.items():
            instances[name].append(value)
        tries: list[tuple[str, dict[str, float] | None]] = []
        for method, name in enumerate(METHODS):
            failed = bool(rng.random() < recipe.failures)
            spread = SPREAD[name] * (run + 1) * 6 / keypoints
            errors = {
                metric.key: None if failed else _error(rng, metric, spread) for metric in METRICS
            }
            reason = self._string(REASON) if failed else -1
            for key, value in {
                "instance": place,
                "method": method,
                "status": int(failed),
                "reason": reason,
                **errors,
            }.items():
                rows[key].append(value)
            tries.append((name, None if failed else errors))
        if recipe.exhibits:
            exhibits[str(place)] = self._exhibit(gt, stretch, keypoints, tries, index)

    def _exhibit(
        self, gt: Alignment, stretch: np.ndarray, keypoints: int, tries: Any, index: int
    ) -> dict[str, Any]:
        camera = KEYPOINT_CAMERA
        given = self.mesh.vertices * stretch
        corners = given[:: len(given) // keypoints][:keypoints]
        noise = self.rng.normal(0, 1, (len(corners), 2))
        names = ("width", "height", "fx", "fy", "cx", "cy")
        return {
            "camera": {name: getattr(camera, name) for name in names},
            "picture": str(index % self.recipe.pictures) if self.recipe.pictures else None,
            "gt": _pose(gt),
            "stretch": stretch.tolist(),
            "bounds": [given.min(axis=0).tolist(), given.max(axis=0).tolist()],
            "points_3d": corners.tolist(),
            "points_2d": (camera.project(gt.apply(corners)) + noise).tolist(),
            "semantic_ids": list(range(len(corners))),
            "mesh": "0",
            "estimates": [
                {"method": name, "reason": REASON}
                if errors is None
                else _estimate(self.rng, name, gt, errors)
                for name, errors in tries
            ],
        }

    def _headline(self, rows: Any, instances: Any) -> dict[str, Any]:
        if not rows["instance"]:
            none = ("columns", "rows", "failures", "skipped")
            return {"group": "category", "note": "", **{name: [] for name in none}}
        table = pd.DataFrame(rows)
        for name in ("run", "category"):
            table[name] = [instances[name][i] for i in rows["instance"]]
        found, failures = [], []
        for (run, category, method), cell in table.groupby(["run", "category", "method"]):
            about = {
                "run": int(run),
                "category": self.strings[category],
                "method": METHODS[method],
            }
            failed = int(cell["status"].sum())
            medians = {m.key: m.factor * cell[m.key].astype(float).median() for m in HEADED}
            found.append(
                {
                    **about,
                    "cells": {"instances": len(cell), "failed": failed, **medians},
                    "best": [m.key for m in HEADED] if method == 0 and failed < len(cell) else [],
                }
            )
            if failed:
                failures.append({**about, "reason": REASON, "count": failed})
        counts = {"unit": "", "digits": 0, "better": None}
        columns = [{"key": key, "label": key, **counts} for key in ("instances", "failed")]
        columns += [metric.page() for metric in HEADED]
        return {
            "group": "category",
            "columns": columns,
            "rows": found,
            "failures": failures,
            "skipped": [],
            "note": "Medians.",
        }


def _plot(runs: int, metric: Metric) -> dict[str, Any]:
    """Lines of every method in every run."""
    places = [1.0, 2.0, 5.0, 10.0]
    traces = [
        Trace(run, name, places, [10.0 * (k + run + 1) for k in range(4)])
        for run in range(runs)
        for name in METHODS
    ]
    share = replace(metric, key="share", label="share of instances", unit="%", log=False)
    return Plot(metric.key, metric, share, traces, note="Made up.").to_dict()


def _scenes(rng: np.random.Generator, count: int) -> list[tuple[Alignment, np.ndarray]]:
    """True alignments of pictures, and stretches of the model that methods are given."""
    return [_scene(rng) for _ in range(count)]


def _scene(rng: np.random.Generator) -> tuple[Alignment, np.ndarray]:
    stretch = np.array([1, *np.exp(rng.uniform(-0.4, 0.4, 2))])
    seen = look_at(
        azimuth=float(rng.uniform(0, 360)),
        elevation=float(rng.uniform(5, 40)),
        distance=float(rng.uniform(1.8, 2.6)),
    )
    return Alignment(seen.rotation, seen.translation, 1 / stretch), stretch


@cache
def _picture(index: int, size: tuple[int, int]) -> str:
    """A picture of one colour, which depends on ``index``."""
    buffer = io.BytesIO()
    Image.new("RGB", size, (40 * index % 256, 120, 90)).save(buffer, "WEBP", quality=80, method=0)
    return "data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode()


def _error(rng: np.random.Generator, metric: Any, spread: float) -> float:
    if metric.better == "high":
        return float(np.exp(-0.1 * spread * rng.exponential()))
    unit = {"deg": 0.8, "%": 0.015, "px": 0.9}.get(metric.unit, 0.008)
    return float(unit * spread * rng.lognormal(0, 0.7))


def _pose(alignment: Alignment) -> dict[str, Any]:
    return {
        "rotation": alignment.rotation.ravel().tolist(),
        "translation": alignment.translation.tolist(),
        "scale": alignment.scale.tolist(),
    }


def _estimate(rng: np.random.Generator, name: str, gt: Alignment, errors: Any) -> dict[str, Any]:
    turn = rng.normal(0, 1, 3)
    turn *= np.deg2rad(errors["rotation_error_deg"]) / np.linalg.norm(turn)
    scale = gt.scale * np.array([1, 1 + errors["scale_y_error"], 1 / (1 + errors["scale_z_error"])])
    pose = Alignment(Rotation.from_rotvec(turn).as_matrix() @ gt.rotation, gt.translation, scale)
    flipped = Alignment(gt.rotation @ np.diag([-1.0, 1, -1]), gt.translation, scale)
    best = name == "optimal"
    return {
        "method": name,
        **_pose(pose),
        "std": STD if best else None,
        "sigma": 1.0 if best else None,
        "rms_px": errors["rms_px"],
        "warnings": [WARNING] if best else [],
        "alternatives": [{**_pose(flipped), "likelihood": 0.31}] if best else [],
    }
