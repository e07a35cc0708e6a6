"""From tracks to the smoother's problem: nodes in time, noise of each step, start values and their sd."""

from dataclasses import dataclass, field, replace

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_host.fusion.clocks.time_alignment import MIN_ROTATION_SD_RAD, TimeAlignment, has_pose
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.inertial.imu_samples import clean_samples, seconds_since
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal
from bricktrack_host.fusion.pose_by_pose.folded_vibration import samples_beside_camera
from bricktrack_host.fusion.pose_by_pose.gap_fill import fill_of_gaps
from bricktrack_host.fusion.pose_by_pose.inertial_noise import (
    NoiseLevel,
    NoiseParts,
    camera_noise,
    noise_parts,
)
from bricktrack_host.fusion.pose_by_pose.moving_camera import CameraMotion, imu_seconds, still_track
from bricktrack_host.fusion.smoothing.linearisation import Linearisation
from bricktrack_host.fusion.smoothing.sensor_errors import SensorErrors
from bricktrack_host.fusion.smoothing.smoother import (
    ATT,
    BA,
    BG,
    GRAV,
    LAG,
    LOSS,
    N_STATES,
    POS,
    SKEW,
    TAU,
    VEL,
    Problem,
    State,
)
from bricktrack_host.tracks import ImuTrack, OpticalTrack

