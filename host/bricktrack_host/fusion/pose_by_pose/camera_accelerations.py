"""What the camera says of accelerations between frames, to compare with the accelerometer's, and how surely.

Three positions in a row make a second difference, and that is the acceleration between them, weighted by a
triangle: exactly, however fast it changes. So both are compared without a derivative of either. The noise of
the positions, which neighbouring differences share, is known; with it the comparison is a least squares.
"""

import numpy as np
from scipy.linalg import cholesky_banded, solve_banded
from scipy.ndimage import uniform_filter1d

from bricktrack_common.arrays import FloatArray
from bricktrack_common.errors import TrackingError
from bricktrack_common.rotations import matrix_from_rvec, rvec_from_matrix
from bricktrack_host.fusion.clocks.time_alignment import TimeAlignment, has_pose
from bricktrack_host.fusion.inertial.attitude import Attitude
from bricktrack_host.fusion.inertial.imu_samples import CleanSamples, seconds_since
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal
from bricktrack_host.tracks import OpticalTrack

_ATTITUDE_FRAMES = 15  # over which attitudes by camera and by gyro are compared: half a second
_SAMPLE_SD_MPS2 = 0.05  # white noise of samples, so that no error of theirs is weighed as of the camera
_SIDE_BY_SIDE = 1.5  # frame periods
_FAR_OFF = 6.0  # sd
_CHI_3_MEDIAN = 1.538  # median of the root of chi-square with 3 degrees of freedom


