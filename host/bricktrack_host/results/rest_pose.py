"""The rest pose: where the brick stood while nothing moved, from which displacements are counted (tare)."""

from bisect import insort
from dataclasses import dataclass, replace
from math import dist
from typing import Literal

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.errors import TrackingError
from bricktrack_common.poses import Pose
from bricktrack_common.rotations import matrix_from_rvec, rvec_from_matrix, skew
from bricktrack_host.results.ray_errors import RayErrors
from bricktrack_host.tracks import FusedTrack, ImuTrack, OpticalTrack

MIN_FRAMES = 4  # three steps: a vibrating brick stands still for one step at its turning point, not for three
_STILL_MM = 0.05  # steps below this are rest whatever the covariance promises
_STILL_RAD = np.deg2rad(0.05)
_STILL_GYRO_RADPS = np.deg2rad(1.0)
_STILL_ACC_MPS2 = 0.5
_N_SD = 5.0
_N_IN_A_ROW = 3
_AT_ONCE = 1 << 14  # poses, whose covariances are worked on together


@dataclass(frozen=True, slots=True, eq=False)
class FromRest:
    """Poses of a track as seen from rest, in the brick's axes at rest.

    Attributes
    ----------
    R : ndarray, shape (n, 3, 3)
    t_mm : ndarray, shape (n, 3), mm
    covariance : ndarray, shape (n, 6, 6)
        Of ``[dtheta rad, dt mm]``, with the rest pose's own; see `RestPose.relative_covariance`.
    """

    R: FloatArray
    t_mm: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class RestPose:
    """The brick's pose at rest.

    Attributes
    ----------
    R_camera_rest : ndarray, shape (3, 3)
        Takes the brick's axes at rest to camera axes.
    t_camera_rest_mm : ndarray, shape (3,), mm, camera frame
    interval_ns : (int, int), CLOCK_MONOTONIC of the unit
        First and last frame instant that was used.
    n_frames : int
        Frames that the mean is of.
    spread_mm, spread_rad : ndarray, shape (3,)
        Standard deviation of single frames about the mean: position in camera axes, rotation in brick axes.
    covariance : ndarray, shape (6, 6)
        Of the error ``[dtheta rad, dt mm]`` of the mean, as far as poses seen from it do not share it.
    source : "found" or "given"
        Whether the interval was found by stillness or told.
    ray_errors : RayErrors or None
        What the covariance of the run's poses holds of its calibration's rays, taken about this pose.
    """

    R_camera_rest: FloatArray
    t_camera_rest_mm: FloatArray
    interval_ns: tuple[int, int]
    n_frames: int
    spread_mm: FloatArray
    spread_rad: FloatArray
    covariance: FloatArray
    source: Literal["found", "given"]
    ray_errors: RayErrors | None = None

    def from_rest(
        self, track: OpticalTrack | FusedTrack, *, covariance: FloatArray | None = None
    ) -> FromRest:
        """Return the poses of a track as seen from this one; their covariance is worked out if not known."""
        R, t_mm = track.R_camera_brick, track.t_camera_brick_mm
        if covariance is None:
            with_rest = track.with_rest if isinstance(track, FusedTrack) else None
            covariance = self.relative_covariance(R, t_mm, track.covariance, with_rest=with_rest)
        return FromRest(*self._seen_from_rest(R, t_mm), covariance)

    def relative(self, R_camera_brick: FloatArray, t_camera_brick_mm: FloatArray) -> Pose:
        """Return the pose of the brick seen from its own rest pose, in the brick's axes at rest.

        Parameters
        ----------
        R_camera_brick : ndarray, shape (..., 3, 3)
        t_camera_brick_mm : ndarray, shape (..., 3), mm
        """
        return Pose(*self._seen_from_rest(R_camera_brick, t_camera_brick_mm))

    def _seen_from_rest(
        self, R_camera_brick: FloatArray, t_camera_brick_mm: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        R_rest_camera = self.R_camera_rest.T
        return R_rest_camera @ R_camera_brick, (t_camera_brick_mm - self.t_camera_rest_mm) @ R_rest_camera.T

    def relative_covariance(
        self,
        R_camera_brick: FloatArray,
        t_camera_brick_mm: FloatArray,
        covariance: FloatArray,
        *,
        with_rest: FloatArray | None = None,
    ) -> FloatArray:
        """Return the covariance, shape (n, 6, 6), of poses seen from rest: theirs and the mean's there.

        What both share drops out, and so does what the calibration's rays do to both alike; what differs
        stays. All are of ``[dtheta rad, dt mm]``. With ``D = X_rest^-1 X``:
        dtheta = dtheta_X - R_D' dtheta_rest and dt = R_rest' (dt_X - dt_rest) + [t_D]x dtheta_rest.

        Parameters
        ----------
        R_camera_brick : ndarray, shape (n, 3, 3)
        t_camera_brick_mm : ndarray, shape (n, 3), mm
        covariance : ndarray, shape (n, 6, 6)
            Of these poses in the camera frame.
        with_rest : ndarray, shape (n, 6, 6), optional
            Of their errors with that of the mean at rest; none: nothing is shared.
        """
        total = np.empty((len(covariance), 6, 6))
        for start in range(0, len(total), _AT_ONCE):
            now = slice(start, start + _AT_ONCE)
            shared = np.zeros((6, 6)) if with_rest is None else with_rest[now]
            total[now] = self._covariance_of(
                R_camera_brick[now], t_camera_brick_mm[now], covariance[now], shared
            )
        return total

    def _covariance_of(
        self,
        R_camera_brick: FloatArray,
        t_camera_brick_mm: FloatArray,
        covariance: FloatArray,
        with_rest: FloatArray,
    ) -> FloatArray:
        """Return the same as `relative_covariance` of not too many poses: it takes 2 kB for each."""
        turned, moved_mm = self._seen_from_rest(R_camera_brick, t_camera_brick_mm)
        of_pose, of_rest = np.zeros((6, 6)), np.zeros((len(turned), 6, 6))
        of_pose[:3, :3], of_pose[3:, 3:] = np.eye(3), self.R_camera_rest.T
        of_rest[:, :3, :3], of_rest[:, 3:, :3] = -np.swapaxes(turned, 1, 2), skew(moved_mm)
        of_rest[:, 3:, 3:] = -self.R_camera_rest.T
        # Of all rows at once: products of six by six one by one take three times as long.
        half = (of_rest.reshape(-1, 6) @ (0.5 * self.covariance)).reshape(-1, 6, 6) + of_pose @ with_rest
        total = half @ np.swapaxes(of_rest, 1, 2)
        total += np.swapaxes(total, 1, 2).copy()
        half = np.swapaxes((covariance.reshape(-1, 6) @ of_pose.T).reshape(-1, 6, 6), 1, 2)
        total += (half.reshape(-1, 6) @ of_pose.T).reshape(-1, 6, 6)
        if self.ray_errors is not None:
            total += self.ray_errors.change_from_there(R_camera_brick, t_camera_brick_mm)
        return np.asarray(total)


def rest_of_fused(rest: RestPose, frames: FusedTrack, optical: OpticalTrack) -> RestPose:
    """Return the rest pose of a motion that takes out errors which the optical poses keep: its own mean.

    Where it does not reach the rest it is counted from the optical rest pose, as unsure as one optical pose.
    All covariances are still without what the calibration's rays do, which is not for each pose by itself.

    Parameters
    ----------
    rest : RestPose
        Of the optical poses.
    frames : FusedTrack
        The motion at the instants of the optical poses.
    optical : OpticalTrack
    """
    t_mm, first, last = frames.t_camera_brick_mm, *rest.interval_ns
    inside = (frames.t_ns >= first) & (frames.t_ns <= last)
    known = np.flatnonzero(inside & np.isfinite(t_mm).all(axis=1))
    if frames.with_rest is None or len(known) < MIN_FRAMES:
        at_rest = (optical.t_ns >= first) & (optical.t_ns <= last)
        of_one = np.nanmean(optical.covariance[at_rest], axis=0)
        return replace(rest, covariance=rest.covariance + of_one)
    own = _mean_pose(frames, known, rest.source)
    return replace(own, covariance=own.covariance + frames.covariance[known].mean(axis=0))


def tare(
    optical: OpticalTrack,
    imu: ImuTrack | None = None,
    *,
    interval_ns: tuple[int, int] | None = None,
) -> RestPose:
    """Return the robust mean pose over the quiet interval before the shake.

    Without ``interval_ns`` the interval is the first in which the optical pose stands still from frame to
    frame for at least four frames, ended where the pose leaves the interval's median, or where the gyroscope
    or the accelerometer begin to move.

    Parameters
    ----------
    optical : OpticalTrack
    imu : ImuTrack, optional
        Stamped on the camera's time. Sees the beginning of the shake earlier than the camera.
    interval_ns : (int, int), optional
        First and last instant to use, CLOCK_MONOTONIC of the unit.

    Raises
    ------
    TrackingError
        If no interval is quiet, or the one given holds fewer than four poses.
    """
    has_position = np.isfinite(optical.t_camera_brick_mm).all(axis=1)
    valid = np.asarray(has_position & np.isfinite(optical.R_camera_brick).all(axis=(1, 2)))
    if interval_ns is not None:
        first, last = interval_ns
        chosen = valid & (optical.t_ns >= first) & (optical.t_ns <= last)
        if np.count_nonzero(chosen) < MIN_FRAMES:
            raise TrackingError(
                f"rest interval {first}..{last} ns holds {np.count_nonzero(chosen)} poses; expected at least "
                f"{MIN_FRAMES}. Choose an interval in which the brick stands still and is seen"
            )
        return _mean_pose(optical, np.flatnonzero(chosen), "given")
    frames = _first_still_frames(optical, valid)
    if imu is not None and frames.size:
        onset_ns = _inertial_onset_ns(imu, optical.t_ns[frames])
        if onset_ns is not None:
            frames = frames[optical.t_ns[frames] < onset_ns]
    if frames.size < MIN_FRAMES:
        raise TrackingError(
            f"no rest before the shake: the brick never stood still for {MIN_FRAMES} frames in a row. "
            "Start the recording earlier, or give the interval in which it rests"
        )
    return _mean_pose(optical, frames, "found")


def _first_still_frames(optical: OpticalTrack, valid: BoolArray) -> IntArray:
    """Return the indices of the first frames that stand still; empty where none do."""
    index = np.flatnonzero(valid)
    if index.size < MIN_FRAMES:
        return np.empty(0, dtype=np.int64)
    t_mm = optical.t_camera_brick_mm[index]
    R = optical.R_camera_brick[index]
    sd_mm, sd_rad = _pose_sd(optical.covariance[index])
    step_mm = np.linalg.norm(np.diff(t_mm, axis=0), axis=1)
    step_rad = np.linalg.norm(rvec_from_matrix(np.swapaxes(R[:-1], -1, -2) @ R[1:]), axis=1)
    limit_mm = np.maximum(_STILL_MM, _N_SD * np.hypot(sd_mm[:-1], sd_mm[1:]))
    limit_rad = np.maximum(_STILL_RAD, _N_SD * np.hypot(sd_rad[:-1], sd_rad[1:]))
    still = (step_mm < limit_mm) & (step_rad < limit_rad)
    edges = np.diff(np.concatenate([[0], still.astype(np.int8), [0]]))
    for start, stop in zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True):
        run = slice(start, stop + 1)
        if stop + 1 - start < MIN_FRAMES:
            continue
        # A slow start drifts off in small steps: end where the pose leaves the median of what came before.
        turns_rad = rvec_from_matrix(R[start].T @ R[run])
        keep = min(
            _n_near_median(t_mm[run], np.maximum(_STILL_MM, _N_SD * sd_mm[run])),
            _n_near_median(turns_rad, np.maximum(_STILL_RAD, _N_SD * sd_rad[run])),
        )
        return np.asarray(index[run][:keep])
    return np.empty(0, dtype=np.int64)


