"""The smoother's way forwards in time, compiled: what is seen at each node, and the pass over a run.

The loops hold no lock of the interpreter: runs can share the cores by threads.
"""

from typing import Any, NamedTuple

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_host.compiled import compiled, compiled_inline, compiled_sums
from bricktrack_host.fusion.inertial.rotation_kernel import turn_by
from bricktrack_host.fusion.smoothing.covariance_kernel import (
    F_SIZE,
    SIZE,
    M,
    N,
    dot,
    factor,
    rows_times,
    take_off,
    whiten,
    whiten_rows,
)
from bricktrack_host.fusion.smoothing.observation_kernel import (
    ObservationRoom,
    observation_room,
    observe_pose,
    place_led,
)
from bricktrack_host.fusion.smoothing.transition_kernel import RunArrays, move_to

CHUNK = 64  # nodes between the states that are kept on the way forwards
NIS_CAP = 100.0  # so that an outlier does not choose the noise
CHI2_6_95 = 12.59  # 95 % point of chi-square with 6 degrees of freedom
CHI2_2_95 = 5.99


class Kept(NamedTuple):
    """What a stretch of the way forwards leaves for the way back; arrays of length 0 where nothing is kept.

    Attributes
    ----------
    R, x, P : ndarray, shape (n, 3, 3), (n, 22), (n, SIZE)
        States after the measurements of each node.
    first : ndarray of int64, shape (n + 1,)
        Measurements of node i of the stretch are ``first[i]`` to ``first[i + 1]``, in the order taken.
    n_rows : ndarray of int64, shape (m,)
    H, HP, y : ndarray, shape (m, 6 N), (m, 6 N), (m, 6)
        Of each measurement, whitened by its innovation: L^-1 H, L^-1 H P, L^-1 y.
    L : ndarray, shape (m, 6, 6)
        Root of the innovation's covariance; only the lower triangle of the first ``n_rows`` is written.
    """

    R: FloatArray
    x: FloatArray
    P: FloatArray
    first: IntArray
    n_rows: IntArray
    H: FloatArray
    HP: FloatArray
    y: FloatArray
    L: FloatArray


class Room(NamedTuple):
    """Room to work in, of one pass: a transition, also in a row, and a measurement as in `Kept`."""

    F: FloatArray
    F_flat: FloatArray
    FP: FloatArray
    H: FloatArray
    HP: FloatArray
    y: FloatArray
    white: FloatArray
    predicted: FloatArray
    S: FloatArray
    dx: FloatArray
    w: FloatArray
    observation: ObservationRoom


@compiled
def room_to_work() -> Room:
    """Return room for one pass."""
    F = np.zeros(F_SIZE)
    return Room(
        F.reshape((M, N)), F, np.zeros(F_SIZE), np.zeros(6 * N), np.zeros(6 * N), np.zeros(6), np.zeros(6),
        np.empty((6, 6)), np.empty((6, 6)), np.zeros(N), np.empty(3), observation_room(),
    )  # fmt: skip


@compiled
def room_for(n_nodes: int, n_measurements: int) -> Kept:
    """Return what a stretch of so many nodes leaves."""
    m = n_measurements
    return Kept(
        np.empty((n_nodes, 3, 3)),
        np.empty((n_nodes, N)),
        np.empty((n_nodes, SIZE)),
        np.zeros(n_nodes + 1, dtype=np.int64),
        np.zeros(m, dtype=np.int64),
        np.empty((m, 6 * N)),
        np.empty((m, 6 * N)),
        np.empty((m, 6)),
        np.empty((m, 6, 6)),
    )


@compiled_sums
def measurements_of(run: RunArrays, start: int, stop: int) -> int:
    """Return for how many measurements nodes from ``start`` to before ``stop`` need room."""
    n = run.leds.first[stop, 0] - run.leds.first[start, 0]
    for k in range(start, stop):
        n += run.has_frame[k]
    return int(n)


