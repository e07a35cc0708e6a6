"""What a run amounts to: key figures and a verdict in plain words, for the report and the command line."""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.imu_records import UNUSABLE
from bricktrack_common.rotations import rvec_from_matrix
from bricktrack_host.quality import PoseFlag
from bricktrack_host.results.result_store import RunResult
from bricktrack_host.results.result_tables import FusedKind
from bricktrack_host.tracks import FusedTrack

MUCH_DROPPED = 0.01  # of the frames; one now and then harms nothing
POOR_RESIDUAL_PX = 0.3  # several times what centroids of sharp dots and LEDs scatter, about 0.06 px
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
        Times between optical poses further apart than one and a half frame periods, and times that the
        fusion flags as dropouts because it did not believe the poses there.
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


def main_kind(result: RunResult) -> FusedKind | None:
    """Return which fused motion is on the densest even grid: of sensor slots, else of frames, else `None`."""
    kinds: tuple[FusedKind, ...] = ("imu", "frame")
    return next((kind for kind in kinds if kind in result.fused), None)


def main_track(result: RunResult) -> FusedTrack | None:
    """Return the fused motion of `main_kind`."""
    kind = main_kind(result)
    return None if kind is None else result.fused[kind]


def imu_camera_time_ns(result: RunResult) -> IntArray:
    """Return when the inertial samples were taken, on the camera's time.

    Older results do not say it: by the offset between both clocks, if one was found.
    """
    if result.imu is None:
        return np.empty(0, dtype=np.int64)
    if result.imu_camera_t_ns is not None:
        return result.imu_camera_t_ns
    offset_ms = result.alignment.get("offset_ms")
    offset_ns = round(offset_ms * 1e6) if isinstance(offset_ms, int | float) else 0
    return np.asarray(result.imu.t_ns - offset_ns)


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
        inside, covariance = np.ones(len(optical.t_ns), dtype=np.bool_), optical.covariance
        speed = np.empty(0)
    else:
        inside = track.flags & int(PoseFlag.EXTRAPOLATED | PoseFlag.NO_POSE) == 0
        covariance = track.covariance[inside]
        speed = np.linalg.norm(track.v_camera_mmps[inside], axis=1)
    peak_mm = peak_deg = np.full(3, np.nan)
    if (moved := result.from_rest.get(main_kind(result) or "optical")) is not None:
        peak_mm = _largest(moved.t_mm[inside])
        peak_deg = _largest(np.rad2deg(rvec_from_matrix(moved.R[inside])))
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    median_sd = (
        np.median(sd[np.isfinite(sd).all(axis=1)], axis=0) if np.isfinite(sd).any() else np.full(6, np.nan)
    )
    squares = np.sum(optical.residual_px**2, axis=2)
    squares = squares[np.isfinite(squares)]
    speed = speed[np.isfinite(speed)]
    impacts = np.empty(0, dtype=np.int64)
    dropouts_ns = _without_pose(optical.t_ns, has_pose, period_ns)
    if track is not None:
        unbelieved = _intervals(track.t_ns, track.flags & int(PoseFlag.DROPOUT) != 0)
        dropouts_ns = _merged(np.concatenate([dropouts_ns, unbelieved]))
        struck = _intervals(track.t_ns, track.flags & int(PoseFlag.IMPACT) != 0)
        impacts = struck[:, 0] + (struck[:, 1] - struck[:, 0]) // 2
    return KeyFigures(
        duration_s=float((stamps[-1] - stamps[0]) / 1e9) if len(stamps) else 0.0,
        n_frames=len(stamps),
        n_frames_dropped=int(missing.sum()),
        n_poses=int(has_pose.sum()),
        frame_period_ns=period_ns,
        dropouts_ns=dropouts_ns,
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
    problems += _flag_problems(result, figures)
    if result.rest is None:
        problems.append("no rest pose: displacements from rest are not given")
    if result.edge_fit is not None:
        problems += [p for p in result.edge_fit.problems() if not any(p in said for said in problems)]
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


def _flag_problems(result: RunResult, figures: KeyFigures) -> list[str]:
    """Return in words what the flags and residuals say of the run as a whole."""
    flags = result.optical.flags

    def count(bit: PoseFlag) -> int:
        return int(np.count_nonzero(flags & int(bit)))

    found = []
    if figures.residual_rms_px > POOR_RESIDUAL_PX:
        found.append(
            f"LEDs lie {figures.residual_rms_px:.2f} px rms from where the poses put them, where 0.1 px is "
            "usual: check the layout, the calibration and the LED profile. 'bricktrack calibrate leds "
            "--positions' finds where the LEDs sit"
        )
    n_expected = figures.n_frames + figures.n_frames_dropped
    if figures.n_frames_dropped > MUCH_DROPPED * n_expected:
        found.append(
            f"the camera dropped {figures.n_frames_dropped} of {n_expected} frames: the motion between them "
            "is the inertial sensor's alone. 'bricktrackd check' on the unit tells whether it keeps up"
        )
    if count(PoseFlag.LED_PROFILE_UNKNOWN):
        found.append(
            "the layout file holds no profile of these LEDs: their shape was fitted to this run alone, where "
            "it told one, and a bias of some 0.1 mm is possible. Run 'bricktrack calibrate leds'"
        )
    if n := count(PoseFlag.UNCOVERED):
        found.append(f"{n} poses use rays where the calibration had no dots and extrapolates")
    if n := count(PoseFlag.AMBIGUOUS):
        found.append(f"in {n} frame{'' if n == 1 else 's'} more than one pose fitted; none is given there")
    if n := count(PoseFlag.UNVERIFIED):
        found.append(f"in {n} frame{'' if n == 1 else 's'} too few LEDs were seen to check which is which")
    track = main_track(result)
    if track is not None and (n := int(np.count_nonzero(track.flags & int(PoseFlag.CLIPPED)))):
        found.append(f"the inertial sensor was at its range limit in {n} samples")
    return found


def _without_pose(t_ns: IntArray, has_pose: BoolArray, period_ns: float) -> IntArray:
    """Return the times between poses that are further apart than one and a half frame periods."""
    seen = t_ns[has_pose]
    if seen.size < 2:
        return np.empty((0, 2), dtype=np.int64)
    far = np.flatnonzero(np.diff(seen) > GAP_PERIODS * period_ns)
    return np.stack([seen[far], seen[far + 1]], axis=1)


def _merged(intervals_ns: IntArray) -> IntArray:
    """Return the union of intervals as intervals in order of time."""
    merged: list[list[int]] = []
    for first, last in sorted(intervals_ns.tolist()):
        if merged and first <= merged[-1][1]:
            merged[-1][1] = max(merged[-1][1], last)
        else:
            merged.append([first, last])
    return np.array(merged, dtype=np.int64).reshape(-1, 2)


def _intervals(t_ns: IntArray, mask: BoolArray) -> IntArray:
    """Return first and last instant of each stretch of set samples, shape (k, 2)."""
    edges = np.diff(np.concatenate([[0], mask.astype(np.int8), [0]]))
    first, last = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1
    return np.stack([t_ns[first], t_ns[last]], axis=1)


def _largest(values: FloatArray) -> FloatArray:
    known = values[np.isfinite(values).all(axis=1)]
    return np.abs(known).max(axis=0) if len(known) else np.full(3, np.nan)
