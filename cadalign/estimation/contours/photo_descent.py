"""Steps that bring a model's outline to where photos show it, together with all other evidence.

Each round predicts the outline at the present estimate, learns the colours on both sides of it, and
takes the places where lines across it leave the object as rows of the evidence (`photo_lines.py`).
Rounds begin with long lines of blurred colours and end with short ones at full resolution; the last
ones count with the noise that the residuals show.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, cast

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.estimation.contours.contour import correlation_length, trimmed_deviation
from cadalign.estimation.contours.photo_lines import (
    Outline,
    PhotoPyramid,
    outline_of,
    silhouette_of,
)
from cadalign.estimation.contours.surface import (
    Measured,
    PosedSurface,
    Surface,
    count_of,
    state_with_points,
    state_without_points,
    with_measured,
)
from cadalign.estimation.contours.view_contour import contour_rows
from cadalign.estimation.estimates import poses_of
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.solvers.joint.covariance import information_of
from cadalign.solvers.joint.evidence import Evidence, State, log_focals_of
from cadalign.solvers.joint.search import reduced, refine_joint

COARSE = (0.16, 0.08)
"""Reaches of the lines of a first approach, relative to the silhouette's size."""
_FINE = (0.04, 0.02)
_LEAST_REACH = 5.0  # [px]
_ROUNDS = 3  # of every reach
_LAST_ROUNDS = 3  # with the noise that is learned
_ITERATIONS = 4  # of a round, whose outline is not that of its end
OWN_SIGMAS = (0.4, 0.3, 0.3)
"""Standard deviations [px] of what all of an outline has in common: an offset outwards, and, where
light and blur differ from side to side, shifts to the right and down."""
_FIRST_CORRELATION = 4.0  # lines
_LEAST_CORRELATION = 12.0  # lines: pixels and blur displace neighbours alike
_LEAST_FACTOR = 0.7
_LEAST_FREEDOM = 0.1  # share of the residuals' degrees of freedom that the unknowns leave
_LEAST_INFORMATION = 1e-12  # about an unknown, relative
_LOSS_SCALE = 2.4  # in standard deviations
_LEAST_OUTLIER = 2.0  # in standard deviations
_TOLERANCE = 2.0  # [px], of a line that agrees, and the same relative to the silhouette's size
_RELATIVE_TOLERANCE = 0.01
_SIMILAR_TOLERANCE = 0.04  # where the model is only similar to the object
_STRAY = 0.2  # share of the lines whose places are of other things
_LINES_OF_PATCH = 5.0  # of which the colours count as independent


class LineNoise(NamedTuple):
    """Factor of the standard deviations of a photo's lines, and neighbours that count as one."""

    factor: float = 1.0
    correlation: float = _FIRST_CORRELATION


class Pictured(NamedTuple):
    """Evidence with photos, and the surface whose outline is sought in these."""

    evidence: Evidence
    keypoints: int
    photos: list[PhotoPyramid]
    surface: Surface

    def camera_at(self, photo: PhotoPyramid, state: State) -> Camera:
        """The camera of a photo with the focal length of a state."""
        if self.evidence.focals.group[photo.image] < 0:
            return photo.camera
        ratio = float(np.exp(log_focals_of(self.evidence, state)[photo.image]))
        return photo.camera.with_focal(photo.camera.fx * ratio)


class Approach(NamedTuple):
    """A state, and the coefficients (V, 3) of what each outline has in common.

    ``outlines`` are those from which the last step was taken, None where there is none; ``full``
    is the evidence with them, in the state ``room``.
    """

    state: State
    own: FloatArray
    outlines: tuple[Outline | None, ...] = ()
    full: Evidence | None = None
    room: State | None = None


def approach(
    pictured: Pictured, start: Approach, reaches: Sequence[float], noises: list[LineNoise]
) -> Approach | None:
    """Rounds with lines of the given reaches; None where no photo shows an outline."""
    here: Approach | None = start
    for share in reaches:
        for _ in range(_ROUNDS):
            here = None if here is None else _round(pictured, here, share, noises)
    return here


