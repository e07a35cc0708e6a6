"""Frames that the samples contradict, but not by so much that the camera must be wrong.

A frame that lies far off all the others is not shown to the smoother. Far beyond what lights and lenses do,
it is an outlier, and nothing of it is left. Nearer, either the camera saw the brick where it was not (a light
half hidden), or the samples missed a motion, and from one frame nobody can tell. Both being as likely, the
mean of the two is what is nearest to either, and the covariance reaches both.
"""

from dataclasses import replace

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.rotations import matrix_from_rvec, rvec_from_matrix
from bricktrack_host.quality import PoseFlag
from bricktrack_host.tracks import FusedTrack

_CAMERA_IS_RIGHT = 0.5  # as likely as not


def with_contested_frames(
    track: FusedTrack, at_frames: FusedTrack, R_seen: FloatArray, t_seen_mm: FloatArray, *, period_ns: float
) -> FusedTrack:
    """Return fused poses that meet contested frames half-way, and whose covariance reaches both sides.

    What a frame differs from the fused motion fades linearly to nothing over one frame period on either
    side. The twist stays as the samples have it.

    Parameters
    ----------
    track : FusedTrack
        From the frames that are not contested.
    at_frames : FusedTrack
        The same motion at the instants of the n contested frames.
    R_seen, t_seen_mm : ndarray, shape (n, 3, 3), (n, 3), mm
        What these frames show.
    period_ns : float, ns
        Between frames.

    Returns
    -------
    FusedTrack
        With `PoseFlag.CONTESTED` where a contested frame tells.
    """
    turn = rvec_from_matrix(np.swapaxes(at_frames.R_camera_brick, 1, 2) @ R_seen)
    off = np.concatenate([turn, t_seen_mm - at_frames.t_camera_brick_mm], axis=1)
    R, t_mm = track.R_camera_brick.copy(), track.t_camera_brick_mm.copy()
    covariance, flags = track.covariance.copy(), track.flags.copy()
    p = _CAMERA_IS_RIGHT
    for frame_ns, d in zip(at_frames.t_ns, off, strict=True):
        near, share = _hat(track.t_ns, int(frame_ns), period_ns)
        if not np.isfinite(d).all():
            continue
        part = share[:, None] * d
        R[near] = R[near] @ matrix_from_rvec(p * part[:, :3])
        t_mm[near] += p * part[:, 3:]
        covariance[near] += p * (1 - p) * part[:, :, None] * part[:, None, :]
        flags[near] |= int(PoseFlag.CONTESTED)
    return replace(track, R_camera_brick=R, t_camera_brick_mm=t_mm, covariance=covariance, flags=flags)


def _hat(t_ns: IntArray, centre_ns: int, half_width_ns: float) -> tuple[IntArray, FloatArray]:
    """Return which instants lie within a hat function, and its height there."""
    share = 1 - np.abs(t_ns - centre_ns) / half_width_ns
    near = np.flatnonzero(share > 0)
    return near, share[near]