def _n_near_median(vectors: FloatArray, limits: FloatArray) -> int:
    """Return how many vectors, (n, 3), come before one that is off the median of all before by its limit."""
    before = [sorted(column) for column in vectors[:MIN_FRAMES].T.tolist()]
    rows, allowed = vectors.tolist(), limits.tolist()
    for n in range(MIN_FRAMES, len(rows)):
        median = [0.5 * (ordered[n // 2] + ordered[(n - 1) // 2]) for ordered in before]
        if dist(rows[n], median) > allowed[n]:
            return n
        for ordered, value in zip(before, rows[n], strict=True):
            insort(ordered, value)
    return len(rows)


def _inertial_onset_ns(imu: ImuTrack, frames_ns: IntArray) -> int | None:
    """Return when the inertial sensor begins to move within the span of the frames."""
    span = (imu.t_ns <= frames_ns[-1]) & np.isfinite(imu.gyro_radps).all(axis=1)
    span &= np.isfinite(imu.acc_mps2).all(axis=1)
    inside = np.flatnonzero(span)
    # The noise is that of the first half of what can be rest.
    head = inside[: max(len(inside) // 2, 8)]
    if head.size < 8:
        return None
    moving = np.zeros(inside.size, dtype=np.bool_)
    for values, floor in ((imu.gyro_radps, _STILL_GYRO_RADPS), (imu.acc_mps2, _STILL_ACC_MPS2)):
        centre = np.median(values[head], axis=0)
        sd = 1.4826 * np.median(np.abs(values[head] - centre), axis=0)
        moving |= (np.abs(values[inside] - centre) > np.maximum(floor, _N_SD * sd)).any(axis=1)
    in_a_row = np.convolve(moving, np.ones(_N_IN_A_ROW), "valid") == _N_IN_A_ROW
    begins = inside[np.flatnonzero(in_a_row)]
    begins = begins[imu.t_ns[begins] >= frames_ns[0]]
    return int(imu.t_ns[begins[0]]) if begins.size else None


def _mean_pose(
    track: OpticalTrack | FusedTrack, frames: IntArray, source: Literal["found", "given"]
) -> RestPose:
    """Return the mean of poses, without those beyond five robust deviations of the median.

    How unsure it is the means of each quarter of the time say: a brick that creeps has no one rest pose.
    """
    t_mm = track.t_camera_brick_mm[frames]
    R = track.R_camera_brick[frames]
    R_start = R[len(R) // 2]
    turns_rad = rvec_from_matrix(R_start.T @ R)
    keep = np.ones(len(frames), dtype=np.bool_)
    for values, floor in ((t_mm, 1e-3), (turns_rad, 1e-5)):
        off = np.abs(values - np.median(values, axis=0))
        keep &= (off <= np.maximum(_N_SD * 1.4826 * np.median(off, axis=0), floor)).all(axis=1)
    if np.count_nonzero(keep) < MIN_FRAMES:
        keep[:] = True
    used = frames[keep]
    mean_turn_rad = turns_rad[keep].mean(axis=0)
    quarters = np.array_split(np.concatenate([turns_rad[keep], t_mm[keep]], axis=1), 4)
    variance = np.var([quarter.mean(axis=0) for quarter in quarters], axis=0, ddof=1)
    return RestPose(
        R_camera_rest=R_start @ matrix_from_rvec(mean_turn_rad),
        t_camera_rest_mm=t_mm[keep].mean(axis=0),
        interval_ns=(int(track.t_ns[used[0]]), int(track.t_ns[used[-1]])),
        n_frames=int(used.size),
        spread_mm=t_mm[keep].std(axis=0, ddof=1),
        spread_rad=turns_rad[keep].std(axis=0, ddof=1),
        covariance=np.diag(variance),
        source=source,
    )


def _pose_sd(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the deviations of position, mm, and rotation, rad, as one number a frame each; 0 for NaN."""
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    sd_mm = np.sqrt(np.maximum(variance[:, 3:].sum(axis=1), 0))
    sd_rad = np.sqrt(np.maximum(variance[:, :3].sum(axis=1), 0))
    return np.nan_to_num(sd_mm), np.nan_to_num(sd_rad)
