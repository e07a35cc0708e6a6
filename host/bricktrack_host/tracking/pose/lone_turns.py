"""Frames of few LEDs that turn away from the frames about them, and poses of theirs that do not.

Four LEDs leave two equations to judge a pose by, and the motion within the frame may take them up: a motion
had from splines through the wrong pose bears it out. So such frames are fitted once more from where their
neighbours show the brick, moving as these do.
"""

from collections.abc import Callable

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracking.pose.first_poses import RIVAL_CHI2, degrees_of_freedom
from bricktrack_host.tracking.pose.neighbour_poses import poses_between, turn_between
from bricktrack_host.tracking.pose.refine import MIN_LEDS, RefinedPoses

_MANY_LEDS = MIN_LEDS + 2  # leave six equations: no motion takes them all up
_LEAST_TURN_RAD = 0.05  # off the cubic through two neighbours on either side
_CLEARLY = 4.0

FitFrom = Callable[[IntArray, FloatArray, FloatArray], RefinedPoses]
"""Fits some frames, (m,), of a run that has these poses, (n, 3, 3) and (n, 3), and moves as they do."""


def on_their_neighbours_course(
    poses: RefinedPoses, uv_px: FloatArray, t_ns: IntArray, fit: FitFrom
) -> tuple[RefinedPoses, BoolArray]:
    """Return poses of which those that turn away alone are such as no other fits as well, and what is open.

    Parameters
    ----------
    poses : RefinedPoses
        Of n frames.
    uv_px : ndarray, shape (n, n_leds, 2), px
        The centroids fitted; NaN where an LED is not seen or not used.
    t_ns : ndarray of int64, shape (n,)
        Instants of the frames.
    fit : callable

    Returns
    -------
    poses : RefinedPoses
        Of n frames: where a pose near the neighbours' course fits as well, that.
    is_open : ndarray of bool, shape (n,)
        Frames with two poses that fit as well, neither of which the neighbours clearly bear out.
    """
    R, t_mm = poses.R_camera_brick, poses.t_camera_brick_mm
    is_open = np.zeros(len(R), dtype=np.bool_)
    n_seen = all_finite(uv_px).sum(axis=1)
    if not (n_seen[all_finite(R, 2)] < _MANY_LEDS).any():
        return poses, is_open
    between_R, between_t_mm = poses_between(t_ns, R, t_mm)
    turn = np.nan_to_num(turn_between(R, between_R))
    # A frame that is off draws its neighbours' cubics along, by two thirds of it.
    most = np.maximum(np.append(turn[1:], 0.0), np.append(0.0, turn[:-1]))
    frames = np.flatnonzero((turn > _LEAST_TURN_RAD) & (turn >= most) & (n_seen < _MANY_LEDS))
    if frames.size == 0:
        return poses, is_open
    course_R, course_t_mm = R.copy(), t_mm.copy()
    course_R[frames], course_t_mm[frames] = between_R[frames], between_t_mm[frames]
    tries = fit(frames, course_R, course_t_mm)
    scale = np.maximum(poses.chi2[frames] / np.maximum(degrees_of_freedom(uv_px[frames]), 1.0), 1.0)
    is_rival = tries.chi2 < poses.chi2[frames] + RIVAL_CHI2 * scale
    is_rival &= (np.where(np.isfinite(tries.facing), tries.facing, 1.0) > 0).all(axis=1)
    left = turn_between(tries.R_camera_brick, between_R[frames])
    is_nearer = is_rival & (turn[frames] > left + _LEAST_TURN_RAD)
    is_clear = is_nearer & (turn[frames] > _CLEARLY * left)
    is_open[frames[is_nearer & ~is_clear]] = True
    return poses.replaced(frames[is_clear], tries.take(np.flatnonzero(is_clear))), is_open