_MIN_POSITION_SD_M = 2e-6  # a covariance below this is not believed
_LONGEST_STEP_PERIODS = 1.25


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """One run's inputs, in seconds after the IMU's first sample and metres.

    Attributes
    ----------
    t_cam_s : ndarray, shape (n,)
        Frames with a pose, camera time.
    frame : ndarray of int64, shape (n,)
        Their index in the optical track.
    cov_seen : ndarray, shape (n, 6, 6)
        Of what is new in each frame.
    shared_seen : ndarray, shape (n, 6, 6), or None
        Of what frames share, where that is known; else ``cov_seen`` is of both.
    camera : CameraMotion or None
        Where the camera moves: poses are then in still axes about its IMU, and gravity is its accelerometer's
        bias.
    still_s : ndarray, shape (n,), or (0,)
        There, IMU time of the frames at which the camera's attitude was taken.
    gyro_gain, acc_gain : ndarray, shape (3, 3)
        Of the samples over the truth, as far as is known.
    sensor_covariance : ndarray, shape (21, 21) or (44, 44)
        Of what is left in them and in the lever arm, see `sensor_errors.SensorErrors`.
    gyro_loss_s2 : float
        What the gyro's low-pass takes from the second derivative, over what the alignment says.
    """

    imu: ImuTrack
    signal: ImuSignal
    alignment: TimeAlignment
    lever_arm_m: FloatArray
    t_cam_s: FloatArray
    frame: IntArray
    R_seen: FloatArray
    p_seen_m: FloatArray
    cov_seen: FloatArray
    t_mid_s: float
    span_cam_s: tuple[float, float]
    shared_seen: FloatArray | None = None
    camera: CameraMotion | None = None
    still_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    gyro_gain: FloatArray = field(default_factory=lambda: np.eye(3))
    acc_gain: FloatArray = field(default_factory=lambda: np.eye(3))
    sensor_covariance: FloatArray = field(default_factory=lambda: np.zeros((21, 21)))
    gyro_loss_s2: float = 0.0

    @classmethod
    def from_tracks(
        cls,
        optical: OpticalTrack,
        imu: ImuTrack,
        alignment: TimeAlignment,
        *,
        lever_arm_mm: FloatArray,
        output_t_ns: IntArray,
        camera: CameraMotion | None = None,
        vibration_beside_camera: bool = True,
    ) -> "Run":
        """Return what of a run is used: frames with a pose, and the time to be covered."""
        if camera is None:
            if vibration_beside_camera:
                samples = samples_beside_camera(optical, imu, alignment, lever_arm_mm * 1e-3)
            else:
                samples = clean_samples(imu)
            samples = replace(samples, fill=fill_of_gaps(optical, samples, alignment, lever_arm_mm * 1e-3))
        else:
            samples = clean_samples(imu)
        signal = ImuSignal.from_samples(samples, gyro_filter_s=alignment.gyro_filter_s)
        seen, still_s = np.flatnonzero(has_pose(optical)), np.zeros(0)
        if camera is not None:
            t_s = imu_seconds(alignment, optical.t_ns, signal.epoch_ns)
            optical, still_s = still_track(optical, camera, t_s), t_s[seen]
        t_cam_s = seconds_since(optical.t_ns[seen], signal.epoch_ns)
        shared = optical.shared_covariance
        to_m = np.repeat([1.0, 1e-3], 3)
        cov = optical.covariance[seen] - (0.0 if shared is None else shared[seen])
        cov = to_m[:, None] * cov * to_m
        floor = np.repeat([MIN_ROTATION_SD_RAD**2, _MIN_POSITION_SD_M**2], 3)
        cov = 0.5 * (cov + np.swapaxes(cov, 1, 2)) + np.diag(floor)
        # IMU samples in camera time, as far as they reach beyond the frames.
        first = min(float(t_cam_s[0]), float(signal.t_s[0]) - alignment.offset_ns * 1e-9)
        last = max(float(t_cam_s[-1]), float(signal.t_s[-1]) - alignment.offset_ns * 1e-9)
        wanted_s = seconds_since(output_t_ns, signal.epoch_ns)
        span = (
            float(min(t_cam_s[0], max(first, wanted_s.min(initial=np.inf)))),
            float(max(t_cam_s[-1], min(last, wanted_s.max(initial=-np.inf)))),
        )
        return cls(
            imu=imu,
            signal=signal,
            alignment=alignment,
            lever_arm_m=lever_arm_mm * 1e-3,
            t_cam_s=t_cam_s,
            frame=seen.astype(np.int64),
            R_seen=optical.R_camera_brick[seen],
            p_seen_m=optical.t_camera_brick_mm[seen] * 1e-3,
            cov_seen=cov,
            shared_seen=None if shared is None else to_m[:, None] * shared[seen] * to_m,
            t_mid_s=(alignment.t_mid_ns - signal.epoch_ns) * 1e-9,
            span_cam_s=span,
            camera=camera,
            still_s=still_s,
        )

    def with_acc_loss(self, loss_s2: float) -> "Run":
        """Return the run with the accelerometer's low-pass undone as far as is known now."""
        signal = self.signal.with_acc_filter(float(np.sqrt(max(loss_s2, 0.0))))
        camera = None if self.camera is None else self.camera.with_acc_loss(loss_s2)
        return replace(self, signal=signal, camera=camera)

    def with_sensor(self, errors: SensorErrors) -> "Run":
        """Return the run with the errors of the sensor, and of its place, taken out."""
        gyro_gain = (np.eye(3) + errors.gyro) @ self.gyro_gain
        acc_gain = (np.eye(3) + errors.acc) @ self.acc_gain
        gyro_loss_s2 = self.gyro_loss_s2 + errors.gyro_loss_s2
        signal = self.signal.without_gains(gyro_gain, acc_gain)
        if errors.gyro_loss_s2 != 0.0:
            loss_s2 = self.alignment.gyro_filter_s**2 + gyro_loss_s2
            signal = signal.with_gyro_filter(float(np.sqrt(max(loss_s2, 0.0))))
        camera, R_seen, p_seen_m = self.camera, self.R_seen, self.p_seen_m
        if self.camera is not None:
            camera = self.camera.with_acc_loss(0.0)
            if errors.camera is not None:
                camera = self.camera.with_sensor(errors.camera)
                R_seen, p_seen_m = camera.poses_from(self.camera, self.still_s, R_seen, p_seen_m)
        return replace(
            self,
            signal=signal,
            camera=camera,
            R_seen=R_seen,
            p_seen_m=p_seen_m,
            lever_arm_m=self.lever_arm_m + errors.arm_m,
            gyro_gain=gyro_gain,
            acc_gain=acc_gain,
            gyro_loss_s2=gyro_loss_s2,
            sensor_covariance=errors.covariance,
        )

    def seen_at(self, lin: Linearisation) -> "Run":
        """Return the run with the poses of a camera that moves in still axes by better clocks."""
        if self.camera is None:
            return self
        t_s = self.imu_time_s(self.t_cam_s, lin)
        seen = self.camera.from_still(self.still_s, self.R_seen, self.p_seen_m)
        R_seen, p_seen_m = self.camera.to_still(t_s, *seen)
        return replace(self, R_seen=R_seen, p_seen_m=p_seen_m, still_s=t_s)

    def noise_parts(self, t_s: FloatArray, lin: Linearisation, settings: FusionSettings) -> NoiseParts:
        """Return how far all sensors are to be trusted over steps between instants of IMU time."""
        parts = noise_parts(self.signal, t_s, lin, settings)
        return parts if self.camera is None else parts + camera_noise(self.camera, t_s, lin, settings)

    def aligned_s(self) -> FloatArray:
        """Return IMU time of the frames as the alignment had it, shape (n,)."""
        a = self.alignment
        return np.asarray(self.t_cam_s + a.offset_ns * 1e-9 + a.skew * (self.t_cam_s - self.t_mid_s))

    def imu_time_s(self, t_cam_s: FloatArray, lin: Linearisation) -> FloatArray:
        """Return IMU time of camera time at the linearisation point."""
        return np.asarray(t_cam_s + lin.tau_s + lin.skew * (t_cam_s - self.t_mid_s))

    def camera_time_s(self, t_s: FloatArray, lin: Linearisation) -> FloatArray:
        """Return camera time of IMU time at the linearisation point."""
        return np.asarray((t_s - lin.tau_s + lin.skew * self.t_mid_s) / (1 + lin.skew))


