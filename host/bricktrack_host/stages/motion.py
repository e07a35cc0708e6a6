"""The stage of the motion: the instants wanted, frames and inertial samples together, and what fell out."""

from dataclasses import dataclass, replace

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray, rows_of
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_common.errors import ShapeError, TrackingError
from bricktrack_host.fusion.camera_step import words_on_camera_step
from bricktrack_host.fusion.estimate import FusionResult, fuse
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.inertial.imu_samples import BRIDGE_PERIODS, seconds_since
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal
from bricktrack_host.fusion.optical.inertial_hint import InertialHint
from bricktrack_host.fusion.optical.optical_smoothing import smooth_optical
from bricktrack_host.fusion.pose_by_pose.fused_output import unsure_times
from bricktrack_host.fusion.sensor_agreement import doubt_about_camera_sensor
from bricktrack_host.fusion.tight import TightResult, fuse_tight
from bricktrack_host.quality import LedFlag, PoseFlag
from bricktrack_host.results.daq_clock import EdgeFit
from bricktrack_host.results.ray_errors import RayErrors
from bricktrack_host.results.result_tables import FusedKind
from bricktrack_host.stages.clocks import Inertial
from bricktrack_host.tracking.optical_track import solve_poses
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracking.pose.first_poses import FirstPoses
from bricktrack_host.tracking.pose.frame_motion import led_motion, motion_to_leds, within_exposure_ns
from bricktrack_host.tracking.pose.refine import LedMotion
from bricktrack_host.tracks import FusedTrack, LedObservations, OpticalTrack

_RETIME_PASSES = 1
_MUCH_REJECTED = 0.01  # of the LED centroids; a spark or a glint now and then harms nothing
_MUCH_OFFSET_PX = 0.15
# How far samples are to be believed, how far scales are off, and what a vibration leaves in samples decides
# about dropouts and impacts. Within a frame's 20 ms it cannot be seen (`scripts/bench_retime.py`).
_WITHIN_FRAMES = FusionSettings(
    adapt_noise=False, vibration_beside_camera=False, sensor_gain_sd=0.0, lever_arm_sd_mm=0.0
)


@dataclass(frozen=True, slots=True, eq=False)
class OutputGrid:
    """The instants at which the motion is wanted, camera time, by kind."""

    t_ns: dict[FusedKind, IntArray]
    edge_index: IntArray


def output_grid(optical: OpticalTrack, inertial: Inertial | None, edge_fit: EdgeFit | None) -> OutputGrid:
    """Return every IMU slot, frame and sample of the square wave from the first frame to the last."""
    first, last = int(optical.t_ns[0]), int(optical.t_ns[-1])
    t_ns: dict[FusedKind, IntArray] = {}
    if inertial is not None:
        slots = inertial.alignment.camera_time_ns(inertial.imu.t_ns)
        t_ns["imu"] = slots[(slots >= first) & (slots <= last)]
    t_ns["frame"] = optical.t_ns
    index = np.empty(0, dtype=np.int64)
    if edge_fit is not None:
        index = np.arange(edge_fit.last_index + 1)
        edges = edge_fit.time_of_index(index)
        inside = (edges >= first) & (edges <= last)
        index = index[inside]
        t_ns["edge"] = edges[inside]
    return OutputGrid(t_ns, index)


def retime(
    observations: LedObservations,
    first: FirstPoses,
    optical: OpticalTrack,
    inertial: Inertial | None,
    rays: RayModel,
    brick: BrickModel,
) -> OpticalTrack:
    """Solve the poses again with each LED carried to its frame's instant by the fused motion.

    Splines through 30 frames a second cannot follow a motion above 15 Hz, and read-out takes 20 ms: the IMU
    knows what the brick did meanwhile. Where its samples are missing, it does not, and the splines stay; so
    they do where the fused motion is not known.
    """
    if inertial is None or inertial.is_hint or brick.imu_lever_arm_mm is None:
        return optical
    n = len(optical.t_ns)
    for _ in range(_RETIME_PASSES):
        within_ns = within_exposure_ns(optical.led_t_ns, observations.exposure_ns)
        wanted = np.concatenate([optical.t_ns, within_ns.ravel()])
        try:
            track = _by_poses(
                optical, inertial, brick.imu_lever_arm_mm, wanted, settings=_WITHIN_FRAMES
            ).track
        except (ShapeError, TrackingError):
            return optical  # the fusion itself will say why
        motion = led_motion(rows_of(track, slice(0, n)), rows_of(track, slice(n, None)), n_instants=2)
        unknown = ~np.isfinite(motion.shift_camera_mm).all(axis=(1, 2))
        motion = _with_splines(motion, optical, unknown | _frames_unfelt(optical, inertial))
        optical = solve_poses(observations, rays, brick, motion=motion, first=first)
        if not np.isfinite(optical.t_camera_brick_mm).any():
            break
    return optical


