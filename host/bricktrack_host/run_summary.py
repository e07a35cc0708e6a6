"""What a run amounts to: key figures and a verdict in plain words, for the report and the command line."""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.imu_records import UNUSABLE
from bricktrack_common.rotations import rvec_from_matrix
from bricktrack_host.quality import LedFlag, PoseFlag
from bricktrack_host.results import RunResult
from bricktrack_host.tracks import FusedTrack

GAP_PERIODS = 1.5  # a longer time between two frame stamps is a dropped frame


@dataclass(frozen=True, slots=True, eq=False)
class KeyFigures:
    """A run in a few numbers; NaN where it cannot be told.

    Attributes
    ----------
    duration_s : float
        From the first to the last frame.
    n_frames, n_frames_dropped, n_poses : int
        Frame records; frames missing between them; frames with an optical pose.
    frame_period_ns : float
    dropouts_ns : ndarray of int64, shape (k, 2)
        First and last instant without an optical pose, between the first and the last one.
    impacts_ns : ndarray of int64, shape (k,)
    residual_rms_px : float
        Distance between seen and predicted LED, root mean square over LEDs used.
    peak_mm, peak_deg : ndarray, shape (3,)
        Largest magnitude of displacement and of the rotation vector from rest, brick axes at rest.
    peak_speed_mmps : float
    sd_mm, sd_deg : ndarray, shape (3,)
        Median standard deviation of the poses: x, y, z in camera axes, rotation in brick axes.
    n_imu, n_imu_unusable : int
    """

    duration_s: float
    n_frames: int
    n_frames_dropped: int
    n_poses: int
    frame_period_ns: float
    dropouts_ns: IntArray
    impacts_ns: IntArray
    residual_rms_px: float
    peak_mm: FloatArray
    peak_deg: FloatArray
    peak_speed_mmps: float
    sd_mm: FloatArray
    sd_deg: FloatArray
    n_imu: int
    n_imu_unusable: int


def main_track(result: RunResult) -> FusedTrack | None:
    """Return the fused motion on the densest even grid: sensor slots, else frames, else `None`."""
    return result.fused.get("imu") or result.fused.get("frame")


def key_figures(result: RunResult) -> KeyFigures:
    """Return the run's key figures."""
    optical = result.optical
    stamps = result.observations.sensor_timestamp_ns
    steps = np.diff(stamps)
    period_ns = float(np.median(steps)) if steps.size else float("nan")
    missing = np.rint(steps[steps > GAP_PERIODS * period_ns] / period_ns).astype(np.int64) - 1
    has_pose = np.asarray(np.isfinite(optical.t_camera_brick_mm).all(axis=1))
    track = main_track(result)
    if track is None:
        R, t_mm, covariance = optical.R_camera_brick, optical.t_camera_brick_mm, optical.covariance
        speed = np.empty(0)
    else:
        inside = track.flags & int(PoseFlag.EXTRAPOLATED | PoseFlag.NO_POSE) == 0
        R, t_mm = track.R_camera_brick[inside], track.t_camera_brick_mm[inside]
        covariance = track.covariance[inside]
        speed = np.linalg.norm(track.v_camera_mmps[inside], axis=1)
    peak_mm = peak_deg = np.full(3, np.nan)
    if result.rest is not None:
        moved = result.rest.relative(R, t_mm)
        peak_mm = _largest(moved.t_mm)
        peak_deg = _largest(np.rad2deg(rvec_from_matrix(moved.R)))
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    median_sd = (
        np.median(sd[np.isfinite(sd).all(axis=1)], axis=0) if np.isfinite(sd).any() else np.full(6, np.nan)
    )
    squares = np.sum(optical.residual_px**2, axis=2)
    squares = squares[np.isfinite(squares)]
    speed = speed[np.isfinite(speed)]
    impacts = np.empty(0, dtype=np.int64)
    if track is not None:
        impacts = (
            _intervals(track.t_ns, track.flags & int(PoseFlag.IMPACT) != 0).mean(axis=1).astype(np.int64)
        )
    return KeyFigures(
        duration_s=float((stamps[-1] - stamps[0]) / 1e9) if len(stamps) else 0.0,
        n_frames=len(stamps),
        n_frames_dropped=int(missing.sum()),
        n_poses=int(has_pose.sum()),
        frame_period_ns=period_ns,
        dropouts_ns=_without_pose(optical.t_ns, has_pose, period_ns),
        impacts_ns=impacts,
        residual_rms_px=float(np.sqrt(squares.mean())) if squares.size else float("nan"),
        peak_mm=peak_mm,
        peak_deg=peak_deg,
        peak_speed_mmps=float(speed.max()) if speed.size else float("nan"),
        sd_mm=median_sd[3:],
        sd_deg=np.rad2deg(median_sd[:3]),
        n_imu=0 if result.imu is None else len(result.imu.t_ns),
        n_imu_unusable=0 if result.imu is None else int(np.count_nonzero(result.imu.flags & int(UNUSABLE))),
    )


def verdict(result: RunResult, figures: KeyFigures) -> tuple[str, list[str]]:
    """Return one line on the run, and every problem in words, the gravest first."""
    problems = list(result.problems)
    if figures.n_poses == 0:
        problems.insert(0, "no pose could be had from any frame")
    elif not result.fused:
        problems.insert(0, "no fused motion: the poses are from the camera alone")
    if result.rest is None:
        problems.append("no rest pose: displacements from rest are not given")
    if result.edge_fit is not None:
        problems += [p for p in result.edge_fit.problems() if p not in problems]
    share = figures.n_poses / figures.n_frames if figures.n_frames else 0.0
    tracked = f"{figures.n_poses} of {figures.n_frames} frames gave a pose ({100 * share:.1f} %)"
    if not figures.n_poses:
        line = "Not usable"
    elif problems:
        points = "1 point" if len(problems) == 1 else f"{len(problems)} points"
        line = f"Usable with care: {tracked}; {points} to read first"
    else:
        line = f"No problem found: {tracked}"
    return line + ".", problems


def pose_flag_counts(flags: IntArray) -> dict[PoseFlag, int]:
    """Return how often each `PoseFlag` bit is set."""
    return {f: int(np.count_nonzero(flags & int(f))) for f in PoseFlag if int(f)}


def led_flag_counts(flags: IntArray) -> dict[LedFlag, int]:
    """Return how often each `LedFlag` bit is set."""
    return {f: int(np.count_nonzero(flags & int(f))) for f in LedFlag if int(f)}


def _without_pose(t_ns: IntArray, has_pose: BoolArray, period_ns: float) -> IntArray:
    """Return the times between poses that are further apart than one and a half frame periods."""
    seen = t_ns[has_pose]
    if seen.size < 2:
        return np.empty((0, 2), dtype=np.int64)
    far = np.flatnonzero(np.diff(seen) > GAP_PERIODS * period_ns)
    return np.stack([seen[far], seen[far + 1]], axis=1)


def _intervals(t_ns: IntArray, mask: BoolArray) -> FloatArray:
    """Return first and last instant of each stretch of set samples, shape (k, 2)."""
    edges = np.diff(np.concatenate([[0], mask.astype(np.int8), [0]]))
    first, last = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1
    # Half the sum of two times of hours stays exact in float64 to better than a microsecond.
    return np.stack([t_ns[first], t_ns[last]], axis=1).astype(np.float64)


def _largest(values: FloatArray) -> FloatArray:
    known = values[np.isfinite(values).all(axis=1)]
    return np.abs(known).max(axis=0) if len(known) else np.full(3, np.nan)
