"""The motion from optical poses alone: a white-jerk smoother, for runs without a usable IMU.

Between frames the jerk is taken for white noise; its strength is chosen by the likelihood of the frames. In a
gap the covariance grows with the fifth power of time, and poses too unsure are NaN.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.errors import ShapeError, TrackingError
from bricktrack_common.rotations import matrix_from_rvec, right_jacobian, rvec_from_matrix
from bricktrack_host.fusion.imu_signal import seconds_since
from bricktrack_host.fusion.time_alignment import MIN_ROTATION_SD_RAD, has_pose
from bricktrack_host.quality import PoseFlag
from bricktrack_host.tracks import FusedTrack, OpticalTrack

_MIN_POSITION_SD_MM = 2e-3
_MAX_TURN_RAD = 2.5  # rotation vectors from the middle attitude stay smooth below pi
_INNOVATION_GATE = 63.0  # five times the 95 % point of chi-square with 6: real motion is not stationary
_NIS_CAP = 200.0  # so that an outlier does not choose the jerk
_JERK_WINDOW_S = 0.5
# Densities of white jerk tried, rad^2/s^5 and mm^2/s^5: from a brick at rest to 50 mm at 10 Hz.
_ROTATION_JERK = 10.0 ** np.arange(-4.0, 8.5, 1.0)
_POSITION_JERK = 10.0 ** np.arange(-1.0, 11.5, 1.0)


@dataclass(frozen=True, slots=True)
class OpticalSmoothingSettings:
    """How the optical poses are smoothed.

    Attributes
    ----------
    optical_common_share : float
        Part of the optical sd that neighbouring frames have in common; added to the covariance given out.
    gate_chi2 : float
        A frame farther than this from its neighbours (6 degrees of freedom) is left out, if it stands alone.
    max_position_sd_mm, max_rotation_sd_rad : float
        A pose less sure than this is given as NaN.
    """

    optical_common_share: float = 0.3
    gate_chi2: float = 33.0
    max_position_sd_mm: float = 50.0
    max_rotation_sd_rad: float = 0.3


def _transition(dt_s: float) -> FloatArray:
    return np.kron(np.array([[1, dt_s, dt_s**2 / 2], [0, 1, dt_s], [0, 0, 1]]), np.eye(6))


def _jerk_noise(dt_s: float) -> FloatArray:
    d = dt_s
    return np.array(
        [
            [d**5 / 20, d**4 / 8, d**3 / 6],
            [d**4 / 8, d**3 / 3, d**2 / 2],
            [d**3 / 6, d**2 / 2, d],
        ]
    )


class _Smoother:
    """Kalman filter and smoother of [rotation vector, position], rate and acceleration: 18 states.

    A batch of jerk densities runs side by side, shape (n, B, 6): row k holds from node k - 1 to k.
    """

    def __init__(
        self, t_s: FloatArray, frame: IntArray, z: FloatArray, cov: FloatArray, jerk: FloatArray
    ) -> None:
        n, n_runs = len(t_s), jerk.shape[1]
        self.x, self.P = np.empty((n, n_runs, 18)), np.empty((n, n_runs, 18, 18))
        self._x_pred, self._P_pred = np.empty_like(self.x), np.empty_like(self.P)
        self._F = np.empty((max(n - 1, 0), 18, 18))
        self.log_likelihood = np.zeros((n, n_runs))
        first = int(np.flatnonzero(frame >= 0)[0])
        x = np.zeros((n_runs, 18))
        x[:, :6] = z[frame[first]]
        # Start wide: 1 rad, 1 m; 20 rad/s, 2 m/s; 3 g and what turns as fast.
        P = np.diag(np.repeat([1.0, 1e3, 20.0, 2e3, 1e3, 3e4], 3) ** 2) + np.zeros((n_runs, 1, 1))
        for k in range(n):
            if k:
                dt = float(t_s[k] - t_s[k - 1])
                F = self._F[k - 1] = _transition(dt)
                x = x @ F.T
                Q = np.einsum("ij,bk,kl->bikjl", _jerk_noise(dt), jerk[k], np.eye(6)).reshape(n_runs, 18, 18)
                P = F @ P @ F.T + Q
            self._x_pred[k], self._P_pred[k] = x, P
            if frame[k] >= 0:
                R = cov[frame[k]]
                y = z[frame[k]] - x[:, :6]
                S = P[:, :6, :6] + R
                nis = (y * np.linalg.solve(S, y[..., None])[..., 0]).sum(axis=1)
                self.log_likelihood[k] = -0.5 * (np.linalg.slogdet(S)[1] + np.minimum(nis, _NIS_CAP))
                S = P[:, :6, :6] + R * np.maximum(nis / _INNOVATION_GATE, 1.0)[:, None, None]
                gain = np.swapaxes(np.linalg.solve(S, P[:, :6]), 1, 2)
                x = x + (gain @ y[..., None])[..., 0]
                P = P - gain @ P[:, :6]
                P = 0.5 * (P + np.swapaxes(P, 1, 2))
            self.x[k], self.P[k] = x, P

    def smooth(self) -> tuple[FloatArray, FloatArray]:
        """Return the smoothed states, shape (n, B, 18), and covariances."""
        x, P = self.x.copy(), self.P.copy()
        scale = 1 / np.sqrt(np.diagonal(self._P_pred[1:], axis1=-2, axis2=-1))
        scaled = self._P_pred[1:] * scale[..., :, None] * scale[..., None, :]
        FP = self._F[:, None] @ self.P[:-1]
        gains = np.swapaxes(np.linalg.solve(scaled, FP * scale[..., :, None]) * scale[..., :, None], -1, -2)
        for k in range(len(x) - 2, -1, -1):
            x[k] += (gains[k] @ (x[k + 1] - self._x_pred[k + 1])[..., None])[..., 0]
            Pk = P[k] + gains[k] @ (P[k + 1] - self._P_pred[k + 1]) @ np.swapaxes(gains[k], -1, -2)
            P[k] = 0.5 * (Pk + np.swapaxes(Pk, -1, -2))
        return x, P


def _choose_jerk(t_s: FloatArray, z: FloatArray, cov: FloatArray) -> FloatArray:
    """Return the likeliest density of white jerk around each frame, shape (n, 6).

    Rotation and position each share one over their axes. A brick rests, shakes and rests: the likelihood is
    summed over half a second about each frame, with a little of the whole run's to steady it.
    """
    index = np.arange(len(t_s))
    window = max(round(_JERK_WINDOW_S / float(np.median(np.diff(t_s)))), 5)

    def best(trial: FloatArray, densities: FloatArray) -> FloatArray:
        ll = _Smoother(t_s, index, z, cov, trial).log_likelihood
        local = uniform_filter1d(ll, window, axis=0, mode="nearest") * window + 0.02 * ll.sum(axis=0)
        return np.asarray(densities[np.argmax(local, axis=1)])

    ones = np.ones((len(t_s), 1, 3))
    turn = np.full(len(t_s), _ROTATION_JERK[len(_ROTATION_JERK) // 2])
    shift = np.full(len(t_s), _POSITION_JERK[len(_POSITION_JERK) // 2])
    for _ in range(2):
        q = _ROTATION_JERK[:, None] * ones
        turn = best(np.concatenate([q, shift[:, None, None] * np.ones_like(q)], axis=2), _ROTATION_JERK)
        q = _POSITION_JERK[:, None] * ones
        shift = best(np.concatenate([turn[:, None, None] * np.ones_like(q), q], axis=2), _POSITION_JERK)
    return np.repeat(np.stack([turn, shift], axis=1), 3, axis=1)


def smooth_optical(
    optical: OpticalTrack,
    output_t_ns: IntArray,
    *,
    settings: OpticalSmoothingSettings | None = None,
) -> FusedTrack:
    """Return the motion from optical poses alone, at any instants.

    Parameters
    ----------
    optical : OpticalTrack
        Frames without pose (NaN) are passed over.
    output_t_ns : ndarray of int64, shape (m,), camera time
        In any order.
    settings : OpticalSmoothingSettings, optional

    Returns
    -------
    FusedTrack
        Every sample carries OPTICAL_ONLY. NaN with NO_POSE where the poses leave it too unsure: in long gaps
        and soon after the last frame.

    Raises
    ------
    TrackingError
        If fewer than three frames have a pose, or the brick turns by more than 143 degrees from its middle
        attitude.
    """
    settings = settings or OpticalSmoothingSettings()
    if output_t_ns.ndim != 1 or not np.issubdtype(output_t_ns.dtype, np.integer):
        raise ShapeError(f"output_t_ns has shape {output_t_ns.shape}; expected one dimension of int64 ns")
    seen = has_pose(optical)
    if seen.sum() < 3:
        raise TrackingError(
            f"only {seen.sum()} of {seen.size} frames have a pose; three are needed to smooth"
        )
    frame_ns = optical.t_ns[seen]
    if (np.diff(frame_ns) <= 0).any():
        raise ShapeError("stamps of the optical poses do not increase; sort the frames")
    epoch_ns = int(frame_ns[0])
    R, p_mm = optical.R_camera_brick[seen], optical.t_camera_brick_mm[seen]
    middle = R[len(R) // 2]
    rvec = rvec_from_matrix(middle.T @ R)
    farthest = float(np.linalg.norm(rvec, axis=1).max())
    if farthest > _MAX_TURN_RAD:
        raise TrackingError(
            f"the brick turns by {np.degrees(farthest):.0f} degrees from its middle attitude; "
            "smoothing of poses alone reaches 143"
        )
    floor = np.diag(np.repeat([MIN_ROTATION_SD_RAD**2, _MIN_POSITION_SD_MM**2], 3))
    cov = 0.5 * (optical.covariance[seen] + np.swapaxes(optical.covariance[seen], 1, 2)) + floor
    to_rvec = np.zeros((len(rvec), 6, 6))
    to_rvec[:, :3, :3] = np.linalg.inv(right_jacobian(rvec))
    to_rvec[:, 3:, 3:] = np.eye(3)
    z, z_cov = np.concatenate([rvec, p_mm], axis=1), to_rvec @ cov @ np.swapaxes(to_rvec, 1, 2)

    t_frame = seconds_since(frame_ns, epoch_ns)
    good = _good_frames(t_frame, z, z_cov, settings.gate_chi2)
    frame_ns, t_frame, z, z_cov = frame_ns[good], t_frame[good], z[good], z_cov[good]
    jerk = _choose_jerk(t_frame, z, z_cov)
    t_ns, back = np.unique(np.concatenate([frame_ns, output_t_ns]), return_inverse=True)
    frame = np.full(len(t_ns), -1)
    frame[back[: len(frame_ns)]] = np.arange(len(frame_ns))
    t_s = seconds_since(t_ns, epoch_ns)
    # In an interval between frames the livelier of its ends holds.
    after = np.clip(np.searchsorted(t_frame, t_s), 1, len(t_frame) - 1)
    node_jerk = np.maximum(jerk[after], jerk[after - 1])
    x, P = _Smoother(t_s, frame, z, z_cov, node_jerk[:, None]).smooth()
    at = back[len(frame_ns) :]
    common = settings.optical_common_share**2 * np.median(cov[good], axis=0)
    return _to_track(x[at, 0], P[at, 0], middle, output_t_ns, frame_ns, common, settings)


def _cubic_through(t_s: FloatArray, z: FloatArray, k: int, others: list[int]) -> FloatArray:
    """Return what the cubic through four other frames says of frame k."""
    t = t_s[others] - t_s[k]
    weights = [np.prod([-t[j] / (t[i] - t[j]) for j in range(4) if j != i]) for i in range(4)]
    return np.asarray(np.array(weights) @ z[others])


def _good_frames(t_s: FloatArray, z: FloatArray, cov: FloatArray, gate_chi2: float) -> BoolArray:
    """Return which frames are no lone outliers.

    A frame far off the cubic through two neighbours on each side is one only if its neighbours agree with
    theirs once it is left out: at an impact they do not, and the frame stays.
    """
    n = len(t_s)
    good = np.ones(n, dtype=np.bool_)

    def off(k: int, without: int) -> float:
        around = [i for i in range(k - 3, k + 4) if i not in (k, without) and 0 <= i < n and good[i]]
        before, after = [i for i in around if i < k], [i for i in around if i > k]
        if len(before) < 2 or len(after) < 2:
            return np.inf
        e = z[k] - _cubic_through(t_s, z, k, before[-2:] + after[:2])
        # The cubic's own noise adds 17/18 of a frame's variance on an even grid.
        return float(e @ np.linalg.solve(2 * cov[k], e))

    alone = np.array([off(k, k) for k in range(n)])
    far = np.where(np.isfinite(alone), alone, 0.0)
    for k in np.argsort(-far):
        if far[k] < gate_chi2:
            break
        least = max(gate_chi2, 0.05 * far[k])
        if all(off(j, int(k)) < least for j in (k - 1, k + 1) if 0 <= j < n):
            good[k] = False
    return good


def _to_track(
    x: FloatArray,
    P: FloatArray,
    middle: FloatArray,
    t_ns: IntArray,
    frame_ns: IntArray,
    common: FloatArray,
    settings: OpticalSmoothingSettings,
) -> FusedTrack:
    J = np.zeros((len(x), 6, 6))
    J[:, :3, :3] = right_jacobian(x[:, :3])
    J[:, 3:, 3:] = np.eye(3)
    covariance = J @ P[:, :6, :6] @ np.swapaxes(J, 1, 2) + common
    flags = np.full(len(t_ns), int(PoseFlag.OPTICAL_ONLY), dtype=np.int64)
    period_ns = float(np.median(np.diff(frame_ns)))
    i = np.clip(np.searchsorted(frame_ns, t_ns), 1, len(frame_ns) - 1)
    away_ns = np.minimum(np.abs(t_ns - frame_ns[i]), np.abs(t_ns - frame_ns[i - 1]))
    flags[away_ns > 1.5 * period_ns] |= int(PoseFlag.DROPOUT)
    flags[(t_ns < frame_ns[0]) | (t_ns > frame_ns[-1])] |= int(PoseFlag.EXTRAPOLATED)
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    lost = (variance[:, 3:].max(axis=1) > settings.max_position_sd_mm**2) | (
        variance[:, :3].max(axis=1) > settings.max_rotation_sd_rad**2
    )
    flags[lost] |= int(PoseFlag.NO_POSE)
    R = middle @ matrix_from_rvec(x[:, :3])
    t_mm, v_mmps = x[:, 3:6].copy(), x[:, 9:12].copy()
    omega = np.einsum("nij,nj->ni", J[:, :3, :3], x[:, 6:9])
    for values in (R, t_mm, v_mmps, omega, covariance):
        values[lost] = np.nan
    return FusedTrack(t_ns, R, t_mm, omega, v_mmps, covariance, flags)
