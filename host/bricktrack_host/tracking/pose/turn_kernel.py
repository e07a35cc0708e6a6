"""Compiled: turns between attitudes, given as matrices or as rotation vectors."""

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
        for k in range(there_rad.shape[1]):
            turn_between_vectors(here_rad[i], there_rad[i, k], out[i, k])
    return out


@compiled
def angles_between(R: FloatArray, other: FloatArray) -> FloatArray:
    """Return the angles between attitudes, (n, 3, 3) both, rad, within [0, pi]; NaN where one is NaN."""
    out = np.empty(len(R))
    M = np.empty((3, 3))
    for i in range(len(R)):
        turn_matrix(R[i], other[i], M)
        x, y, z = M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]
        out[i] = atan2(sqrt(x * x + y * y + z * z), M[0, 0] + M[1, 1] + M[2, 2] - 1.0)
    return out


@compiled_inline
def turn_between_vectors(here_rad: FloatArray, there_rad: FloatArray, out_rad: FloatArray) -> None:
    """Put Log(Exp(here)^T Exp(there)) into ``out_rad``, (3,)."""
    w0, a = _half_turn(here_rad[0], here_rad[1], here_rad[2])
    x0, y0, z0 = -a * here_rad[0], -a * here_rad[1], -a * here_rad[2]
    w1, b = _half_turn(there_rad[0], there_rad[1], there_rad[2])
    x1, y1, z1 = b * there_rad[0], b * there_rad[1], b * there_rad[2]
    _put_vector(
        w0 * w1 - x0 * x1 - y0 * y1 - z0 * z1,
        w0 * x1 + x0 * w1 + y0 * z1 - z0 * y1,
        w0 * y1 - x0 * z1 + y0 * w1 + z0 * x1,
        w0 * z1 + x0 * y1 - y0 * x1 + z0 * w1,
        out_rad,
    )


@compiled_inline
def turn_matrix(here: FloatArray, there: FloatArray, out: FloatArray) -> None:
    """Put the transpose of one matrix times another, (3, 3) each, into ``out``."""
    for r in range(3):
        for c in range(3):
            out[r, c] = here[0, r] * there[0, c] + here[1, r] * there[1, c] + here[2, r] * there[2, c]


@compiled_inline
def put_rotation_vector(M: FloatArray, out_rad: FloatArray) -> None:
    """Put the rotation vector of a matrix, of an angle within [0, pi], into ``out_rad``, (3,).

    By the quaternion, from the largest of its components (Bar-Itzhack).
    """
    w = 1 + M[0, 0] + M[1, 1] + M[2, 2]
    x = 1 + M[0, 0] - M[1, 1] - M[2, 2]
    y = 1 - M[0, 0] + M[1, 1] - M[2, 2]
    z = 1 - M[0, 0] - M[1, 1] + M[2, 2]
    wx, wy, wz = M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]
    xy, xz, yz = M[0, 1] + M[1, 0], M[0, 2] + M[2, 0], M[1, 2] + M[2, 1]
    if w >= x and w >= y and w >= z:
        x, y, z = wx, wy, wz
    elif x >= y and x >= z:
        w, y, z = wx, xy, xz
    elif y >= z:
        w, x, z = wy, xy, yz
    else:
        w, x, y = wz, xz, yz
    norm = sqrt(w * w + x * x + y * y + z * z)
    _put_vector(w / norm, x / norm, y / norm, z / norm, out_rad)


@compiled_inline
def _put_vector(w: float, x: float, y: float, z: float, out_rad: FloatArray) -> None:
    sine = sqrt(x * x + y * y + z * z)
    gain = 2.0 * atan2(sine, abs(w)) / sine if sine > 1e-12 else 2.0
    if w < 0:
        gain = -gain
    out_rad[0], out_rad[1], out_rad[2] = gain * x, gain * y, gain * z


@compiled_inline
def _half_turn(x: float, y: float, z: float) -> tuple[float, float]:
    """Return the real part of a rotation vector's quaternion, and what makes the vector its other part."""
    angle = sqrt(x * x + y * y + z * z)
    return cos(0.5 * angle), sin(0.5 * angle) / angle if angle > 1e-12 else 0.5
