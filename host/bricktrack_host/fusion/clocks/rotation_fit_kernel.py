"""The loops of `rotation_fit`, compiled: attitudes by the gyro, and least squares beside a slow drift.

The drift is a sum of hat functions, of which two at most are not zero at a frame: what it explains is taken
out through a tridiagonal matrix, without a dense basis.
"""

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_host.compiled import compiled
from bricktrack_host.fusion.inertial.rotation_kernel import turn_by, write_rotation_vector
from bricktrack_host.fusion.inertial.signal_kernel import GyroPieces, held_value, piece_of

N_COLUMNS = 4
"""Of the least squares: offset, skew, and the low-pass's c and d."""
_RIDGE = 1e-12  # of the largest knot: one without frames is held at zero


@compiled
def integrate_attitudes(
    pieces: GyroPieces, nodes_s: FloatArray, bias_radps: FloatArray, out: FloatArray
) -> None:
    """Write the gyro's attitudes at instants seen from the first, shape (n, 3, 3).

    Over 2.5 ms the integral of the rate is the rotation vector: coning is below 1e-8 rad.
    """
    R, turn, before = np.eye(3), np.empty(3), np.empty(3)
    i = 0
    for n in range(len(nodes_s)):
        i = piece_of(pieces.knots_s, nodes_s[n], i)
        for a in range(3):
            angle = held_value(pieces.angle, pieces.gyro, i, a, nodes_s[n], pieces)
            turn[a] = angle - before[a]
            if n > 0:
                turn[a] -= (nodes_s[n] - nodes_s[n - 1]) * bias_radps[a]
            before[a] = angle
        if n > 0:
            turn_by(R, turn)
        out[n] = R