@dataclass(frozen=True, slots=True, eq=False)
class Nodes:
    """The instants of the filter, IMU time, and which frame stands at which."""

    t_s: FloatArray
    node_of_frame: IntArray

    def camera_attitudes(self, run: Run) -> FloatArray | None:
        """Return how a camera that moves is turned at them, in still axes, shape (K, 3, 3)."""
        return None if run.camera is None else run.camera.still_attitude(self.t_s)


def first_linearisation(run: Run, settings: FusionSettings) -> Linearisation:
    """Return start values from the alignment, the optical attitudes and the accelerometer.

    Averaged over a run, specific force turned into camera axes is minus gravity: the brick ends near where
    it began.
    """
    a = run.alignment
    tau, lag = a.offset_ns * 1e-9, settings.acc_lag_ns * 1e-9
    t_imu = run.aligned_s()
    whole = ~run.signal.in_gap(t_imu)
    whole = whole if whole.any() else np.ones(len(t_imu), dtype=bool)
    force = np.einsum("nij,nj->ni", run.R_seen[whole], run.signal.acc_at(t_imu[whole] + lag))
    if run.camera is not None:
        force = force - run.camera.still_force_mps2(t_imu[whole], lag)
    # The median is not drawn by a few impacts, and its direction is all that is taken.
    down = -np.median(force, axis=0)
    norm = float(np.linalg.norm(down))
    down = down / norm if norm > 0 else np.array([0.0, 1.0, 0.0])
    # Of two sensors only the difference of their biases is left, and gravity, if one was zeroed before.
    gravity = down * (settings.gravity_mps2 if run.camera is None else norm)
    return Linearisation(
        tau_s=tau,
        skew=a.skew,
        lag_s=lag,
        loss_s2=0.0,
        bg_radps=np.asarray(a.gyro_bias_radps, dtype=np.float64),
        ba_mps2=np.zeros(3),
        R_first=run.R_seen[0],
        v_first_mps=np.zeros(3),
        p_first_m=run.p_seen_m[0] + run.R_seen[0] @ run.lever_arm_m,
        gravity_mps2=gravity,
    )


