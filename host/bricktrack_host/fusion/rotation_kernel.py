"""Rotations inside compiled loops: one at a time, written in place."""

from typing import Any

import numpy as np

from bricktrack_host.compiled import compiled


@compiled
def write_rotation(v: Any, out: Any) -> None:
    """Write Exp of a rotation vector."""
    a2 = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    if a2 < 0.01:  # the next terms are below 1e-17
        s = 1.0 - a2 / 6.0 * (1.0 - a2 / 20.0 * (1.0 - a2 / 42.0 * (1.0 - a2 / 72.0)))
        c = 0.5 - a2 / 24.0 * (1.0 - a2 / 30.0 * (1.0 - a2 / 56.0 * (1.0 - a2 / 90.0)))
    else:
        a = np.sqrt(a2)
        s, c = np.sin(a) / a, (1.0 - np.cos(a)) / a2
    for i in range(3):
        for j in range(3):
            out[i, j] = c * v[i] * v[j]
        out[i, i] += 1.0 - c * a2
    out[0, 1] -= s * v[2]
    out[0, 2] += s * v[1]
    out[1, 0] += s * v[2]
    out[1, 2] -= s * v[0]
    out[2, 0] -= s * v[1]
    out[2, 1] += s * v[0]


@compiled
def write_rotation_vector(A: Any, B: Any, out: Any) -> None:
    """Write Log of A^T B, by the quaternion: good for every angle."""
    C = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            C[i, j] = A[0, i] * B[0, j] + A[1, i] * B[1, j] + A[2, i] * B[2, j]
    trace = C[0, 0] + C[1, 1] + C[2, 2]
    q = np.zeros(4)
    i = 0
    if trace > 0:
        q[0] = 1 + trace
        q[1], q[2], q[3] = C[2, 1] - C[1, 2], C[0, 2] - C[2, 0], C[1, 0] - C[0, 1]
    else:
        if C[1, 1] > C[0, 0]:
            i = 1
        if C[2, 2] > C[i, i]:
            i = 2
        j, k = (i + 1) % 3, (i + 2) % 3
        q[1 + i] = 1 + C[i, i] - C[j, j] - C[k, k]
        q[0] = C[k, j] - C[j, k]
        q[1 + j], q[1 + k] = C[j, i] + C[i, j], C[k, i] + C[i, k]
    norm = np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    sign = 1.0 if q[0] >= 0 else -1.0
    s = np.sqrt(q[1] ** 2 + q[2] ** 2 + q[3] ** 2) / norm
    w = sign * q[0] / norm
    gain = 2.0 + s * s / 3.0 if s < 1e-4 else 2.0 * np.arctan2(s, w) / s
    for i in range(3):
        out[i] = gain * sign * q[1 + i] / norm


@compiled
def turn_by(R: Any, v: Any) -> None:
    """Replace R by R Exp(v)."""
    E = np.empty((3, 3))
    write_rotation(v, E)
    row = np.empty(3)
    for i in range(3):
        for j in range(3):
            row[j] = R[i, 0] * E[0, j] + R[i, 1] * E[1, j] + R[i, 2] * E[2, j]
        for j in range(3):
            R[i, j] = row[j]


@compiled
def orthonormalise(R: Any) -> None:
    """Take one Newton step back to a rotation."""
    S = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            S[i, j] = -0.5 * (R[0, i] * R[0, j] + R[1, i] * R[1, j] + R[2, i] * R[2, j])
        S[i, i] += 1.5
    row = np.empty(3)
    for i in range(3):
        for j in range(3):
            row[j] = R[i, 0] * S[0, j] + R[i, 1] * S[1, j] + R[i, 2] * S[2, j]
        for j in range(3):
            R[i, j] = row[j]