def words_on_knocks(optical: OpticalTrack, inertial: Inertial | None) -> list[str]:
    """Return what to say of a camera that is to stand still and was knocked."""
    if inertial is None or inertial.is_hint or inertial.camera is not None or inertial.slips is not None:
        return []
    return words_on_camera_step(optical, inertial.imu, inertial.alignment)


def _frames_unfelt(optical: OpticalTrack, inertial: Inertial) -> BoolArray:
    """Return which frames have an LED whose instant lies in a long gap of the inertial samples, or beyond."""
    alignment = inertial.alignment
    signal = ImuSignal.from_track(alignment.restamped(inertial.imu))
    instants_ns = np.concatenate([optical.t_ns[:, None], optical.led_t_ns], axis=1)
    t_s = seconds_since(alignment.imu_time_ns(instants_ns), signal.epoch_ns)
    return np.asarray(signal.in_gap(t_s, least_periods=BRIDGE_PERIODS).any(axis=1))


def _with_splines(motion: LedMotion, optical: OpticalTrack, frames: BoolArray) -> LedMotion:
    """Return a motion within frames that in some of them is that of splines through the optical poses."""
    if not frames.any() or motion.twist_sd is None:
        return motion
    splines = motion_to_leds(
        optical.t_ns, optical.led_t_ns, optical.R_camera_brick, optical.t_camera_brick_mm
    )
    if splines.twist_sd is None:
        return motion
    return LedMotion(
        rvec_brick_rad=np.where(frames[:, None, None], splines.rvec_brick_rad, motion.rvec_brick_rad),
        shift_camera_mm=np.where(frames[:, None, None], splines.shift_camera_mm, motion.shift_camera_mm),
        dt_s=np.where(frames[:, None], splines.dt_s, motion.dt_s),
        twist_sd=np.where(frames[:, None], splines.twist_sd, motion.twist_sd),
    )


def _by_poses(
    optical: OpticalTrack,
    inertial: Inertial,
    lever_arm_mm: FloatArray,
    wanted: IntArray,
    *,
    settings: FusionSettings | None = None,
) -> FusionResult:
    return fuse(
        optical, inertial.imu, lever_arm_mm=lever_arm_mm, output_t_ns=wanted, alignment=inertial.alignment,
        camera="static" if inertial.camera is None else inertial.camera.kind,
        camera_imu=inertial.camera, camera_alignment=inertial.camera_alignment, settings=settings,
    )  # fmt: skip


def with_times_doubted(observations: LedObservations, time_sd_ns: FloatArray) -> LedObservations:
    """Return centroids that are as unsure as they move in what their frames' instants are unsure by.

    All LEDs of a frame are early or late together. Fused each for itself they would seem to say so all the
    more surely, the more there are: so each has as many times the variance.

    Parameters
    ----------
    observations : LedObservations
    time_sd_ns : ndarray, shape (n_frames,), ns
        As `unsure_stamps` returns it.
    """
    uv, t_s = observations.uv_px, observations.sensor_timestamp_ns * 1e-9
    if not time_sd_ns.any():
        return observations
    speed = np.zeros_like(uv)  # px/s, by the frames on either side that show it, or the one that does
    for led, is_seen in enumerate(all_finite(uv).T):
        if is_seen.sum() > 1:
            speed[is_seen, led] = np.gradient(uv[is_seen, led], t_s[is_seen], axis=0)
    doubt_px = speed * (time_sd_ns * 1e-9)[:, None, None]
    n_seen = np.isfinite(uv[..., 0]).sum(axis=1)[:, None, None, None]
    doubt_px2 = n_seen * doubt_px[..., :, None] * doubt_px[..., None, :]
    return replace(observations, cov_px2=observations.cov_px2 + doubt_px2)


