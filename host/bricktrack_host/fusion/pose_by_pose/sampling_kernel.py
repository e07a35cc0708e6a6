"""A smoothed motion at instants between the filter's nodes, and its covariance there, compiled.

State indices are `smoother`'s: velocity from 6, gyro and accelerometer bias from 9 and 12, gravity from 15.
"""

from typing import Any, NamedTuple

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_host.compiled import compiled, compiled_inline
from bricktrack_host.fusion.inertial.rotation_kernel import turn_by, write_rotation_vector
from bricktrack_host.fusion.inertial.signal_kernel import (
    SignalPieces,
    StepRoom,
    gyro_at,
    integrate_step,
    step_room,
)


class Path(NamedTuple):
    """States at K nodes, and what carries them from one to the next.

    Attributes
    ----------
    node_s, R, x : ndarray, shape (K,), (K, 3, 3), (K, 22)
    pieces : SignalPieces
    lag_s : float
        Of the accelerometer, see `ImuSignal.increments`.
    felt : ndarray, shape (K - 1, 2, 3), or (0, 2, 3)
        What a moving camera adds to velocity and position over each step, in still axes.
    """

    node_s: FloatArray
    R: FloatArray
    x: FloatArray
    pieces: SignalPieces
    lag_s: float
    felt: FloatArray


class _Carried(NamedTuple):
    """A state carried on from a node: attitude, velocity and position; and the step in body axes."""

    R: FloatArray
    v: FloatArray
    p: FloatArray
    R_step: FloatArray
    dv: FloatArray
    dp: FloatArray
    R_half: FloatArray
    f_rate: FloatArray
    f_curve: FloatArray


@compiled
def _carried_room() -> _Carried:
    return _Carried(
        np.empty((3, 3)), np.empty(3), np.empty(3), np.empty((3, 3)), np.empty(3), np.empty(3),
        np.empty((3, 3)), np.empty(3), np.empty(3),
    )  # fmt: skip


@compiled_inline
def _carry(
    path: Path, k: int, t_s: float, felt: Any, n: int, room: StepRoom, i: int, j: int, out: _Carried
) -> tuple[int, int]:
    """Carry the state of node ``k`` to an instant; ``felt[n]``, where there is any, is the camera's part."""
    R, x, h = path.R[k], path.x[k], t_s - path.node_s[k]
    i, j = integrate_step(
        path.pieces, path.node_s[k], h, x[9:12], x[12:15], path.lag_s, out.R_step, out.dv, out.dp,
        out.R_half, out.f_rate, out.f_curve, room, i, j,
    )  # fmt: skip
    for a in range(3):
        out.v[a] = x[6 + a] + h * x[15 + a]
        out.p[a] = x[3 + a] + h * x[6 + a] + 0.5 * h * h * x[15 + a]
        if len(felt):
            out.v[a] += felt[n, 0, a]
            out.p[a] += felt[n, 1, a]
        for b in range(3):
            out.v[a] += R[a, b] * out.dv[b]
            out.p[a] += R[a, b] * out.dp[b]
            out.R[a, b] = R[a, 0] * out.R_step[0, b] + R[a, 1] * out.R_step[1, b] + R[a, 2] * out.R_step[2, b]
    return i, j


@compiled
def carry_between(
    path: Path,
    t_s: FloatArray,
    node: IntArray,
    felt: FloatArray,
    is_smoothed: bool,
    R: FloatArray,
    p_m: FloatArray,
    v_mps: FloatArray,
    omega_radps: FloatArray,
) -> None:
    """Write the state at instants, shape (n,): carried on from the node before, and led to the node after.

    Where the samples miss the node after, the miss is spread as white noise would: attitude linearly,
    velocity and position along the cubic between both ends; if not smoothed, not at all.

    Parameters
    ----------
    node : ndarray of int64, shape (n,)
        The last one not after each instant; instants in order take the least time.
    felt : ndarray, shape (n, 2, 3), or (0, 2, 3)
        As `Path.felt`, from the node to the instant.
    R, p_m, v_mps, omega_radps : ndarray, shape (n, 3, 3), (n, 3) each
        Written; the last is the measured rate less the node's bias.
    """
    room, now, then = step_room(), _carried_room(), _carried_room()
    turn, share_of_turn, miss_v, miss_p = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    i, j, last = 0, 0, -1
    for n in range(len(t_s)):
        k, t = node[n], t_s[n]
        i, j = _carry(path, k, t, felt, n, room, i, j, now)
        gyro_at(path.pieces, t, i, omega_radps[n])
        for a in range(3):
            omega_radps[n, a] -= path.x[k, 9 + a]
        if is_smoothed:
            s = path.node_s[k + 1] - path.node_s[k]
            if k != last:
                _carry(path, k, path.node_s[k + 1], path.felt, k, room, i, j, then)
                write_rotation_vector(then.R, path.R[k + 1], turn)
                for a in range(3):
                    miss_v[a] = path.x[k + 1, 6 + a] - then.v[a]
                    miss_p[a] = path.x[k + 1, 3 + a] - then.p[a]
                last = k
            share = (t - path.node_s[k]) / s
            square, cube = share * share, share * share * share
            for a in range(3):
                share_of_turn[a] = share * turn[a]
                now.p[a] += (3 * square - 2 * cube) * miss_p[a] + s * (cube - square) * miss_v[a]
                now.v[a] += 6 * (share - square) / s * miss_p[a] + (3 * square - 2 * share) * miss_v[a]
            turn_by(now.R, share_of_turn)
        for a in range(3):
            p_m[n, a], v_mps[n, a] = now.p[a], now.v[a]
            for b in range(3):
                R[n, a, b] = now.R[a, b]


