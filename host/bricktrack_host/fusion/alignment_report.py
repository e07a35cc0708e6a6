"""What one recording tells of its clocks: offset, skew and lag, and whether the stamps agree."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.rotations import rvec_from_matrix
from bricktrack_host.fusion.clocks.frame_stamps import StampCheck, check_stamps
from bricktrack_host.fusion.clocks.rate_correlation import Correlation, correlate
from bricktrack_host.fusion.clocks.slip_search import find_slips
from bricktrack_host.fusion.clocks.stamp_slips import StampSlips
from bricktrack_host.fusion.clocks.time_alignment import TimeAlignment, align_times, has_pose
from bricktrack_host.fusion.estimate import FusionResult, fuse
from bricktrack_host.fusion.inertial.imu_samples import seconds_since
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal
from bricktrack_host.fusion.mount import Mount, refine_mount
from bricktrack_host.quality import PoseFlag
from bricktrack_host.tracks import ImuTrack, OpticalTrack


@dataclass(frozen=True, slots=True, eq=False)
class AlignmentReport:
    """The clocks of one recording.

    Attributes
    ----------
    alignment : TimeAlignment
        By the rotations that both saw.
    fused : FusionResult or None
        Where the lever arm is known: offset and skew by all that camera and IMU say, and the lag of the
        accelerometer behind the gyro.
    slips : StampSlips or None
        Where the frames' stamps slip by whole periods; all else here is of mended ones.
    n_restamped : int
        Frames whose stamps had been mended so before, when the run was processed.
    stamps : StampCheck
        What else speaks against the frames' stamps.
    prior_offset_ns, prior_sd_ns : float, ns
        What the stamps promise.
    correlation : Correlation
        Of the angular rates over offsets.
    mount : Mount or None
        Where the sensor sits, if that was asked for.
    t_s : ndarray, shape (n,), s
        Middles of neighbouring frames, after the first.
    optical_radps, gyro_radps : ndarray, shape (n,)
        Angular speed between them by the camera, and by the gyro at the offset found, its bias removed.
    """

    alignment: TimeAlignment
    fused: FusionResult | None
    slips: StampSlips | None
    n_restamped: int
    stamps: StampCheck
    prior_offset_ns: float
    prior_sd_ns: float
    correlation: Correlation
    mount: Mount | None
    t_s: FloatArray
    optical_radps: FloatArray
    gyro_radps: FloatArray

    @property
    def problems(self) -> list[str]:
        """What speaks against the frames' stamps, in words."""
        return [*([] if self.slips is None else self.slips.words()), *self.stamps.problems]

    @property
    def stamps_agree(self) -> bool | None:
        """Whether motion and stamps agree; None where the motion does not tell."""
        if self.slips is not None or self.stamps.is_contradicted or self.alignment.disagrees_with_stamps:
            return False
        return True if self.alignment.source == "data" else None

    def figures(self) -> dict[str, object]:
        """Return the figures by name, with units in the names; None where a figure is not known."""
        a, f = self.alignment, self.fused
        clock = a.sample_clock
        found: dict[str, object] = {
            "source": "motion" if a.source == "data" else "stamps",
            "trusted": a.is_trusted,
            "stamps_agree": self.stamps_agree,
            "stamps_problems": self.problems,
            "stamps_slip": [
                {"frame": s.frame, "first": s.first, "last": s.last, "late_periods": s.late_periods}
                for s in (() if self.slips is None else self.slips.slips)
            ],
            "frames_restamped": self.n_restamped,
            "remark": a.reason,
            "offset_ms": a.offset_ns / 1e6,
            "offset_sd_ms": a.offset_sd_ns / 1e6,
            "skew_ppm": a.skew * 1e6,
            "skew_sd_ppm": a.skew_sd * 1e6,
            "stamps_offset_ms": self.prior_offset_ns / 1e6,
            "stamps_offset_sd_ms": self.prior_sd_ns / 1e6,
            "correlation": a.correlation,
            "rotation_residual": a.rotation_residual_sd,
            "gyro_bias_dps": np.rad2deg(a.gyro_bias_radps).tolist(),
            "gyro_filter_ms": a.gyro_filter_s * 1e3,
            "sensor_clock_ppm": None,
            "samples_not_read": 0,
            "smoothed_offset_ms": None,
            "smoothed_offset_sd_ms": None,
            "acc_lag_ms": None,
            "acc_lag_sd_ms": None,
        }
        if clock is not None:
            found["sensor_clock_ppm"] = self._clock_ppm(clock.period_ns)
            found["samples_not_read"] = clock.n_skipped
        if f is not None:
            found |= {
                "smoothed_offset_ms": f.offset_ns / 1e6,
                "smoothed_offset_sd_ms": f.offset_sd_ns / 1e6,
                "acc_lag_ms": f.acc_lag_ns / 1e6,
                "acc_lag_sd_ms": f.acc_lag_sd_ns / 1e6,
            }
        plain = {k: v.item() if isinstance(v, np.generic) else v for k, v in found.items()}
        if self.mount is not None:
            m = self.mount
            plain |= {
                "mount_rvec_deg": np.rad2deg(m.rvec_layout_rad).tolist(),
                "mount_rvec_sd_deg": np.rad2deg(m.rvec_sd_rad).tolist(),
                "lever_arm_mm": [v if math.isfinite(v) else None for v in m.lever_arm_mm.tolist()],
                "lever_arm_sd_mm": [v if math.isfinite(v) else None for v in m.lever_arm_sd_mm.tolist()],
                "gravity_off_deg": m.gravity_off_deg,
                "gravity_mps2": m.gravity_mps2,
            }
        return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in plain.items()}

    @staticmethod
    def _clock_ppm(period_ns: float) -> float:
        """Return by how much a sensor's clock is slow against the nearest whole rate."""
        rate_hz = round(1e9 / period_ns)
        return (period_ns * rate_hz / 1e9 - 1) * 1e6


