"""A pinhole camera with Brown's distortion, as a `RayModel`: truth for tests, apart from the product's models."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bricktrack_common.arrays import BoolArray
from bricktrack_common.camera_model import IMX219_1080P, Projection, SensorMode

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class PinholeCamera:
    """``u = f x' + u0`` with radial (k1, k2) and tangential (p1, p2) distortion of the slopes x/z, y/z."""

    f_px: float = 1560.0
    u0_px: float = 959.5
    v0_px: float = 539.5
    k1: float = 0.06
    k2: float = -0.02
    p1: float = 4e-4
    p2: float = -3e-4
    sensor_mode: SensorMode = IMX219_1080P
    plane_a_mm: float = 101.117
    plane_b_mm: float = 161.111

    def _distort(self, xy: FloatArray) -> tuple[FloatArray, FloatArray]:
        x, y = xy[..., 0], xy[..., 1]
        r2 = x * x + y * y
        radial = 1 + self.k1 * r2 + self.k2 * r2 * r2
        slope = self.k1 + 2 * self.k2 * r2  # d radial / d r2
        out = np.stack(
            [
                x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x),
                y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y,
            ],
            axis=-1,
        )
        J = np.empty((*xy.shape[:-1], 2, 2))
        J[..., 0, 0] = radial + 2 * x * x * slope + 2 * self.p1 * y + 6 * self.p2 * x
        J[..., 0, 1] = J[..., 1, 0] = 2 * x * y * slope + 2 * self.p1 * x + 2 * self.p2 * y
        J[..., 1, 1] = radial + 2 * y * y * slope + 6 * self.p1 * y + 2 * self.p2 * x
        return out, J

    def points_on_plane(self, uv_px: ArrayLike, z_mm: float) -> FloatArray:
        uv = np.asarray(uv_px, dtype=np.float64)
        wanted = (uv - [self.u0_px, self.v0_px]) / self.f_px
        xy = wanted.copy()
        for _ in range(8):
            got, J = self._distort(xy)
            xy = xy + np.linalg.solve(J, (wanted - got)[..., None])[..., 0]
        return xy * z_mm

    def project(self, points_camera_mm: ArrayLike) -> Projection:
        p = np.asarray(points_camera_mm, dtype=np.float64)
        z = p[..., 2:]
        xy = p[..., :2] / z
        out, J2 = self._distort(xy)
        d_slopes = np.zeros((*p.shape[:-1], 2, 3))
        d_slopes[..., 0, 0] = d_slopes[..., 1, 1] = 1 / z[..., 0]
        d_slopes[..., :, 2] = -xy / z
        uv = self.f_px * out + [self.u0_px, self.v0_px]
        return Projection(uv_px=uv, J_px_per_mm=self.f_px * J2 @ d_slopes)

    def is_covered(self, uv_px: ArrayLike) -> BoolArray:
        uv = np.asarray(uv_px)
        return np.asarray(np.isfinite(uv).all(axis=-1))
