"""The motion from optical poses alone: a white-jerk smoother, for runs without a usable IMU.

Between frames the jerk is taken for white noise; its strength is chosen by the likelihood of the frames. In a
gap the covariance grows with the fifth power of time, and poses too unsure are NaN.

Where a camera moves unfelt, the brick's IMU cannot be fused, but it can hint: its gyro takes the brick's own
turning out of the attitudes, and what is left to smooth is the camera's; its accelerometer marks impacts, at
which the velocity may jump.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import uniform_filter1d

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.errors import ShapeError, TrackingError
from bricktrack_common.rotations import matrix_from_rvec, right_jacobian, rvec_from_matrix
from bricktrack_host.fusion.clocks.time_alignment import MIN_ROTATION_SD_RAD, has_pose
from bricktrack_host.fusion.inertial.imu_samples import seconds_since
from bricktrack_host.fusion.optical.inertial_hint import Felt, InertialHint
from bricktrack_host.fusion.optical.pose_neighbours import good_frames, interpolated, pose_jumps
from bricktrack_host.quality import PoseFlag
from bricktrack_host.tracks import FusedTrack, OpticalTrack, median_frame

_MIN_POSITION_SD_MM = 2e-3
_MAX_TURN_RAD = 2.5  # rotation vectors from the middle attitude stay smooth below pi
_INNOVATION_GATE = 63.0  # five times the 95 % point of chi-square with 6: real motion is not stationary
_NIS_CAP = 200.0  # so that an outlier does not choose the jerk
_JERK_WINDOW_S = 0.5
_VELOCITY = np.arange(9, 12)  # of the position, among the states
# Densities of white jerk tried, rad^2/s^5 and mm^2/s^5: from a brick at rest to 50 mm at 10 Hz, and beyond,
# more coarsely, to one that is put elsewhere from one frame to the next: there every frame stands for itself.
_ROTATION_JERK = 10.0 ** np.concatenate([np.arange(-4.0, 8.5, 1.0), [10.0, 12.0]])
_POSITION_JERK = 10.0 ** np.concatenate([np.arange(-1.0, 11.5, 1.0), [13.0, 15.0]])


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

    A batch of jerk densities runs side by side, shape (n, B, 6): row k holds from node k - 1 to k, and so do
    the sd of the jumps of velocity, ``kick_mmps``, shape (n,).
    """

    def __init__(
        self,
        t_s: FloatArray,
        frame: IntArray,
        z: FloatArray,
        cov: FloatArray,
        jerk: FloatArray,
        kick_mmps: FloatArray,
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
                P[:, _VELOCITY, _VELOCITY] += kick_mmps[k] ** 2
            self._x_pred[k], self._P_pred[k] = x, P
            if frame[k] >= 0:
                R = cov[frame[k]]
                y = z[frame[k]] - x[:, :6]
                S = P[:, :6, :6] + R
                nis = (y * np.linalg.solve(S, y[..., None])[..., 0]).sum(axis=1)
                self.log_likelihood[k] = -0.5 * (np.linalg.slogdet(S)[1] + np.minimum(nis, _NIS_CAP))
                R_used = R * np.maximum(nis / _INNOVATION_GATE, 1.0)[:, None, None]
                S = P[:, :6, :6] + R_used
                gain = np.swapaxes(np.linalg.solve(S, P[:, :6]), 1, 2)
                x = x + (gain @ y[..., None])[..., 0]
                # Joseph's form: what a sharp frame leaves of a wide prediction is no difference of the two.
                rest = np.eye(18) - np.pad(gain, ((0, 0), (0, 0), (0, 12)))
                P = rest @ P @ np.swapaxes(rest, 1, 2) + gain @ R_used @ np.swapaxes(gain, 1, 2)
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


def _choose_jerk(t_s: FloatArray, z: FloatArray, cov: FloatArray, kick_mmps: FloatArray) -> FloatArray:
    """Return the likeliest density of white jerk around each frame, shape (n, 6).

    Rotation and position each share one over their axes. A brick rests, shakes and rests: the likelihood is
    summed over half a second about each frame, with a little of the whole run's to steady it.
    """
    index = np.arange(len(t_s))
    window = max(round(_JERK_WINDOW_S / float(np.median(np.diff(t_s)))), 5)

    def best(trial: FloatArray, densities: FloatArray) -> FloatArray:
        ll = _Smoother(t_s, index, z, cov, trial, kick_mmps).log_likelihood
        local = uniform_filter1d(ll, window, axis=0, mode="nearest") * window + 0.02 * ll.sum(axis=0)
        return np.asarray(densities[np.argmax(local, axis=1)])

    ones = np.ones((len(t_s), 1, 3))
    # Begun with a position that may do anything: what it leaves of a frame says nothing of the turn,
    # and sharp frames would all count as outliers, whatever the turn.
    shift = np.full(len(t_s), _POSITION_JERK[-1])
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
    hint: InertialHint | None = None,
) -> FusedTrack:
    """Return the motion from optical poses alone, at any instants.

    Parameters
    ----------
    optical : OpticalTrack
        Frames without pose (NaN) are passed over.
    output_t_ns : ndarray of int64, shape (m,), camera time
        In any order.
    settings : OpticalSmoothingSettings, optional
    hint : InertialHint, optional
        Where the camera moves and only the brick's IMU feels anything: impacts are marked and the velocity
        may jump there, and attitudes are smoothed less what the gyro says, where that leaves them calmer.

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
    felt = None if hint is None else Felt(hint)
    turning = felt
    if felt is not None:
        R = optical.R_camera_brick[seen]
        left = R @ np.swapaxes(felt.turned(frame_ns), 1, 2)
        turning = felt if _restlessness(frame_ns, left) < _restlessness(frame_ns, R) else None
    return _Smoothing(optical, seen, turning, felt, settings).at(output_t_ns)


def _restlessness(t_ns: IntArray, R: FloatArray) -> float:
    """Return how far attitudes are from the cubic through two neighbours on each side, rad, rms."""
    t_s, rvec = seconds_since(t_ns, int(t_ns[0])), rvec_from_matrix(R[len(R) // 2].T @ R)
    k = range(2, len(R) - 2)
    off = np.array([rvec[i] - interpolated(t_s, rvec, [i - 2, i - 1, i + 1, i + 2], t_s[i]) for i in k])
    squares = (off**2).sum(axis=1)
    # A frame thrown far off, or a dropout, shall not decide.
    return float(np.sqrt(np.mean(np.minimum(squares, np.quantile(squares, 0.95))))) if k else 0.0


class _Smoothing:
    """One smoothing of the poses, ready for any instants; ``turning`` is taken out of the attitudes."""

    def __init__(
        self,
        optical: OpticalTrack,
        seen: BoolArray,
        turning: Felt | None,
        felt: Felt | None,
        settings: OpticalSmoothingSettings,
    ) -> None:
        self._settings, self._turning, self._felt = settings, turning, felt
        frame_ns, R = optical.t_ns[seen], optical.R_camera_brick[seen]
        floor = np.diag(np.repeat([MIN_ROTATION_SD_RAD**2, _MIN_POSITION_SD_MM**2], 3))
        stated = 0.5 * (optical.covariance[seen] + np.swapaxes(optical.covariance[seen], 1, 2)) + floor
        cov = stated
        if turning is not None:
            B = turning.turned(frame_ns)
            R, cov = R @ np.swapaxes(B, 1, 2), _rotated(stated, B)
        self._middle = R[len(R) // 2]
        rvec = rvec_from_matrix(self._middle.T @ R)
        farthest = float(np.linalg.norm(rvec, axis=1).max())
        if farthest > _MAX_TURN_RAD:
            raise TrackingError(
                f"the brick turns by {np.degrees(farthest):.0f} degrees from its middle attitude; "
                "smoothing of poses alone reaches 143"
            )
        to_rvec = np.zeros((len(rvec), 6, 6))
        to_rvec[:, :3, :3] = np.linalg.inv(right_jacobian(rvec))
        to_rvec[:, 3:, 3:] = np.eye(3)
        z = np.concatenate([rvec, optical.t_camera_brick_mm[seen]], axis=1)
        z_cov = to_rvec @ cov @ np.swapaxes(to_rvec, 1, 2)
        self._epoch_ns = int(frame_ns[0])
        good = good_frames(seconds_since(frame_ns, self._epoch_ns), z, z_cov, settings.gate_chi2)
        self._frame_ns, self._z, self._z_cov = frame_ns[good], z[good], z_cov[good]
        self._t_s = seconds_since(self._frame_ns, self._epoch_ns)
        self._jerk = _choose_jerk(self._t_s, self._z, self._z_cov, self._kicks(self._frame_ns))
        median = np.flatnonzero(good)[median_frame(stated[good])]
        shared = optical.shared_covariance
        self._common = (
            settings.optical_common_share**2 * stated[median] if shared is None else shared[seen][median]
        )

    def _kicks(self, t_ns: IntArray) -> FloatArray:
        return np.zeros(len(t_ns)) if self._felt is None else self._felt.kicks_mmps(t_ns)

    def at(self, output_t_ns: IntArray) -> FusedTrack:
        """Return the motion at instants."""
        frame_ns, t_frame = self._frame_ns, self._t_s
        t_ns, back = np.unique(np.concatenate([frame_ns, output_t_ns]), return_inverse=True)
        frame = np.full(len(t_ns), -1)
        frame[back[: len(frame_ns)]] = np.arange(len(frame_ns))
        t_s = seconds_since(t_ns, self._epoch_ns)
        # In an interval between frames the livelier of its ends holds.
        after = np.clip(np.searchsorted(t_frame, t_s), 1, len(t_frame) - 1)
        jerk = np.maximum(self._jerk[after], self._jerk[after - 1])
        smoother = _Smoother(t_s, frame, self._z, self._z_cov, jerk[:, None], self._kicks(t_ns))
        x, P = smoother.smooth()
        at = back[len(frame_ns) :]
        i = np.clip(np.searchsorted(frame_ns, output_t_ns) - 1, 0, len(frame_ns) - 2)
        between = (output_t_ns > frame_ns[i]) & (output_t_ns < frame_ns[i + 1])
        # Before the jump or after it: two answers as likely, and the smoothed one lies between them.
        jump = np.where(between[:, None], pose_jumps(t_frame, self._z, self._z_cov)[i], 0.0)
        P_out = P[at, 0]
        P_out[:, :6, :6] += 0.25 * jump[:, :, None] * jump[:, None, :]
        track = _to_track(x[at, 0], P_out, self._middle, output_t_ns, frame_ns)
        if self._turning is not None:
            track = _with_turning(track, self._turning)
        flags = track.flags
        flags[jump.any(axis=1)] |= int(PoseFlag.IMPACT)
        if self._felt is not None:
            flags[self._felt.near_impact(output_t_ns)] |= int(PoseFlag.IMPACT)
        return _unsure_left_out(replace(track, covariance=track.covariance + self._common), self._settings)


def _rotated(covariance: FloatArray, R: FloatArray) -> FloatArray:
    """Return covariances of [dtheta, dt] with dtheta turned by rotations, shape (n, 3, 3)."""
    turn = np.zeros((len(R), 6, 6))
    turn[:, :3, :3], turn[:, 3:, 3:] = R, np.eye(3)
    return np.asarray(turn @ covariance @ np.swapaxes(turn, 1, 2))


def _with_turning(track: FusedTrack, felt: Felt) -> FusedTrack:
    """Return a motion with the turning put back that had been taken out of its attitudes."""
    B = felt.turned(track.t_ns)
    B_back = np.swapaxes(B, 1, 2)
    omega = np.einsum("nij,nj->ni", B_back, track.omega_brick_radps) + felt.omega_radps(track.t_ns)
    return replace(
        track, R_camera_brick=track.R_camera_brick @ B, omega_brick_radps=omega,
        covariance=_rotated(track.covariance, B_back),
    )  # fmt: skip


def _to_track(
    x: FloatArray, P: FloatArray, middle: FloatArray, t_ns: IntArray, frame_ns: IntArray
) -> FusedTrack:
    J = np.zeros((len(x), 6, 6))
    J[:, :3, :3] = right_jacobian(x[:, :3])
    J[:, 3:, 3:] = np.eye(3)
    flags = np.full(len(t_ns), int(PoseFlag.OPTICAL_ONLY), dtype=np.int64)
    period_ns = float(np.median(np.diff(frame_ns)))
    i = np.clip(np.searchsorted(frame_ns, t_ns), 1, len(frame_ns) - 1)
    away_ns = np.minimum(np.abs(t_ns - frame_ns[i]), np.abs(t_ns - frame_ns[i - 1]))
    flags[away_ns > 1.5 * period_ns] |= int(PoseFlag.DROPOUT)
    flags[(t_ns < frame_ns[0]) | (t_ns > frame_ns[-1])] |= int(PoseFlag.EXTRAPOLATED)
    return FusedTrack(
        t_ns=t_ns,
        R_camera_brick=middle @ matrix_from_rvec(x[:, :3]),
        t_camera_brick_mm=x[:, 3:6].copy(),
        omega_brick_radps=np.einsum("nij,nj->ni", J[:, :3, :3], x[:, 6:9]),
        v_camera_mmps=x[:, 9:12].copy(),
        covariance=J @ P[:, :6, :6] @ np.swapaxes(J, 1, 2),
        flags=flags,
    )


def _unsure_left_out(track: FusedTrack, settings: OpticalSmoothingSettings) -> FusedTrack:
    """Make poses that are too unsure NaN, in place."""
    variance = np.diagonal(track.covariance, axis1=1, axis2=2)
    lost = (variance[:, 3:].max(axis=1) > settings.max_position_sd_mm**2) | (
        variance[:, :3].max(axis=1) > settings.max_rotation_sd_rad**2
    )
    track.flags[lost] |= int(PoseFlag.NO_POSE)
    for values in (
        track.R_camera_brick, track.t_camera_brick_mm, track.v_camera_mmps, track.omega_brick_radps,
        track.covariance,
    ):  # fmt: skip
        values[lost] = np.nan
    return track