@compiled_inline
def _write_derivative(
    R: Any, turn_radps: Any, v_origin_mps: Any, since_mid_s: float, arm_m: Any, H: Any
) -> None:
    """Write what of the derivative of a pose by its states, shape (6, 8), is neither 0 nor 1."""
    for r in range(3):
        H[3 + r, 0] = R[r, 1] * arm_m[2] - R[r, 2] * arm_m[1]  # R [arm]x
        H[3 + r, 1] = R[r, 2] * arm_m[0] - R[r, 0] * arm_m[2]
        H[3 + r, 2] = R[r, 0] * arm_m[1] - R[r, 1] * arm_m[0]
        H[r, 6], H[3 + r, 6] = turn_radps[r], v_origin_mps[r]
        H[r, 7], H[3 + r, 7] = turn_radps[r] * since_mid_s, v_origin_mps[r] * since_mid_s


@compiled
def covariance_between(
    covariance: FloatArray,
    of: IntArray,
    node: IntArray,
    share: FloatArray,
    R: FloatArray,
    turn_radps: FloatArray,
    v_origin_mps: FloatArray,
    since_mid_s: FloatArray,
    arm_m: FloatArray,
    further: FloatArray,
    common: FloatArray,
    out: FloatArray,
) -> None:
    """Write the covariance of poses between nodes, shape (n, 6, 6), of ``[dtheta rad, dt mm]``.

    H C H^T with the derivative H of `smoother.observe`, and what is added.

    Parameters
    ----------
    covariance : ndarray, shape (K, c, c)
        Of states at the nodes.
    of : ndarray of int64, shape (8,)
        Where in it attitude, position, offset and skew are: all that a pose depends on.
    node, share : ndarray, shape (n,)
        The node before each instant, and how far it is on the way to the next: C is linear between them.
    R, turn_radps, v_origin_mps : ndarray, shape (n, 3, 3), (n, 3), (n, 3)
        Attitude, and how attitude and origin move as the camera sees them.
    since_mid_s : ndarray, shape (n,)
    arm_m : ndarray, shape (3,)
    further : ndarray, shape (n, 2)
        Variance to be added to each axis of attitude and position, rad^2 and m^2.
    common : ndarray, shape (6, 6), rad and m
        Added to each.
    """
    n, c = len(node), len(of)
    half, between, H = np.empty((6, c)), np.empty((c, c)), np.eye(6, c)
    for i in range(n):
        k, a = node[i], share[i]
        for r in range(c):
            for s in range(c):
                between[r, s] = covariance[k, of[r], of[s]]
                if a != 0.0:
                    between[r, s] += a * (covariance[k + 1, of[r], of[s]] - covariance[k, of[r], of[s]])
        _write_derivative(R[i], turn_radps[i], v_origin_mps[i], since_mid_s[i], arm_m, H)
        for p in range(6):
            for s in range(c):
                half[p, s] = 0.0
            for r in range(c):
                h = H[p, r]
                if h != 0.0:
                    for s in range(c):
                        half[p, s] += h * between[r, s]
            for q in range(p + 1):
                total = common[p, q]
                for s in range(c):
                    total += half[p, s] * H[q, s]
                if p == q:
                    total += further[i, p // 3]
                out[i, p, q] = out[i, q, p] = total * (1e3 if p > 2 else 1.0) * (1e3 if q > 2 else 1.0)


@compiled
def shared_between(
    shared: FloatArray,
    node: IntArray,
    share: FloatArray,
    R: FloatArray,
    turn_radps: FloatArray,
    v_origin_mps: FloatArray,
    since_mid_s: FloatArray,
    arm_m: FloatArray,
    out: FloatArray,
) -> None:
    """Write the covariance of poses between nodes with d other errors, (n, 6, d), of ``[dtheta rad, dt mm]``.

    ``shared``, shape (K, 8, d), is that of the states at the nodes, attitude, position, offset and skew; all
    else as of `covariance_between`.
    """
    n_states, n_errors = shared.shape[1], shared.shape[2]
    between, H = np.empty((n_states, n_errors)), np.eye(6, n_states)
    for i in range(len(node)):
        k, a = node[i], share[i]
        for r in range(n_states):
            for s in range(n_errors):
                between[r, s] = shared[k, r, s]
                if a != 0.0:
                    between[r, s] += a * (shared[k + 1, r, s] - shared[k, r, s])
        _write_derivative(R[i], turn_radps[i], v_origin_mps[i], since_mid_s[i], arm_m, H)
        for p in range(6):
            for s in range(n_errors):
                total = 0.0
                for r in range(n_states):
                    total += H[p, r] * between[r, s]
                out[i, p, s] = total * (1e3 if p > 2 else 1.0)
