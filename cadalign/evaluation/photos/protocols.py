"""Protocols of data sets of photos: their metrics and keypoints, and the names of methods.

A method's name is a base, and the evidence beside the keypoints, as in ``rigid+mask``.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from cadalign.datasets.photos.pascal3d import Pascal3D, Pascal3DDetections
from cadalign.datasets.photos.pix3d import Pix3D
from cadalign.datasets.photos.scan2cad import Scan2CAD
from cadalign.errors import InputError, quote
from cadalign.evaluation.methods import SHAPE
from cadalign.evaluation.metrics.photos import NINE_DOF, VIEWPOINT, MetricSet
from cadalign.evaluation.metrics.scan2cad import SCAN2CAD

SIMULATED = "simulated"
"""Source of keypoints that are projected with the true pose."""
EPNP, RIGID, STRETCHED, PRIOR, SIMILAR = "epnp", "rigid", "stretched", "prior", "similar"
TRUTH = "truth"
BASES = (EPNP, RIGID, STRETCHED, PRIOR, SIMILAR, SHAPE)
MASK, GRAVITY, IMAGE = "mask", "gravity", "image"
EVIDENCE = (MASK, GRAVITY, IMAGE)


def parts_of(method: str) -> tuple[str, frozenset[str]]:
    """The base of a method, and its evidence."""
    base, *evidence = method.split("+")
    return base, frozenset(evidence)


def check_method(method: str) -> None:
    """Check the name of a method.

    Raises InputError if there is none of this name, or EPnP or the truth is given evidence.
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
) -> tuple[str, ...]:
    """The methods for data that have some evidence, which the given bases get."""
    bases = [base for base in BASES if has_shape or base != SHAPE]
    more = []
    for base in (each for each in with_evidence if each in bases):
        kinds = [kind for kind in EVIDENCE if kind in evidence]
        sets = [[kind] for kind in kinds] + ([kinds] if len(kinds) > 1 else [])
        more += ["+".join((base, *each)) for each in sets]
    return (*bases, *more)


SETS = (VIEWPOINT, NINE_DOF, SCAN2CAD)
"""All sets of metrics, in the order of the result table's columns."""


@dataclass(frozen=True)
class Protocol:
    """Evaluation of a data set: its metrics, and what it is given."""

    metrics: tuple[MetricSet, ...]
    best: str
    """The method whose estimates are drawn, and which gets the evidence besides the rigid one."""
    up_axis: str = "y"  # the upward axis of its models
    sigma_of_side: float = 1 / 64
    """Standard deviation of its keypoints as a share of the longer side of the object's rectangle:
    networks' heatmaps have 64 cells."""
    sigma_of_width: float | None = None  # the same as a share of the image's width


_PROTOCOLS = {
    # Annotators' points on scan and model are about 5 cm apart, 8 px in an image of 480.
    Scan2CAD.kind: Protocol((VIEWPOINT, SCAN2CAD, NINE_DOF), SIMILAR, sigma_of_width=1 / 60),
    Pix3D.kind: Protocol((VIEWPOINT, NINE_DOF), RIGID),
    Pascal3D.kind: Protocol((VIEWPOINT,), SIMILAR, up_axis="z"),
    Pascal3DDetections.kind: Protocol((VIEWPOINT,), SIMILAR, up_axis="z"),
}
_OTHER = Protocol((VIEWPOINT, NINE_DOF), PRIOR)


def protocol_of(kind: str) -> Protocol:
    """The protocol of a data set's kind; of another one, viewpoint and box."""
    return _PROTOCOLS.get(kind, _OTHER)
