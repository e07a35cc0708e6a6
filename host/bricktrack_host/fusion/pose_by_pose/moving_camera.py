"""When the camera moves too: its component's inertial sensor makes an inertial frame to track the brick in.

With one IMU at the camera (A) and one in the brick (B) only their relative motion is wanted (DESIGN 8.3).
The angular rate of A, integrated, turns the camera's axes into axes N that do not turn; there the
displacement d of IMU B from IMU A obeys ``d'' = R_NB f_b - R_NA f_a``. Gravity is gone, and what A feels is a
known input: in N the problem is that of a static camera (`pose_level`), and its smoother serves. The
accelerometer bias of A stands in gravity's place. The gyro bias of A is that under which it ends as it
began: N then turns by some 1e-4 rad/s, which changes what stands for gravity by far less than the noise.
"""

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.errors import ConfigError
from bricktrack_common.rotations import rvec_from_matrix
from bricktrack_host.fusion.clocks.joint_alignment import align_jointly
from bricktrack_host.fusion.clocks.time_alignment import TimeAlignment, align_times
from bricktrack_host.fusion.inertial.attitude import Attitude, mean_rate
from bricktrack_host.fusion.inertial.imu_samples import seconds_since
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal
from bricktrack_host.fusion.smoothing.camera_errors import CameraErrors
from bricktrack_host.tracks import FusedTrack, ImuTrack, OpticalTrack

_ALIGN_ROUNDS = 3
_CLOSING_ROUNDS = 2
NOT_OBSERVABLE = (
    "When the camera moves, one IMU on the LED component cannot tell the camera's acceleration from the "
    "brick's: the position is not observable. Mount a second IMU with the camera, or smooth the optical "
    "poses alone."
)


@dataclass(frozen=True, slots=True, eq=False)
class CameraImu:
    """The inertial sensor that moves with the camera.

    Attributes
    ----------
    imu : ImuTrack
        In camera axes. Of a table's accelerometers: zero angular rate, if the table only shifts.
    imu_to_camera_mm : ndarray, shape (3,), mm, camera axes
        From the sensor to the projection centre.
    kind : "imu" or "table"
        A BNO055 like the brick's, with the same lags; or accelerometers of the laboratory without.
    """

    imu: ImuTrack
    imu_to_camera_mm: FloatArray
    kind: Literal["imu", "table"] = "imu"


