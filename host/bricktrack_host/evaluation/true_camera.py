"""A camera that is known exactly, for simulation: it shows points and dot targets, and is then calibrated.

Its lens is Brown's; the product knows no such lens and must find the rays from the dots.
"""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_common.camera_model import IMX219_1080P, RayModel, SensorMode
from bricktrack_host.calibration.dots.dot_observations import DotObservations
from bricktrack_host.calibration.rays.ray_calibration import calibrate_rays

PLANE_A_MM, PLANE_B_MM = 101.117, 161.111
PITCH_MM, COLUMNS, ROWS = 4.0, 54, 32
_DOT_AREA_PX2 = 1e-3  # points: the correction for a disc's size is part of another test
_BORDER_PX = 12.0


@dataclass(frozen=True, slots=True)
class TrueCamera:
    """``u = cx + f x (1 + k1 r^2 + k2 r^4 + k3 r^6) + tangential`` with x = X/Z, y = Y/Z."""

    focal_px: float
    cx_px: float
    cy_px: float
    k1: float
    k2: float
    k3: float
    p1: float
    p2: float
    mode: SensorMode = IMX219_1080P

    @classmethod
    def of_seed(cls, seed: int) -> "TrueCamera":
        """Return one of many cameras of a kind: a 3 mm lens on a sensor's centre crop, never centred."""
        d = np.random.default_rng([seed, 62]).uniform(-1, 1, 8)
        return cls(
            focal_px=1640.0 * (1 + 0.02 * d[0]),
            cx_px=959.5 + 15 * d[1],
            cy_px=539.5 + 15 * d[2],
            k1=-0.11 + 0.04 * d[3],
            k2=0.06 + 0.02 * d[4],
            k3=-0.015 * d[5],
            p1=8e-4 * d[6],
            p2=8e-4 * d[7],
        )

    def project(self, points_camera_mm: FloatArray) -> FloatArray:
        """Return the pixels (..., 2) of points (..., 3), mm, camera frame."""
        x = points_camera_mm[..., 0] / points_camera_mm[..., 2]
        y = points_camera_mm[..., 1] / points_camera_mm[..., 2]
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        u = x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x)
        v = y * radial + 2 * self.p2 * x * y + self.p1 * (r2 + 2 * y * y)
        return np.stack([self.cx_px + self.focal_px * u, self.cy_px + self.focal_px * v], axis=-1)

    def sees(self, uv_px: FloatArray, border_px: float = _BORDER_PX) -> BoolArray:
        """Tell for pixels (..., 2) whether they lie in the picture, off its border."""
        high = np.array([self.mode.width, self.mode.height]) - 1 - border_px
        return np.asarray(((uv_px >= border_px) & (uv_px <= high)).all(axis=-1))

    @property
    def half_field(self) -> tuple[float, float]:
        """Slopes of the picture's borders, about, the smaller of either side."""
        across = min(self.cx_px, self.mode.width - 1 - self.cx_px) / self.focal_px
        down = min(self.cy_px, self.mode.height - 1 - self.cy_px) / self.focal_px
        return across, down

    def calibrated(self, *, noise_px: float, rng: np.random.Generator) -> RayModel:
        """Return the rays as the product finds them from a dot target at two planes."""
        i, j = (g.ravel() for g in np.meshgrid(np.arange(COLUMNS), np.arange(ROWS)))
        xy = np.column_stack([i - (COLUMNS - 1) / 2, j - (ROWS - 1) / 2]) * PITCH_MM
        planes = []
        for z_mm in (PLANE_A_MM, PLANE_B_MM):
            uv = self.project(np.column_stack([xy, np.full(len(xy), z_mm)]))
            shown = self.sees(uv)
            n = int(shown.sum())
            dots = DotObservations(
                uv_px=uv[shown] + rng.normal(0, noise_px, (n, 2)),
                xy_mm=xy[shown],
                cov_px2=np.tile(noise_px**2 * np.eye(2), (n, 1, 1)),
                area_px2=np.full(n, _DOT_AREA_PX2),
                column_row=np.column_stack([i, j])[shown],
            )
            planes.append((z_mm, dots))
        return calibrate_rays(tuple(planes), sensor_mode=self.mode, dot_diameter_mm=1e-3).model
