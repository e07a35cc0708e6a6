"""Compiled: the least-squares fit of one frame's pose after the other; see `refine` for what it fits.

Unknowns are ``[turn of the brick, rad; shift, mm]`` and, where asked for, the profile's one unknown, common
to all LEDs, a change of the twist that the LEDs' motion was had from, and of its rate, in this order.
"""

import math
from typing import NamedTuple

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_host.compiled import compiled_in_place, compiled_inline
from bricktrack_host.tracking.led_view import AREA, N_SHAPE, led_shape, led_view
from bricktrack_host.tracking.small_algebra import inverse_block, quadratic, rotation, solve

N_UNKNOWNS = 19
_PROFILE, _TWIST, _RATE = 6, 7, 13
N_MORE = N_UNKNOWNS - 6
_FRESH_MM, _FRESH_RAD = 1.0, 0.03  # moved less than this, an LED's shape is good to a few 0.001 px
_RATE_PER_TWIST = 30.0
"""How wrong the twist's rate may be for a given doubt about the twist, 1/s. Of a sine of w T = 0.6 to pi (3
to 15 Hz at 30 frames a second), a cubic spline's second derivative at the frames errs by 0.09 to 0.15 of the
fourth difference over T^2, while the twist is doubted by 0.1 of it over T (`optical_track`)."""
_LAST_SIGMAS = 0.3
"""A step this small, in the pose's own uncertainty, is the last: the next would be some hundredths of it.
Residuals follow it by their derivatives."""
_DONE_SIGMAS = 1e-3  # one this small is not taken


class Observed(NamedTuple):
    """What was seen in n frames of L LEDs, and what is known of how the brick moves within them.

    ``hits`` (n, L, 6, 4) are the rays near the centroids, ``W`` (n, L, 2, 2) inverse covariances, ``seen``
    (n, L); ``rvec``, ``shift`` (n, L, 3), ``dt`` (n, L) and ``twist_sd`` (n, 6) are of `refine.LedMotion`.
    """

    hits: FloatArray
    W: FloatArray
    seen: BoolArray
    has_motion: bool
    rvec: FloatArray
    shift: FloatArray
    dt: FloatArray
    has_twist: bool
    twist_sd: FloatArray


class Model(NamedTuple):
    """The brick, its LEDs' profile, the planes of the rays, and where Huber's loss grows linear.

    ``profile_sd`` and ``own_sd``: of what the profile leaves unknown, in units of ``shift_per_radius``, the
    part that all LEDs have in common, and each one's own; 0: nothing.
    """

    P: FloatArray
    N: FloatArray
    radii: FloatArray
    collar: float
    shift_per_radius: float
    profile_sd: float
    own_sd: float
    plane_a: float
    apart: float
    huber: float


class Fitted(NamedTuple):
    """Results, in place: poses (n, 3, 3) and (n, 3), the rest of the unknowns, and what `refine` reports."""

    R: FloatArray
    t: FloatArray
    more: FloatArray
    covariance: FloatArray
    residual: FloatArray
    sigmas: FloatArray
    cost: FloatArray
    area: FloatArray
    facing: FloatArray


class Room(NamedTuple):
    """Room to work in, for one frame."""

    shapes: FloatArray
    A: FloatArray
    g: FloatArray
    A_new: FloatArray
    g_new: FloatArray
    L: FloatArray
    step: FloatArray
    R: FloatArray
    t: FloatArray
    more: FloatArray
    E: FloatArray
    R_led: FloatArray
    centre: FloatArray
    axis: FloatArray
    J_centre: FloatArray
    J_axis: FloatArray
    J: FloatArray
    W: FloatArray
    R_shape: FloatArray
    t_shape: FloatArray


def room_for(n_leds: int) -> Room:
    """Return room for the fits of bricks of so many LEDs."""
    k = N_UNKNOWNS
    return Room(
        np.empty((n_leds, N_SHAPE)),
        np.empty((k, k)),
        np.empty(k),
        np.empty((k, k)),
        np.empty(k),
        np.empty((k, k)),
        np.empty(k),
        np.empty((3, 3)),
        np.empty(3),
        np.empty(N_MORE),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty(3),
        np.empty(3),
        np.empty((2, 3)),
        np.empty((2, 3)),
        np.zeros((n_leds, 2, k)),
        np.empty((n_leds, 3)),
        np.empty((3, 3)),
        np.empty(3),
    )


