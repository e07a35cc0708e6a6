"""Frame stamps that slip by whole periods from some frame on: what is said of them, and how they mend."""

from dataclasses import dataclass, replace

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.rotations import rvec_from_matrix
from bricktrack_host.fusion.clocks.time_alignment import TimeAlignment, has_pose
from bricktrack_host.quality import PoseFlag
from bricktrack_host.tracks import OpticalTrack

_MOVES = 22.5  # chi-square with six degrees of freedom, once in a thousand
_OWN_PERIODS = 0.5  # more than this after the frame before: a picture of its own
_DOUBLE_PERIODS = 0.25  # less than this after the frame before: the same picture once more


@dataclass(frozen=True, slots=True)
class StampSlip:
    """One place where the stamps slip.

    Attributes
    ----------
    frame : int
        The likeliest first frame behind it, from 0.
    first, last : int
        The first frame behind it lies from ``first`` to ``last``.
    late_periods : int
        By how many periods the stamps behind it are later than they were before it; negative: earlier.
    """

    frame: int
    first: int
    last: int
    late_periods: int


@dataclass(frozen=True, slots=True, eq=False)
class StampSlips:
    """The slips of a run, and what mends them.

    Attributes
    ----------
    slips : tuple of StampSlip
        At least one.
    period_ns : float
    late_periods : ndarray of int64, shape (n_frames,)
        By how many periods each stamp is late.
    t_ns : ndarray of int64, shape (n_frames,), ns, rising
        The frames' instants, mended.
    left_out : ndarray of bool, shape (n_frames,)
        Frames that have no instant of their own: copies of the frame before, and those that move where the
        place of the slip is not known to the frame.
    sd_ns : ndarray, shape (n_frames,)
        How unsure the instant is: the slip itself where its place is not known, else zero.
    is_side_told : bool
        Whether the clocks told which stamps were right; else those before the first slip were kept.
    alignment : TimeAlignment
        With the stamps mended.
    """

    slips: tuple[StampSlip, ...]
    period_ns: float
    late_periods: IntArray
    t_ns: IntArray
    left_out: BoolArray
    sd_ns: FloatArray
    is_side_told: bool
    alignment: TimeAlignment

    @property
    def is_mended(self) -> BoolArray:
        """Whether each frame has another stamp now."""
        return np.asarray((self.late_periods != 0) | self.left_out)

    @property
    def frame_flags(self) -> IntArray:
        """What a pose of each frame has to be flagged with, `PoseFlag`."""
        return np.where(self.is_mended, int(PoseFlag.RESTAMPED), 0)

    def mended(self, optical: OpticalTrack) -> OpticalTrack:
        """Return the poses at their own instants; NaN where a frame has none."""
        out = self.left_out
        shift_ns = self.t_ns - optical.t_ns
        return replace(
            optical,
            t_ns=self.t_ns,
            R_camera_brick=np.where(out[:, None, None], np.nan, optical.R_camera_brick),
            t_camera_brick_mm=np.where(out[:, None], np.nan, optical.t_camera_brick_mm),
            covariance=np.where(out[:, None, None], np.nan, optical.covariance),
            flags=optical.flags | self.frame_flags | np.where(out, int(PoseFlag.NO_POSE), 0),
            led_t_ns=optical.led_t_ns + shift_ns[:, None],
        )

    def words(self) -> list[str]:
        """Return what happened, a line for each slip, and what was done."""
        right = (
            "the offset of the two clocks tells which ones were right"
            if self.is_side_told
            else "nothing tells which ones were right, so those before the first slip were kept"
        )
        n, n_out = int(np.count_nonzero(self.late_periods)), int(np.count_nonzero(self.left_out))
        stamps = _number(n, "frame stamp")
        done = f"{stamps} mended by whole periods, as the turns that camera and gyro saw ask; {right}"
        out = f"; {_number(n_out, 'frame')} in between left out" if n_out else ""
        return [*(self._slip_words(slip) for slip in self.slips), done + out]

    def _slip_words(self, slip: StampSlip) -> str:
        n = abs(slip.late_periods)
        by = f"{_number(n, 'period')} ({n * self.period_ns / 1e6:.2f} ms)"
        place = (
            f"from frame {slip.frame} on"
            if slip.first == slip.last
            else f"from one of the frames {slip.first} to {slip.last} on"
        )
        if slip.late_periods < 0:
            side, cause = "early", f"{_number(n, 'picture')} lost and not counted"
        else:
            side, cause = "late", f"{_number(n, 'picture')} there twice, or skipped by the stamps alone"
        return f"frame stamps slip: {place} they come {by} too {side}; {cause}"


