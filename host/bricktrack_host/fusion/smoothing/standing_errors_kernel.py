"""How states and innovations of a filter depend on errors that stand still: compiled loops.

The filter is run once more; beside each state goes its derivative by every error, and back again by the
adjoint. What a frame or an LED says is whitened: divided by the root of its innovation's covariance. Matrices
of 22 rows are flat inside, as in `covariance_kernel`. As on the smoother's way back, one stretch is in memory
at a time, made again from what is kept before it.
"""

from typing import Any, NamedTuple

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_host.compiled import compiled, compiled_sums
from bricktrack_host.fusion.smoothing.covariance_kernel import F_SIZE, M, N, step_back, step_forward
from bricktrack_host.fusion.smoothing.smoother_kernel import (
    CHUNK,
    Kept,
    forward_stretch,
    measurements_of,
    room_for,
    room_to_work,
)
from bricktrack_host.fusion.smoothing.transition_kernel import RunArrays, transition

N_GAINS = 18
"""The first errors: 9 of the gyro and 9 of the accelerometer, row by row, which drive the states."""


class Sight(NamedTuple):
    """What errors change by themselves of what is seen, m frames of r = 6 residuals or m LEDs of r = 2.

    In the order of the errors, q = 18 + d + 2 v L + c: the gains, which change nothing by themselves; then

    Attributes
    ----------
    first : ndarray of int64, shape (K + 1,)
        What is seen at node k is ``first[k]`` to ``first[k + 1]``.
    use : ndarray of bool, shape (m,)
        Others are not shown to the filter.
    shared : ndarray, shape (m, r, d)
        By the errors that all LEDs share, the place of the sensor first.
    by_view, led : ndarray, shape (m, v) and of int64 (m,)
        By each of v errors of (u, v) of LED number ``led`` alone, for all L LEDs after each other; minus.
    n_leds : int
    last : ndarray, shape (m, r, c)
        By the last c, which may drive the states as well.
    """

    first: IntArray
    use: BoolArray
    shared: FloatArray
    by_view: FloatArray
    led: IntArray
    n_leds: int
    last: FloatArray


class Way(NamedTuple):
    """A filter's way over a run with the derivatives by all errors, as kept to go any stretch of it again.

    Attributes
    ----------
    run : RunArrays
        K nodes.
    gyro_var, acc_var : ndarray, shape (K - 1,)
    R_before, x_before, P_before
        What `smoother_kernel.forward_pass` kept before each stretch.
    sight : Sight
    further : ndarray, shape (K - 1, 3, c), m/s
        What the last c errors change of the velocity in each step.
    now_before : ndarray, shape (n, 22 q)
        Derivatives of the state before each stretch, written by `carry_forward`.
    turning : ndarray, shape (K - 1, 3, d), rad
        What the first d of the last c errors turn in each step.
    """

    run: RunArrays
    gyro_var: FloatArray
    acc_var: FloatArray
    R_before: FloatArray
    x_before: FloatArray
    P_before: FloatArray
    sight: Sight
    further: FloatArray
    now_before: FloatArray
    turning: FloatArray


@compiled
def _drive(run: RunArrays, k: int, R: Any, further: Any, turning: Any, now: Any) -> None:
    """Add what the errors do to the state in the step from node ``k``: the gains, and the last c."""
    h, half, dv = run.dt_s[k], run.R_half[k], run.dv_mps[k]
    first = now.shape[1] - further.shape[1]
    for m in range(3):
        rate = 0.5 * (run.omega_radps[k, m] + run.omega_radps[k + 1, m])
        force = (half[0, m] * dv[0] + half[1, m] * dv[1] + half[2, m] * dv[2]) / h
        for i in range(3):
            now[i, 3 * i + m] -= h * rate
            for r in range(3):
                axis = R[r, 0] * half[0, i] + R[r, 1] * half[1, i] + R[r, 2] * half[2, i]
                now[6 + r, 9 + 3 * i + m] -= h * axis * force
                now[3 + r, 9 + 3 * i + m] -= 0.5 * h * h * axis * force
    for r in range(3):
        for c in range(further.shape[1]):
            now[6 + r, first + c] += further[r, c]
            now[3 + r, first + c] += 0.5 * h * further[r, c]
        for c in range(turning.shape[1]):
            now[r, first + c] += turning[r, c]


@compiled_sums
def _write_own(sight: Sight, i: int, out: Any) -> None:
    """Write what the errors change by themselves of the residuals of sight ``i``, shape (r, q)."""
    n_shared, n_last = sight.shared.shape[2], sight.last.shape[2]
    n_rows, q = out.shape
    for r in range(n_rows):
        for j in range(q):
            out[r, j] = 0.0
        for j in range(n_shared):
            out[r, N_GAINS + j] = sight.shared[i, r, j]
        for j in range(n_last):
            out[r, q - n_last + j] = sight.last[i, r, j]
    for v in range(sight.by_view.shape[1]):
        at = N_GAINS + n_shared + 2 * (sight.n_leds * v + sight.led[i])
        out[0, at] = -sight.by_view[i, v]
        out[1, at + 1] = -sight.by_view[i, v]


@compiled_sums
def _take_in(kept: Kept, m: int, now: Any, dy: Any) -> None:
    """Turn what errors change of residuals, shape (r, q), into what they change of whitened innovations.

    In place; and take that into the derivative of the state. The rows are an even number.
    """
    n, q = dy.shape
    H, HP, L = kept.H[m], kept.HP[m], kept.L[m]
    for r in range(n):
        for s in range(r):
            weight = L[r, s]
            for j in range(q):
                dy[r, j] -= weight * dy[s, j]
        for j in range(q):
            dy[r, j] /= L[r, r]
    for r in range(0, n, 2):
        for i in range(N):
            a, b = H[r * N + i], H[(r + 1) * N + i]
            if a != 0.0 or b != 0.0:
                for j in range(q):
                    dy[r, j] -= a * now[i * q + j]
                    dy[r + 1, j] -= b * now[i * q + j]
    for r in range(0, n, 2):
        for i in range(N):
            a, b = HP[r * N + i], HP[(r + 1) * N + i]
            for j in range(q):
                now[i * q + j] += a * dy[r, j] + b * dy[r + 1, j]


