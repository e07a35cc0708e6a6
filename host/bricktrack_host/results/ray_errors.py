"""What the calibration's rays, and LEDs that show elsewhere, leave unsure in poses: one error of a whole run.

The dots of a calibration are few and noisy, so its rays are off by a little, the same way in every frame.
No residual of the run shows that. To first order a pose is off by ``[dtheta, dt] = A(pose) n`` with n
standard normal, drawn once for a run. A changes slowly with the pose, so displacements from rest are off by
much less.
"""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.poses import Pose
from bricktrack_common.rotations import matrix_from_rvec, skew
from bricktrack_host.calibration.rays.central_rays import CentralRays
from bricktrack_host.calibration.rays.irt import TwoPlaneIrt

# Far enough that differences are not rounding, near enough that they are straight: a shake's own size.
_STEP = np.repeat([0.02, 2.0], 3)  # rad, mm
_LEAST_LEDS = 4
_LEAST_SHARE = 1e-4  # of the greatest variance; less than that is not kept
_AT_ONCE = 1 << 14  # poses, whose weights are in memory together, 1 kB each


@dataclass(frozen=True, slots=True, eq=False)
class RayErrors:
    """Errors of all poses of a run for which its calibration's rays, or its LEDs, are to blame.

    Attributes
    ----------
    about : Pose
        Of the brick in the camera frame, about which the errors were taken: at rest, where it was.
    factor : ndarray, shape (6, m)
        ``A`` there, of ``[dtheta rad, dt mm]``: ``R_true = R Exp(dtheta)``, ``t_true = t + dt``.
    slopes : ndarray, shape (6, 6, m)
        Change of ``A`` by each coordinate of the pose from there: turned by rad about brick axes, moved by mm
        along camera axes.
    """

    about: Pose
    factor: FloatArray
    slopes: FloatArray

    def covariance(self, R_camera_brick: FloatArray, t_camera_brick_mm: FloatArray) -> FloatArray:
        """Return the covariance, shape (n, 6, 6), of ``[dtheta rad, dt mm]`` of n poses; NaN of NaN.

        Parameters
        ----------
        R_camera_brick : ndarray, shape (n, 3, 3)
        t_camera_brick_mm : ndarray, shape (n, 3), mm
        """
        factors = np.concatenate([self.factor[None], self.slopes])
        return self._sum(_products(factors), R_camera_brick, t_camera_brick_mm)

    def change_from_there(self, R_camera_brick: FloatArray, t_camera_brick_mm: FloatArray) -> FloatArray:
        """Return by how much, shape (n, 6, 6), `covariance` changes where n poses are seen from `about`.

        Of ``[dtheta rad, dt mm]`` in the axes of `about`. Both ends err alike but for the slopes, and for
        what an attitude that is off does to the way between: ``D = X_about^-1 X`` to first order of the way,
        see `RestPose.relative_covariance`.
        """
        R = self.about.R.T
        alone = np.concatenate([self.factor[None], self.slopes])
        alone[:, 3:] = R @ alone[:, 3:]
        seen = alone.copy()
        seen[0] = 0.0
        seen[1:4, :3] += skew(np.eye(3)) @ self.factor[:3]
        seen[4:, 3:] += skew(R.T) @ self.factor[:3]
        return self._sum(_products(seen) - _products(alone), R_camera_brick, t_camera_brick_mm)

    def _sum(self, products: FloatArray, R: FloatArray, t_mm: FloatArray) -> FloatArray:
        """Return the sums, shape (n, 6, 6), of `_products` of factors by 1 and by the way to n poses."""
        sums = np.empty((len(R), 6, 6))
        i, j = np.triu_indices(7)
        for start in range(0, len(R), _AT_ONCE):
            now = slice(start, start + _AT_ONCE)
            way = self._way_to(R[now], t_mm[now])
            weights = np.concatenate([np.ones((len(way), 1)), way], axis=1)
            sums[now] = ((weights[:, i] * weights[:, j]) @ products.reshape(-1, 36)).reshape(-1, 6, 6)
        return sums

    def _way_to(self, R: FloatArray, t_mm: FloatArray) -> FloatArray:
        """Return the coordinates of the way from `about` to poses, shape (n, 6), to first order."""
        turned = self.about.R.T @ R
        turn = [turned[:, k, j] - turned[:, j, k] for j, k in ((1, 2), (2, 0), (0, 1))]
        return np.concatenate([np.stack(turn, axis=1) / 2, t_mm - self.about.t_mm], axis=1)