@dataclass(frozen=True, slots=True, eq=False)
class CameraMotion:
    """The camera's own motion, at instants of the brick's IMU.

    Attributes
    ----------
    imu : ImuTrack
        Of the camera's IMU, by its own sample clock.
    gyro_filter_s : float
    signal : ImuSignal
    bias_radps : ndarray, shape (3,)
    attitude : Attitude
    epoch_ns : int
        Zero of the seconds of the brick's IMU.
    delay_s, delay_rate, mid_s : float
        The camera's IMU stamps an instant later than the brick's by ``delay + rate * (t - mid)``.
    imu_to_camera_m : ndarray, shape (3,)
    kind : "imu" or "table"
    errors : CameraErrors
        Of the sensor, taken out so far.
    """

    imu: ImuTrack
    gyro_filter_s: float
    signal: ImuSignal
    bias_radps: FloatArray
    attitude: Attitude
    epoch_ns: int
    delay_s: float
    delay_rate: float
    mid_s: float
    imu_to_camera_m: FloatArray
    kind: Literal["imu", "table"]
    errors: CameraErrors = field(default_factory=CameraErrors)

    def with_acc_loss(self, loss_s2: float) -> "CameraMotion":
        """Return the motion with the accelerometer's low-pass undone, if it is one like the brick's."""
        if self.kind == "table":
            return self
        filter_s = float(np.sqrt(max(loss_s2, 0.0)))
        signal = ImuSignal.from_track(self.imu, gyro_filter_s=self.gyro_filter_s, acc_filter_s=filter_s)
        return replace(self, signal=signal)

    def with_sensor(self, errors: CameraErrors) -> "CameraMotion":
        """Return the motion with the errors of the sensor, and of its place, taken out."""
        eye = np.eye(3)
        imu = without_gains(self.imu, gyro_gain=eye + errors.gyro, acc_gain=eye + errors.acc)
        signal = ImuSignal.from_track(imu, gyro_filter_s=self.gyro_filter_s)
        bias = closing_bias(signal, mean_rate(imu))
        return replace(
            self,
            imu=imu,
            signal=signal,
            bias_radps=bias,
            attitude=Attitude(signal, bias),
            delay_s=self.delay_s + errors.delay_s,
            delay_rate=self.delay_rate + errors.delay_rate,
            imu_to_camera_m=self.imu_to_camera_m + errors.arm_m,
            errors=CameraErrors.of(self.errors.values() + errors.values()),
        )

    def poses_from(
        self, other: "CameraMotion", t_s: FloatArray, R: FloatArray, p_m: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return poses in still axes by this motion, shape (n, 3, 3) and (n, 3), that were so by another."""
        return self.to_still(t_s, *other.from_still(t_s, R, p_m))

    def to_still(self, t_s: FloatArray, R: FloatArray, p_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return poses that the camera sees, shape (n, 3, 3) and (n, 3), in still axes about its sensor."""
        still = self.still_attitude(t_s)
        return still @ R, np.einsum("nij,nj->ni", still, p_m + self.imu_to_camera_m)

    def from_still(self, t_s: FloatArray, R: FloatArray, p_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return poses in still axes, shape (n, 3, 3) and (n, 3), as the camera sees them."""
        still = self.still_attitude(t_s)
        seen_m = np.einsum("nji,nj->ni", still, p_m) - self.imu_to_camera_m
        return np.swapaxes(still, 1, 2) @ R, np.asarray(seen_m)

    def own_s(self, t_s: FloatArray) -> FloatArray:
        """Return instants of the brick's IMU as seconds of the camera's."""
        shift = (self.epoch_ns - self.signal.epoch_ns) * 1e-9 + self.delay_s
        return np.asarray(t_s + shift + self.delay_rate * (t_s - self.mid_s))

    def still_attitude(self, t_s: FloatArray) -> FloatArray:
        """Return the camera's attitudes in axes that stand still, shape (n, 3, 3)."""
        return self.attitude.at(self.own_s(t_s))

    def omega_radps(self, t_s: FloatArray) -> FloatArray:
        """Return the camera's angular rate in its own axes, shape (n, 3)."""
        return self.signal.gyro_at(self.own_s(t_s)) - self.bias_radps

    def still_omega_radps(self, t_s: FloatArray) -> FloatArray:
        """Return the camera's angular rate in axes that stand still, shape (n, 3)."""
        return np.asarray(np.einsum("nij,nj->ni", self.still_attitude(t_s), self.omega_radps(t_s)))

    def still_force_mps2(self, t_s: FloatArray, lag_s: float) -> FloatArray:
        """Return the specific force at the camera's sensor in axes that stand still, shape (n, 3)."""
        felt = self.signal.acc_at(self.own_s(t_s) + self.acc_lag_s(lag_s))
        return np.asarray(np.einsum("nij,nj->ni", self.still_attitude(t_s), felt))

    def acc_lag_s(self, lag_s: float) -> float:
        """Return the accelerometer-minus-gyro lag of this sensor, when the brick's has ``lag_s``."""
        return lag_s if self.kind == "imu" else 0.0

    def increments(self, start_s: FloatArray, end_s: FloatArray, *, acc_lag_s: float) -> FloatArray:
        """Return what the specific force adds to a displacement from the camera's IMU, in still axes.

        Shape (n, 4, 3): to velocity and displacement; to the velocity's rate by lag and by loss
        (`smoother.LAG`, `smoother.LOSS`), where the sensor has these.
        """
        start = self.own_s(start_s)
        step = self.signal.increments(
            start, self.own_s(end_s), gyro_bias_radps=self.bias_radps, acc_bias_mps2=np.zeros(3),
            acc_lag_s=self.acc_lag_s(acc_lag_s),
        )  # fmt: skip
        has_lag = float(self.kind == "imu")
        felt = [-step.dv_mps, -step.dp_m, -has_lag * step.f_rate_mps3, has_lag * step.f_curve_mps4]
        return np.asarray(np.einsum("nij,nkj->nki", self.attitude.at(start), np.stack(felt, axis=1)))

    def to_camera(self, track: FusedTrack, t_s: FloatArray) -> FusedTrack:
        """Return a motion in still axes about the camera's IMU as the camera sees it."""
        R_back = np.swapaxes(self.still_attitude(t_s), 1, 2)
        from_imu_mm = np.einsum("nij,nj->ni", R_back, track.t_camera_brick_mm)
        R = R_back @ track.R_camera_brick
        omega = self.omega_radps(t_s)
        turn = np.zeros((len(t_s), 6, 6))
        turn[:, :3, :3], turn[:, 3:, 3:] = np.eye(3), R_back
        return FusedTrack(
            t_ns=track.t_ns,
            R_camera_brick=R,
            t_camera_brick_mm=from_imu_mm - 1e3 * self.imu_to_camera_m,
            omega_brick_radps=track.omega_brick_radps - np.einsum("nji,nj->ni", R, omega),
            v_camera_mmps=np.einsum("nij,nj->ni", R_back, track.v_camera_mmps) - np.cross(omega, from_imu_mm),
            covariance=turn @ track.covariance @ np.swapaxes(turn, 1, 2),
            flags=track.flags,
            with_rest=None if track.with_rest is None else turn @ track.with_rest,
        )


def without_gains(imu: ImuTrack, *, gyro_gain: FloatArray, acc_gain: FloatArray) -> ImuTrack:
    """Return samples without the gains, shape (3, 3), that they have over the truth."""
    return replace(
        imu,
        gyro_radps=imu.gyro_radps @ np.linalg.inv(gyro_gain).T,
        acc_mps2=imu.acc_mps2 @ np.linalg.inv(acc_gain).T,
    )


def still_track(optical: OpticalTrack, motion: CameraMotion, t_s: FloatArray) -> OpticalTrack:
    """Return the optical poses in still axes, about the camera's IMU; ``t_s`` are the frames' IMU times."""
    turn = np.zeros((len(t_s), 6, 6))
    turn[:, :3, :3], turn[:, 3:, 3:] = np.eye(3), motion.still_attitude(t_s)
    R, p_m = motion.to_still(t_s, optical.R_camera_brick, 1e-3 * optical.t_camera_brick_mm)
    shared = optical.shared_covariance
    return replace(
        optical,
        R_camera_brick=R,
        t_camera_brick_mm=1e3 * p_m,
        covariance=turn @ optical.covariance @ np.swapaxes(turn, 1, 2),
        shared_covariance=None if shared is None else turn @ shared @ np.swapaxes(turn, 1, 2),
    )


@dataclass(frozen=True, slots=True, eq=False)
class CameraAlignment:
    """The clocks of both sensors against the camera's, and the camera's motion by them."""

    brick: TimeAlignment
    camera: TimeAlignment
    motion: CameraMotion


def align_both(
    optical: OpticalTrack,
    imu: ImuTrack,
    camera: CameraImu,
    *,
    max_offset_s: float = 0.25,
    prior_sd_ns: float = 5e6,
) -> CameraAlignment:
    """Return how camera time maps to the time of both sensors, from the rotations that all saw.

    The camera sees the rotation of B in A. With that of A taken out by its gyro, what is left is the brick's
    own, and aligned with its gyro; and the other way round. From there both are found together, see
    `joint_alignment`. Each sensor's own sample clock is found with it. Where the rotation of A tells nothing
    (a table that only shifts) its offset stays that of the stamps.
    """
    a: TimeAlignment | None = None
    b: TimeAlignment | None = None
    for _ in range(1 if camera.kind == "table" else _ALIGN_ROUNDS):
        b = align_times(
            _without(optical, camera.imu, a, is_camera=True), imu,
            max_offset_s=max_offset_s, prior_sd_ns=prior_sd_ns,
        )  # fmt: skip
        if camera.kind == "imu":
            a = align_times(
                _without(optical, imu, b, is_camera=False), camera.imu,
                max_offset_s=max_offset_s, prior_sd_ns=prior_sd_ns,
            )  # fmt: skip
            if a.source == b.source == "data":
                b, a = align_jointly(optical, imu, b, camera.imu, a, camera_bias_radps=mean_rate(camera.imu))
    if b is None:
        raise ConfigError("no round of alignment was made")
    if a is None:
        # The table's stamps are the unit's own time, without lag.
        a = replace(b, offset_ns=0.0, skew=0.0, sample_clock=None, gyro_filter_s=0.0, source="stamps")
    return CameraAlignment(b, a, camera_motion(camera, a, imu, b))


def _without(
    optical: OpticalTrack, imu: ImuTrack, alignment: TimeAlignment | None, *, is_camera: bool
) -> OpticalTrack:
    """Return attitudes with the rotation of one of the two bodies taken out by its gyro.

    What is left is the attitude of the other in still axes: of the brick where ``is_camera``, else of the
    camera.
    """
    if alignment is None:
        restamped, t_ns, filter_s = imu, optical.t_ns, 0.0
    else:
        restamped = alignment.restamped(imu)
        t_ns, filter_s = alignment.imu_time_ns(optical.t_ns), alignment.gyro_filter_s
    signal = ImuSignal.from_track(restamped, gyro_filter_s=filter_s)
    R = Attitude(signal, mean_rate(imu)).at(seconds_since(t_ns, signal.epoch_ns))
    seen = optical.R_camera_brick if is_camera else np.swapaxes(optical.R_camera_brick, 1, 2)
    return replace(optical, R_camera_brick=R @ seen)


def camera_motion(
    camera: CameraImu, alignment: TimeAlignment, imu: ImuTrack, brick: TimeAlignment
) -> CameraMotion:
    """Return the camera's motion by its sensor, at instants of the brick's."""
    own = alignment.restamped(camera.imu)
    signal = ImuSignal.from_track(own, gyro_filter_s=alignment.gyro_filter_s)
    epoch_ns = ImuSignal.from_track(brick.restamped(imu)).epoch_ns
    bias = closing_bias(signal, mean_rate(camera.imu))
    return CameraMotion(
        imu=own,
        gyro_filter_s=alignment.gyro_filter_s,
        signal=signal,
        bias_radps=bias,
        attitude=Attitude(signal, bias),
        epoch_ns=epoch_ns,
        delay_s=(alignment.offset_ns - brick.offset_ns) * 1e-9,
        delay_rate=alignment.skew - brick.skew,
        mid_s=(brick.t_mid_ns - epoch_ns) * 1e-9,
        imu_to_camera_m=np.asarray(camera.imu_to_camera_mm, dtype=np.float64) * 1e-3,
        kind=camera.kind,
    )


def closing_bias(signal: ImuSignal, mean_radps: FloatArray) -> FloatArray:
    """Return the gyro's bias, rad/s, under which the body ends in the attitude in which it began.

    To first order that is the mean rate. A body that rocks about several axes turns on the mean even so, by
    what its rotations do not commute (coning): at 2 degrees rms by half a degree a second, as no bias does.
    """
    bias = mean_radps
    for _ in range(_CLOSING_ROUNDS):
        ends = Attitude(signal, bias).at(signal.t_s[[0, -1]])
        bias = bias + rvec_from_matrix(ends[0].T @ ends[1]) / (signal.t_s[-1] - signal.t_s[0])
    return np.asarray(bias)


def imu_seconds(alignment: TimeAlignment, t_ns: IntArray, epoch_ns: int) -> FloatArray:
    """Return camera times as seconds of the brick's IMU."""
    return seconds_since(alignment.imu_time_ns(t_ns), epoch_ns)
