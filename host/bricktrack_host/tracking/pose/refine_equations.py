"""Compiled: the least-squares problem of one frame about a pose: residuals, normal equations, cost."""

import math

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_host.compiled import compiled_fast, compiled_inline
from bricktrack_host.tracking.led_model.hit_polynomials import expand_pixel
from bricktrack_host.tracking.led_model.led_view import AREA, led_shape, led_view
from bricktrack_host.tracking.pose.refine_problem import (
    N_UNKNOWNS,
    PROFILE,
    RATE,
    TWIST,
    Fitted,
    Model,
    Observed,
    Room,
)
from bricktrack_host.tracking.pose.small_algebra import rotation

RATE_PER_TWIST = 30.0
"""How wrong the twist's rate may be for a given doubt about the twist, 1/s. Of a sine of w T = 0.6 to pi (3
to 15 Hz at 30 frames a second), a cubic spline's second derivative at the frames errs by 0.09 to 0.15 of the
fourth difference over T^2, while the twist is doubted by 0.1 of it over T (`optical_track`)."""


@compiled_inline
def take_frame(i: int, observed: Observed, model: Model, room: Room) -> None:
    """Have the rays near a frame's centroids, and their weights."""
    uv, cov, seen, hits, seen_W = observed.uv, observed.cov, observed.seen, room.hits, room.seen_W
    cells, cell_px = model.cells, model.cell_px
    for k in range(seen.shape[1]):
        if seen[i, k]:
            expand_pixel(uv[i, k, 0], uv[i, k, 1], cells, cell_px, hits, k)
            c00, c01, c10, c11 = cov[i, k, 0, 0], cov[i, k, 0, 1], cov[i, k, 1, 0], cov[i, k, 1, 1]
            det = c00 * c11 - c01 * c10
            seen_W[k, 0], seen_W[k, 1], seen_W[k, 2] = c11 / det, -c01 / det, c00 / det


@compiled_inline
def take_shapes(
    i: int, observed: Observed, model: Model, R: FloatArray, t: FloatArray, more: FloatArray, room: Room
) -> None:
    """Have the LEDs' shapes at a pose."""
    # Fields of tuples are taken out once: each time they are touched or passed on is an atomic count.
    hits, seen, rvec, shift, dt = room.hits, observed.seen, observed.rvec, observed.shift, observed.dt
    P, N, radii, tables, kind, shapes = model.P, model.N, model.radii, model.tables, model.kind, room.shapes
    plane_a, apart = model.plane_a, model.apart
    E, R_led, centre, axis = room.E, room.R_led, room.centre, room.axis
    for k in range(seen.shape[1]):
        if seen[i, k]:
            _place(i, k, observed.has_motion, P, N, R, t, more, rvec, shift, dt, E, R_led, centre, axis)
            led_shape(centre, axis, radii[k], tables, kind[k], hits, k, plane_a, apart, shapes)


@compiled_inline
def _place(
    i: int,
    k: int,
    has_motion: bool,
    P: FloatArray,
    N: FloatArray,
    R: FloatArray,
    t: FloatArray,
    more: FloatArray,
    rvec: FloatArray,
    shift: FloatArray,
    dt: FloatArray,
    E: FloatArray,
    R_led: FloatArray,
    centre: FloatArray,
    axis: FloatArray,
) -> None:
    """Find an LED's centre and axis, camera frame, at its own instant, with R_led = R E."""
    if has_motion:
        by_twist, by_rate = dt[i, k], 0.5 * dt[i, k] ** 2
        rotation(
            rvec[i, k, 0] + more[1] * by_twist + more[7] * by_rate,
            rvec[i, k, 1] + more[2] * by_twist + more[8] * by_rate,
            rvec[i, k, 2] + more[3] * by_twist + more[9] * by_rate,
            E,
        )
        for r in range(3):
            for c in range(3):
                R_led[r, c] = R[r, 0] * E[0, c] + R[r, 1] * E[1, c] + R[r, 2] * E[2, c]
    else:
        for r in range(3):
            for c in range(3):
                R_led[r, c] = R[r, c]
    for r in range(3):
        centre[r] = R_led[r, 0] * P[k, 0] + R_led[r, 1] * P[k, 1] + R_led[r, 2] * P[k, 2] + t[r]
        axis[r] = R_led[r, 0] * N[k, 0] + R_led[r, 1] * N[k, 1] + R_led[r, 2] * N[k, 2]
        if has_motion:
            centre[r] += shift[i, k, r] + (more[4 + r] + more[10 + r] * 0.5 * dt[i, k]) * dt[i, k]