def place_nodes(run: Run, lin: Linearisation) -> Nodes:
    """Return the frames' instants and even steps between them, to a step beyond what is wanted."""
    t_frame = run.imu_time_s(run.t_cam_s, lin)
    lo, hi = run.imu_time_s(np.array(run.span_cam_s), lin)
    step = run.signal.period_s
    ends = np.concatenate([[min(lo, t_frame[0]) - step], t_frame, [max(hi, t_frame[-1]) + step]])
    n_steps = np.maximum(np.ceil(np.diff(ends) / (_LONGEST_STEP_PERIODS * step)), 1).astype(np.int64)
    first = np.concatenate([[0], np.cumsum(n_steps)])
    interval = np.repeat(np.arange(len(n_steps)), n_steps)
    share = (np.arange(first[-1]) - first[interval]) / n_steps[interval]
    t_s = np.append(ends[interval] + share * np.diff(ends)[interval], ends[-1])
    return Nodes(t_s, first[1:-1])


def start_covariance(run: Run, lin: Linearisation, settings: FusionSettings) -> FloatArray:
    """Return the covariance of the start values, shape (22, 22): wide where the first frames will tell.

    No wider than bricks move, though: what later frames leave of a variance is a difference, and of a square
    metre rounding would leave more than is left of it in truth.
    """
    s, a = settings, run.alignment
    sd = np.zeros(N_STATES)
    sd[ATT], sd[POS], sd[VEL] = 0.2, 0.03, 1.0
    sd[BG], sd[BA], sd[GRAV] = s.gyro_bias_sd_radps, s.acc_bias_sd_mps2, 0.5
    if a.source == "data":
        sd[TAU] = max(s.offset_prior_sd_ns, a.offset_sd_ns) * 1e-9
        sd[SKEW] = 2 * a.skew_sd
    else:
        sd[TAU], sd[SKEW] = a.offset_sd_ns * 1e-9, a.skew_sd
    sd[LAG], sd[LOSS] = s.acc_lag_sd_ns * 1e-9, s.acc_loss_sd_s2
    if run.camera is not None:
        sd[GRAV] = s.acc_bias_sd_mps2
        return np.diag(sd**2)
    P = np.diag(sd**2)
    along = lin.gravity_mps2 / np.linalg.norm(lin.gravity_mps2)
    P[GRAV, GRAV] += (s.gravity_sd_mps2**2 - sd[GRAV.start] ** 2) * np.outer(along, along)
    return P


