"""Whether the tightly coupled motion and the pose-level one are where both allow each other to be."""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.rotations import rvec_from_matrix
from bricktrack_host.normalised_errors import normalised_squares
from bricktrack_host.tracks import FusedTrack

_DISAGREE_CHI2 = 22.5  # of 6 degrees of freedom: one in 1000
_DISAGREE_SHARE = 0.02
_AT_ONCE = 1 << 13  # instants, whose covariances are worked on together: of all of them it takes 1 kB each


@dataclass(frozen=True, slots=True, eq=False)
class CrossCheck:
    """How far the tightly coupled motion lies from the pose-level one, at the instants of the output.

    Attributes
    ----------
    rms_mm, max_mm, max_deg : float
    share_apart : float
        Instants at which they are farther apart than their covariances allow one in 1000.
    agrees : bool
        Whether those are few.
    """

    rms_mm: float
    max_mm: float
    max_deg: float
    share_apart: float
    agrees: bool


def cross_check(track: FusedTrack, pose_level: FusedTrack) -> CrossCheck:
    """Return how far two motions at the same instants are apart, by the covariances of both.

    Were the second only the same less well known, its own covariance would do. But it knows nothing of some
    errors that the first doubts, as of LEDs seen at other angles than their profile was fitted at, and lies
    beside the first by them. Both see the same lights, so their sum is what they differ by at most.
    """
    both = np.isfinite(track.t_camera_brick_mm[:, 0]) & np.isfinite(pose_level.t_camera_brick_mm[:, 0])
    rows = np.flatnonzero(both)
    if not rows.size:
        return CrossCheck(np.nan, np.nan, np.nan, 1.0, agrees=False)
    away, turned, allowed = np.empty(len(rows)), np.empty(len(rows)), np.empty(len(rows), dtype=np.bool_)
    for start in range(0, len(rows), _AT_ONCE):
        now = slice(start, start + _AT_ONCE)
        at = rows[now]
        turn = rvec_from_matrix(np.swapaxes(pose_level.R_camera_brick[at], 1, 2) @ track.R_camera_brick[at])
        shift = track.t_camera_brick_mm[at] - pose_level.t_camera_brick_mm[at]
        e = np.concatenate([turn, shift], axis=1)
        squares = normalised_squares(e, track.covariance[at] + pose_level.covariance[at])
        allowed[now] = squares <= _DISAGREE_CHI2
        away[now], turned[now] = np.linalg.norm(shift, axis=1), np.linalg.norm(turn, axis=1)
    apart = float(1.0 - allowed.mean())
    return CrossCheck(
        rms_mm=float(np.sqrt(np.mean(away**2))),
        max_mm=float(away.max()),
        max_deg=float(np.degrees(turned.max())),
        share_apart=apart,
        agrees=apart <= _DISAGREE_SHARE,
    )