@compiled_fast
def normal_equations(
    i: int,
    observed: Observed,
    model: Model,
    fitted: Fitted,
    R: FloatArray,
    t: FloatArray,
    more: FloatArray,
    room: Room,
    A: FloatArray,
    g: FloatArray,
) -> float:
    """Fill in the normal matrix (lower half) and right side, and the frame's residuals; return the cost."""
    hits, seen_W, seen, rvec, shift, dt = (
        room.hits,
        room.seen_W,
        observed.seen,
        observed.rvec,
        observed.shift,
        observed.dt,
    )
    has_motion, has_twist = observed.has_motion, observed.has_twist
    P, N, radii, plane_a, apart, huber = (
        model.P,
        model.N,
        model.radii,
        model.plane_a,
        model.apart,
        model.huber,
    )
    E, R_led, centre, axis, shapes = room.E, room.R_led, room.centre, room.axis, room.shapes
    J, J_centre, J_axis = room.J, room.J_centre, room.J_axis
    residual, sigmas_out, area, facing_out = fitted.residual, fitted.sigmas, fitted.area, fitted.facing
    W_own = room.W
    has_profile = model.profile_sd > 0
    n = N_UNKNOWNS if has_twist else PROFILE + 1 if has_profile else PROFILE
    for c in range(n):
        g[c] = 0.0
        for b in range(c + 1):
            A[c, b] = 0.0
    cost = 0.0
    for k in range(seen.shape[1]):
        if not seen[i, k]:
            continue
        _place(i, k, has_motion, P, N, R, t, more, rvec, shift, dt, E, R_led, centre, axis)
        if not centre[2] > 0:
            return np.inf
        du, dv, facing, magnification, shown_u, shown_v = led_view(
            centre, axis, hits, k, plane_a, apart, shapes, J_centre, J_axis
        )
        facing_out[i, k], area[i, k] = facing, shapes[k, AREA] * magnification
        per_profile = model.shift_per_radius * radii[k]
        r0 = -du - per_profile * shown_u * more[0]
        r1 = -dv - per_profile * shown_v * more[0]
        dt_s = dt[i, k] if has_motion else 0.0
        for row in range(2):
            _pose_row(row, k, has_motion, has_twist, dt_s, P, N, R_led, E, J_centre, J_axis, J)
        if has_profile:
            J[k, 0, PROFILE], J[k, 1, PROFILE] = per_profile * shown_u, per_profile * shown_v
        w00, w01, w11 = seen_W[k, 0], seen_W[k, 1], seen_W[k, 2]
        if has_profile:  # this LED's own part of what the profile leaves unknown: inverse of cov + m m'
            own = per_profile * model.own_sd
            m0, m1 = own * shown_u, own * shown_v
            p0, p1 = w00 * m0 + w01 * m1, w01 * m0 + w11 * m1
            gain = 1 / (1 + m0 * p0 + m1 * p1)
            w00, w01, w11 = w00 - gain * p0 * p0, w01 - gain * p0 * p1, w11 - gain * p1 * p1
        W_own[k, 0], W_own[k, 1], W_own[k, 2] = w00, w01, w11
        sigmas = math.sqrt(max(w00 * r0 * r0 + 2 * w01 * r0 * r1 + w11 * r1 * r1, 0.0))
        residual[i, k, 0], residual[i, k, 1], sigmas_out[i, k] = r0, r1, sigmas
        cost += _huber(sigmas, huber)
        if sigmas > huber:
            weight = huber / sigmas
            w00, w01, w11 = w00 * weight, w01 * weight, w11 * weight
        for c in range(n):
            j0, j1 = w00 * J[k, 0, c] + w01 * J[k, 1, c], w01 * J[k, 0, c] + w11 * J[k, 1, c]
            g[c] += j0 * r0 + j1 * r1
            for b in range(c + 1):
                A[c, b] += j0 * J[k, 0, b] + j1 * J[k, 1, b]
    if has_profile:
        per_sd = 1 / model.profile_sd**2
        A[PROFILE, PROFILE] += per_sd
        g[PROFILE] -= more[0] * per_sd
    elif n > PROFILE:
        A[PROFILE, PROFILE] = 1.0  # held where it is
    if has_twist:
        for c in range(12):
            sd = observed.twist_sd[i, c % 6] * (RATE_PER_TWIST if c >= 6 else 1.0)
            A[TWIST + c, TWIST + c] += 1 / sd**2
            g[TWIST + c] -= more[1 + c] / sd**2
    return cost + _prior_cost(i, observed, model, more)


