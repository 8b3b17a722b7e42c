"""The contour of one view's mask, and the rims on its normals as evidence."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.estimation.contours.contour import Contour, mask_contour
from cadalign.estimation.contours.noise import OWN_MODES, REGISTRATION, Noise
from cadalign.estimation.contours.rims import MaskImage, Rims, across_rims, mask_image
from cadalign.estimation.contours.rows import Measured
from cadalign.estimation.contours.surface import PosedSurface
from cadalign.estimation.view import View
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.solvers.constants import CAUCHY
from cadalign.solvers.joint.evidence import Evidence, Sightings, State, log_focals_of


@dataclass(frozen=True, eq=False)
class ViewContour:
    """The contour in view number ``image``.

    ``slopes`` (S, 2, 2) are the derivatives of its samples' places [px] by their rays; ``sigma`` is
    the given standard deviation [px], None to estimate it. The contour is that of ``mask``.
    """

    image: int
    camera: Camera
    contour: Contour
    slopes: FloatArray
    sigma: float | None
    mask: MaskImage

    def camera_at(self, evidence: Evidence, state: State, own: FloatArray) -> Camera:
        """The camera with the focal length of a state, registered to the mask.

        ``own`` (3,) are the contour's own coefficients.
        """
        camera = self.camera
        if evidence.focals.group[self.image] >= 0:
            ratio = np.exp(log_focals_of(evidence, state)[self.image])
            camera = camera.with_focal(camera.fx * float(ratio))
        right, down = (REGISTRATION * own[1:]).tolist()
        return replace(camera, cx=camera.cx + right, cy=camera.cy + down)

    def evidence_of(
        self,
        rims: Rims,
        noise: Noise,
        surface: PosedSurface,
        pose: Alignment,
        *,
        camera: Camera,
        bias: FloatArray,
    ) -> Measured:
        """The rims that were found, in the form of the evidence.

        The ``camera`` is that of `camera_at`. Rims are to lie outside of the contour by the
        ``bias`` (S,) of its extraction [px]. The contour's own modes move every rim outwards, to
        the right and down, by one standard deviation.
        """
        kept = np.flatnonzero(rims.found)
        points, count = rims.points[kept], len(kept)
        across = np.einsum("ni,nij->nj", across_rims(self.contour, rims)[kept], self.slopes[kept])
        # A step along this direction of the ray moves the image by one pixel along the normal.
        step = across / (across**2).sum(axis=1, keepdims=True)
        seen, ratio = pose.apply(points), camera.fx / self.camera.fx
        # At this state the residual is the distance that was found, whatever the normals are.
        rays = ratio * seen[:, :2] / seen[:, 2:]
        rays += np.subtract((camera.cx, camera.cy), (self.camera.cx, self.camera.cy)) / self._focal
        rays -= (rims.offset[kept] - bias[kept])[:, None] * step
        own = np.zeros((OWN_MODES, count, 3))
        own[0, :, :2] = noise.offset * step
        own[1, :, 0], own[2, :, 1] = REGISTRATION / self._focal
        own *= seen[:, 2:] / ratio
        weight = 1 / (noise.sigma * np.sqrt(noise.correlation))
        return Measured(
            surface.rows(points, rims.face[kept]),
            Sightings(
                kept,
                np.full(count, self.image),
                rays,
                np.column_stack([across * weight, np.zeros(count)]),
                np.zeros((count, 2)),
                np.full(count, CAUCHY),
                np.full(count, noise.loss_scale / np.sqrt(noise.correlation)),
                np.zeros((count, 2)),
            ),
            own @ pose.rotation / pose.scale,
        )

    @property
    def _focal(self) -> FloatArray:
        return np.array([self.camera.fx, self.camera.fy])


def contour_view(image: int, view: View, where: str, camera: Camera | None = None) -> ViewContour:
    """The contour of a view's mask, with what the sightings need of the camera.

    Samples outside of its lens are dropped.

    Raises
    ------
    InputError
        If the mask ``where`` has no contour.
    """
    camera = view.camera if camera is None else camera
    mask = cast("FloatArray | BoolArray", view.mask_image)
    contour = mask_contour(mask, where)
    rays, valid = camera.normalize_where_valid(contour.points)
    slopes = np.array([[camera.fx], [camera.fy]]) * camera.distortion_jacobian(rays[valid])
    return ViewContour(
        image, camera, contour.taken(valid), slopes, view.mask_sigma, mask_image(mask)
    )
