"""What of its error a motion seen LED by LED shares with the pose at rest, from which it is counted.

Errors that stand still are nearly the same at rest and in motion, so displacements from rest are much surer
than poses. What each of them moves the smoothed states by tells how nearly.
"""

import numpy as np
from numpy.typing import NDArray

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.rotations import skew
from bricktrack_host.fusion.pose_by_pose.fused_output import imu_seconds
from bricktrack_host.fusion.pose_by_pose.pose_level import Smoothed

_ALIKE_SHARE = 0.9
"""Of errors that stand still, what is believed to be one at rest and in motion. Mosaic and coding make others
in a picture that stands, and a shape shows another side as it turns. In 24 recordings by another renderer 1
made motion from rest too sure (12 had less than 90 % of their frames in the 95 % region), 0.9 none
(simulated)."""


def shared_with_rest(s: Smoothed, moved_by: NDArray[np.float32], rest_ns: IntArray) -> FloatArray | None:
    """Return the covariance of the errors of smoothed states with that of the mean pose at rest.

    Shape (K, 8, 6), of the states `smoother.SEEN` with ``[dtheta rad, dt mm]``; `None` where no node is at
    rest. What is not of errors that stand still is new there.

    Parameters
    ----------
    s : Smoothed
        A run alone.
    moved_by : ndarray, shape (K, 8, q)
        What each of the errors that stand still, one sd of it, moves the states by.
    rest_ns : ndarray of int64, shape (2,), camera time
        First and last instant of rest.
    """
    states, node_s = s.estimate.state, s.nodes.t_s
    first_s, last_s = imu_seconds(s.run, states, s.b, rest_ns)
    at_rest = np.flatnonzero((node_s >= first_s) & (node_s <= last_s))
    if not at_rest.size:
        return None
    turn, shift_m = moved_by[at_rest, :3], moved_by[at_rest, 3:6]
    shift_m = shift_m + states.R[at_rest, s.b] @ skew(s.run.lever_arm_m) @ turn  # of the first LED
    if s.run.camera is not None:
        shift_m = np.swapaxes(s.run.camera.still_attitude(node_s[at_rest]), 1, 2) @ shift_m
    rest = np.concatenate([turn, 1e3 * shift_m], axis=1).mean(axis=0)
    shared = moved_by.reshape(-1, len(rest.T)) @ (_ALIKE_SHARE * rest.T).astype(np.float32)
    return np.asarray(shared.reshape(*moved_by.shape[:2], 6), dtype=np.float64)
