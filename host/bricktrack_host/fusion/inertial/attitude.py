"""The attitude of a body by its gyro alone, in axes that stand still."""

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_host.fusion.inertial.imu_samples import usable_samples
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal, chain_rotations
from bricktrack_host.tracks import ImuTrack

_NODE_S = 0.0025  # of the integrated gyro: coning over it is below 1e-8 rad


class Attitude:
    """The attitude of a body by its gyro, in axes that stand still, from the first sample on."""

    def __init__(self, signal: ImuSignal, bias_radps: FloatArray) -> None:
        self._signal, self._bias = signal, bias_radps
        n = int(np.ceil((signal.t_s[-1] - signal.t_s[0]) / _NODE_S))
        self._nodes = np.linspace(signal.t_s[0], signal.t_s[-1], n + 1)
        steps = self._turn(self._nodes[:-1], self._nodes[1:])
        self._R = np.concatenate([np.eye(3)[None], chain_rotations(steps)])

    def _turn(self, start_s: FloatArray, end_s: FloatArray) -> FloatArray:
        return self._signal.increments(
            start_s, end_s, gyro_bias_radps=self._bias, acc_bias_mps2=np.zeros(3), acc_lag_s=0.0
        ).R

    def at(self, t_s: FloatArray) -> FloatArray:
        """Return the attitudes at instants, shape (n, 3, 3); held beyond the samples."""
        t = np.clip(t_s, self._nodes[0], self._nodes[-1])
        i = np.clip(np.searchsorted(self._nodes, t) - 1, 0, len(self._nodes) - 2)
        return np.asarray(self._R[i] @ self._turn(self._nodes[i], t))


def mean_rate(imu: ImuTrack) -> FloatArray:
    """Return the gyro's mean, rad/s: its bias, as a body that ends as it began shows it."""
    return np.asarray(imu.gyro_radps[usable_samples(imu)].mean(axis=0), dtype=np.float64)