@compiled_inline
def _correct(C: Any, n: int, chi2_95: float, R: Any, x: Any, P: Any, room: Room, kept: Kept, m: int) -> Any:
    """Take in ``n`` residuals with their Jacobian, as in ``room``, and covariance C, in place.

    Returns the innovation squared over its covariance, its log-determinant, and by how much C was enlarged: a
    surprise is believed less, in proportion, never refused, so that the filter finds back after it has gone
    wrong itself. Where states are kept, the measurement is left whitened as number m.
    """
    H, HP, y, white, predicted, S, dx = (
        room.H, room.HP, room.y, room.white, room.predicted, room.S, room.dx,
    )  # fmt: skip
    rows_times(H, n, P, HP)
    for i in range(n):
        for j in range(i + 1):
            predicted[i, j] = dot(HP, i, H, j)
            S[i, j] = predicted[i, j] + C[i, j]
    factor(S, n)
    root = 1.0
    for i in range(n):
        root *= S[i, i]
    log_det = 2.0 * np.log(root)
    nis = whiten(S, y, n, white)
    inflation = max(nis / chi2_95, 1.0)
    if inflation > 1.0:
        for i in range(n):
            for j in range(i + 1):
                S[i, j] = predicted[i, j] + inflation * C[i, j]
        factor(S, n)
        whiten(S, y, n, white)
    whiten_rows(S, HP, n)
    take_off(P, HP, HP, n)
    dx[:] = 0.0
    for i in range(n):
        for j in range(N):
            dx[j] += HP[i * N + j] * white[i]
    turn_by(R, dx)
    for j in range(3, N):
        x[j] += dx[j]
    if len(kept.P):
        whiten_rows(S, H, n)
        kept.n_rows[m] = n
        for i in range(n):
            kept.y[m, i] = white[i]
            for j in range(i + 1):
                kept.L[m, i, j] = S[i, j]
        for j in range(n * N):
            kept.H[m, j], kept.HP[m, j] = H[j], HP[j]
    return nis, log_det, inflation


@compiled_inline
def take_in(
    run: RunArrays,
    k: int,
    R: Any,
    x: Any,
    P: Any,
    nis: FloatArray,
    inflation: FloatArray,
    room: Room,
    kept: Kept,
    m: int,
) -> tuple[float, int]:
    """Take in what was seen at node ``k``, in place; return its log-likelihood and how many measurements.

    They are left in ``kept`` from number ``m`` on, where it has room.
    """
    leds = run.leds
    log_likelihood, n = 0.0, 0
    if run.has_frame[k]:
        since, w = run.since_mid_s[k], room.w
        ahead = (x[18] - run.tau_lin) + since * (x[19] - run.skew_lin)
        for i in range(3):
            w[i] = run.omega_radps[k, i] - x[9 + i]
        observe_pose(
            R, x, w, run.camera_omega_radps[k], run.arm_m, since, ahead, run.R_seen[k], run.p_seen_m[k],
            room.H, room.y, room.observation,
        )  # fmt: skip
        nis[k], log_det, inflation[k] = _correct(run.cov_seen[k], 6, CHI2_6_95, R, x, P, room, kept, m)
        log_likelihood -= 0.5 * (log_det + min(nis[k], NIS_CAP))
        n += 1
    for i in range(leds.first[k, 0], leds.first[k + 1, 0]):
        if leds.use[i]:
            place_led(
                leds, i, R, x, run.arm_m, run.bg_lin, run.off_lin, run.tau_lin, run.skew_lin,
                room.H, room.y, room.observation,
            )  # fmt: skip
            far, log_det, enlarged = _correct(leds.cov_px2[i], 2, CHI2_2_95, R, x, P, room, kept, m + n)
            leds.nis[i], leds.inflation[i] = far, enlarged
            log_likelihood -= 0.5 * (log_det + min(far, NIS_CAP))
            n += 1
    return log_likelihood, n