@compiled
def compare_with_gyro(
    pieces: GyroPieces,
    nodes_s: FloatArray,
    node_attitude: FloatArray,
    bias_radps: FloatArray,
    t_imu_s: FloatArray,
    since_mid_s: FloatArray,
    R: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the gyro's attitudes at frames, what the frames are turned against them, and what explains it.

    Parameters
    ----------
    nodes_s, node_attitude, bias_radps : ndarray, shape (k,), (k, 3, 3), (3,)
        As `integrate_attitudes` wrote them.
    t_imu_s, since_mid_s : ndarray, shape (n,)
        Of the frames: IMU time, and camera time after the middle.
    R : ndarray, shape (n, 3, 3)
        Optical attitudes.

    Returns
    -------
    attitude, error : ndarray, shape (n, 3, 3), (n, 3)
        The error in the axes of the gyro's start: constant but for its drift.
    design : ndarray, shape (n, 3, 4)
        Columns: derivative of the error by offset, by skew, and by the low-pass: beside its delay, that takes
        c times the second derivative from the rate and d times the third, and so from the angle c times the
        rate's first derivative and d times its second.
    """
    n_frames = len(t_imu_s)
    attitude, error = np.empty((n_frames, 3, 3)), np.empty((n_frames, 3))
    design = np.empty((n_frames, 3, N_COLUMNS))
    reference, predicted, turn = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    low, high = pieces.span_s
    rate, slope, curve = np.empty(3), np.empty(3), np.empty(3)
    i, node = 0, 0
    for n in range(n_frames):
        t = t_imu_s[n]
        node = piece_of(nodes_s, t, node)
        at_node = nodes_s[node]
        i = piece_of(pieces.knots_s, at_node, i)
        for a in range(3):
            turn[a] = -held_value(pieces.angle, pieces.gyro, i, a, at_node, pieces)
        i = piece_of(pieces.knots_s, min(max(t, low), high), i)
        s = min(max(t, low), high) - pieces.knots_s[i]
        for a in range(3):
            turn[a] += held_value(pieces.angle, pieces.gyro, i, a, t, pieces) - (t - at_node) * bias_radps[a]
            c = pieces.gyro[:, i, a]
            rate[a] = ((c[0] * s + c[1]) * s + c[2]) * s + c[3] - bias_radps[a]
            slope[a] = (3.0 * c[0] * s + 2.0 * c[1]) * s + c[2]
            curve[a] = 6.0 * c[0] * s + 2.0 * c[1]
        A = attitude[n]
        A[:] = node_attitude[node]
        turn_by(A, turn)
        if n == 0:
            for a in range(3):
                for b in range(3):
                    reference[a, b] = R[0, a, 0] * A[b, 0] + R[0, a, 1] * A[b, 1] + R[0, a, 2] * A[b, 2]
        for a in range(3):
            for b in range(3):
                predicted[a, b] = (
                    reference[a, 0] * A[0, b] + reference[a, 1] * A[1, b] + reference[a, 2] * A[2, b]
                )
        write_rotation_vector(predicted, R[n], turn)
        for a in range(3):
            error[n, a] = A[a, 0] * turn[0] + A[a, 1] * turn[1] + A[a, 2] * turn[2]
            design[n, a, 0] = A[a, 0] * rate[0] + A[a, 1] * rate[1] + A[a, 2] * rate[2]
            design[n, a, 1] = since_mid_s[n] * design[n, a, 0]
            design[n, a, 2] = -(A[a, 0] * slope[0] + A[a, 1] * slope[1] + A[a, 2] * slope[2])
            design[n, a, 3] = -(A[a, 0] * curve[0] + A[a, 1] * curve[1] + A[a, 2] * curve[2])
    return attitude, error, design


@compiled
def _knot_solution(
    weight2: FloatArray, knot: IntArray, share: FloatArray, n_knots: int, values: FloatArray
) -> FloatArray:
    """Return the knots that fit values best, shape (n, c) -> (n_knots, c).

    ``share`` of frame n belongs to knot ``knot[n] + 1``, the rest to ``knot[n]``.
    """
    diagonal, beside = np.zeros(n_knots), np.zeros(n_knots)
    n_columns = values.shape[1]
    out = np.zeros((n_knots, n_columns))
    for n in range(len(knot)):
        k, s, w = knot[n], share[n], weight2[n]
        diagonal[k] += w * (1.0 - s) * (1.0 - s)
        diagonal[k + 1] += w * s * s
        beside[k] += w * s * (1.0 - s)
        for c in range(n_columns):
            out[k, c] += w * (1.0 - s) * values[n, c]
            out[k + 1, c] += w * s * values[n, c]
    ridge = _RIDGE * diagonal.max()
    diagonal[0] += ridge
    for k in range(1, n_knots):
        f = beside[k - 1] / diagonal[k - 1]
        diagonal[k] += ridge - f * beside[k - 1]
        for c in range(n_columns):
            out[k, c] -= f * out[k - 1, c]
    for k in range(n_knots - 1, -1, -1):
        for c in range(n_columns):
            if k < n_knots - 1:
                out[k, c] -= beside[k] * out[k + 1, c]
            out[k, c] /= diagonal[k]
    return out


@compiled
def drift_of(
    weight: FloatArray, knot: IntArray, share: FloatArray, n_knots: int, values: FloatArray
) -> FloatArray:
    """Return the slow drift that fits values best, shape (n, c), in weighted least squares.

    Parameters
    ----------
    weight : ndarray, shape (n,)
        One over the sd of each frame.
    knot, share, n_knots
        See `hats`.
    """
    knots = _knot_solution(weight * weight, knot, share, n_knots, values)
    out = np.empty(values.shape)
    for n in range(len(knot)):
        for c in range(values.shape[1]):
            out[n, c] = (1.0 - share[n]) * knots[knot[n], c] + share[n] * knots[knot[n] + 1, c]
    return out


@compiled
def normal_equations(
    weight: FloatArray,
    knot: IntArray,
    share: FloatArray,
    n_knots: int,
    design: FloatArray,
    error: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return normal matrix (4, 4) and right side (4,) of error = design @ step + drift, drift eliminated."""
    n_frames = len(knot)
    n_each = N_COLUMNS + 1
    columns = np.empty((n_frames, 3 * n_each))  # axis by axis: design and error
    for n in range(n_frames):
        for a in range(3):
            for c in range(N_COLUMNS):
                columns[n, n_each * a + c] = design[n, a, c]
            columns[n, n_each * a + N_COLUMNS] = error[n, a]
    columns -= drift_of(weight, knot, share, n_knots, columns)
    normal, right = np.zeros((N_COLUMNS, N_COLUMNS)), np.zeros(N_COLUMNS)
    for n in range(n_frames):
        w = weight[n] * weight[n]
        for a in range(3):
            i = n_each * a
            for c in range(N_COLUMNS):
                right[c] += w * columns[n, i + c] * columns[n, i + N_COLUMNS]
                for d in range(N_COLUMNS):
                    normal[c, d] += w * columns[n, i + c] * columns[n, i + d]
    return normal, right
