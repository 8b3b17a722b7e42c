"""Summaries of an estimate: deviations, evidence, masks, and warnings about what is doubtful."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.estimation.warning import EstimateWarning, Kind, Warnings
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.pixels import PIXEL_CENTRE
from cadalign.geometry.rotations import vector_from_rotation
from cadalign.shapes.parts import probability_within

UNDETERMINED = 1.0
"""Relative standard deviation beyond which a length, distance or focal length is undetermined."""
UNDETERMINED_ROTATION_DEG = 30.0
OTHER_SIZES = (1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 4, 4 / 3, 3 / 2, 2.0, 3.0, 4.0)
"""Usual sizes of other images of a photo, over that of its camera."""
_SAME_MIDDLE = 0.02  # of an image's size, from its middle to a principal point taken for it
_LEAST_GAIN = 0.9  # of a standard deviation, relative to that of the prior alone
_ANY_ROTATION = math.sqrt(math.pi**2 / 3 + 2)  # standard deviation of uniform rotations [rad]
_SHALLOW = 0.5  # differences of depth over the distance
_THIN = 0.1  # spread along an axis over the largest that counts as nearly a plane
_END_ON_DEG = 15.0
_ANOTHER_DEG = 10.0
_LEAST_TURN = 1e-12  # [rad], and of a relative variance
_ROUNDING = 1e-12  # relative standard deviation below which a length is known
_REGION = 0.95  # probability of the stated region, which alternatives outside of it contradict
_FIELDS = {
    "keypoints": "points_2d",
    "photo": "image",
    "gravity": "up",
    "camera height": "camera_height",
    "rig": "cam_from_rig",
}


@dataclass(frozen=True)
class Uncertainty:
    """Predicted standard deviations of an alignment."""

    rotation_deg: float
    """Rotation [degrees]: the root of the sum of the variances about three axes."""
    translation: tuple[float, float, float]
    """Along the camera's axes [model units]."""
    scale: tuple[float, float, float]
    """Scale along the model's x, y, z, relative (0.02 is 2 %); 0 where it is known."""
    focal: float
    """Focal length, relative; 0 where it is known."""


def uncertainty_of(covariance: FloatArray) -> Uncertainty:
    """Standard deviations from a covariance (9, 9) or (10, 10)."""
    variance = np.maximum(covariance.diagonal(), 0.0)
    variance[6:9][variance[6:9] < _ROUNDING**2] = 0.0
    x, y, z, sx, sy, sz = np.sqrt(variance[3:9]).tolist()
    return Uncertainty(
        rotation_deg=float(np.degrees(np.sqrt(variance[:3].sum()))),
        translation=(x, y, z),
        scale=(sx, sy, sz),
        focal=float(np.sqrt(variance[9:].sum())),
    )


@np.errstate(all="ignore")  # lengths that overflow are of translations known well enough
def weaknesses_of_keypoints(
    points_3d: FloatArray,
    alignment: Alignment,
    covariance: FloatArray,
    *,
    redundancy: int,
    stretch_sigma: float | None,
    doubt: EstimateWarning | None,
) -> Warnings:
    """Warn about stretch and motion that the keypoints do not determine, with the reason.

    Not about two scales that are open together, whose ratio is not: one image leaves size and
    distance open as far as the known axis does not tell them, and the standard deviations of both
    say so. ``redundancy`` counts the equations minus the unknowns; beside a prior on the scales the
    keypoints must determine them better than the prior does; ``doubt`` is a warning about an
    estimated focal length that looks well determined.
    """
    warnings, std = [], uncertainty_of(covariance)
    if redundancy <= 0:
        text = (
            f"{len(points_3d)} keypoints fit exactly whatever they are: "
            "the residuals say nothing about the quality of the fit"
        )
        warnings.append(EstimateWarning("untested", text))
    if std.focal > UNDETERMINED:
        why = _why_focal_is_weak(alignment.apply(points_3d))
        warnings.append(_known_only("focal", "the focal length", percent(std.focal), why))
    if doubt is not None:
        warnings.append(doubt)
    most = UNDETERMINED
    if stretch_sigma is not None:
        most = min(most, _LEAST_GAIN * stretch_sigma)
    is_open = [axis for axis, relative in enumerate(std.scale) if relative > most]
    if len(is_open) == 1 or _ratio_deviation(covariance, is_open) > most:
        for axis in is_open:
            why = _why_scale_is_weak(points_3d, alignment, axis)
            to = percent(std.scale[axis])
            warnings.append(_known_only("scale", f"s_{'xyz'[axis]}", to, why))
    if std.rotation_deg > UNDETERMINED_ROTATION_DEG:
        warnings.append(_known_only("rotation", "the rotation", f"{std.rotation_deg:.2g} deg"))
    distance, spread = _distance(alignment, std)
    if spread > UNDETERMINED * distance and not is_open and std.focal <= UNDETERMINED:
        direction = "xyz"[int(np.argmax(std.translation))]
        share = f" ({percent(spread / distance)} of the distance)" if distance > 0 else ""
        size = f"{max(std.translation):.2g} model units{share}"
        what = f"the translation along the camera's {direction}"
        warnings.append(_known_only("translation", what, size))
    return tuple(warnings)