class CameraAccelerations:
    """Second differences of the sensor's positions, as the camera saw them.

    Parameters
    ----------
    optical : OpticalTrack
        Of a camera that stands still.
    samples : CleanSamples
    alignment : TimeAlignment
    lever_arm_m : ndarray, shape (3,), m, brick axes

    Attributes
    ----------
    R : ndarray, shape (n_samples, 3, 3)
        Attitude at the samples.
    n_rows : int
        Second differences, of three axes each.

    Raises
    ------
    TrackingError
        If fewer than three frames with a pose lie within the samples.
    """

    def __init__(
        self,
        optical: OpticalTrack,
        samples: CleanSamples,
        alignment: TimeAlignment,
        lever_arm_m: FloatArray,
    ) -> None:
        self._t_s = samples.t_s
        tau_s = seconds_since(alignment.imu_time_ns(optical.t_ns), samples.epoch_ns)
        use = np.flatnonzero(has_pose(optical) & (tau_s > samples.t_s[0]) & (tau_s < samples.t_s[-1]))
        if len(use) < 3:
            raise TrackingError(
                f"{len(use)} frames with a pose lie within the inertial samples; accelerations need 3. "
                "Check the offset of the clocks."
            )
        self._tau_s, R_seen = tau_s[use], optical.R_camera_brick[use]
        attitude = Attitude(ImuSignal.from_samples(samples), alignment.gyro_bias_radps)
        # The gyro's attitudes, turned slowly towards the camera's.
        turn = R_seen @ np.swapaxes(attitude.at(self._tau_s), 1, 2)
        middle = turn[len(turn) // 2]
        drift = uniform_filter1d(rvec_from_matrix(middle.T @ turn), _ATTITUDE_FRAMES, axis=0, mode="nearest")

        def attitude_at(t_s: FloatArray) -> FloatArray:
            towards = np.stack([np.interp(t_s, self._tau_s, axis) for axis in drift.T], axis=1)
            return np.asarray(middle @ matrix_from_rvec(towards) @ attitude.at(t_s))

        self.R = attitude_at(samples.t_s)
        position_m = 1e-3 * optical.t_camera_brick_mm[use] + attitude_at(self._tau_s) @ lever_arm_m
        sd_m = 1e-3 * np.sqrt(np.trace(optical.covariance[use][:, 3:, 3:], axis1=1, axis2=2) / 3)
        dt = np.diff(self._tau_s)
        beside = dt < _SIDE_BY_SIDE * np.median(dt)
        self._first = np.flatnonzero(beside[:-1] & beside[1:])
        felt_mps = self._felt(np.einsum("nij,nj->ni", self.R, samples.acc_mps2))
        off_mps = self._second_difference(position_m) - felt_mps
        if len(off_mps):
            # Gravity is the same in all; a frame that is off beyond belief is the camera's, or an impact.
            off = np.linalg.norm(off_mps - np.median(off_mps, axis=0), axis=1)
            kept = off <= _FAR_OFF * float(np.median(off)) / _CHI_3_MEDIAN
            self._first, off_mps = self._first[kept], off_mps[kept]
        self.n_rows, self._off_mps = len(self._first), off_mps
        self._root = self._root_of_covariance(sd_m)

    def _root_of_covariance(self, sd_m: FloatArray) -> FloatArray:
        """Return the lower root of the covariance of the differences, a band of three, shape (3, n_rows)."""
        k, dt = self._first, np.diff(self._tau_s)
        weight = np.stack([1 / dt[k], -1 / dt[k] - 1 / dt[k + 1], 1 / dt[k + 1]], axis=1)
        by_frame = weight * sd_m[k[:, None] + np.arange(3)]
        sample_s = float(np.median(np.diff(self._t_s)))
        band = np.zeros((3, len(k)))
        band[0] = (by_frame**2).sum(axis=1) + _SAMPLE_SD_MPS2**2 * sample_s * dt[k]
        for j in (1, 2):
            shared = (by_frame[:-j, j:] * by_frame[j:, : 3 - j]).sum(axis=1)
            band[j, : len(k) - j] = np.where(k[j:] - k[:-j] == j, shared, 0.0)
        return np.asarray(cholesky_banded(band, lower=True)) if len(k) else band

    def _second_difference(self, values: FloatArray) -> FloatArray:
        k, dt = self._first, np.diff(self._tau_s)
        shape = (-1, *[1] * (values.ndim - 1))
        later = (values[k + 2] - values[k + 1]) / dt[k + 1].reshape(shape)
        return np.asarray(later - (values[k + 1] - values[k]) / dt[k].reshape(shape))

    def _felt(self, acc_camera_mps2: FloatArray) -> FloatArray:
        from scipy.interpolate import CubicSpline  # which takes long to load; most cameras stand still

        return self._second_difference(CubicSpline(self._t_s, acc_camera_mps2).antiderivative(2)(self._tau_s))

    def _white(self, values: FloatArray) -> FloatArray:
        rows = values.reshape(self.n_rows, -1)
        return np.asarray(solve_banded((2, 0), self._root, rows).reshape(self.n_rows * 3, -1))

    def off(self) -> FloatArray:
        """Return by how much the camera says more than the samples, in sd, shape (3 n_rows,)."""
        return self._white(self._off_mps)[:, 0]

    def of(self, forces_mps2: list[FloatArray]) -> FloatArray:
        """Return what forces at the samples, each shape (n, 3) in camera axes, do; (3 n_rows, n_forces)."""
        return self._white(self._felt(np.stack(forces_mps2, axis=2)))

    def seen_by_samples(self, left: FloatArray) -> FloatArray:
        """Return how much a force at each sample, in brick axes, would explain of a misfit, shape (n, 3).

        The transpose of `of`, by straight lines between samples in place of the cubic.
        """
        upper = np.zeros_like(self._root)
        for j in range(3):
            upper[2 - j, j:] = self._root[j, : self.n_rows - j]
        u = solve_banded((0, 2), upper, left.reshape(self.n_rows, 3))
        t, tau, k = self._t_s, self._tau_s, self._first
        out = np.zeros((len(t), 3))
        start, end = np.searchsorted(t, tau[k]), np.searchsorted(t, tau[k + 2])
        for j in range(int((end - start).max(initial=0))):
            i = np.minimum(start + j, len(t) - 1)
            rising = (t[i] - tau[k]) / (tau[k + 1] - tau[k])
            falling = (tau[k + 2] - t[i]) / (tau[k + 2] - tau[k + 1])
            weight = np.where(start + j < end, np.minimum(rising, falling), 0.0)
            np.add.at(out, i, weight[:, None] * u)
        return np.asarray(np.einsum("nij,ni->nj", self.R, out))