def _number(n: int, name: str) -> str:
    return f"{n} {name}{'' if n == 1 else 's'}"


def mend(
    optical: OpticalTrack,
    slips: list[StampSlip],
    late_periods: IntArray,
    *,
    period_ns: float,
    is_side_told: bool,
    alignment: TimeAlignment,
) -> StampSlips:
    """Return what mends slips that were found.

    Parameters
    ----------
    optical : OpticalTrack
        With instants as stamped.
    slips, late_periods, period_ns, is_side_told, alignment
        See `StampSlips`.
    """
    in_doubt = np.zeros(len(optical.t_ns), dtype=np.int64)  # by so many periods
    for slip in slips:
        in_doubt[slip.first : slip.last] = abs(slip.late_periods)
    t_ns = optical.t_ns - np.rint(late_periods * period_ns).astype(np.int64)
    t_ns, is_copy = _without_copies(t_ns, period_ns)
    left_out = is_copy | ((in_doubt > 0) & _may_move(optical, in_doubt))
    sd_ns = np.where(left_out, 0.0, in_doubt * period_ns)
    return StampSlips(tuple(slips), period_ns, late_periods, t_ns, left_out, sd_ns, is_side_told, alignment)


def may_slip_at(optical: OpticalTrack, frames: IntArray, late_periods: int, period_ns: float) -> BoolArray:
    """Return at which frames, from 1, the stamps can begin to be so many periods late, shape (n,).

    Each picture has an instant of its own: stamps that come late leave an interval that is as much longer, or
    the picture is there twice, with the same pose. Stamps that come early, pictures lost, show neither.
    """
    left_periods = (optical.t_ns[frames] - optical.t_ns[frames - 1]) / period_ns - max(late_periods, 0)
    known = has_pose(optical)
    return np.array(
        [
            left > _OWN_PERIODS or not (known[i] and known[i - 1]) or not _differ(optical, i, i - 1)
            for i, left in zip(frames.tolist(), left_periods.tolist(), strict=True)
        ],
        dtype=np.bool_,
    )


def _may_move(optical: OpticalTrack, periods: IntArray) -> BoolArray:
    """Return which frames have no pose, or move within so many frames by more than poses scatter."""
    n = len(optical.t_ns)
    out = ~has_pose(optical)
    for i in np.flatnonzero((periods > 0) & ~out).tolist():
        beside = [k for d in range(1, int(periods[i]) + 1) for k in (i - d, i + d) if 0 <= k < n]
        out[i] |= any(_differ(optical, i, k) for k in beside if not out[k])
    return np.asarray(out)


def _differ(optical: OpticalTrack, i: int, k: int) -> bool:
    """Return whether two frames' poses are apart by more than poses scatter."""
    turn = rvec_from_matrix(optical.R_camera_brick[k].T @ optical.R_camera_brick[i])
    off = np.append(turn, optical.t_camera_brick_mm[i] - optical.t_camera_brick_mm[k])
    both = optical.covariance[i] + optical.covariance[k]
    return bool(off @ np.linalg.solve(both, off) > _MOVES)


def _without_copies(t_ns: IntArray, period_ns: float) -> tuple[IntArray, BoolArray]:
    """Return rising instants, and which frames are copies of those before, put evenly up to the next."""
    t_ns, latest = t_ns.copy(), np.maximum.accumulate(t_ns)
    is_copy = np.zeros(len(t_ns), dtype=np.bool_)
    is_copy[1:] = t_ns[1:] < latest[:-1] + round(_DOUBLE_PERIODS * period_ns)
    kept = np.flatnonzero(~is_copy)
    frames = np.flatnonzero(is_copy)
    beyond = t_ns[kept[-1]] + round(period_ns)
    t_ns[frames] = (
        np.rint(
            np.interp(frames, np.append(kept, len(t_ns)), np.append(t_ns[kept] - t_ns[0], beyond - t_ns[0]))
        ).astype(np.int64)
        + t_ns[0]
    )
    return t_ns, is_copy
