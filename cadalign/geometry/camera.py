"""The calibrated camera: from camera-frame points to pixels and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, as_floats, as_points, is_masked, is_number
from cadalign.errors import InputError, quote
from cadalign.geometry.camera_form import COLMAP_PARAMS as COLMAP_PARAMS
from cadalign.geometry.camera_form import read_form, read_matrix, write_form
from cadalign.geometry.pixels import (
    PIXEL_CENTRE,
    LensKind,
    PixelOrigin,
    checked_coefficients,
    distort,
    image_of,
    largest_angle,
    perspective,
    rays_of_image,
    require_perspective_lens,
    rescaled_pixels,
    undistort,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True)
class Camera:
    """A calibrated camera: a pinhole, with lens distortion or without, or a wide lens.

    Camera axes are OpenCV's: x right, y down, z forward. Integer pixel coordinates are pixel
    centres: the top-left pixel's centre is (0, 0), the image spans [-0.5, width - 0.5].

    Parameters
    ----------
    width, height : int
        Image size [px].
    fx, fy : float
        Focal lengths [px].
    cx, cy : float
        Principal point [px].
    distortion : tuple of float, optional
        For a perspective lens OpenCV's coefficients in OpenCV's order: (k1, k2, p1, p2), or with
        k3, or with k3, k4, k5, k6; empty for none. For a fisheye (k1, k2, k3, k4) as in
        ``cv2.fisheye``, 0 by default, or (k1, k2, p1, p2, k3, k4, sx1, sy1) as in COLMAP's
        THIN_PRISM_FISHEYE. For a fov lens (omega,) as in COLMAP's FOV.
    lens : {"perspective", "fisheye", "fov"}
        Kind of lens. A fisheye or fov lens may see points beside and behind the camera's plane;
        its focal length has to be known.
    focal_known : bool
        False for a camera whose focal lengths are placeholders; see `without_focal`.

    Raises
    ------
    InputError
        If a size is not a positive integer, a focal length is missing or not positive, a value is
        not finite, or the coefficients are not those of the lens.

    Examples
    --------
    >>> camera = Camera(width=640, height=480, fx=500, fy=500, cx=319.5, cy=239.5)
    >>> camera.project([[0.0, 0.0, 2.0], [0.2, 0.0, 2.0]]).tolist()
    [[319.5, 239.5], [369.5, 239.5]]
    >>> fisheye = Camera(640, 640, fx=200, fy=200, cx=319.5, cy=319.5, lens="fisheye")
    >>> fisheye.project([[1.0, 0.0, 0.0]]).round(2).tolist()  # 90 degrees off the axis
    [[633.66, 319.5]]
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    lens: LensKind = field(default="perspective", kw_only=True)
    focal_known: bool = field(default=True, kw_only=True, repr=False)
    turn: tuple[float, ...] = field(default=(), kw_only=True, repr=False)
    """Rotation by rows from the frame that `turned` gave to the lens's own; empty for none."""

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            size = getattr(self, name)
            if not is_number(size) or int(size) != size or size < 1:
                what = f"{quote(size)} is not a size"
                raise InputError(what, where=f"camera.{name}", fix=_SIZE_FIX)
            object.__setattr__(self, name, int(size))
        for name in ("fx", "fy", "cx", "cy"):
            value = getattr(self, name)
            if not is_number(value):
                raise InputError(f"{quote(value)} is not a finite number", where=f"camera.{name}")
            object.__setattr__(self, name, float(value))
        for name in ("fx", "fy"):
            if getattr(self, name) <= 0:
                what = f"the focal length is {getattr(self, name):g}"
                fix = "give the calibrated focal length in pixels"
                raise InputError(what, where=f"camera.{name}", fix=fix)
        known: object = self.focal_known
        if not isinstance(known, bool | np.bool_):
            what = f"{quote(known)} is neither True nor False"
            raise InputError(what, where="camera.focal_known")
        try:
            if np.iscomplexobj(self.distortion) or is_masked(self.distortion):
                raise TypeError
            coefficients = tuple(float(value) for value in self.distortion)
        except (TypeError, ValueError, OverflowError, NotImplementedError):  # of a memoryview
            raise InputError("not a sequence of numbers", where="camera.distortion") from None
        coefficients = checked_coefficients(self.lens, coefficients)
        object.__setattr__(self, "distortion", coefficients)
        if not self.focal_known:
            require_perspective_lens(self.lens, where="camera.lens")

    @classmethod
    def from_fov(cls, width: int, height: int, *, fov_x: float) -> Camera:
        """Make a camera with square pixels from its horizontal field of view ``fov_x`` [degrees].

        Examples
        --------
        >>> round(Camera.from_fov(640, 480, fov_x=90.0).fx, 6)
        320.0
        """
        if not is_number(fov_x) or not 0 < fov_x < 180:
            raise InputError(f"{quote(fov_x)} is not between 0 and 180 degrees", where="fov_x")
        for name, size in (("width", width), ("height", height)):
            if not is_number(size):
                what = f"{quote(size)} is not a size"
                raise InputError(what, where=f"camera.{name}", fix=_SIZE_FIX)
        with np.errstate(over="ignore"):
            focal = 0.5 * width / np.tan(np.radians(fov_x) / 2)
        return cls(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)

    @classmethod
    def from_matrix(
        cls,
        matrix: npt.ArrayLike,
        width: int,
        height: int,
        *,
        pixel_origin: PixelOrigin = "center",
        distortion: tuple[float, ...] = (),
        lens: LensKind = "perspective",
    ) -> Camera:
        """Make a camera from its calibration matrix K.

        Parameters
        ----------
        matrix : (3, 3) float
            ``[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]`` [px], without skew.
        pixel_origin : {"center", "corner"}
            Where (0, 0) lies for the principal point: at the centre of the top-left pixel (OpenCV,
            Kalibr, BOP), or at the top-left corner of the image (COLMAP, PyTorch3D, many
            renderers), half a pixel away.

        Raises
        ------
        InputError
            If it is no such matrix.

        Examples
        --------
        >>> K = [[500, 0, 320], [0, 500, 240], [0, 0, 1]]
        >>> Camera.from_matrix(K, 640, 480, pixel_origin="corner").cx
        319.5
        """
        return cls(width, height, *read_matrix(matrix, pixel_origin), distortion, lens=lens)

    @classmethod
    def without_focal(
        cls,
        width: int,
        height: int,
        *,
        cx: float | None = None,
        cy: float | None = None,
        distortion: tuple[float, ...] = (),
    ) -> Camera:
        """Make a camera of which only the image is known, for ``fit(..., focal="estimate")``.

        Its pixels are square. ``fx`` and ``fy`` are placeholders; `project`, `normalize` and fits
        with a known focal length refuse it. The principal point is the image's centre by default.

        Examples
        --------
        >>> camera = Camera.without_focal(640, 480)
        >>> camera.cx, camera.cy, camera.focal_known
        (319.5, 239.5, False)
        >>> camera.with_focal(700).fy
        700.0
        """
        if not is_number(width) or not is_number(height) or min(width, height) < 1:
            what = f"{quote(width)} x {quote(height)} is not a size"
            raise InputError(what, where="camera.width", fix=_SIZE_FIX)
        focal = float(max(width, height))
        cx = (width - 1) / 2 if cx is None else cx
        cy = (height - 1) / 2 if cy is None else cy
        return cls(width, height, focal, focal, cx, cy, distortion, focal_known=False)

    def with_focal(self, focal: float) -> Camera:
        """The same camera with the horizontal focal length ``focal`` [px], known from now on.

        The shape of its pixels stays: ``fy`` changes in proportion.
        """
        if not is_number(focal):
            raise InputError(f"{quote(focal)} is not a finite number", where="focal")
        return replace(self, fx=focal, fy=focal * (self.fy / self.fx), focal_known=True)

    def resized(self, width: int, height: int) -> Camera:
        """The camera of the image after it was resized to so many pixels.

        Examples
        --------
        >>> Camera(4, 2, fx=3, fy=3, cx=1.5, cy=0.5).resized(8, 4).cx
        3.5
        """
        factors = np.array([width / self.width, height / self.height])
        cx, cy = rescaled_pixels(np.array([self.cx, self.cy]), factors).tolist()
        fx, fy = (factors * (self.fx, self.fy)).tolist()
        return replace(self, width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)

    def cropped(self, left: int, top: int, width: int, height: int) -> Camera:
        """The camera of a part of the image whose first pixel is (``left``, ``top``).

        The part may reach beyond the image, as a crop with a border does.

        Examples
        --------
        >>> camera = Camera(640, 480, fx=900, fy=900, cx=319.5, cy=239.5)
        >>> part = camera.cropped(100, 50, 200, 300)
        >>> part.cx, part.cy, part.width
        (219.5, 189.5, 200)
        """
        cx, cy = self.cx - left, self.cy - top
        return replace(self, width=width, height=height, cx=cx, cy=cy)

    @property
    def matrix(self) -> FloatArray:
        """The calibration matrix K, (3, 3) float, of pixels whose centres are integers."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=float)

    def turned(self, rotation: npt.ArrayLike) -> Camera:
        """The same camera of a wide lens, its points in a frame that is turned about its centre.

        The rotation (3, 3) leads from this camera's frame to the new one. Image and lens stay where
        they are: the new frame's z axis is not the optical axis.

        Examples
        --------
        >>> camera = Camera(640, 480, 500, 500, 319.5, 239.5, lens="fisheye")
        >>> aside = camera.turned([[0, 0, -1], [0, 1, 0], [1, 0, 0]])  # z is the former x
        >>> bool(np.allclose(aside.project([[0, 0, 1]]), camera.project([[1, 0, 0]])))
        True
        """
        if not self.is_wide:
            raise InputError("the frame of a pinhole is its own", where="camera.lens")
        rows = as_floats(rotation, name="rotation", shape=(3, 3))
        return replace(self, turn=tuple((self.lens_from_camera @ rows.T).ravel().tolist()))

    @property
    def lens_from_camera(self) -> FloatArray:
        """Rotation (3, 3) from the camera's frame to the lens's; see `turned`."""
        return np.array(self.turn).reshape(3, 3) if self.turn else np.eye(3)

    @property
    def is_wide(self) -> bool:
        """True for a lens that may see points beside and behind its plane."""
        return self.lens != "perspective"

    def sees(self, points_cam: FloatArray) -> BoolArray:
        """Say which points (n, 3) of the camera frame have a projection, in the image or not.

        For a pinhole those in front of its plane; for a wide lens those up to the angle from the
        axis at which the image of farther directions would turn back.
        """
        points = points_cam @ self.lens_from_camera.T if self.turn else points_cam
        if not self.is_wide:
            return np.asarray(points[:, 2] > 0)
        angle = np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2])
        return np.asarray((angle < largest_angle(self.lens, self.distortion)) & points.any(axis=1))

    def require_focal(self) -> None:
        """Refuse a camera `without_focal` by an InputError."""
        if not self.focal_known:
            fix = 'estimate it with focal="estimate", or give it: camera.with_focal(...)'
            raise InputError("the focal length is unknown", where="camera", fix=fix)

    def project(self, points_cam: npt.ArrayLike) -> FloatArray:
        """Project points (n, 3) of the camera frame to pixels (n, 2), in the image or beside it.

        Raises
        ------
        InputError
            If a point lies in or behind the camera's plane (z <= 0), or outside the field of a
            wide lens, or the focal length is unknown.
        """
        self.require_focal()
        points = as_points(points_cam, name="points_cam", dimension=3)
        unseen = np.flatnonzero(~self.sees(points))
        if len(unseen):
            what, first = f"{len(unseen)} of {len(points)} points lie", unseen[0]
            if self.is_wide:
                limit = np.degrees(largest_angle(self.lens, self.distortion))
                what += f" outside the lens's field, the first is point {first}"
                fix = f"less than {limit:.4g} degrees off the axis"
            else:
                z = points[first, 2]
                what += f" behind the camera, the first is point {first} with z = {z:g}"
                fix = "with z > 0"
            raise InputError(what, where="points_cam", fix=f"only points {fix} have a projection")
        return self.pixels_of_rays(points)

    def project_where_ahead(self, points_cam: FloatArray) -> FloatArray:
        """Project points (n, 3) of the camera frame; infinite pixels (n, 2) where not seen."""
        pixels = np.full((len(points_cam), 2), np.inf)
        ahead = self.sees(points_cam)
        pixels[ahead] = self.pixels_of_rays(points_cam[ahead])
        return pixels

    def pixels_of_rays(self, rays: FloatArray) -> FloatArray:
        """Pixels (n, 2) of directions (n, 3) that the camera `sees`, of any length."""
        if not self.is_wide:
            return self.pixels_from_normalized(perspective(rays))
        with np.errstate(over="ignore", invalid="ignore"):  # lens polynomials
            image, _ = image_of(rays @ self.lens_from_camera.T, self.lens, self.distortion)
            return image * (self.fx, self.fy) + (self.cx, self.cy)

    def projection_slopes(self, points_cam: FloatArray) -> FloatArray:
        """Derivatives (n, 2, 3) of pixels by points (n, 3) that the camera `sees`."""
        lens_from_camera = self.lens_from_camera
        slopes = image_of(points_cam @ lens_from_camera.T, self.lens, self.distortion)[1]
        return np.asarray(np.array([[self.fx], [self.fy]]) * (slopes @ lens_from_camera))

    def projected_covariances(self, points_cam: FloatArray, covariances: FloatArray) -> FloatArray:
        """Covariances (n, 2, 2) [px squared] of projections of uncertain points, to first order.

        The points (n, 3) are some that the camera `sees`, their covariances are (n, 3, 3).

        Examples
        --------
        >>> camera = Camera(640, 480, 500, 500, 319.5, 239.5)
        >>> camera.projected_covariances(np.array([[0.0, 0.0, 5.0]]), np.eye(3)[None]).tolist()
        [[[10000.0, 0.0], [0.0, 10000.0]]]
        """
        slopes = self.projection_slopes(points_cam)
        return np.asarray(slopes @ covariances @ slopes.swapaxes(1, 2))

    def unproject(self, points_2d: npt.ArrayLike) -> FloatArray:
        """Directions of the rays of pixels (n, 2) in the camera frame, unit vectors (n, 3).

        For a wide lens, z may be 0 or negative.

        Raises
        ------
        InputError
            If the lens model cannot be inverted at a pixel, or the focal length is unknown.

        Examples
        --------
        >>> camera = Camera(640, 640, fx=200, fy=200, cx=319.5, cy=319.5, lens="fisheye")
        >>> camera.unproject([[319.5 + 200 * np.pi / 4, 319.5]]).round(3).tolist()
        [[0.707, 0.0, 0.707]]
        """
        self.require_focal()
        rays, valid = self.rays_where_valid(points_2d)
        _check_undone(valid)
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))

    def rays_where_valid(self, points_2d: npt.ArrayLike) -> tuple[FloatArray, BoolArray]:
        """Directions (n, 3) of pixels (n, 2), and where they exist (n,): elsewhere without meaning.

        They have z = 1 for a pinhole and the length 1 for a wide lens.
        """
        if not self.is_wide:
            normalized, valid = self.normalize_where_valid(points_2d)
            return _homogeneous(normalized), valid
        points = as_points(points_2d, name="points_2d", dimension=2)
        with np.errstate(over="ignore", invalid="ignore"):
            image = (points - (self.cx, self.cy)) / (self.fx, self.fy)
            rays, valid = rays_of_image(image, self.lens, self.distortion)
        return np.asarray(rays @ self.lens_from_camera), valid

    def normalize(self, points_2d: npt.ArrayLike) -> FloatArray:
        """Turn pixels (n, 2) into normalised image coordinates, the lens distortion removed.

        These are (n, 2), such that (u, v, 1) is the direction of the pixel's ray.

        Raises
        ------
        InputError
            If the lens model cannot be inverted at a pixel (far outside the calibrated image), if
            its ray is 90 degrees or more off the z axis (see `unproject`), or the focal length is
            unknown.
        """
        self.require_focal()
        normalized, valid = self.normalize_where_valid(points_2d)
        if self.is_wide and not valid.all():
            _check_undone(self.rays_where_valid(points_2d)[1])
            behind = np.flatnonzero(~valid)
            what = (
                f"the rays of {len(behind)} of {len(valid)} pixels are 90 degrees or more off the"
            )
            what += f" z axis, the first is point {behind[0]}"
            fix = "these have no normalised coordinates; use unproject"
            raise InputError(what, where="points_2d", fix=fix)
        _check_undone(valid)
        return normalized

    def normalize_where_valid(self, points_2d: npt.ArrayLike) -> tuple[FloatArray, BoolArray]:
        """Turn pixels (n, 2) into normalised image coordinates where the lens can be inverted.

        Returns what `normalize` does, meaningless but finite elsewhere, and where it is valid (n,).
        """
        if self.is_wide:
            rays, valid = self.rays_where_valid(points_2d)
            ahead = valid & (rays[:, 2] > 0)
            rays[~ahead] = (0.0, 0.0, 1.0)
            return perspective(rays), ahead
        points = as_points(points_2d, name="points_2d", dimension=2)
        with np.errstate(over="ignore", invalid="ignore"):  # lens polynomials
            distorted = (points - (self.cx, self.cy)) / (self.fx, self.fy)
            if not self.distortion:
                return distorted, np.ones(len(points), dtype=bool)
            return undistort(distorted, self.lens, self.distortion)

    def pixels_from_normalized(self, normalized: FloatArray) -> FloatArray:
        """Apply lens and calibration matrix to (n, 2) normalised coordinates; gives pixels."""
        with np.errstate(over="ignore", invalid="ignore"):  # far outside the lens model's field
            if self.is_wide:
                return self.pixels_of_rays(_homogeneous(normalized))
            if self.distortion:
                normalized, _ = distort(normalized, self.lens, self.distortion)
            return normalized * (self.fx, self.fy) + (self.cx, self.cy)

    def distortion_jacobian(self, normalized: FloatArray) -> FloatArray:
        """Derivatives (n, 2, 2) of pixels, over focal lengths, by normalised coordinates (n, 2)."""
        if not self.distortion:
            return np.broadcast_to(np.eye(2), (len(normalized), 2, 2))
        if self.is_wide:
            slopes = self.projection_slopes(_homogeneous(normalized))[:, :, :2]
            return np.asarray(slopes / np.array([[self.fx], [self.fy]]))
        return distort(normalized, self.lens, self.distortion)[1]

    @property
    def is_centred(self) -> bool:
        """True if the principal point is within an eighth of the image's size of its middle."""
        x, y = (self.cx + PIXEL_CENTRE) / self.width, (self.cy + PIXEL_CENTRE) / self.height
        return max(abs(x - 1 / 2), abs(y - 1 / 2)) < 1 / 8

    def contains(self, points_2d: FloatArray, *, margin: float = 0.0) -> BoolArray:
        """Say which pixels (..., 2) lie at least ``margin`` [px] inside the image; (...) bool."""
        low = -0.5 + margin
        high = np.array([self.width, self.height]) - 0.5 - margin
        return np.asarray(((points_2d >= low) & (points_2d <= high)).all(axis=-1))

    def _repr_html_(self) -> str:
        focal, angle = "unknown", "unknown"
        if self.focal_known:
            half = 0.5 * np.diag([self.width, self.height]) + (self.cx, self.cy)
            rays, valid = replace(self, turn=()).rays_where_valid(half)
            angles = 2 * np.degrees(np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]))
            focal = f"{self.fx:.5g}, {self.fy:.5g} px"
            angle = "{:.3g}° x {:.3g}°".format(*angles) if valid.all() else "the lens's whole"
        lens = ", ".join(f"{value:.3g}" for value in self.distortion)
        from cadalign.notebook import card, draw_picture, photo_axes

        rows = [
            ("image", f"{self.width} x {self.height} px"),
            ("focal length", focal),
            ("field of view", angle),
            ("principal point", f"{self.cx:.5g}, {self.cy:.5g} px (pixel centres are integers)"),
            ("lens", self.lens),
            ("distortion", lens or "none"),
        ]

        def draw(axes: Axes) -> None:
            photo_axes(self.width, self.height, axes=axes)
            axes.axvline((self.width - 1) / 2, color="0.7", linewidth=0.8)
            axes.axhline((self.height - 1) / 2, color="0.7", linewidth=0.8)
            axes.plot(self.cx, self.cy, "+", color="#f03232", markersize=14, markeredgewidth=2)

        picture = draw_picture(draw, aspect=self.height / self.width)
        return card("Camera", rows, picture=picture)

    def to_dict(self, *, pixel_origin: PixelOrigin | None = None) -> dict[str, Any]:
        """Write the camera as COLMAP does: ``{"model", "width", "height", "params"}``.

        COLMAP puts the centre of the top-left pixel at (0.5, 0.5), so the principal point there
        is larger by half a pixel than ``cx`` and ``cy`` here. An unknown focal length is None,
        ``null`` in JSON.

        Parameters
        ----------
        pixel_origin : {"corner", "center"}, optional
            Where (0, 0) lies for the written principal point: the top-left corner of the image,
            or the centre of the top-left pixel; stated in ``pixel_origin``. By default COLMAP's
            corner, not stated.

        Examples
        --------
        >>> camera = Camera(640, 480, 500, 500, 319.5, 239.5)
        >>> camera.to_dict()["params"]
        [500.0, 500.0, 320.0, 240.0]
        >>> camera.to_dict(pixel_origin="center")["params"]
        [500.0, 500.0, 319.5, 239.5]
        """
        if self.turn:
            what = "a camera in a turned frame has no form in files"
            raise InputError(what, where="camera", fix="write the camera that was turned")
        return write_form(vars(self), pixel_origin)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Camera:
        """Read a camera in COLMAP's form, see `to_dict`, or as a calibration matrix.

        Parameters
        ----------
        data : mapping
            ``model`` (SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, FULL_OPENCV,
            SIMPLE_RADIAL_FISHEYE, RADIAL_FISHEYE, OPENCV_FISHEYE, THIN_PRISM_FISHEYE or FOV),
            ``width``, ``height``, and ``params`` in COLMAP's order and pixel convention. None in
            the place of the focal lengths, or ``width`` and ``height`` alone, give a camera
            `without_focal`. Or ``matrix`` (3, 3), ``width``, ``height`` and optionally
            ``distortion`` and ``lens``, as for `from_matrix`. ``pixel_origin`` states where (0, 0)
            lies: by default ``"corner"`` for ``params`` and ``"center"`` for ``matrix``.

        Raises
        ------
        InputError
            If a field is missing, the model is unknown, or the number of parameters is wrong.

        Examples
        --------
        >>> Camera.from_dict({"model": "SIMPLE_RADIAL", "width": 640, "height": 480,
        ...                   "params": [500, 320, 240, 0.1]}).distortion
        (0.1, 0.0, 0.0, 0.0)
        >>> matrix = [[500, 0, 319.5], [0, 500, 239.5], [0, 0, 1]]
        >>> Camera.from_dict({"matrix": matrix, "width": 640, "height": 480}).cx
        319.5
        """
        fields = read_form(data)
        return cls(**fields) if "fx" in fields else cls.without_focal(**fields)


def needs_facing(cameras: Sequence[Camera]) -> bool:
    """True if any of the cameras has a wide lens whose frame faces nothing yet."""
    return True in [camera.is_wide and not camera.turn for camera in cameras]


def _homogeneous(normalized: FloatArray) -> FloatArray:
    return np.column_stack([normalized, np.ones(len(normalized))])


def _check_undone(valid: BoolArray) -> None:
    failed = np.flatnonzero(~valid)
    if len(failed):
        what = f"the lens distortion cannot be undone at {len(failed)} of {len(valid)} pixels, "
        fix = "these lie outside the area in which the lens model is valid; drop them"
        raise InputError(f"{what}the first is point {failed[0]}", where="points_2d", fix=fix)


_SIZE_FIX = "give the image size in whole pixels"
