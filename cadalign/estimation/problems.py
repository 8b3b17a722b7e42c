"""Problems for the solvers: checked and packed correspondences, rays and weights; solutions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
import numpy.typing as npt

from cadalign.arrays import (
    FloatArray,
    IntArray,
    as_floats,
    as_points,
    is_number,
    worker_count,
)
from cadalign.errors import CadalignError, DegenerateError, InputError, quote, require_kind
from cadalign.estimation.options import SIGMA_HELP, FitOptions, Sigma, pixel_information
from cadalign.geometry.alignment import describe_plane
from cadalign.geometry.camera import Camera, rays_ahead
from cadalign.geometry.pixels import check_pixels
from cadalign.solvers.constants import LEAST_POINTS, NOT_FOUND, OUT_OF_RANGE, TOO_FEW
from cadalign.solvers.linear import aepnp_error, out_of_range_error
from cadalign.solvers.projection import all_finite, pinhole_rays

T = TypeVar("T")

_SAME_DIGITS = 6  # decimals that equal keypoints share
_MOST_COMPARED = 64  # keypoints: among more, a duplicate changes little
_LEAST_WEIGHT = 0.01  # relative to the largest, so that every keypoint can be drawn


@dataclass(frozen=True, eq=False)
class Problems:
    """Correspondences of problems with one camera, points (n, 3) and (n, 2) [px].

    Problem b has the rows ``offsets[b]`` to ``offsets[b + 1]``.
    """

    points_3d: FloatArray
    points_2d: FloatArray
    offsets: IntArray
    camera: Camera

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def rows(self, problem: int) -> slice:
        return slice(int(self.offsets[problem]), int(self.offsets[problem + 1]))

    @property
    def counts(self) -> IntArray:
        """Number of points of each problem, (B,) int."""
        return self.offsets[1:] - self.offsets[:-1]


def join_problems(problems: Sequence[Problems]) -> Problems:
    return Problems(
        np.concatenate([each.points_3d for each in problems]),
        np.concatenate([each.points_2d for each in problems]),
        np.cumsum([0, *(len(each.points_3d) for each in problems)], dtype=np.int64),
        problems[0].camera,
    )


def first_rows(problem: Problems) -> list[int]:
    """For each row, the first row with the same point and pixel; empty without duplicates."""
    u = problem.points_2d[:_MOST_COMPARED, 0].tolist()  # these differ in most problems
    if len(set(u)) == len(u) or len(problem.points_2d) > _MOST_COMPARED:
        return []
    with np.errstate(over="ignore"):  # of large numbers
        pairs = np.concatenate([problem.points_3d, problem.points_2d], axis=1).round(_SAME_DIGITS)
    first: dict[tuple[float, ...], int] = {}
    firsts = [first.setdefault(tuple(row), number) for number, row in enumerate(pairs.tolist())]
    return firsts if LEAST_POINTS < len(first) < len(firsts) else []  # fewer raise an error


def pack_one(
    points_3d: npt.ArrayLike, points_2d: npt.ArrayLike, camera: Camera, place: str = ""
) -> Problems:
    """Check and pack one problem; messages append its ``place`` to the names of arguments."""
    model, image = cast(FloatArray, points_3d), cast(FloatArray, points_2d)
    name_2d = f"points_2d{place}"
    if not (_is_kernel_array(model, 3) and _is_kernel_array(image, 2) and all_finite(model, image)):
        name_3d = f"points_3d{place}"
        model = np.require(as_points(points_3d, name=name_3d, dimension=3), requirements="W")
        image = np.require(as_points(points_2d, name=name_2d, dimension=2), requirements="W")
    if len(model) != len(image):
        raise InputError(
            f"{len(model)} model points but {len(image)} image points",
            where=name_2d,
            fix="row i of both must be the same keypoint",
        )
    require_kind(camera, Camera, "camera")
    check_pixels(image, camera.width, camera.height, where=name_2d)
    return Problems(model, image, np.array([0, len(model)]), camera)


def pack_many(
    points_3d: Sequence[npt.ArrayLike] | FloatArray,
    points_2d: Sequence[npt.ArrayLike] | FloatArray,
    camera: Camera | Sequence[Camera],
) -> list[Problems]:
    """Check and pack many problems, of equal or different sizes."""
    points_3d = entry_per_problem(points_3d, "points_3d", None, "")
    count = len(points_3d)
    points_2d = entry_per_problem(points_2d, "points_2d", count, "sets of image points")
    is_shared = isinstance(camera, Camera)
    cameras = (
        [camera] * count if is_shared else entry_per_problem(camera, "camera", count, "cameras")
    )
    places = [f"[{b}]" for b in range(count)]
    given = zip(points_3d, points_2d, cameras, places, strict=True)
    return [pack_one(*arguments) for arguments in given]


def entry_per_problem(value: Any, name: str, count: int | None, entries: str) -> Any:
    """A sequence with one entry per problem; messages call them ``entries``."""
    try:
        each = value if isinstance(value, np.ndarray) and value.ndim else list(value)
    except TypeError:
        what = f"expected a sequence of one entry per problem, got {type(value).__name__}"
        raise InputError(what, where=name) from None
    if count is not None and len(each) != count:
        raise InputError(f"{count} problems but {len(each)} {entries}", where=name)
    return each


def run_in_threads(run: Callable[[int, int], T], count: int, workers: int) -> list[T]:
    """Run ``run(first, last)`` over parts of ``count`` problems in threads."""
    bounds = np.linspace(0, count, min(worker_count(workers), max(count, 1)) + 1).astype(int)
    parts = list(pairwise(bounds.tolist()))
    if len(parts) == 1:
        return [run(*parts[0])]
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(len(parts)) as pool:
        return list(pool.map(run, *zip(*parts, strict=True)))


def _is_kernel_array(points: npt.ArrayLike, dimension: int) -> bool:
    """True for an array in the kernels' layout; a read-only one would compile them again."""
    return (
        type(points) is np.ndarray
        and points.dtype == np.float64
        and points.flags.carray
        and points.ndim == 2
        and points.shape[1] == dimension
    )