def _products(factors: FloatArray) -> FloatArray:
    """Return the products, shape (28, 6, 6), that make up ``A A^T`` of ``A = sum w[i] factors[i]``.

    One for each pair of the factors, shape (7, 6, m), to be weighed by ``w[i] w[j]``: weights of pairs are
    all that differs from pose to pose.
    """
    i, j = np.triu_indices(len(factors))
    products = np.einsum("pam,pbm->pab", factors[i], factors[j])
    return np.asarray(np.where((i == j)[:, None, None], products, products + np.swapaxes(products, 1, 2)))


def ray_errors(
    rays: CentralRays | TwoPlaneIrt, brick: BrickModel, about: Pose, *, led_sd_px: FloatArray | None = None
) -> RayErrors | None:
    """Return what a calibration's covariance means for poses near one; `None` where it cannot be told.

    Poses are those that fit the LEDs in the picture best, by least squares of pixels.

    Parameters
    ----------
    rays : CentralRays or TwoPlaneIrt
    brick : BrickModel
    about : Pose
        Of the brick in the camera frame, as at rest.
    led_sd_px : ndarray, shape (n_leds,), px, optional
        How far each LED may show elsewhere in either direction, the same way in all pictures; else none does.
    """
    mode = rays.sensor_mode
    uv_px = rays.project(about.apply(brick.led_positions_mm)).uv_px
    inside = np.asarray(((uv_px >= 0) & (uv_px <= [mode.width - 1, mode.height - 1])).all(axis=1))
    if np.count_nonzero(inside) < _LEAST_LEDS:
        return None
    leds_mm = brick.led_positions_mm[inside]
    sd_px = np.zeros(len(leds_mm)) if led_sd_px is None else led_sd_px[inside]
    by_errors = _by_errors(rays, leds_mm, about, sd_px)
    slopes = []
    for step in np.diag(_STEP):
        ahead, behind = (_by_errors(rays, leds_mm, _moved(about, side * step), sd_px) for side in (1.0, -1.0))
        slopes.append((ahead - behind) / 2)
    stacked = np.stack([by_errors, *slopes])  # slopes as steps, so that rows compare in size
    if not np.isfinite(stacked).all():
        return None
    stacked = stacked.reshape(42, -1)
    in_units = np.tile(1 / _STEP, 7)[:, None]
    n_rays = len(rays.covariance)
    by_rays, by_leds = in_units * stacked[:, :n_rays], in_units * stacked[:, n_rays:]
    values, vectors = np.linalg.eigh(by_rays @ rays.covariance @ by_rays.T + by_leds @ by_leds.T)
    kept = values > _LEAST_SHARE * values[-1]
    factors = (vectors[:, kept] * np.sqrt(values[kept]) / in_units).reshape(7, 6, -1)
    return RayErrors(about, factors[0], factors[1:] / _STEP[:, None, None])


def _moved(pose: Pose, step: FloatArray) -> Pose:
    return Pose(pose.R @ matrix_from_rvec(step[:3]), pose.t_mm + step[3:])


def _by_errors(
    rays: CentralRays | TwoPlaneIrt, leds_mm: FloatArray, pose: Pose, led_sd_px: FloatArray
) -> FloatArray:
    """Return the derivative, shape (6, p + 2 n_leds), of the error of a pose by what errs.

    By the p parameters of the rays: a ray that truly passes at e beside where it is believed lets its LED
    appear where one at -e would be believed: ``J [dp/dtheta, dp/dt] [dtheta, dt] = J_xy e`` in pixels, for
    all LEDs by least squares. And by each LED's u and v, in units of its sd.
    """
    points_mm = pose.apply(leds_mm)
    seen = rays.project(points_mm)
    J = seen.J_px_per_mm
    by_pose = np.concatenate([-J @ (pose.R @ skew(leds_mm)), J], axis=2).reshape(-1, 6)
    by_rays = J[:, :, :2] @ rays.point_derivatives(seen.uv_px, points_mm[:, 2])
    by_all = np.concatenate([by_rays.reshape(len(by_pose), -1), np.diag(np.repeat(-led_sd_px, 2))], axis=1)
    if not np.isfinite(by_pose).all():
        return np.full((6, by_all.shape[1]), np.nan)
    return np.asarray(np.linalg.pinv(by_pose * _STEP) @ by_all * _STEP[:, None])
