"""How the inertial sensor sits in the brick, as the motion shows it: its axes and its place, and how surely.

The layout file says both; this refines them on request. A motion tells only what it exercises: turning about
one axis leaves the angle about it, and the place along it, unknown. The uncertainties say so.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from bricktrack_common.arrays import FloatArray, IntArray, as_float_array
from bricktrack_common.errors import TrackingError
from bricktrack_common.rotations import matrix_from_quaternion, rvec_from_matrix
from bricktrack_host.fusion.clocks.time_alignment import TimeAlignment, align_times, has_pose
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.inertial.imu_samples import seconds_since
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal
from bricktrack_host.fusion.pose_by_pose.fusion_problem import Run, first_linearisation
from bricktrack_host.fusion.pose_by_pose.noise_choice import frames_log_likelihood
from bricktrack_host.tracks import ImuTrack, OpticalTrack

_STEP_MM = 1.5  # of the differences by which the likelihood's curvature is had
_MOST_ROUNDS, _SETTLED_MM = 10, 0.05  # of Newton's method
_MAX_SD_MM, _MAX_SD_DEG = 1.0, 0.5
_CHI_3_MEDIAN = 1.538  # median of the root of chi-square with 3 degrees of freedom
_SURE_ARM_MM = 0.05  # while it is sought, its error is no noise


@dataclass(frozen=True, slots=True, eq=False)
class Mount:
    """Where the sensor sits, beside what the layout says.

    Attributes
    ----------
    rvec_layout_rad, rvec_sd_rad : ndarray, shape (3,), brick axes
        The sensor's true axes are those of the layout turned by this: ``R_brick_imu = Exp(rvec) @ layout's``.
    lever_arm_mm, lever_arm_sd_mm : ndarray, shape (3,), mm, brick axes
        NaN with an infinite sd along an axis that the motion tells nothing of.
    rvec_is_told, lever_arm_is_told : ndarray of bool, shape (3,)
        Axes known to better than half a degree, and to better than a millimetre.
    gravity_off_deg : float
        Between gravity by the smoother's start, from all of the run, and by the accelerometer at the quietest
        second: a wrong axis or a camera that was moved shows here.
    gravity_mps2 : float
        What the accelerometer measures then; 9.8 when its scale and bias are right.
    """

    rvec_layout_rad: FloatArray
    rvec_sd_rad: FloatArray
    lever_arm_mm: FloatArray
    lever_arm_sd_mm: FloatArray
    rvec_is_told: np.ndarray
    lever_arm_is_told: np.ndarray
    gravity_off_deg: float
    gravity_mps2: float


def refine_mount(
    optical: OpticalTrack,
    imu: ImuTrack,
    *,
    lever_arm_mm: ArrayLike,
    alignment: TimeAlignment | None = None,
    settings: FusionSettings | None = None,
) -> Mount:
    """Return where the sensor sits, from one run.

    Parameters
    ----------
    optical, imu : OpticalTrack, ImuTrack
        The samples in brick axes by the layout.
    lever_arm_mm : array_like, shape (3,), mm
        By the layout.
    alignment : TimeAlignment, optional
    settings : FusionSettings, optional

    Raises
    ------
    TrackingError
        If the motion does not tell the offset of the clocks: it then tells nothing of the mount.

    Notes
    -----
    Axes: the rotation that takes the gyro's rotations between frames onto the camera's (Wahba's problem).
    Place: Newton's method on the likelihood of the frames under the filter, with steps that raise it; not
    told where it does not settle.
    """
    settings = settings or FusionSettings()
    arm = as_float_array("lever_arm_mm", lever_arm_mm, (3,))
    alignment = alignment or align_times(optical, imu)
    if alignment.source != "data":
        raise TrackingError(f"the mount of the IMU cannot be refined: {alignment.reason}")
    imu = alignment.restamped(imu)
    rvec, rvec_sd = _axes(optical, imu, alignment)
    found, sd = _place(optical, imu, alignment, arm, settings)
    run = Run.from_tracks(optical, imu, alignment, lever_arm_mm=arm, output_t_ns=optical.t_ns[:0])
    off_deg, size = _gravity_check(run, settings)
    return Mount(
        rvec_layout_rad=rvec,
        rvec_sd_rad=rvec_sd,
        lever_arm_mm=found,
        lever_arm_sd_mm=sd,
        rvec_is_told=np.rad2deg(rvec_sd) < _MAX_SD_DEG,
        lever_arm_is_told=sd < _MAX_SD_MM,
        gravity_off_deg=off_deg,
        gravity_mps2=size,
    )


def _axes(optical: OpticalTrack, imu: ImuTrack, alignment: TimeAlignment) -> tuple[FloatArray, FloatArray]:
    """Return the turn of the gyro's axes against the brick's, and its sd."""
    signal = ImuSignal.from_track(imu, gyro_filter_s=alignment.gyro_filter_s)
    seen = has_pose(optical)
    R = optical.R_camera_brick[seen]
    t_s = seconds_since(alignment.imu_time_ns(optical.t_ns[seen]), signal.epoch_ns)
    dt = np.diff(t_s)
    pair = (dt < 1.5 * np.median(dt)) & ~signal.in_gap(t_s[1:]) & ~signal.in_gap(t_s[:-1])
    by_camera = rvec_from_matrix(np.swapaxes(R[:-1], 1, 2) @ R[1:])[pair]
    by_gyro = (signal.angle_at(t_s[1:]) - signal.angle_at(t_s[:-1]))[pair]
    by_gyro = by_gyro - dt[pair, None] * alignment.gyro_bias_radps
    weight = np.ones(len(by_camera))
    turn = np.eye(3)
    for _ in range(5):
        U, _, Vt = np.linalg.svd(np.einsum("n,ni,nj->ij", weight, by_camera, by_gyro))
        turn = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        off = np.linalg.norm(by_camera - by_gyro @ turn.T, axis=1)
        sd = max(
            float(np.median(off)) / 1.538, 1e-9
        )  # median of the root of chi-square, 3 degrees of freedom
        weight = 1 / (1 + (off / (2.5 * sd)) ** 2)
    told = np.einsum("n,nk,nk->", weight, by_gyro, by_gyro) * np.eye(3)
    told -= np.einsum("n,ni,nj->ij", weight, by_gyro, by_gyro)
    # Frame-to-frame noise is anticorrelated, so this is on the safe side.
    covariance = sd**2 * np.linalg.inv(told + 1e-12 * np.eye(3))
    return rvec_from_matrix(turn), np.sqrt(np.diagonal(covariance))


def _place(
    optical: OpticalTrack,
    imu: ImuTrack,
    alignment: TimeAlignment,
    arm_mm: FloatArray,
    settings: FusionSettings,
) -> tuple[FloatArray, FloatArray]:
    """Return the lever arm and its sd, mm."""
    settings = replace(settings, lever_arm_sd_mm=_SURE_ARM_MM)

    def log_likelihood(at_mm: FloatArray) -> float:
        run = Run.from_tracks(optical, imu, alignment, lever_arm_mm=at_mm, output_t_ns=optical.t_ns[:0])
        return frames_log_likelihood(run, settings)

    h, unit = _STEP_MM, np.eye(3) * _STEP_MM
    found, here = arm_mm.copy(), log_likelihood(arm_mm)
    has_settled = False
    for _ in range(_MOST_ROUNDS):
        plus = np.array([log_likelihood(found + e) for e in unit])
        minus = np.array([log_likelihood(found - e) for e in unit])
        gradient = (plus - minus) / (2 * h)
        hessian = np.diag((plus + minus - 2 * here) / h**2)
        for i, j in ((0, 1), (0, 2), (1, 2)):
            along, across = unit[i] + unit[j], unit[i] - unit[j]
            both = log_likelihood(found + along) + log_likelihood(found - along)
            both -= log_likelihood(found + across) + log_likelihood(found - across)
            hessian[i, j] = hessian[j, i] = both / (4 * h**2)
        told, axes = np.linalg.eigh(-hessian)
        good = told > 1 / 20.0**2  # a prior of 20 mm: along what is told less, the layout stands
        # Far away the likelihood may curve the other way: then too, uphill.
        steep = np.abs(told) > 1 / 20.0**2
        uphill = (axes[:, steep].T @ gradient) / np.abs(told[steep])
        step = np.clip(axes[:, steep] @ uphill, -10.0, 10.0)
        has_settled = bool((np.abs(step) < _SETTLED_MM).all())
        there = log_likelihood(found + step)
        while there < here and not has_settled:
            step = 0.5 * step
            has_settled = bool((np.abs(step) < _SETTLED_MM).all())
            there = log_likelihood(found + step)
        found, here = found + step, there
        if has_settled:
            break
    if not has_settled:
        return np.full(3, np.nan), np.full(3, np.inf)
    variance = (axes[:, good] ** 2 / told[good]).sum(axis=1)
    untold = (axes[:, ~good] ** 2).sum(axis=1) > 0.05
    return np.where(untold, np.nan, found), np.where(untold, np.inf, np.sqrt(variance))


def _gravity_check(run: Run, settings: FusionSettings) -> tuple[float, float]:
    """Return how far gravity of the quietest second is from that of the run, deg, and its size, m/s^2."""
    whole = first_linearisation(run, settings).gravity_mps2
    signal = run.signal
    n = max(round(1.0 / signal.period_s), 5)
    restless = np.convolve(np.linalg.norm(np.diff(signal.acc_mps2, axis=0), axis=1), np.ones(n), "valid")
    i = int(np.argmin(restless))
    force = signal.acc_mps2[i : i + n].mean(axis=0)
    t_imu = run.t_cam_s + run.alignment.offset_ns * 1e-9
    R = run.R_seen[int(np.argmin(np.abs(t_imu - signal.t_s[i + n // 2])))]
    quiet = -(R @ force)
    cosine = quiet @ whole / np.linalg.norm(quiet) / np.linalg.norm(whole)
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))), float(np.linalg.norm(force))


@dataclass(frozen=True, slots=True)
class ChipOrientationCheck:
    """How the chip's own orientation (fusion modes) agrees with the camera's.

    Attributes
    ----------
    rms_deg, max_deg : float
        Of the rotation that each saw since the first frame; the chip's drifts and lags under fast motion.
    gravity_deg : float
        Between gravity by the chip and ``gravity_camera_mps2``, both as the camera has it.
    n : int
        Frames compared.
    """

    rms_deg: float
    max_deg: float
    gravity_deg: float
    n: int


def check_chip_orientation(
    optical: OpticalTrack,
    t_ns: IntArray,
    q_wxyz_gravity_imu: FloatArray,
    *,
    R_brick_imu: FloatArray,
    alignment: TimeAlignment,
    gravity_camera_mps2: FloatArray,
) -> ChipOrientationCheck:
    """Return how the BNO055's own quaternion agrees with the optical attitudes.

    Parameters
    ----------
    t_ns : ndarray of int64, shape (n,)
        Stamps of the samples.
    q_wxyz_gravity_imu : ndarray, shape (n, 4)
        As `bricktrack_common.imu_records.ImuSamples.q_wxyz`; NaN where there is none.
    R_brick_imu : ndarray, shape (3, 3)
    gravity_camera_mps2 : ndarray, shape (3,)
        By the fusion.

    Raises
    ------
    TrackingError
        If no frame has both.
    """
    given = np.flatnonzero(np.isfinite(q_wxyz_gravity_imu).all(axis=1))
    seen = np.flatnonzero(has_pose(optical))
    if given.size == 0 or seen.size == 0:
        raise TrackingError("no quaternions of the chip beside optical poses: did a fusion mode run?")
    at_ns = alignment.imu_time_ns(optical.t_ns[seen])
    near = given[np.clip(np.searchsorted(t_ns[given], at_ns), 0, given.size - 1)]
    chip = matrix_from_quaternion(q_wxyz_gravity_imu[near]) @ R_brick_imu.T
    camera = optical.R_camera_brick[seen]
    # Both heads are arbitrary: what the first frame, as good as any, makes of gravity's axes in the camera's.
    to_camera = camera[0] @ chip[0].T
    off = np.degrees(np.linalg.norm(rvec_from_matrix(np.swapaxes(to_camera @ chip, 1, 2) @ camera), axis=1))
    down = -to_camera[:, 2]
    cosine = down @ gravity_camera_mps2 / np.linalg.norm(gravity_camera_mps2)
    return ChipOrientationCheck(
        rms_deg=float(np.sqrt(np.mean(off**2))),
        max_deg=float(off.max()),
        gravity_deg=float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))),
        n=len(seen),
    )