def build_problem(
    runs: list[Run],
    nodes: list[Nodes],
    lins: list[Linearisation],
    *,
    settings: FusionSettings,
    use_frame: list[BoolArray],
    noise_scale: list[FloatArray],
    levels: list[tuple[NoiseLevel, NoiseLevel]],
) -> tuple[Problem, list[NoiseParts]]:
    """Return the batch's arrays, time first; shorter runs are padded with steps of no duration.

    Parameters
    ----------
    use_frame : list of ndarray of bool, shape (n_frames,)
    noise_scale : list of ndarray, shape (2,)
        Factors on the stated sd of optical rotation and position.
    levels : list of (NoiseLevel, NoiseLevel)
        Of gyro and accelerometer.

    Returns
    -------
    problem, parts : Problem, list of NoiseParts
        The parts at the steps of each run, from which other levels can be made.
    """
    parts: list[NoiseParts] = []
    n_nodes, n_runs = max(len(n.t_s) for n in nodes), len(runs)
    steps, eye = (n_nodes - 1, n_runs), np.eye(3)
    zeros3 = np.zeros((*steps, 3))
    pr = Problem(
        dt_s=np.zeros(steps),
        R_step=np.broadcast_to(eye, (*steps, 3, 3)).copy(),
        R_half=np.broadcast_to(eye, (*steps, 3, 3)).copy(),
        dv_mps=zeros3.copy(),
        dp_m=zeros3.copy(),
        f_rate_mps3=zeros3.copy(),
        f_curve_mps4=zeros3.copy(),
        known=np.zeros((*steps, 4, 3)),
        gyro_var=np.zeros(steps),
        acc_var=np.zeros(steps),
        gyro_bias_walk=np.full(steps, settings.gyro_bias_walk_radps**2),
        acc_bias_walk=np.full(steps, settings.acc_bias_walk_mps2**2),
        omega_radps=np.zeros((n_nodes, n_runs, 3)),
        camera_omega_radps=np.zeros((n_nodes, n_runs, 3)),
        has_frame=np.zeros((n_nodes, n_runs), dtype=np.bool_),
        R_seen=np.zeros((n_nodes, n_runs, 3, 3)),
        p_seen_m=np.zeros((n_nodes, n_runs, 3)),
        cov_seen=np.zeros((n_nodes, n_runs, 6, 6)),
        since_mid_s=np.zeros((n_nodes, n_runs)),
        lever_arm_m=np.stack([r.lever_arm_m for r in runs]),
        bg_lin=np.stack([x.bg_radps for x in lins]),
        ba_lin=np.stack([x.ba_mps2 for x in lins]),
        tau_lin=np.array([x.tau_s for x in lins]),
        skew_lin=np.array([x.skew for x in lins]),
        lag_lin=np.array([x.lag_s for x in lins]),
        loss_lin=np.array([x.loss_s2 for x in lins]),
        start=State(np.empty((n_runs, 3, 3)), np.zeros((n_runs, N_STATES))),
        P_start=np.stack([start_covariance(r, x, settings) for r, x in zip(runs, lins, strict=True)]),
    )
    for b, (run, node, lin) in enumerate(zip(runs, nodes, lins, strict=True)):
        k = len(node.t_s) - 1
        step = run.signal.increments(
            node.t_s[:-1],
            node.t_s[1:],
            gyro_bias_radps=lin.bg_radps,
            acc_bias_mps2=lin.ba_mps2,
            acc_lag_s=lin.lag_s,
        )
        pr.dt_s[:k, b] = np.diff(node.t_s)
        pr.R_step[:k, b], pr.R_half[:k, b] = step.R, step.R_half
        pr.dv_mps[:k, b], pr.dp_m[:k, b] = step.dv_mps, step.dp_m
        pr.f_rate_mps3[:k, b], pr.f_curve_mps4[:k, b] = step.f_rate_mps3, step.f_curve_mps4
        parts.append(run.noise_parts(node.t_s, lin, settings))
        if run.camera is not None:
            start_s, end_s = node.t_s[:-1], node.t_s[1:]
            pr.known[:k, b] = run.camera.increments(start_s, end_s, acc_lag_s=lin.lag_s)
            pr.camera_omega_radps[: k + 1, b] = run.camera.still_omega_radps(node.t_s)
        pr.gyro_var[:k, b], pr.acc_var[:k, b] = parts[b].gyro(levels[b][0]), parts[b].acc(levels[b][1])
        pr.omega_radps[: k + 1, b] = run.signal.gyro_at(node.t_s)
        at = node.node_of_frame
        pr.has_frame[at, b] = use_frame[b]
        pr.R_seen[at, b], pr.p_seen_m[at, b] = run.R_seen, run.p_seen_m
        scale = np.repeat(noise_scale[b], 3)
        pr.cov_seen[at, b] = run.cov_seen * scale[:, None] * scale
        pr.since_mid_s[: k + 1, b] = run.camera_time_s(node.t_s, lin) - run.t_mid_s
        pr.start.R[b] = lin.R_first
        x = pr.start.x[b]
        x[POS], x[VEL], x[BG], x[GRAV] = lin.p_first_m, lin.v_first_mps, lin.bg_radps, lin.gravity_mps2
        x[TAU], x[SKEW] = run.alignment.offset_ns * 1e-9, run.alignment.skew
        x[LAG] = settings.acc_lag_ns * 1e-9
    return pr, parts


def with_frames_used(problem: Problem, nodes: list[Nodes], used: list[BoolArray]) -> Problem:
    """Return the same arrays with other frames shown to the filter, shape (n_frames,) of each run."""
    has_frame = np.zeros_like(problem.has_frame)
    for b, (node, of_run) in enumerate(zip(nodes, used, strict=True)):
        has_frame[node.node_of_frame, b] = of_run
    return replace(problem, has_frame=has_frame)
