"""Style of figures: one label, colour and marker for each method, the same everywhere."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zlib import crc32

import numpy as np

from cadalign.evaluation.methods.fitted import LIMIT, fit_methods
from cadalign.io.files import write_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Colours that colour-blind people tell apart, too: Okabe and Ito's (jfly.uni-koeln.de/color), then
# dark ones of Paul Tol's "muted" (personal.sron.nl/~pault).
_COLORS = (
    "#0072B2",
    "#E69F00",
    "#D55E00",
    "#CC79A7",
    "#009E73",
    "#56B4E9",
    "#332288",
    "#999933",
    "#882255",
    "#44AA99",
    "#AA4499",
    "#117733",
)
_MARKERS = "os^DvP<X>phd"
_LABELS = {
    "optimal": "optimal (ours)",
    "aepnp": "AEPnP, 4 x 4 (ours)",
    "aepnp-paper": "AEPnP, as published",
    "epnp": "EPnP (no stretch)",
    "optimal-unstretched": "optimal, without stretch",
    "optimal-huber": "optimal, Huber loss",
    "optimal-cauchy": "optimal, Cauchy loss",
    "ransac-optimal": "LO-RANSAC + optimal (ours)",
    "ransac-ap4p": "RANSAC, 4 points",
    "ransac-aepnp": "RANSAC, 6 points (AEPnP)",
    "ransac-aepnp-refined": "RANSAC, 6 points + refinement",
    "shape": "shape model of the category (ours)",
    "random-rigid": "another model, rigid",
    "random-stretched": "another model, stretched",
    "nearest": "nearest of the library",
    "mean-rigid": "mean shape, rigid",
    "mean-stretched": "mean shape, stretched",
    "exact": "the object's own model",
    "keypoints": "keypoints alone",
    "gravity": "+ gravity",
    "length": "+ height",
    "depth": "+ depth",
    "views-2-free": "2 views, unknown motion",
    "views-5-free": "5 views, unknown motion",
    "views-2": "2 views, known motion",
    "views-5": "5 views, known motion",
    "mask": "+ mask",
    "mask-dilated": "+ mask, dilated",
    "mask-eroded": "+ mask, eroded",
    "mask-smoothed": "+ mask, wandering",
    "mask-hidden": "+ mask, partly hidden",
    "mask-hole": "+ mask with a hole",
    "mask-blob": "+ mask with a blob",
    "gravity+length": "+ gravity, height",
    "mask+gravity": "+ mask, gravity",
    "mask+depth": "+ mask, depth",
    "mask+views-2": "+ mask, 2 known views",
    "all": "all of one kind each",
    "rigid": "the given model, rigid",
    "stretched": "stretched",
    "prior": "stretched, with a prior",
    "similar": "stretched, similar keypoints",
    "rigid+mask": "rigid + mask",
    "rigid+depth": "rigid + depth",
    "rigid+gravity": "rigid + gravity",
    "rigid+mask+depth": "rigid + mask, depth",
    "similar+gravity": "similar + gravity",
    "stretched+gravity": "stretched + gravity",
    "shape+gravity": "shape model + gravity",
    "truth": "the truth itself",
    LIMIT: "Cramer-Rao bound",
}


@dataclass(frozen=True)
class Look:
    """Label and line of a method; the marker and the dash are matplotlib's."""

    label: str
    color: str
    marker: str
    dash: str


def look_of(method: str) -> Look:
    """The look of a method; that of the Cramer-Rao bound is a dashed line without markers."""
    label = _LABELS.get(method, method)
    if method == LIMIT:
        return Look(label, "black", "", "--")
    # Those of `cadalign.fit` first.
    names = [name for name in dict.fromkeys([*fit_methods(), *_LABELS]) if name != LIMIT]
    if method in names:
        place = mark = names.index(method)
    else:  # of a registered one by its name, wherever it is drawn
        place = crc32(method.encode())
        mark = place // len(_COLORS)
    return Look(label, _COLORS[place % len(_COLORS)], _MARKERS[mark % len(_MARKERS)], "-")


@contextmanager
def new_figure(**options: Any) -> Iterator[Figure]:
    """A figure in the project's style, drawn without a display."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    settings: Any = {
        "font.size": 10,
        "axes.grid": True,
        "axes.grid.which": "both",
        "grid.color": "0.9",
        "grid.linewidth": 0.6,
        "axes.axisbelow": True,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "legend.frameon": False,
        "legend.fontsize": 9,
        "lines.linewidth": 1.8,
        "lines.markersize": 5,
        "pdf.fonttype": 42,
        "figure.dpi": 160,
    }
    with rc_context(settings):
        yield Figure(layout="constrained", **options)


def label_log_axis(axes: Axes) -> None:
    """Write plain numbers, also between the powers of ten, on a logarithmic vertical axis."""
    from matplotlib.ticker import FuncFormatter, LogLocator

    low, high = axes.get_ylim()
    decades = np.log10(high / low)
    subs = (1.0, 2.0, 5.0) if decades < 3.5 else (1.0,)
    axes.yaxis.set_major_locator(LogLocator(subs=subs, numticks=30))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(LogLocator(subs=[float(k) for k in range(2, 10)], numticks=99))
    axes.yaxis.set_minor_formatter(FuncFormatter(lambda value, _: ""))


def save_figure(figure: Figure, path: Path) -> list[Path]:
    """Write a figure as PNG and PDF, ``path`` being without an ending; returns the files."""
    files = [path.with_name(f"{path.name}.{ending}") for ending in ("png", "pdf")]
    for file in files:
        # Without its date a PDF is the same in every run.
        metadata: Any = {"CreationDate": None} if file.suffix == ".pdf" else {"Software": None}
        write_whole(file, partial(figure.savefig, metadata=metadata))
    return files
