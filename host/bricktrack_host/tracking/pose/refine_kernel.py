"""Compiled: the least-squares fit of one frame's pose after the other; see `refine` for what it fits."""

import math

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_host.compiled import compiled_fast, compiled_inline
from bricktrack_host.tracking.pose.refine_equations import (
    follow_residuals,
    normal_equations,
    take_frame,
    take_shapes,
)
from bricktrack_host.tracking.pose.refine_problem import (
    N_MORE,
    N_UNKNOWNS,
    PROFILE,
    Fitted,
    Model,
    Observed,
    Room,
)
from bricktrack_host.tracking.pose.small_algebra import inverse_columns, quadratic, rotation, solve

_FRESH_MM, _FRESH_RAD = 1.0, 0.03  # moved less than this, an LED's shape is good to a few 0.001 px
_LAST_SIGMAS = 0.3
"""A step this small, in the pose's own uncertainty, is the last: the next would be some hundredths of it.
Residuals follow it by their derivatives."""
_DONE_SIGMAS = 1e-3  # one this small is not taken


@compiled_inline
def _fit_frame(i: int, observed: Observed, model: Model, fitted: Fitted, max_steps: int, room: Room) -> None:
    """Damped Gauss-Newton, so that no step raises the cost, until the step is far below its uncertainty.

    The LEDs' shapes are those of the start; where the pose went far from it, they are had anew.
    """
    R, t, more = fitted.R[i], fitted.t[i], fitted.more[i]
    n = N_UNKNOWNS if observed.has_twist else PROFILE + 1 if model.profile_sd > 0 else PROFILE
    take_frame(i, observed, model, room)
    cost, rejected = 0.0, False
    for round_ in range(3):
        _copy(R, t, more, room.R_shape, room.t_shape, room.more)
        take_shapes(i, observed, model, R, t, more, room)
        cost = normal_equations(i, observed, model, fitted, R, t, more, room, room.A, room.g)
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
                cost = follow_residuals(i, n, observed, model, fitted, more, room)
                break
            size = math.sqrt(room.step[0] ** 2 + room.step[1] ** 2 + room.step[2] ** 2)
            for c in range(n):
                room.step[c] *= min(1.0, 0.5 / max(size, 1e-12))
            _copy(R, t, more, room.R, room.t, room.more)
            _move(room.R, room.t, room.more, room.step, room.E)
            new = normal_equations(
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
        cost = normal_equations(i, observed, model, fitted, R, t, more, room, room.A, room.g)
    fitted.cost[i] = cost
    if not math.isfinite(cost) or not solve(room.A, room.g, 0.0, n, room.L, room.step):
        fitted.cost[i] = np.nan
        return
    inverse_columns(room.L, n, fitted.covariance[i], room.step)


@compiled_inline
def _copy(
    R: FloatArray, t: FloatArray, more: FloatArray, R_to: FloatArray, t_to: FloatArray, more_to: FloatArray
) -> None:
    for r in range(3):
        t_to[r] = t[r]
        for c in range(3):
            R_to[r, c] = R[r, c]
    for c in range(N_MORE):
        more_to[c] = more[c]


@compiled_inline
def _move(R: FloatArray, t: FloatArray, more: FloatArray, step: FloatArray, E: FloatArray) -> None:
    rotation(step[0], step[1], step[2], E)
    for r in range(3):
        x, y, z = R[r, 0], R[r, 1], R[r, 2]
        for c in range(3):
            R[r, c] = x * E[0, c] + y * E[1, c] + z * E[2, c]
        t[r] += step[3 + r]
    for c in range(N_MORE):
        more[c] += step[6 + c]


@compiled_inline
def _went_far(R: FloatArray, t: FloatArray, R_old: FloatArray, t_old: FloatArray) -> bool:
    moved, turned = 0.0, 0.0
    for r in range(3):
        moved += (t[r] - t_old[r]) ** 2
        for c in range(3):
            turned += (R[r, c] - R_old[r, c]) ** 2
    return moved > _FRESH_MM**2 or turned > _FRESH_RAD**2


@compiled_fast
def fit_frames(observed: Observed, model: Model, fitted: Fitted, room: Room, max_steps: int) -> None:
    """Fit all frames whose start is a number; a frame without an answer has an infinite or NaN cost."""
    for i in range(len(observed.seen)):
        if math.isfinite(fitted.cost[i]):
            _fit_frame(i, observed, model, fitted, max_steps, room)