@compiled
def _go_again(way: Way, c: int, of: Any, now: Any, changed: Any) -> tuple[Kept, Any]:
    """Go over stretch ``c`` again; return what the filter leaves and how its innovations change, (n, r, q).

    The latter are whitened. The derivatives ``now``, flat, are carried over it. With room in ``changed``,
    those of the states ``of`` after each node are written, shape (n_nodes, c, q).
    """
    run, sight, n_nodes, q = way.run, way.sight, len(way.run.has_frame), len(now) // N
    start, stop = c * CHUNK, min((c + 1) * CHUNK, n_nodes)
    kept = room_for(stop - start, measurements_of(run, start, stop))
    R, x, P = way.R_before[c].copy(), way.x_before[c].copy(), way.P_before[c].copy()
    nis, inflation = np.empty(n_nodes), np.empty(n_nodes)
    forward_stretch(
        run, way.gyro_var, way.acc_var, start, stop, R, x, P, nis, inflation, room_to_work(), kept
    )
    F_flat, dy = np.zeros(F_SIZE), np.empty((kept.first[stop - start], sight.shared.shape[1], q))
    F, now_rows = F_flat.reshape((M, N)), now.reshape((N, q))
    for k in range(start, stop):
        if k > 0 and run.dt_s[k - 1] > 0.0:
            R_last = kept.R[k - start - 1] if k > start else way.R_before[c]
            transition(run, k - 1, R_last, F)
            step_forward(F_flat, now, run.dt_s[k - 1], q)
            _drive(run, k - 1, R_last, way.further[k - 1], way.turning[k - 1], now_rows)
        m = kept.first[k - start]
        for i in range(sight.first[k], sight.first[k + 1]):
            if sight.use[i]:
                _write_own(sight, i, dy[m])
                _take_in(kept, m, now, dy[m])
                m += 1
        if len(changed):
            for r in range(len(of)):
                changed[k - start, r] = now_rows[of[r]]
    return kept, dy


@compiled
def carry_forward(way: Way, normal: Any, pull: Any) -> None:
    """Write how the errors move what is seen in a whole run, and what `carry_back` begins its stretches with.

    ``normal``, shape (q, q), and ``pull``, shape (q,), are the sums over what is seen of the products of the
    innovations' derivatives with each other, and with the innovations; whitened.
    """
    q, n_rows = len(pull), way.sight.shared.shape[1]
    now, of, nothing = np.zeros(N * q), np.zeros(0, dtype=np.int64), np.empty((0, 0, q))
    normal[:], pull[:] = 0.0, 0.0
    for c in range(len(way.R_before)):
        way.now_before[c] = now
        kept, dy = _go_again(way, c, of, now, nothing)
        n = len(dy)
        rows, y = dy.reshape((n_rows * n, q)), np.empty(n_rows * n)
        for m in range(n):
            for r in range(n_rows):
                y[n_rows * m + r] = kept.y[m, r]
        normal += np.dot(rows.T, rows)
        pull += np.dot(rows.T, y)


@compiled_sums
def _take_back(H: Any, HP: Any, dy: Any, later: Any) -> None:
    """Carry what comes later, flat, to before what was seen, in place; ``dy``, shape (r, q), is used up."""
    n, q = dy.shape
    for r in range(0, n, 2):
        for i in range(N):
            a, b = HP[r * N + i], HP[(r + 1) * N + i]
            for j in range(q):
                dy[r, j] -= a * later[i * q + j]
                dy[r + 1, j] -= b * later[i * q + j]
    for r in range(0, n, 2):
        for i in range(N):
            a, b = H[r * N + i], H[(r + 1) * N + i]
            if a != 0.0 or b != 0.0:
                for j in range(q):
                    later[i * q + j] += a * dy[r, j] + b * dy[r + 1, j]


@compiled
def carry_back(way: Way, c: int, of: Any, later: Any, changed: Any) -> None:
    """Write the derivatives of the smoothed states ``of`` of stretch ``c`` by the errors, shape (n, c, q).

    By the adjoint of the way forwards (modified Bryson-Frazier form), which was gone before. ``later``, flat,
    shape (22 q,), is what comes after the stretch, zero at the last, and becomes what comes after the one
    before it.
    """
    run, q = way.run, len(later) // N
    F_flat, later_rows, rows = np.zeros(F_SIZE), later.reshape((N, q)), np.empty((len(of), N))
    F, start = F_flat.reshape((M, N)), c * CHUNK
    kept, dy = _go_again(way, c, of, way.now_before[c].copy(), changed)
    for i in range(len(changed) - 1, -1, -1):
        for r in range(len(of)):
            rows[r] = kept.P[i, of[r] * N : (of[r] + 1) * N]
        changed[i] += np.dot(rows, later_rows)
        for m in range(kept.first[i + 1] - 1, kept.first[i] - 1, -1):
            _take_back(kept.H[m], kept.HP[m], dy[m], later)
        k = start + i
        if k > 0 and run.dt_s[k - 1] > 0.0:
            transition(run, k - 1, kept.R[i - 1] if i > 0 else way.R_before[c], F)
            step_back(F_flat, later, run.dt_s[k - 1], q)