@compiled_sums
def copy_state(R: Any, x: Any, R_out: Any, x_out: Any) -> None:
    """Write a state into arrays of its own."""
    for i in range(3):
        for j in range(3):
            R_out[i, j] = R[i, j]
    for i in range(N):
        x_out[i] = x[i]


@compiled_sums
def forward_stretch(
    run: RunArrays,
    gyro_var: FloatArray,
    acc_var: FloatArray,
    start: int,
    stop: int,
    R: FloatArray,
    x: FloatArray,
    P: FloatArray,
    nis: FloatArray,
    inflation: FloatArray,
    room: Room,
    kept: Kept,
) -> float:
    """Run the filter over nodes from ``start`` to before ``stop``; R, x and P come from the node before.

    They end as the state of the last node. ``gyro_var`` and ``acc_var`` have shape (K - 1,). Innovations
    squared and inflations are written for each node with a frame, shape (K,), and into the LEDs' arrays; with
    room in ``kept``, all that the way back needs is left there. Returns the log-likelihood of what was seen.
    """
    keep = len(kept.P) > 0
    log_likelihood, m = 0.0, 0
    for k in range(start, stop):
        if k > 0 and run.dt_s[k - 1] > 0.0:
            move_to(run, k, gyro_var[k - 1], acc_var[k - 1], R, x, P, room.F, room.F_flat, room.FP)
        earned, n = take_in(run, k, R, x, P, nis, inflation, room, kept, m)
        log_likelihood += earned
        m += n
        if keep:
            copy_state(R, x, kept.R[k - start], kept.x[k - start])
            for j in range(SIZE):
                kept.P[k - start, j] = P[j]
            kept.first[k - start + 1] = m
    return log_likelihood


@compiled
def forward_pass(
    run: RunArrays,
    gyro_var: FloatArray,
    acc_var: FloatArray,
    R: FloatArray,
    x: FloatArray,
    P_start: FloatArray,
    nis: FloatArray,
    inflation: FloatArray,
    R_before: FloatArray,
    x_before: FloatArray,
    P_before: FloatArray,
) -> float:
    """Run the filter over a run, from R, x and P, shape (22, 22); see `forward_stretch`.

    These end as the last state. The state before every `CHUNK` nodes is written into the last three, of
    shape (n, 3, 3), (n, 22) and (n, SIZE), where they have room: from these the way back goes forward again,
    a stretch at a time, so that memory holds one stretch and not the run.
    """
    n_nodes, P = len(run.has_frame), P_start.ravel()
    room, nothing = room_to_work(), room_for(0, 0)
    log_likelihood = 0.0
    for c in range((n_nodes + CHUNK - 1) // CHUNK):
        if len(R_before):
            R_before[c], x_before[c], P_before[c] = R, x, P
        stop = min((c + 1) * CHUNK, n_nodes)
        log_likelihood += forward_stretch(
            run, gyro_var, acc_var, c * CHUNK, stop, R, x, P, nis, inflation, room, nothing
        )
    return log_likelihood


@compiled
def predict(
    run: RunArrays,
    gyro_var: FloatArray,
    acc_var: FloatArray,
    R: FloatArray,
    x: FloatArray,
    P_start: FloatArray,
    P_out: FloatArray,
) -> None:
    """Write the covariance of each node before what was seen there is taken in, shape (K, 22, 22)."""
    n_nodes, P = len(run.has_frame), P_start.ravel()
    nis, inflation, nothing = np.empty(n_nodes), np.empty(n_nodes), room_for(0, 0)
    room = room_to_work()
    for k in range(n_nodes):
        if k > 0 and run.dt_s[k - 1] > 0.0:
            move_to(run, k, gyro_var[k - 1], acc_var[k - 1], R, x, P, room.F, room.F_flat, room.FP)
        P_out[k] = P.reshape((N, N))
        take_in(run, k, R, x, P, nis, inflation, room, nothing, 0)