def rays_of(points_2d: FloatArray, camera: Camera, *, clips: bool = False) -> FloatArray:
    """Normalised image coordinates (n, 2) of checked pixels (n, 2); see `rays_ahead`."""
    if camera.is_wide:
        return rays_ahead(points_2d, camera, clips=clips)
    if camera.distortion:
        return camera.normalize(points_2d)
    return pinhole_rays(points_2d, camera.fx, camera.fy, camera.cx, camera.cy)


def whitening_of(sigma: Sigma | None, rays: FloatArray, camera: Camera) -> FloatArray:
    """Weights (1 or n, 3) that whiten errors (du, dv) of rays (n, 2).

    A row (a, b, c) is the upper Cholesky factor of a ray's information: the whitened error is
    (a du + b dv, c dv). A sigma of None counts as 1 px.
    """
    if sigma is None:
        sigma = 1.0
    if isinstance(sigma, int | float) and not camera.distortion:
        if not (is_number(sigma) and sigma > 0):
            raise InputError(
                f"{quote(sigma)} is not a standard deviation", where="sigma", fix=SIGMA_HELP
            )
        return np.array([[camera.fx / sigma, 0.0, camera.fy / sigma]])
    information = pixel_information(sigma, len(rays))
    to_pixels = np.diag([camera.fx, camera.fy]) @ camera.distortion_jacobian(rays)
    return whitening_by(np.swapaxes(to_pixels, 1, 2) @ information @ to_pixels)


def whitening_by(information: FloatArray) -> FloatArray:
    """Weights (n, 3) as in `whitening_of`, from the information (n, 2, 2) of rays."""
    a = np.sqrt(information[:, 0, 0])
    b = information[:, 0, 1] / a
    return np.stack([a, b, np.sqrt(information[:, 1, 1] - b * b)], axis=1)


def sample_weights(scores: npt.ArrayLike | None, count: int) -> FloatArray:
    """Probabilities of keypoints (n,) in a sample, from scores; empty if these are equal."""
    if scores is None:
        return np.empty(0)
    values = as_floats(scores, name="scores", shape=(count,))
    if (values < 0).any():
        raise InputError(
            f"keypoint {int(np.argmax(values < 0))} has the score {values.min():g}",
            where="scores",
            fix="give numbers that are not negative",
        )
    if not np.ptp(values) > 0:
        return np.empty(0)
    shares = values + _LEAST_WEIGHT * values.max()
    return np.asarray(shares / shares.sum())


class Solutions(NamedTuple):
    """Minima of every problem, the best first.

    ``poses`` (B, k, 15) are packed; ``costs`` (B, k) are whitened squares. ``covariances``
    (B, 8, 8) and ``residuals`` (n, 2) [px] belong to the best minimum. ``info`` (B, 4) has the
    numbers of minima, iterations and hypotheses, and an undetermined unknown or -1.
    """

    poses: FloatArray
    costs: FloatArray
    covariances: FloatArray | None
    statuses: IntArray
    info: IntArray
    residuals: FloatArray = np.empty((0, 2))
    errors: Mapping[int, CadalignError] = MappingProxyType({})


def solver_error(
    status: int, undetermined: int, points_3d: FloatArray, options: FitOptions
) -> DegenerateError:
    """Convert a solver's status to an exception; ``undetermined`` is an unknown's index, or -1."""
    if status == TOO_FEW:
        return too_few_error(len(points_3d), options)
    if status == OUT_OF_RANGE:
        return out_of_range_error()
    if status == NOT_FOUND:
        return no_alignment_error()
    if undetermined < 0:
        return aepnp_error(points_3d)
    reason = describe_plane(points_3d)
    if undetermined < 3:
        missing = "the rotation"
    elif undetermined < 6:
        missing = f"the translation along the camera's {'xyz'[undetermined - 3]}"
    else:
        missing = f"the scale s_{'yz'[undetermined - 6]}"
    fix = "add keypoints elsewhere, hold scales fixed with stretch=, or give stretch_sigma"
    return DegenerateError(
        f"{missing} is not determined: {reason or 'the keypoints do not fix it in this view'}",
        where="points_3d",
        fix=fix,
    )


def too_few_error(count: int, options: FitOptions) -> DegenerateError:
    method = f"the method {options.method!r}"
    fix = f"give at least {options.min_points}"
    if options.method == "optimal":
        method = f"{options.unknowns} unknowns"
        fix += ", fewer unknowns by stretch=, or a prior"
    what = f"{count} keypoints are too few for {method}"
    return DegenerateError(what, where="points_3d", fix=fix)


def no_alignment_error() -> DegenerateError:
    return DegenerateError(
        "no alignment with all keypoints in front of the camera was found",
        where="points_2d",
        fix="check that points_3d and points_2d correspond, row by row, and the camera",
    )


def no_redundancy_error(count: int) -> DegenerateError:
    """The error if sigma is unknown and the keypoints fit exactly."""
    return DegenerateError(
        f"{count} keypoints fit exactly, so their noise cannot be estimated",
        where="sigma",
        fix="give sigma, or more keypoints",
    )
