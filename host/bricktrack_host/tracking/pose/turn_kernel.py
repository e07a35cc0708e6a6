"""Compiled: turns between attitudes that are given as rotation vectors, many from each of some."""

from math import atan2, cos, sin, sqrt

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_host.compiled import compiled, compiled_inline


@compiled
def turns_between(here_rad: FloatArray, there_rad: FloatArray) -> FloatArray:
    """Return the rotation vectors that turn attitudes into others: Log(Exp(here)^T Exp(there)).

    Parameters
    ----------
    here_rad : ndarray, shape (n, 3), rad
    there_rad : ndarray, shape (n, m, 3), rad

    Returns
    -------
    turn_rad : ndarray, shape (n, m, 3), rad
        Of angles within [0, pi].

    Notes
    -----
    By the product of unit quaternions, which is well conditioned at every angle.
    """
    out = np.empty(there_rad.shape)
    for i in range(len(here_rad)):
        w0, a = _half_turn(here_rad[i, 0], here_rad[i, 1], here_rad[i, 2])
        x0, y0, z0 = -a * here_rad[i, 0], -a * here_rad[i, 1], -a * here_rad[i, 2]
        for k in range(there_rad.shape[1]):
            w1, b = _half_turn(there_rad[i, k, 0], there_rad[i, k, 1], there_rad[i, k, 2])
            x1, y1, z1 = b * there_rad[i, k, 0], b * there_rad[i, k, 1], b * there_rad[i, k, 2]
            w = w0 * w1 - x0 * x1 - y0 * y1 - z0 * z1
            x = w0 * x1 + x0 * w1 + y0 * z1 - z0 * y1
            y = w0 * y1 - x0 * z1 + y0 * w1 + z0 * x1
            z = w0 * z1 + x0 * y1 - y0 * x1 + z0 * w1
            sine = sqrt(x * x + y * y + z * z)
            gain = 2.0 * atan2(sine, abs(w)) / sine if sine > 1e-12 else 2.0
            if w < 0:
                gain = -gain
            out[i, k, 0], out[i, k, 1], out[i, k, 2] = gain * x, gain * y, gain * z
    return out


@compiled_inline
def _half_turn(x: float, y: float, z: float) -> tuple[float, float]:
    """Return the real part of a rotation vector's quaternion, and what makes the vector its other part."""
    angle = sqrt(x * x + y * y + z * z)
    return cos(0.5 * angle), sin(0.5 * angle) / angle if angle > 1e-12 else 0.5
