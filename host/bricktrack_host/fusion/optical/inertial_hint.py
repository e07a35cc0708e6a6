"""What the brick's IMU tells where the camera moves unfelt: the brick's own turning, and impacts."""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_host.fusion.clocks.time_alignment import TimeAlignment
from bricktrack_host.fusion.inertial.attitude import Attitude, mean_rate
from bricktrack_host.fusion.inertial.imu_samples import seconds_since
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal
from bricktrack_host.tracks import ImuTrack

_IMPACT_MPS2 = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class InertialHint:
    """The brick's IMU where its samples cannot be fused.

    Attributes
    ----------
    imu : ImuTrack
        In brick axes.
    alignment : TimeAlignment
    """

    imu: ImuTrack
    alignment: TimeAlignment


class Felt:
    """What the brick's IMU hints at, in camera time."""

    def __init__(self, hint: InertialHint) -> None:
        self._alignment = hint.alignment
        imu = hint.alignment.restamped(hint.imu)
        self.signal = ImuSignal.from_track(imu, gyro_filter_s=hint.alignment.gyro_filter_s)
        self._bias = mean_rate(hint.imu)
        self._attitude = Attitude(self.signal, self._bias)

    def imu_s(self, t_ns: IntArray) -> FloatArray:
        """Return instants as seconds of the IMU's samples."""
        return seconds_since(self._alignment.imu_time_ns(t_ns), self.signal.epoch_ns)

    def turned(self, t_ns: IntArray) -> FloatArray:
        """Return the brick's attitudes in axes that stand still, shape (n, 3, 3)."""
        return self._attitude.at(self.imu_s(t_ns))

    def omega_radps(self, t_ns: IntArray) -> FloatArray:
        """Return the brick's angular rate through space, brick axes."""
        return np.asarray(self.signal.gyro_at(self.imu_s(t_ns)) - self._bias)

    def kicks_mmps(self, t_ns: IntArray) -> FloatArray:
        """Return the change of velocity that impacts since the instant before may have brought."""
        height = self.signal.acc_impact_mps2
        after = np.searchsorted(self.imu_s(t_ns), self.signal.t_s)
        kick_mmps = 1e3 * height * self.signal.period_s
        kicks = np.zeros(len(t_ns) + 1)
        np.maximum.at(kicks, after, np.where(height > _IMPACT_MPS2, kick_mmps, 0.0))
        kicks[0] = 0.0
        return kicks[:-1]

    def near_impact(self, t_ns: IntArray) -> BoolArray:
        """Return which instants have a sample with an impact on either side."""
        t_s, hit = self.imu_s(t_ns), self.signal.acc_impact_mps2 > _IMPACT_MPS2
        i = np.clip(np.searchsorted(self.signal.t_s, t_s), 1, len(hit) - 1)
        return np.asarray(hit[i] | hit[i - 1])