def fuse_run(
    optical: OpticalTrack,
    inertial: Inertial | None,
    brick: BrickModel,
    grid: OutputGrid,
    problems: list[str],
    *,
    seen: tuple[LedObservations, RayModel] | None,
    rest_ns: tuple[int, int] | None = None,
) -> tuple[dict[FusedKind, FusedTrack], FusionResult | None, BoolArray | None]:
    """Return the motion at the instants wanted: LED by LED where ``seen`` is given, else pose by pose.

    ``rest_ns``: when the brick rested, camera time.

    Returns
    -------
    parts : dict of FusedTrack
    fusion : FusionResult or None
        `None` where the motion is of the optical poses alone.
    rejected : ndarray of bool, shape (n_frames, n_leds), or None
        Centroids that the motion leaves out; `None` where it is not LED by LED.
    """
    wanted = np.concatenate(list(grid.t_ns.values()))
    fusion, by_poses, rejected = None, None, None
    if inertial is not None and not inertial.is_hint and brick.imu_lever_arm_mm is not None:
        lever_arm_mm = brick.imu_lever_arm_mm
        try:
            if seen is None:
                fusion = by_poses = _by_poses(optical, inertial, lever_arm_mm, wanted)
            else:
                tight = _fuse_tight(
                    optical, inertial, brick, seen, wanted, problems, lever_arm_mm=lever_arm_mm,
                    rest_ns=rest_ns,
                )  # fmt: skip
                fusion, by_poses, rejected = tight.fused, tight.pose_level, tight.led_rejected
        except (ShapeError, TrackingError) as e:
            problems.append(f"fusion was not possible, optical poses alone: {e}")
    if fusion is not None:
        track = fusion.track
        n_rejected = int(np.count_nonzero(fusion.frame_rejected))
        if n_rejected:
            problems.append(
                f"{n_rejected} optical poses disagree with the IMU and their neighbours and were left out"
            )
        if by_poses is not None and inertial is not None and inertial.camera is not None:
            doubt = doubt_about_camera_sensor(by_poses.gyro_noise, by_poses.acc_noise)
            problems.extend([] if doubt is None else [doubt])
    else:
        hint = InertialHint(inertial.imu, inertial.alignment) if inertial and inertial.is_hint else None
        track = smooth_optical(optical, wanted, hint=hint)
    ends = np.cumsum([len(t) for t in grid.t_ns.values()])
    parts = {
        kind: rows_of(track, slice(end - len(t), end))
        for (kind, t), end in zip(grid.t_ns.items(), ends.tolist(), strict=True)
    }
    return parts, fusion, rejected


def with_rejected_told(observations: LedObservations, rejected: BoolArray | None) -> LedObservations:
    """Return centroids in which those that the motion leaves out, (n_frames, n_leds), are outliers."""
    if rejected is None:
        return observations
    flags = np.where(rejected, int(LedFlag.OUTLIER), 0)
    return replace(observations, led_flags=observations.led_flags | flags)


def _fuse_tight(
    optical: OpticalTrack,
    inertial: Inertial,
    brick: BrickModel,
    seen: tuple[LedObservations, RayModel],
    wanted: IntArray,
    problems: list[str],
    *,
    lever_arm_mm: FloatArray,
    rest_ns: tuple[int, int] | None,
) -> TightResult:
    observations, rays = seen
    tight = fuse_tight(
        observations, optical, inertial.imu, rays, brick,
        lever_arm_mm=lever_arm_mm, output_t_ns=wanted, alignment=inertial.alignment,
        camera="static" if inertial.camera is None else inertial.camera.kind,
        camera_imu=inertial.camera, camera_alignment=inertial.camera_alignment, rest_ns=rest_ns,
    )  # fmt: skip
    problems.extend(words_on_rejected(tight.led_rejected, np.isfinite(tight.led_chi2)))
    problems.extend(words_on_led_offsets(tight.led_offset_sd_px))
    if not tight.check.agrees:
        problems.append(
            f"fusion LED by LED and pose by pose are up to {tight.check.max_mm:.2f} mm apart, in "
            f"{100 * tight.check.share_apart:.0f} % of the instants by more than their uncertainty allows"
        )
    return tight


