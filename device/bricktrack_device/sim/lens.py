"""The simulated camera's true lens: a wide lens with radial and tangential distortion.

Used by the simulator alone. The host never sees these numbers: it calibrates from pictures, and its ray
models share no code with this module.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bricktrack_common.arrays import FloatArray

_STEP_PX = 8  # of the coarse grid under `Lens.pixel_slopes`; cubic between, the error is below 1e-4 px
_TOLERANCE = 1e-12


@dataclass(frozen=True)
class Lens:
    """A projection centre with distortion after Brown and Conrady.

    A point (X, Y, Z) of the camera frame has slopes ``x = X/Z, y = Y/Z``; with ``r2 = x^2 + y^2`` it is
    seen at ``u = cx + f (x (1 + k1 r2 + k2 r2^2 + k3 r2^3) + 2 p1 x y + p2 (r2 + 2 x^2))`` and likewise v.
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
        """Return the slopes (x/z, y/z) that pixels (..., 2) see, by fixed-point iteration to 1e-12."""
        centre = np.array([self.cx_px, self.cy_px])
        target = (uv_px - centre) / self.focal_px
        s = target.copy()
        for _ in range(60):
            error = target - (self._pixel_of(s) - centre) / self.focal_px
            s = s + error
            if np.abs(error).max() < _TOLERANCE:
                break
        return np.asarray(s)

    @cached_property
    def pixel_slopes(self) -> FloatArray:
        """What every pixel centre sees: slopes (x/z, y/z), shape (height, width, 2)."""
        step = _STEP_PX
        # One more knot on every side, so that the cubic never extrapolates.
        rows = np.arange(-step, self.height + 2 * step, step, dtype=np.float64)
        columns = np.arange(-step, self.width + 2 * step, step, dtype=np.float64)
        coarse = self.slopes(np.stack(np.meshgrid(columns, rows), axis=-1))
        fine = _cubic_between(_cubic_between(coarse, step, axis=0), step, axis=1)
        return np.ascontiguousarray(fine[: self.height, : self.width])


def lens_of(seed: int) -> Lens:
    """Return the lens of the unit with this seed: no two are quite alike.

    Examples
    --------
    >>> lens_of(1) == lens_of(1), lens_of(1) == lens_of(2)
    (True, False)
    """
    rng = np.random.default_rng([seed, 8])
    d = rng.uniform(-1, 1, 6)
    return Lens(
        focal_px=round(1652.0 * (1 + 0.008 * d[0]), 3),
        cx_px=round(959.5 + 12 * d[1], 3),
        cy_px=round(539.5 + 12 * d[2], 3),
        k1=round(-0.118 * (1 + 0.06 * d[3]), 6),
        p1=round(8.0e-4 * d[4], 7),
        p2=round(8.0e-4 * d[5], 7),
    )


def _cubic_between(a: FloatArray, step: int, *, axis: int) -> FloatArray:
    """Return Catmull-Rom interpolation, ``step`` samples a knot, from the second knot to the last but one."""
    a = np.moveaxis(a, axis, 0)
    p0, p1, p2, p3 = (p[:, None] for p in (a[:-3], a[1:-2], a[2:-1], a[3:]))
    t = (np.arange(step) / step).reshape(1, step, *([1] * (a.ndim - 1)))
    out = p1 + 0.5 * (
        t * (p2 - p0) + t**2 * (2 * p0 - 5 * p1 + 4 * p2 - p3) + t**3 * (3 * p1 - p0 - 3 * p2 + p3)
    )
    return np.moveaxis(out.reshape(-1, *a.shape[1:]), 0, axis)
