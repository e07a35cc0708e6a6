"""Frames with a pose, and the gyro beside them: what the fits of one to the other begin with."""

from dataclasses import dataclass, replace

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.rotations import rvec_from_matrix
from bricktrack_host.fusion.clocks.rotation_fit_kernel import compare_with_gyro, integrate_attitudes
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal

MIN_POSES = 20
_NODE_S = 0.0025  # of the integrated gyro
_FAR_OFF = 4.0  # medians: a wrong pose
_KNOT_S = 0.5  # of the slow drift between integrated gyro and optics: its noise, bias and scale error


@dataclass(frozen=True, slots=True, eq=False)
class PosedFrames:
    """Frames with a pose.

    Attributes
    ----------
    t_s : ndarray, shape (n,)
        Rising, seconds after the epoch of the inertial samples that they are fitted to.
    R : ndarray, shape (n, 3, 3)
        Attitude of the brick in camera axes.
    sd_rad : ndarray, shape (n,)
        Of the attitude, of one axis.
    """

    t_s: FloatArray
    R: FloatArray
    sd_rad: FloatArray

    def some(self, which: BoolArray) -> "PosedFrames":
        """Return some of the frames."""
        return PosedFrames(self.t_s[which], self.R[which], self.sd_rad[which])

    def later_by(self, by_s: float) -> "PosedFrames":
        """Return the same frames after an epoch that is as much earlier."""
        return replace(self, t_s=self.t_s + by_s)


class FramesBesideGyro:
    """Frames with a pose, and the gyro integrated beside them.

    Parameters
    ----------
    frames : PosedFrames
    signal : ImuSignal
    """

    def __init__(self, frames: PosedFrames, signal: ImuSignal) -> None:
        self.frames, self.signal = frames, signal
        n = int(np.ceil((signal.t_s[-1] - signal.t_s[0]) / _NODE_S))
        self._nodes_s = np.linspace(signal.t_s[0], signal.t_s[-1], n + 1)
        self._pieces = signal.gyro_pieces()

    def integrated(self, bias_radps: FloatArray) -> FloatArray:
        """Return the gyro's attitudes, less a bias, at even instants of its own: for `compared`."""
        R = np.empty((len(self._nodes_s), 3, 3))
        integrate_attitudes(self._pieces, self._nodes_s, bias_radps, R)
        return R

    def mean_bias(self, offset_s: float) -> FloatArray:
        """Return by how much more the gyro turned than the frames did, on the mean, rad/s.

        Roughly; attitudes integrated without it would end up anywhere, for a chip may be off by 3 deg/s, half
        a turn in a minute. The motion cancels, so the offset of the clocks may be rough as well.
        """
        t_s, R = self.frames.t_s, self.frames.R
        inside, segment = self.covered(offset_s)
        dt = np.diff(t_s)
        pair = inside[:-1] & inside[1:] & (segment[:-1] == segment[1:]) & (dt < 1.5 * np.median(dt))
        if not pair.any():
            return np.zeros(3)
        dt, before, after = dt[pair, None], np.flatnonzero(pair), np.flatnonzero(pair) + 1
        seen = rvec_from_matrix(np.swapaxes(R[before], 1, 2) @ R[after])
        felt = self.signal.angle_at(t_s[after] + offset_s) - self.signal.angle_at(t_s[before] + offset_s)
        rate = (felt - seen) / dt
        off = np.linalg.norm(rate - np.median(rate, axis=0), axis=1)
        kept = off <= _FAR_OFF * np.median(off)
        return np.asarray(np.average(rate[kept], axis=0, weights=dt[kept, 0]))

    def compared(
        self,
        inside: BoolArray,
        t_imu_s: FloatArray,
        since_mid_s: FloatArray,
        integrated: FloatArray,
        bias_radps: FloatArray,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return attitudes by the gyro at some frames, errors and what explains them: `compare_with_gyro`."""
        return compare_with_gyro(
            self._pieces, self._nodes_s, integrated, bias_radps, t_imu_s, since_mid_s, self.frames.R[inside]
        )

    def covered(self, offset_s: float) -> tuple[BoolArray, IntArray]:
        """Return the frames whose IMU time has samples around, and the stretch between long gaps of each."""
        signal, t_imu = self.signal, self.frames.t_s + offset_s
        inside = (t_imu > signal.t_s[0] + 0.005) & (t_imu < signal.t_s[-1] - 0.005) & ~signal.in_gap(t_imu)
        long = np.diff(signal.gaps_s, axis=1)[:, 0] > 2.5 * signal.period_s
        segment = np.searchsorted(signal.gaps_s[long, 0], t_imu)
        for k in np.unique(segment):
            if (inside & (segment == k)).sum() < 6:
                inside[segment == k] = False
        return inside, segment


def hats(t_s: FloatArray, segment: IntArray) -> tuple[IntArray, FloatArray, int]:
    """Return hat functions of time, separate for each stretch between IMU gaps.

    Of each frame: the knot before it, and its share of the way to the next; and how many knots there are.
    """
    knot, share = np.zeros(len(t_s), dtype=np.int64), np.zeros(len(t_s))
    n_before = 0
    for k in np.unique(segment):
        inside = segment == k
        lo, hi = t_s[inside].min(), t_s[inside].max()
        n_knots = max(2, round((hi - lo) / _KNOT_S) + 1)
        place = (t_s[inside] - lo) / (hi - lo) * (n_knots - 1)
        first = np.minimum(place.astype(np.int64), n_knots - 2)
        knot[inside], share[inside] = n_before + first, place - first
        n_before += n_knots
    return knot, share, n_before
