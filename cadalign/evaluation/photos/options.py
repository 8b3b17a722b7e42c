"""Options of the experiment on data sets of photos, and the names of its methods.

A method's name is a base, and the evidence beside the keypoints, as in ``rigid+mask``.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from cadalign.errors import InputError, quote
from cadalign.evaluation.options import FunctionOptions

EPNP, RIGID, STRETCHED, PRIOR, SIMILAR = "epnp", "rigid", "stretched", "prior", "similar"
SHAPE, TRUTH = "shape", "truth"
BASES = (EPNP, RIGID, STRETCHED, PRIOR, SIMILAR, SHAPE)
MASK, DEPTH, GRAVITY = "mask", "depth", "gravity"
EVIDENCE = (MASK, DEPTH, GRAVITY)


def parts_of(method: str) -> tuple[str, frozenset[str]]:
    """The base of a method, and its evidence.

    Examples
    --------
    >>> base, evidence = parts_of("rigid+mask+depth")
    >>> base, sorted(evidence)
    ('rigid', ['depth', 'mask'])
    """
    base, *evidence = method.split("+")
    return base, frozenset(evidence)


def is_own(method: str) -> bool:
    """True for a name whose base is one of the experiment's."""
    return parts_of(method)[0] in (*BASES, TRUTH)


def check_method(method: str) -> None:
    """Check the name of a method.

    Raises
    ------
    InputError
        If there is none of this name, or EPnP or the truth is given evidence.
    """
    base, evidence = parts_of(method)
    is_known = base in (*BASES, TRUTH) and evidence <= set(EVIDENCE)
    if not is_known or method.count("+") != len(evidence):
        fix = f"known are {', '.join((*BASES, TRUTH))}, with {', '.join(f'+{e}' for e in EVIDENCE)}"
        raise InputError(f"unknown method {quote(method)}", where="methods", fix=fix)
    if evidence and base in (EPNP, TRUTH):
        fix = "give rigid, stretched, prior, similar or shape the evidence"
        raise InputError(f"{base} takes keypoints alone", where="methods", fix=fix)


def default_methods(
    *,
    with_evidence: Collection[str],
    evidence: Collection[str],
    has_shape: bool,
    up_axis: str = "y",
) -> tuple[str, ...]:
    """The methods for data that have some evidence, which the given bases get, where they can.

    A shape model has no mesh for a mask; other models must be upright along y for gravity.

    Examples
    --------
    >>> default_methods(with_evidence=("rigid",), evidence={"mask", "depth"}, has_shape=False)[5:]
    ('rigid+mask', 'rigid+depth', 'rigid+mask+depth')
    """
    bases = [base for base in BASES if has_shape or base != SHAPE]
    more = []
    for base in (each for each in with_evidence if each in bases):
        useless = {MASK} if base == SHAPE else {GRAVITY} if up_axis != "y" else set()
        kinds = [kind for kind in EVIDENCE if kind in evidence and kind not in useless]
        sets = [[kind] for kind in kinds] + ([kinds] if len(kinds) > 1 else [])
        more += ["+".join((base, *each)) for each in sets]
    return (*bases, *more)


@dataclass(frozen=True)
class PhotosOptions(FunctionOptions):
    """Evaluate methods on photos of real objects, by the metrics of their data set.

    The folder may hold Scan2CAD, PASCAL3D+, ObjectNet3D, Pix3D, BOP, KITTI or Objectron. Keypoints
    are the annotated or detected ones; where there are none, visible points of the model's mesh are
    projected with the true pose, with noise, and called simulated. The model's width (x) is given,
    as one image does not tell size; with depth, or a shape model in metres, it is estimated. The
    run's folder gets results.parquet with a row per object and method, summary.csv, figures and
    report.html. Killed, it goes on where it was when the same command is started again.
    """

    experiment = "photos"

    root: Annotated[Path, tyro.conf.Positional]
    """Folder of the data set, in any of the known formats."""
    _: KW_ONLY
    categories: tuple[str, ...] | None = None
    """Categories to take; all by default."""
    max_photos: int | None = None
    """Number of photos to take, the first ones; all by default."""
    methods: tuple[str, ...] = ()
    """epnp, rigid; stretched, prior (stretched, with a prior on the scales), similar (prior, and
    keypoints that differ from the model's), shape (a shape model); each also with evidence, as in
    rigid+mask or similar+depth+gravity; and truth. By default the first five, shape where there is
    one, and the evidence that the data have."""
    shape: tuple[Path, ...] = ()
    """Files of `cadalign shape learn`, each for its category."""
    simulated_noise_px: float = 1.0
    """Standard deviation of simulated keypoints, in pixels."""
    simulated_points: int = 24
    """Number of points on a model of which the visible ones are simulated keypoints."""
    sigma: float | None = None
    """Standard deviation of annotated or detected keypoints that methods are told, in pixels; by
    default that of the data set."""
    similar_sigma: float = 0.04
    """Deviation of the object's keypoints from the model's, of the method similar, in diagonals of
    the model."""
    min_keypoints: int = 6
    """Objects with fewer keypoints are left out."""
    min_score: float = 0.4
    """Detected keypoints with lower scores are not used."""
    pictures: int = 100
    """Number of photos whose pictures the report shows, the first ones."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_least(max_photos=1, simulated_points=4, min_keypoints=1, pictures=0)
        for name in ("sigma", "similar_sigma"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise InputError(f"{value} is not positive", where=name)
        if not 0 <= self.simulated_noise_px < math.inf:
            what = f"{self.simulated_noise_px} is not a noise level"
            raise InputError(what, where="simulated_noise_px")
        if not math.isfinite(self.min_score):
            raise InputError(f"{self.min_score} is not a score", where="min_score")
        object.__setattr__(self, "methods", tuple(dict.fromkeys(self.methods)))
        from cadalign.evaluation.methods.registry import is_registered

        for name in self.methods:
            if is_own(name) or not is_registered(name):
                check_method(name)


OPTIONS = PhotosOptions
