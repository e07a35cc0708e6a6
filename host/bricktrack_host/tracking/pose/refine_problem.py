"""What the compiled fit of poses is given, what it fills in, and its room to work in; see `refine`.

Unknowns are ``[turn of the brick, rad; shift, mm]`` and, where asked for, the profile's one unknown, common
to all LEDs, a change of the twist that the LEDs' motion was had from, and of its rate, in this order.
"""

from typing import NamedTuple

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_host.tracking.led_model.led_view import N_SHAPE

N_UNKNOWNS = 19
PROFILE, TWIST, RATE = 6, 7, 13
N_MORE = N_UNKNOWNS - 6


class Observed(NamedTuple):
    """What was seen in n frames of L LEDs, and what is known of how the brick moves within them.

    ``uv`` (n, L, 2) and ``cov`` (n, L, 2, 2) are the centroids and their covariances, ``seen`` (n, L);
    ``rvec``, ``shift`` (n, L, 3), ``dt`` (n, L) and ``twist_sd`` (n, 6) are of `refine.LedMotion`, empty
    without it.
    """

    uv: FloatArray
    cov: FloatArray
    seen: BoolArray
    has_motion: bool
    rvec: FloatArray
    shift: FloatArray
    dt: FloatArray
    has_twist: bool
    twist_sd: FloatArray


class Model(NamedTuple):
    """The brick, its LEDs' profile, the camera's rays, and where Huber's loss grows linear.

    ``tables`` and ``kind`` are of `led_outline.Outlines`, ``cells`` and ``cell_px`` of the rays' polynomials.
    ``profile_sd`` and ``own_sd``: of what the profile leaves unknown, in units of ``shift_per_radius``, the
    part that all LEDs have in common, and each one's own; 0: nothing.
    """

    P: FloatArray
    N: FloatArray
    radii: FloatArray
    tables: FloatArray
    kind: IntArray
    shift_per_radius: float
    profile_sd: float
    own_sd: float
    cells: FloatArray
    cell_px: float
    plane_a: float
    apart: float
    huber: float


class Fitted(NamedTuple):
    """Results, in place: poses (n, 3, 3) and (n, 3), the rest of the unknowns, and what `refine` reports.

    ``covariance``, (n, N_UNKNOWNS, 6), is of all unknowns with the pose.
    """

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
    """Room to work in, for one frame.

    ``hits`` (L, 6, 4) are the rays near its centroids, ``seen_W`` (L, 3) the inverses of their covariances
    (00, 01, 11), ``W`` the same with what the profile leaves unknown of each LED.
    """

    hits: FloatArray
    seen_W: FloatArray
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
        np.empty((n_leds, 6, 4)),
        np.empty((n_leds, 3)),
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