@compiled_in_place
def fit_frames(observed: Observed, model: Model, fitted: Fitted, room: Room, max_steps: int) -> None:
    """Fit all frames whose start is a number; a frame without an answer has an infinite or NaN cost."""
    for i in range(len(observed.seen)):
        if math.isfinite(fitted.cost[i]):
            _fit_frame(i, observed, model, fitted, max_steps, room)


@compiled_in_place
def _fit_frame(i: int, observed: Observed, model: Model, fitted: Fitted, max_steps: int, room: Room) -> None:
    """Damped Gauss-Newton, so that no step raises the cost, until the step is far below its uncertainty.

    The LEDs' shapes are those of the start; where the pose went far from it, they are had anew.
    """
    R, t, more = fitted.R[i], fitted.t[i], fitted.more[i]
    n = N_UNKNOWNS if observed.has_twist else _PROFILE + 1 if model.profile_sd > 0 else _PROFILE
    cost, rejected = 0.0, False
    for round_ in range(3):
        _copy(R, t, more, room.R_shape, room.t_shape, room.more)
        _take_shapes(i, observed, model, R, t, more, room)
        cost = _normal_equations(i, observed, model, fitted, R, t, more, room, room.A, room.g)
        damping = 1e-6
        for _ in range(max_steps if round_ == 0 else 3):
            if not math.isfinite(cost) or damping > 1e6:
                break
            if not solve(room.A, room.g, damping, n, room.L, room.step):
                break
            size2 = quadratic(room.A, room.step, n)
            if size2 < _DONE_SIGMAS**2:
                break
            if size2 < _LAST_SIGMAS**2 and not rejected:
                _move(R, t, more, room.step, room.E)
                cost = _follow_residuals(i, n, observed, model, fitted, more, room)
                break
            size = math.sqrt(room.step[0] ** 2 + room.step[1] ** 2 + room.step[2] ** 2)
            for c in range(n):
                room.step[c] *= min(1.0, 0.5 / max(size, 1e-12))
            _copy(R, t, more, room.R, room.t, room.more)
            _move(room.R, room.t, room.more, room.step, room.E)
            new = _normal_equations(
                i, observed, model, fitted, room.R, room.t, room.more, room, room.A_new, room.g_new
            )
            if new <= cost * (1 + 1e-12) + 1e-12:
                _copy(room.R, room.t, room.more, R, t, more)
                for c in range(n):
                    room.g[c] = room.g_new[c]
                    for b in range(c + 1):
                        room.A[c, b] = room.A_new[c, b]
                cost, rejected = new, False
                damping = max(damping / 10, 1e-9)
            else:
                rejected = True
                damping = max(damping * 100, 1e-4)
        if not math.isfinite(cost) or not _went_far(R, t, room.R_shape, room.t_shape):
            break
    if rejected:  # residuals and the like are of the last pose tried: have those of the pose taken
        cost = _normal_equations(i, observed, model, fitted, R, t, more, room, room.A, room.g)
    fitted.cost[i] = cost
    if not math.isfinite(cost) or not solve(room.A, room.g, 0.0, n, room.L, room.step):
        fitted.cost[i] = np.nan
        return
    inverse_block(room.L, n, fitted.covariance[i], room.step)


@compiled_in_place
def _take_shapes(
    i: int, observed: Observed, model: Model, R: FloatArray, t: FloatArray, more: FloatArray, room: Room
) -> None:
    # Fields of tuples are taken out once: each time they are touched or passed on is an atomic count.
    hits, seen, rvec, shift, dt = observed.hits, observed.seen, observed.rvec, observed.shift, observed.dt
    P, N, radii, shapes = model.P, model.N, model.radii, room.shapes
    E, R_led, centre, axis = room.E, room.R_led, room.centre, room.axis
    for k in range(seen.shape[1]):
        if seen[i, k]:
            _place(i, k, observed.has_motion, P, N, R, t, more, rvec, shift, dt, E, R_led, centre, axis)
            led_shape(centre, axis, radii[k], model.collar, hits, i, k, model.plane_a, model.apart, shapes)


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


