"""Where the frames about each frame of a run show the brick, and how far it turns from there."""

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracking.pose.neighbour_kernel import fill_between
from bricktrack_host.tracking.pose.turn_kernel import angles_between

_MAX_FILLED = 2
"""Frames without a pose, one after the other, that their neighbours' spline bridges."""


def poses_between(stamps_ns: IntArray, R: FloatArray, t_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return where each frame's neighbours, two on either side, show it by a cubic; NaN where they are far.

    Parameters
    ----------
    stamps_ns : ndarray of int64, shape (n,)
    R, t_mm : ndarray, shapes (n, 3, 3) and (n, 3)
        NaN where there is no pose.
    """
    out_R, out_t = np.full(R.shape, np.nan), np.full(t_mm.shape, np.nan)
    valid = np.flatnonzero(all_finite(R, 2) & all_finite(t_mm))
    fill_between(stamps_ns, valid, R, t_mm, _MAX_FILLED, out_R, out_t)
    return out_R, out_t


def turn_between(R: FloatArray, other: FloatArray) -> FloatArray:
    """Return the angle between attitudes (n, 3, 3), rad; NaN where one is not known."""
    return angles_between(np.ascontiguousarray(R), np.ascontiguousarray(other))
