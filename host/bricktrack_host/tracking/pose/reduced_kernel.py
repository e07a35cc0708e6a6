"""Compiled: what the lights of frames say of their poses alone, whatever profile and twist are."""

import math

from bricktrack_common.arrays import FloatArray
from bricktrack_host.compiled import compiled_fast
from bricktrack_host.tracking.pose.refine_equations import normal_equations, take_frame, take_shapes
from bricktrack_host.tracking.pose.refine_problem import N_UNKNOWNS, PROFILE, Fitted, Model, Observed, Room


@compiled_fast
def reduce_frames(
    observed: Observed, model: Model, fitted: Fitted, room: Room, A: FloatArray, g: FloatArray
) -> None:
    """Fill in A, (n, 6, 6), and g, (n, 6): what frames say of their poses, all else unknown taken out."""
    n = N_UNKNOWNS if observed.has_twist else PROFILE + 1
    N, right = room.A, room.g
    for i in range(len(observed.seen)):
        R, t, more = fitted.R[i], fitted.t[i], fitted.more[i]
        take_frame(i, observed, model, room)
        take_shapes(i, observed, model, R, t, more, room)
        if not math.isfinite(normal_equations(i, observed, model, fitted, R, t, more, room, N, right)):
            continue
        for p in range(n - 1, PROFILE - 1, -1):
            for c in range(p):
                share = N[p, c] / N[p, p]
                right[c] -= share * right[p]
                for b in range(c + 1):
                    N[c, b] -= share * N[p, b]
        for c in range(6):
            g[i, c] = right[c]
            for b in range(c + 1):
                A[i, c, b] = A[i, b, c] = N[c, b]