def _ratio_deviation(covariance: FloatArray, axes: Sequence[int]) -> float:
    """Standard deviation of the logarithm of the ratio of two scales; 0 without two."""
    if len(axes) < 2:
        return 0.0
    logs = np.zeros(len(covariance))
    logs[[6 + axes[0], 6 + axes[1]]] = 1.0, -1.0
    return math.sqrt(max(float(logs @ covariance @ logs), 0.0))


def weaknesses(alignment: Alignment, std: Uncertainty, lengths: FloatArray) -> Warnings:
    """Warn about lengths, distance and focal length that are not determined.

    ``lengths`` (3,) are those of the object: what is open of one counts relative to all, for that
    of a flat object's thickness changes little.
    """
    warnings, size = [], float(np.linalg.norm(lengths))
    for axis, relative, length in zip("xyz", std.scale, lengths.tolist(), strict=True):
        if relative * length > UNDETERMINED * size:
            warnings.append(_known_only("scale", f"the length along {axis}", percent(relative)))
    distance, spread = _distance(alignment, std)
    if spread > UNDETERMINED * distance > 0 and not warnings:
        warnings.append(_known_only("translation", "the distance", percent(spread / distance)))
    if std.focal > UNDETERMINED:
        warnings.append(_known_only("focal", "the focal length", percent(std.focal)))
    return tuple(warnings)


def _known_only(kind: Kind, what: str, to: str, why: str = "") -> EstimateWarning:
    reason = f": {why}" if why else ""
    return EstimateWarning(kind, f"{what} is known only to +-{to}{reason}")


def _distance(alignment: Alignment, std: Uncertainty) -> tuple[float, float]:
    return float(np.linalg.norm(alignment.translation)), float(np.linalg.norm(std.translation))


def _why_focal_is_weak(in_camera: FloatArray) -> str:
    thickness = np.linalg.svd(in_camera - in_camera.mean(axis=0), compute_uv=False)
    if thickness[-1] < _THIN * thickness[0]:
        return "the keypoints lie nearly in one plane"
    if np.ptp(in_camera[:, 2]) < _SHALLOW * in_camera[:, 2].mean():
        return "the keypoints differ little in depth for their distance"
    return "the keypoints show little perspective for their noise"


def _why_scale_is_weak(points_3d: FloatArray, alignment: Alignment, axis: int) -> str:
    name = "xyz"[axis]
    spread = points_3d.std(axis=0)
    center = points_3d.mean(axis=0)
    if spread[axis] < _THIN * spread.max():
        return f"the keypoints lie nearly in the plane {name} = {center[axis]:.3g}"
    ray = alignment.apply(center[None])[0]
    cosine = abs(ray @ alignment.rotation[:, axis]) / np.linalg.norm(ray)
    if np.degrees(np.arccos(min(1.0, cosine))) < _END_ON_DEG:
        return f"the model's {name} axis is seen nearly end-on"
    thickness = np.linalg.svd(points_3d - center, compute_uv=False)
    if thickness[2] < _THIN * thickness[0]:
        return "the keypoints lie nearly in one plane"
    return "there are few keypoints for their noise"


def percent(fraction: float) -> str:
    """A share in percent, for a sentence."""
    return f"{100 * fraction:.0f} %" if fraction < 100 else "more than 10000 %"


def another_pose(
    best: Alignment,
    others: Sequence[tuple[Alignment, float]],
    covariance: FloatArray,
    degrees_of_freedom: float | None = None,
    *,
    near: float = 0.0,
) -> Warnings:
    """Warn about other poses, with likelihoods relative to the best, that the deviations conceal.

    Those outside of the stated 95 % interval of the turn to them, where they have more than the 5 %
    that it leaves them together; any, where the deviations leave every rotation open. ``near`` is
    the likelihood of all further estimates whose pose is hardly another one.
    """
    total = 1 + near + sum(likelihood for _, likelihood in others)
    is_open = covariance[:3, :3].trace() > (_LEAST_GAIN * _ANY_ROTATION) ** 2
    concealed = []
    for other, likelihood in others:
        turn = vector_from_rotation(other.rotation @ best.rotation.T)
        angle = float(np.linalg.norm(turn))
        along = float(turn @ covariance[:3, :3] @ turn) / max(angle, _LEAST_TURN) ** 4
        within = probability_within(1 / max(along, _LEAST_TURN), 1, degrees_of_freedom)
        if math.degrees(angle) > _ANOTHER_DEG and (is_open or within > _REGION):
            concealed.append((likelihood / total, math.degrees(angle)))
    share = sum(probability for probability, _ in concealed)
    if share <= 1 - _REGION:
        return ()
    _, angle = max(concealed)
    which = f"another pose, {angle:.0f} deg away, has"
    if len(concealed) > 1:
        which = f"other poses, the likeliest {angle:.0f} deg away, have"
    text = f"{which} a probability of {percent(share)}: see `alternatives`"
    return (EstimateWarning("alternative", text),)


