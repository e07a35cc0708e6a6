"""The Cramér-Rao bound: how well any unbiased method can know a pose from centroids with given noise."""

from collections.abc import Callable

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_common.rotations import matrix_from_rvec

_STEP_RAD, _STEP_MM = 1e-5, 1e-3


def cramer_rao_covariance(
    project: Callable[[FloatArray], FloatArray],
    R_camera_brick: FloatArray,
    t_camera_brick_mm: FloatArray,
    led_positions_mm: FloatArray,
    seen: BoolArray,
    *,
    noise_px: float,
) -> FloatArray:
    """Return the bound on the covariance of ``[dtheta rad, dt mm]``, shape (n, 6, 6); see `tracks`.

    Parameters
    ----------
    project : callable
        The true camera: points (..., 3), mm, camera frame, to pixels (..., 2).
    R_camera_brick, t_camera_brick_mm : ndarray, shapes (n, 3, 3) and (n, 3)
        The true poses.
    led_positions_mm : ndarray, shape (n_leds, 3), mm
    seen : ndarray of bool, shape (n, n_leds)
    noise_px : float, px
        Standard deviation of each of u and v.

    Notes
    -----
    Inverse of the Fisher information ``J' J / sigma^2``; J by central differences of the true camera.
    """
    n, n_leds = seen.shape
    J = np.empty((n, n_leds, 2, 6))
    for k in range(6):
        d = np.zeros(6)
        d[k] = _STEP_RAD if k < 3 else _STEP_MM
        turn = matrix_from_rvec(d[:3])
        ends = [
            project(
                np.einsum("nij,lj->nli", R_camera_brick @ (turn if sign > 0 else turn.T), led_positions_mm)
                + (t_camera_brick_mm + sign * d[3:])[:, None]
            )
            for sign in (1.0, -1.0)
        ]
        J[..., k] = (ends[0] - ends[1]) / (2 * d[k])
    rows = np.where(seen[..., None, None], J, 0.0).reshape(n, 2 * n_leds, 6)
    information = np.swapaxes(rows, 1, 2) @ rows / noise_px**2
    return np.asarray(np.linalg.inv(information))