def finish(pictured: Pictured, start: Approach) -> Approach | None:
    """Rounds with short lines, the last ones at the noise that the residuals show."""
    noises = [LineNoise()] * len(pictured.photos)
    here = approach(pictured, start, _FINE, noises)
    for _ in range(_LAST_ROUNDS):
        if here is None:
            return None
        noises = [*map(_noise_of, here.outlines, here.own)]
        here = _round(pictured, here, _FINE[-1], noises)
    return None if here is None else _widened(pictured, here, noises)


def _round(
    pictured: Pictured, here: Approach, share: float, noises: list[LineNoise]
) -> Approach | None:
    """One step, with the outline that the present state has."""
    evidence, state = pictured.evidence, here.state
    posed, poses = pictured.surface.at(evidence.shape, state), poses_of(evidence, state)
    outlines, rows, shown = [], [], []
    for photo, noise in zip(pictured.photos, noises, strict=True):
        camera, pose = pictured.camera_at(photo, state), poses[photo.image]
        silhouette = silhouette_of(posed, camera, pose)
        outline = None
        if silhouette is not None:
            outline = outline_of(photo, silhouette, max(share * silhouette.size, _LEAST_REACH))
        shown.append(outline is not None and bool(outline.is_told.any()))
        outlines.append(outline if shown[-1] else None)
        if outline is not None and shown[-1]:
            rows.append(_rows(photo, outline, noise, posed, pose, camera))
    if not rows:
        return None
    total, chosen = count_of(rows), np.array(shown)
    full = with_measured(evidence, pictured.keypoints, rows)
    room = state_with_points(state, pictured.keypoints, total, here.own[chosen].ravel())
    cost, room, _, _ = refine_joint(full, _ITERATIONS, room)
    if not cost < np.inf:
        return None
    bare, moved = state_without_points(room, pictured.keypoints, total, here.own[chosen].size)
    own = np.zeros_like(here.own)
    own[chosen] = moved.reshape(-1, len(OWN_SIGMAS))
    return Approach(bare, own, tuple(outlines), full, room)


def _rows(
    photo: PhotoPyramid,
    outline: Outline,
    noise: LineNoise,
    surface: PosedSurface,
    pose: Alignment,
    camera: Camera,
) -> Measured:
    """The lines that tell a place, in the form of the evidence."""
    told, silhouette, given = outline.is_told, outline.silhouette, photo.camera
    rays, _ = given.normalize_where_valid(silhouette.contour.points[told])
    slopes = np.array([[given.fx], [given.fy]]) * given.distortion_jacobian(rays)
    root = np.sqrt(noise.correlation)
    return contour_rows(
        photo.image,
        surface,
        pose,
        silhouette.points[told],
        silhouette.face[told],
        across=np.einsum("ni,nij->nj", silhouette.across[told], slopes),
        places=outline.places[told],
        weights=1 / (noise.factor * outline.sigmas[told] * root),
        loss_scale=_LOSS_SCALE / root,
        own=OWN_SIGMAS,
        cameras=(given, camera),
    )


def _noise_of(outline: Outline | None, own: FloatArray) -> LineNoise:
    """The noise that the residuals of an outline show, beside what all of it has in common."""
    if outline is None:
        return LineNoise()
    residuals, told = outline.in_sigmas(_common(outline, own)), outline.is_told
    factor = max(trimmed_deviation(residuals[told], _LEAST_OUTLIER), _LEAST_FACTOR)
    influence = residuals / (1 + (residuals / (_LOSS_SCALE * factor)) ** 2)
    length = correlation_length(outline.silhouette.contour, influence, told)
    return LineNoise(factor, max(length, _LEAST_CORRELATION))