def words_on_rejected(is_rejected: BoolArray, is_fused: BoolArray) -> list[str]:
    """Return what to say of LED centroids left out, both of shape (n_frames, n_leds); a few are usual."""
    n, n_seen = int(np.count_nonzero(is_rejected)), int(np.count_nonzero(is_rejected | is_fused))
    if n <= _MUCH_REJECTED * n_seen:
        return []
    return [
        f"{n} of {n_seen} LED centroids ({100 * n / n_seen:.1f} %) disagree with all the others and were "
        "left out"
    ]


def words_on_led_offsets(sd_px: float) -> list[str]:
    """Return what to say of LEDs that lie beside their places throughout; a few hundredths are usual."""
    if not sd_px > _MUCH_OFFSET_PX:
        return []
    return [
        f"single LEDs lie some {sd_px:.2f} px (sd) beside where layout and profile have them, all over the "
        "run (0.05 px are usual): poses may be as wrong throughout. Are the LEDs where the layout has them "
        "(`bricktrack calibrate leds --positions` finds out), clean, and all of one type?"
    ]


def with_ray_errors(
    optical: OpticalTrack, fused: dict[FusedKind, FusedTrack], errors: RayErrors | None
) -> tuple[OpticalTrack, dict[FusedKind, FusedTrack]]:
    """Return the poses with what the calibration's rays leave unsure in their covariance.

    It is added last: all frames share it, so to a fusion that takes its frames as independent it is nothing.
    """
    if errors is None:
        return optical, fused

    def widened(track: OpticalTrack | FusedTrack) -> FloatArray:
        covariance = errors.covariance(track.R_camera_brick, track.t_camera_brick_mm)
        covariance += track.covariance
        return covariance

    return (
        replace(optical, covariance=widened(optical)),
        {kind: replace(track, covariance=widened(track)) for kind, track in fused.items()},
    )


def with_unsure_times(
    optical: OpticalTrack, fused: dict[FusedKind, FusedTrack], time_sd_ns: FloatArray
) -> tuple[OpticalTrack, dict[FusedKind, FusedTrack]]:
    """Return the poses with the motion in the time that their stamps are unsure by, in covariance and flags.

    ``time_sd_ns``, shape (n_frames,): of the instants of the optical poses; between them it is linear.
    """
    if not time_sd_ns.any():
        return optical, fused
    velocity = max(fused.values(), key=lambda track: len(track.t_ns))
    frames_ns = optical.t_ns
    spread, flags = unsure_times(optical.t_ns, frames_ns, time_sd_ns, velocity)
    optical = replace(optical, covariance=optical.covariance + spread, flags=optical.flags | flags)
    widened: dict[FusedKind, FusedTrack] = {}
    for kind, track in fused.items():
        spread, flags = unsure_times(track.t_ns, frames_ns, time_sd_ns, velocity)
        widened[kind] = replace(track, covariance=track.covariance + spread, flags=track.flags | flags)
    return optical, widened


def with_restamped_told(
    optical: OpticalTrack, fused: dict[FusedKind, FusedTrack]
) -> dict[FusedKind, FusedTrack]:
    """Return the fused motion flagged at frames whose stamps were mended, and between two of them."""
    is_restamped = optical.flags & int(PoseFlag.RESTAMPED) != 0
    if not is_restamped.any():
        return fused
    last = len(optical.t_ns) - 1
    told: dict[FusedKind, FusedTrack] = {}
    for kind, track in fused.items():
        before = np.clip(np.searchsorted(optical.t_ns, track.t_ns, side="right") - 1, 0, last)
        after = np.clip(np.searchsorted(optical.t_ns, track.t_ns, side="left"), 0, last)
        between = is_restamped[before] & is_restamped[after]
        told[kind] = replace(track, flags=track.flags | np.where(between, int(PoseFlag.RESTAMPED), 0))
    return told