def report_alignment(
    optical: OpticalTrack,
    imu: ImuTrack,
    *,
    lever_arm_mm: ArrayLike | None = None,
    prior_offset_ns: float = 0.0,
    prior_sd_ns: float = 5e6,
    max_offset_s: float = 0.25,
    frame_stamps_ns: IntArray | None = None,
    with_mount: bool = False,
) -> AlignmentReport:
    """Return what a recording tells of its clocks.

    Parameters
    ----------
    optical, imu : OpticalTrack, ImuTrack
    lever_arm_mm : array_like, shape (3,), mm, brick axes, optional
        From the origin LED to the IMU.
    prior_offset_ns, prior_sd_ns : float, ns
        What the stamps promise; a wide sd where camera and IMU were stamped by different clocks.
    max_offset_s : float
        How far from that to look.
    frame_stamps_ns : ndarray of int64, shape (n_frames,), ns, optional
        The sensor's stamps of all frames; the times of the poses if not given, which an exposure that varies
        shifts.
    with_mount : bool
        Whether to refine where the sensor sits; needs the lever arm and a motion that tells the offset.

    Raises
    ------
    TrackingError
        If there is no optical pose.
    ShapeError
        If there are too few inertial samples.
    """
    n_restamped = int(np.count_nonzero(optical.flags & int(PoseFlag.RESTAMPED)))

    def aligned(poses: OpticalTrack) -> TimeAlignment:
        return align_times(
            poses, imu, max_offset_s=max_offset_s, prior_offset_ns=prior_offset_ns, prior_sd_ns=prior_sd_ns
        )

    alignment = aligned(optical)
    stamps_ns = optical.t_ns if frame_stamps_ns is None else frame_stamps_ns
    slips = find_slips(
        optical, imu, alignment, aligned,
        prior_offset_ns=prior_offset_ns, prior_sd_ns=prior_sd_ns, max_offset_s=max_offset_s,
    )  # fmt: skip
    if slips is not None:
        stamps_ns = stamps_ns + (slips.t_ns - optical.t_ns)
        alignment, optical = slips.alignment, slips.mended(optical)
    fused, mount = None, None
    if lever_arm_mm is not None and alignment.source == "data":
        fused = fuse(
            optical, imu, lever_arm_mm=lever_arm_mm, output_t_ns=optical.t_ns[:0], alignment=alignment
        )
        if with_mount:
            mount = refine_mount(optical, imu, lever_arm_mm=lever_arm_mm, alignment=alignment)
    signal = ImuSignal.from_track(alignment.restamped(imu))
    seen = has_pose(optical)
    t_ns, R = optical.t_ns[seen], optical.R_camera_brick[seen]
    t_cam_s, t_imu_s = (seconds_since(t, signal.epoch_ns) for t in (t_ns, alignment.imu_time_ns(t_ns)))
    dt = np.diff(t_cam_s)
    pair = dt < 1.5 * np.median(dt) if len(dt) else np.zeros(0, dtype=np.bool_)
    turn = rvec_from_matrix(np.swapaxes(R[:-1], 1, 2) @ R[1:])
    gyro = (signal.angle_at(t_imu_s[1:]) - signal.angle_at(t_imu_s[:-1])) / dt[:, None]
    gyro = np.where(signal.in_gap(t_imu_s[1:])[:, None], np.nan, gyro - alignment.gyro_bias_radps)
    return AlignmentReport(
        alignment=alignment,
        fused=fused,
        slips=slips,
        n_restamped=n_restamped,
        stamps=check_stamps(stamps_ns, optical, imu, alignment),
        prior_offset_ns=prior_offset_ns,
        prior_sd_ns=prior_sd_ns,
        correlation=correlate(t_cam_s, R, signal, centre_s=prior_offset_ns * 1e-9, max_offset_s=max_offset_s),
        mount=mount,
        t_s=(0.5 * (t_cam_s[1:] + t_cam_s[:-1]) - t_cam_s[0])[pair],
        optical_radps=np.linalg.norm(turn / dt[:, None], axis=1)[pair],
        gyro_radps=np.linalg.norm(gyro, axis=1)[pair],
    )
