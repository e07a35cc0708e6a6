"""The simulated camera's true lens: a wide lens with radial and tangential distortion.

Used by the simulator alone. The host never sees these numbers: it calibrates from pictures, and its ray
models share no code with this module.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bricktrack_common.arrays import FloatArray


@dataclass(frozen=True)
class Lens:
    """A projection centre with distortion after Brown and Conrady.

    A point (X, Y, Z) of the camera frame has slopes ``x = X/Z, y = Y/Z``; with ``r2 = x^2 + y^2`` it is seen
    at ``u = cx + f (x (1 + k1 r2 + k2 r2^2 + k3 r2^3) + 2 p1 x y + p2 (r2 + 2 x^2))`` and likewise v.
    """

    width: int = 1920
    height: int = 1080
    focal_px: float = 1652.0
    cx_px: float = 967.3
    cy_px: float = 531.8
    k1: float = -0.118
    k2: float = 0.071
    k3: float = -0.017
    p1: float = 8.0e-4
    p2: float = -5.0e-4

    def project(self, points_camera_mm: FloatArray) -> FloatArray:
        """Return pixels (..., 2) of points (..., 3), mm, camera frame."""
        return self._pixel_of(points_camera_mm[..., :2] / points_camera_mm[..., 2:])

    def _pixel_of(self, slopes: FloatArray) -> FloatArray:
        x, y = slopes[..., 0], slopes[..., 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        xd = x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x)
        yd = y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y
        return np.stack([self.cx_px + self.focal_px * xd, self.cy_px + self.focal_px * yd], axis=-1)

    def slopes(self, uv_px: FloatArray) -> FloatArray:
        """Return the slopes (x/z, y/z) that pixels (..., 2) see, by fixed-point iteration to 1e-9."""
        target = (uv_px - [self.cx_px, self.cy_px]) / self.focal_px
        s = target.copy()
        for _ in range(40):
            error = target - (self._pixel_of(s) - [self.cx_px, self.cy_px]) / self.focal_px
            s = s + error
            if np.abs(error).max() < 1e-9:
                break
        return np.asarray(s)

    @cached_property
    def directions(self) -> FloatArray:
        """Unit ray directions of all pixel centres, shape (height, width, 3)."""
        step = 8  # the map is smooth: bilinear between every eighth pixel errs by less than 1e-3 px
        v, u = np.mgrid[0 : self.height + step : step, 0 : self.width + step : step].astype(np.float64)
        coarse = self.slopes(np.stack([u, v], axis=-1))
        fine = _upsample(_upsample(coarse, step, axis=0), step, axis=1)[: self.height, : self.width]
        d = np.concatenate([fine, np.ones((*fine.shape[:2], 1))], axis=-1)
        d /= np.linalg.norm(d, axis=-1, keepdims=True)
        return np.asarray(d)


def _upsample(a: FloatArray, step: int, *, axis: int) -> FloatArray:
    """Return cubic (Catmull-Rom) interpolation between samples ``step`` apart."""
    a = np.moveaxis(a, axis, 0)
    padded = np.concatenate([2 * a[:1] - a[1:2], a, 2 * a[-1:] - a[-2:-1]])
    p0, p1, p2, p3 = padded[:-3], padded[1:-2], padded[2:-1], padded[3:]
    t = (np.arange(step) / step).reshape(1, step, *([1] * (a.ndim - 1)))
    p0, p1, p2, p3 = (p[:, None] for p in (p0, p1, p2, p3))
    out = 0.5 * (
        2 * p1 + t * (p2 - p0) + t**2 * (2 * p0 - 5 * p1 + 4 * p2 - p3) + t**3 * (3 * p1 - p0 - 3 * p2 + p3)
    )
    return np.moveaxis(out.reshape(-1, *a.shape[1:]), 0, axis)