def _widened(pictured: Pictured, here: Approach, noises: list[LineNoise]) -> Approach:
    """The same, with the noise of lines as large as it is if unknowns fitted a part of it.

    Their residuals have as many degrees of freedom less as the lines determine unknowns.
    """
    full, room = cast(Evidence, here.full), cast(State, here.room)
    is_line = np.arange(len(full.sightings.point)) >= len(pictured.evidence.sightings.point)
    whitening = full.sightings.whitening
    rest = _with_whitening(full, np.where(is_line[:, None], 0.0, whitening))
    (_, whole), (_, without) = information_of(full, room), information_of(rest, room)
    sizes = np.sqrt(np.maximum(whole.diagonal(), 1e-300))
    scaled = whole / np.outer(sizes, sizes) + _LEAST_INFORMATION * np.eye(len(sizes))
    lines = (whole - without) / np.outer(sizes, sizes)
    fitted = float(np.trace(np.linalg.solve(scaled, lines)))
    count = sum(
        float(outline.is_told.sum()) / noise.correlation
        for outline, noise in zip(here.outlines, noises, strict=True)
        if outline is not None
    )
    factor = np.sqrt(max(1 - fitted / max(count, 1.0), _LEAST_FREEDOM))
    return here._replace(
        full=_with_whitening(full, np.where(is_line[:, None], factor, 1.0) * whitening)
    )


def _with_whitening(evidence: Evidence, whitening: FloatArray) -> Evidence:
    return evidence._replace(sightings=evidence.sightings._replace(whitening=whitening))


def _common(outline: Outline, own: FloatArray) -> FloatArray:
    """Places (S,) [px] outwards to which the coefficients ``own`` (3,) take an outline."""
    offset, *shift = own * OWN_SIGMAS
    return np.asarray(offset + outline.silhouette.contour.normals @ shift)


class OutlineSupport(NamedTuple):
    """Agreement of a photo with an outline.

    The ``share`` of it that was found within the tolerance, the number of ``lines``, their
    root mean square distance ``rms`` [px] and ``rms_sigmas``. The log likelihoods [nats] are those
    that the colours give the silhouette, ``contrast``, over one anywhere, and that the lines'
    places give the outline, ``agreement``, over places anywhere on the lines.
    """

    share: float
    lines: int
    rms: float
    rms_sigmas: float
    contrast: float
    agreement: float


def support_of(outline: Outline | None, own: FloatArray, *, is_exact: bool) -> OutlineSupport:
    """The support of an outline beside what all of it has in common, ``own`` (3,) as `Approach`."""
    if outline is None:
        return OutlineSupport(0.0, 0, 0.0, 0.0, 0.0, 0.0)
    relative = _RELATIVE_TOLERANCE if is_exact else _SIMILAR_TOLERANCE
    tolerance = max(_TOLERANCE, relative * outline.silhouette.size)
    common = _common(outline, own)
    distances = outline.places - common
    near: BoolArray = outline.is_told & (np.abs(distances) < tolerance)
    count = int(near.sum())
    patches = len(near) / _LINES_OF_PATCH
    contrast = 2 * patches * outline.contrast
    agreement = _agreement(outline, own)
    if not count:
        return OutlineSupport(0.0, 0, 0.0, 0.0, contrast, agreement)
    rms = float(np.sqrt((distances[near] ** 2).mean()))
    rms_sigmas = float(np.sqrt((outline.in_sigmas(common)[near] ** 2).mean()))
    return OutlineSupport(count / len(near), count, rms, rms_sigmas, contrast, agreement)


def _agreement(outline: Outline, own: FloatArray) -> float:
    """Log likelihood [nats] of the lines' places, some of which are other things'."""
    factor, correlation = _noise_of(outline, own)
    residuals, told = outline.in_sigmas(_common(outline, own)) / factor, outline.is_told
    sigmas = factor * np.where(told, outline.sigmas, 1.0)
    density = np.exp(-(residuals**2) / 2) / np.sqrt(2 * np.pi) / sigmas
    gains = np.log((1 - _STRAY) * density * 2 * outline.reach + _STRAY)
    return float(gains[told].sum() / correlation)


def cost_of_rest(pictured: Pictured, state: State) -> float:
    """Cost of all evidence but the photos."""
    return information_of(*reduced(pictured.evidence, state))[0]