@dataclass(frozen=True)
class EvidenceSummary:
    """Agreement of one piece of evidence with a joint estimate."""

    kind: str
    """Name of the kind: "keypoints", "mask", "photo", "depth", "gravity", "size", "camera height",
    "rig"."""
    view: int | None
    """Number of the view; None for the object's size."""
    count: int
    """Number of measurements: keypoints, contour pixels, depths, directions, lengths."""
    rms_sigmas: float
    """Root mean square residual, in standard deviations of the measurements."""
    rms: float
    """Root mean square residual in ``unit``."""
    unit: str
    """One of "px", "deg", "" (the unit of lengths). A camera's motion has no residual."""
    share: float | None = None
    """Share of the model's outline that was found in a photo, 0 where the photo was left out."""

    @property
    def name(self) -> str:
        """The argument that gave it.

        Examples
        --------
        >>> EvidenceSummary("gravity", 1, 1, 0.5, 0.5, "deg").name
        'views[1].up'
        """
        return name_of(self.kind, self.view)

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        return f"{self.name}: rms {self.rms:.3g}{unit}, {self.rms_sigmas:.2g} sigma"


def name_of(kind: str, view: int | None) -> str:
    """The argument that gives a piece of evidence.

    Examples
    --------
    >>> name_of("size", None), name_of("depth", 0)
    ('size', 'views[0].depth')
    """
    return kind if view is None else f"views[{view}].{_FIELDS.get(kind, kind)}"


def outside_image(
    points_2d: FloatArray, camera: Camera, *, agree: bool, view: int = 0, where: str = ""
) -> Warnings:
    """Warn about keypoints (n, 2) and a principal point that are none of the image's.

    ``view`` is the number of the view, ``where`` what the texts begin with.

    All keypoints lie beyond one side, or, where they do not ``agree``, most outside: of an object
    that is hidden or cropped, some may, and they may surround the image.
    """
    wrong = _wrong_principal_point(camera)
    doubts = () if wrong is None else (EstimateWarning("camera", where + wrong, view),)
    outside = np.flatnonzero(~camera.contains(points_2d)).tolist()
    count = len(outside)
    if 2 * count <= len(points_2d):
        return doubts
    last = np.array([camera.width, camera.height]) - PIXEL_CENTRE
    beyond = (points_2d < -PIXEL_CENTRE).all(axis=0) | (points_2d > last).all(axis=0)
    if agree and not beyond.any():
        return doubts
    text = (
        f"{where}{count} of {len(points_2d)} keypoints lie outside of the image of {camera.width} "
        f"x {camera.height} px: are they of another resolution than the camera, or of another "
        "photo?"
    )
    return (*doubts, EstimateWarning("outside-image", text, view, tuple(outside)))


def _wrong_principal_point(camera: Camera) -> str | None:
    """Says that a principal point is the middle of another image, or outside of its own."""
    if camera.is_centred:
        return None
    size, own = f"{camera.width} x {camera.height} px", f"({camera.cx:.4g}, {camera.cy:.4g})"
    middle = 2 * (camera.cx + PIXEL_CENTRE), 2 * (camera.cy + PIXEL_CENTRE)
    for factor in OTHER_SIZES:
        other = camera.width * factor, camera.height * factor
        apart = (abs(a - b) / b for a, b in zip(middle, other, strict=True))
        if max(apart) < _SAME_MIDDLE:
            return (
                f"the camera's principal point {own} is the middle of an image of "
                f"{other[0]:.0f} x {other[1]:.0f} px, its own has {size}: if the photo was resized "
                f"(not cut out), give Camera.resized({camera.width}, {camera.height}) of the "
                "camera of that size"
            )
    if camera.contains(np.array([[camera.cx, camera.cy]])).all():
        return None
    return (
        f"the camera's principal point {own} lies outside of its image of {size}, which is right "
        "only for a photo cut out of a larger one: compare the camera with the photo's size"
    )