@compiled_in_place
def _normal_equations(
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
    hits, W, seen, rvec, shift, dt = (
        observed.hits,
        observed.W,
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
    n = N_UNKNOWNS if has_twist else _PROFILE + 1 if has_profile else _PROFILE
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
            centre, axis, hits, i, k, plane_a, apart, shapes, J_centre, J_axis
        )
        facing_out[i, k], area[i, k] = facing, shapes[k, AREA] * magnification
        per_profile = model.shift_per_radius * radii[k]
        r0 = -du - per_profile * shown_u * more[0]
        r1 = -dv - per_profile * shown_v * more[0]
        for row in range(2):
            _pose_row(row, k, has_motion, has_twist, dt[i, k], P, N, R_led, E, J_centre, J_axis, J)
        if has_profile:
            J[k, 0, _PROFILE], J[k, 1, _PROFILE] = per_profile * shown_u, per_profile * shown_v
        w00, w01, w11 = W[i, k, 0, 0], W[i, k, 0, 1], W[i, k, 1, 1]
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
        A[_PROFILE, _PROFILE] += per_sd
        g[_PROFILE] -= more[0] * per_sd
    elif n > _PROFILE:
        A[_PROFILE, _PROFILE] = 1.0  # held where it is
    if has_twist:
        for c in range(12):
            sd = observed.twist_sd[i, c % 6] * (_RATE_PER_TWIST if c >= 6 else 1.0)
            A[_TWIST + c, _TWIST + c] += 1 / sd**2
            g[_TWIST + c] -= more[1 + c] / sd**2
    return cost + _prior_cost(i, observed, model, more)


@compiled_inline
def _huber(sigmas: float, limit: float) -> float:
    return sigmas * sigmas if sigmas <= limit else limit * (2 * sigmas - limit)


@compiled_in_place
def _prior_cost(i: int, observed: Observed, model: Model, more: FloatArray) -> float:
    """Return the cost of what is known beforehand of profile and twist."""
    cost = (more[0] / model.profile_sd) ** 2 if model.profile_sd > 0 else 0.0
    if observed.has_twist:
        twist_sd = observed.twist_sd
        for c in range(12):
            cost += (more[1 + c] / (twist_sd[i, c % 6] * (_RATE_PER_TWIST if c >= 6 else 1.0))) ** 2
    return cost


@compiled_in_place
def _follow_residuals(
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
            share, at = (dt, _TWIST) if order == 0 else (0.5 * dt * dt, _RATE)
            J[k, row, at], J[k, row, at + 1], J[k, row, at + 2] = t0 * share, t1 * share, t2 * share
            J[k, row, at + 3], J[k, row, at + 4], J[k, row, at + 5] = c0 * share, c1 * share, c2 * share
    if has_motion:  # R_led = R E: a turn theta of the frame's brick is E' theta of the LED's
        J[k, row, 0] = E[0, 0] * t0 + E[0, 1] * t1 + E[0, 2] * t2
        J[k, row, 1] = E[1, 0] * t0 + E[1, 1] * t1 + E[1, 2] * t2
        J[k, row, 2] = E[2, 0] * t0 + E[2, 1] * t1 + E[2, 2] * t2
    else:
        J[k, row, 0], J[k, row, 1], J[k, row, 2] = t0, t1, t2


@compiled_in_place
def _copy(
    R: FloatArray, t: FloatArray, more: FloatArray, R_to: FloatArray, t_to: FloatArray, more_to: FloatArray
) -> None:
    for r in range(3):
        t_to[r] = t[r]
        for c in range(3):
            R_to[r, c] = R[r, c]
    for c in range(N_MORE):
        more_to[c] = more[c]


@compiled_in_place
def _move(R: FloatArray, t: FloatArray, more: FloatArray, step: FloatArray, E: FloatArray) -> None:
    rotation(step[0], step[1], step[2], E)
    for r in range(3):
        x, y, z = R[r, 0], R[r, 1], R[r, 2]
        for c in range(3):
            R[r, c] = x * E[0, c] + y * E[1, c] + z * E[2, c]
        t[r] += step[3 + r]
    for c in range(N_MORE):
        more[c] += step[6 + c]


@compiled_in_place
def _went_far(R: FloatArray, t: FloatArray, R_old: FloatArray, t_old: FloatArray) -> bool:
    moved, turned = 0.0, 0.0
    for r in range(3):
        moved += (t[r] - t_old[r]) ** 2
        for c in range(3):
            turned += (R[r, c] - R_old[r, c]) ** 2
    return moved > _FRESH_MM**2 or turned > _FRESH_RAD**2