@compiled_inline
def _huber(sigmas: float, limit: float) -> float:
    return sigmas * sigmas if sigmas <= limit else limit * (2 * sigmas - limit)


@compiled_inline
def _prior_cost(i: int, observed: Observed, model: Model, more: FloatArray) -> float:
    """Return the cost of what is known beforehand of profile and twist."""
    cost = (more[0] / model.profile_sd) ** 2 if model.profile_sd > 0 else 0.0
    if observed.has_twist:
        twist_sd = observed.twist_sd
        for c in range(12):
            cost += (more[1 + c] / (twist_sd[i, c % 6] * (RATE_PER_TWIST if c >= 6 else 1.0))) ** 2
    return cost


@compiled_inline
def follow_residuals(
    i: int, n: int, observed: Observed, model: Model, fitted: Fitted, more: FloatArray, room: Room
) -> float:
    """Let the frame's residuals follow the last step, of n unknowns, and return their cost."""
    seen, J, W, step = observed.seen, room.J, room.W, room.step
    residual, sigmas_out = fitted.residual, fitted.sigmas
    cost = 0.0
    for k in range(seen.shape[1]):
        if not seen[i, k]:
            continue
        r0, r1 = residual[i, k, 0], residual[i, k, 1]
        for c in range(n):
            r0, r1 = r0 - J[k, 0, c] * step[c], r1 - J[k, 1, c] * step[c]
        sigmas = math.sqrt(max(W[k, 0] * r0 * r0 + 2 * W[k, 1] * r0 * r1 + W[k, 2] * r1 * r1, 0.0))
        residual[i, k, 0], residual[i, k, 1], sigmas_out[i, k] = r0, r1, sigmas
        cost += _huber(sigmas, model.huber)
    return cost + _prior_cost(i, observed, model, more)


@compiled_inline
def _pose_row(
    row: int,
    k: int,
    has_motion: bool,
    has_twist: bool,
    dt: float,
    P: FloatArray,
    N: FloatArray,
    Rl: FloatArray,
    E: FloatArray,
    J_centre: FloatArray,
    J_axis: FloatArray,
    J: FloatArray,
) -> None:
    """Fill in one row of J: by the turn and shift of the brick, and by the twist."""
    c0, c1, c2 = J_centre[row, 0], J_centre[row, 1], J_centre[row, 2]
    a0, a1, a2 = J_axis[row, 0], J_axis[row, 1], J_axis[row, 2]
    # In brick axes; a turn theta moves the centre by R (theta x P): its row is P x (R' J).
    x, y, z = (
        Rl[0, 0] * c0 + Rl[1, 0] * c1 + Rl[2, 0] * c2,
        Rl[0, 1] * c0 + Rl[1, 1] * c1 + Rl[2, 1] * c2,
        Rl[0, 2] * c0 + Rl[1, 2] * c1 + Rl[2, 2] * c2,
    )
    p, q, s = (
        Rl[0, 0] * a0 + Rl[1, 0] * a1 + Rl[2, 0] * a2,
        Rl[0, 1] * a0 + Rl[1, 1] * a1 + Rl[2, 1] * a2,
        Rl[0, 2] * a0 + Rl[1, 2] * a1 + Rl[2, 2] * a2,
    )
    t0 = P[k, 1] * z - P[k, 2] * y + N[k, 1] * s - N[k, 2] * q
    t1 = P[k, 2] * x - P[k, 0] * z + N[k, 2] * p - N[k, 0] * s
    t2 = P[k, 0] * y - P[k, 1] * x + N[k, 0] * q - N[k, 1] * p
    J[k, row, 3], J[k, row, 4], J[k, row, 5] = c0, c1, c2
    if has_twist:
        for order in range(2):
            share, at = (dt, TWIST) if order == 0 else (0.5 * dt * dt, RATE)
            J[k, row, at], J[k, row, at + 1], J[k, row, at + 2] = t0 * share, t1 * share, t2 * share
            J[k, row, at + 3], J[k, row, at + 4], J[k, row, at + 5] = c0 * share, c1 * share, c2 * share
    if has_motion:  # R_led = R E: a turn theta of the frame's brick is E' theta of the LED's
        J[k, row, 0] = E[0, 0] * t0 + E[0, 1] * t1 + E[0, 2] * t2
        J[k, row, 1] = E[1, 0] * t0 + E[1, 1] * t1 + E[1, 2] * t2
        J[k, row, 2] = E[2, 0] * t0 + E[2, 1] * t1 + E[2, 2] * t2
    else:
        J[k, row, 0], J[k, row, 1], J[k, row, 2] = t0, t1, t2
