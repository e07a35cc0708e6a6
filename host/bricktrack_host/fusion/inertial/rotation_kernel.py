"""Rotations inside compiled loops: one at a time, as nine numbers row by row, or written in place."""

from typing import Any

import numpy as np

from bricktrack_host.compiled import compiled_in_place


@compiled_in_place
def rotation_of(x: float, y: float, z: float) -> Any:
    """Return Exp of a rotation vector, row by row."""
    a2 = x * x + y * y + z * z
    if a2 < 0.01:  # the next terms are below 1e-17
        s = 1.0 - a2 / 6.0 * (1.0 - a2 / 20.0 * (1.0 - a2 / 42.0 * (1.0 - a2 / 72.0)))
        c = 0.5 - a2 / 24.0 * (1.0 - a2 / 30.0 * (1.0 - a2 / 56.0 * (1.0 - a2 / 90.0)))
    else:
        a = np.sqrt(a2)
        s, c = np.sin(a) / a, (1.0 - np.cos(a)) / a2
    rest = 1.0 - c * a2
    return (
        c * x * x + rest, c * x * y - s * z, c * x * z + s * y,
        c * y * x + s * z, c * y * y + rest, c * y * z - s * x,
        c * z * x - s * y, c * z * y + s * x, c * z * z + rest,
    )  # fmt: skip


@compiled_in_place
def _columns(A: Any, i: int, B: Any, j: int) -> float:
    """Return the product of column i of A and column j of B: an element of A^T B."""
    return float(A[0, i] * B[0, j] + A[1, i] * B[1, j] + A[2, i] * B[2, j])


@compiled_in_place
def write_rotation_vector(A: Any, B: Any, out: Any) -> None:
    """Write Log of A^T B, by the quaternion: good for every angle."""
    c00, c11, c22 = _columns(A, 0, B, 0), _columns(A, 1, B, 1), _columns(A, 2, B, 2)
    c01, c10 = _columns(A, 0, B, 1), _columns(A, 1, B, 0)
    c02, c20 = _columns(A, 0, B, 2), _columns(A, 2, B, 0)
    c12, c21 = _columns(A, 1, B, 2), _columns(A, 2, B, 1)
    if c00 + c11 + c22 > 0:
        w, x, y, z = 1 + c00 + c11 + c22, c21 - c12, c02 - c20, c10 - c01
    elif c00 >= c11 and c00 >= c22:
        w, x, y, z = c21 - c12, 1 + c00 - c11 - c22, c01 + c10, c02 + c20
    elif c11 >= c22:
        w, x, y, z = c02 - c20, c01 + c10, 1 + c11 - c22 - c00, c12 + c21
    else:
        w, x, y, z = c10 - c01, c02 + c20, c12 + c21, 1 + c22 - c00 - c11
    norm = np.sqrt(w * w + x * x + y * y + z * z)
    s = np.sqrt(x * x + y * y + z * z) / norm
    gain = 2.0 + s * s / 3.0 if s < 1e-4 else 2.0 * np.arctan2(s, abs(w) / norm) / s
    gain = (gain if w >= 0 else -gain) / norm
    out[0], out[1], out[2] = gain * x, gain * y, gain * z


@compiled_in_place
def times(R: Any, E: Any) -> None:
    """Replace R by R E, the latter given row by row."""
    for i in range(3):
        a, b, c = R[i, 0], R[i, 1], R[i, 2]
        for j in range(3):
            R[i, j] = a * E[j] + b * E[3 + j] + c * E[6 + j]


@compiled_in_place
def turn_by(R: Any, v: Any) -> None:
    """Replace R by R Exp(v)."""
    times(R, rotation_of(v[0], v[1], v[2]))


@compiled_in_place
def orthonormalise(R: Any) -> None:
    """Take one Newton step back to a rotation."""
    xx, yy, zz = _columns(R, 0, R, 0), _columns(R, 1, R, 1), _columns(R, 2, R, 2)
    xy, xz, yz = -0.5 * _columns(R, 0, R, 1), -0.5 * _columns(R, 0, R, 2), -0.5 * _columns(R, 1, R, 2)
    times(R, (1.5 - 0.5 * xx, xy, xz, xy, 1.5 - 0.5 * yy, yz, xz, yz, 1.5 - 0.5 * zz))
