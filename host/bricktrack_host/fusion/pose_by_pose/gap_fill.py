"""Long gaps of the inertial samples, filled by what the camera saw meanwhile.

Where samples are missing for several periods, no curve through those beside the gap says what the brick did.
The optical poses do, to a degree that the run tells: the same prediction, made where there are samples, is
compared with them, and what they differ by is the noise of the fill.
"""

import numpy as np
from scipy.ndimage import uniform_filter1d

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.errors import TrackingError
from bricktrack_host.fusion.clocks.time_alignment import TimeAlignment, has_pose
from bricktrack_host.fusion.inertial.imu_samples import (
    BRIDGE_PERIODS,
    CleanSamples,
    Fill,
    fill_instants,
)
from bricktrack_host.fusion.optical.optical_smoothing import smooth_optical
from bricktrack_host.quality import PoseFlag
from bricktrack_host.tracks import FusedTrack, OpticalTrack

_ASIDE_NS = 3_000_000  # for the change of velocity: small beside a frame period, large beside rounding
_BESIDE_S = 1.0
_MIN_POSES = 3
_MIN_COMPARED = 50
_COUNTED_TWICE = 2.0
"""The frames in a gap count by themselves too, and what two say in part the same is believed half as much
(covariance intersection: S. J. Julier, J. K. Uhlmann, Proc. American Control Conference 1997)."""
_UNSEEN = int(PoseFlag.NO_POSE | PoseFlag.DROPOUT | PoseFlag.EXTRAPOLATED)


def fill_of_gaps(
    optical: OpticalTrack, samples: CleanSamples, alignment: TimeAlignment, lever_arm_m: FloatArray
) -> Fill | None:
    """Return what the samples missing in long gaps would have said, by the optical poses alone.

    Only gaps through which the camera saw the brick are filled; none: there are no such gaps, or too few
    samples beside them to tell how good the fill is.

    Parameters
    ----------
    optical : OpticalTrack
        Of a camera that stands still.
    samples : CleanSamples
    alignment : TimeAlignment
    lever_arm_m : ndarray, shape (3,), m, brick axes
        From the origin LED to the IMU.

    Notes
    -----
    Biases, gravity and the accelerometer's lag are those that fit the samples best. The noise is that of the
    mean error over a frame period, for what alternates faster is gone once integrated to the next frame.
    """
    period_s = float(np.median(np.diff(samples.t_s)))
    before = np.flatnonzero(np.diff(samples.t_s) > BRIDGE_PERIODS * period_s)
    if not before.size or np.count_nonzero(has_pose(optical)) < _MIN_POSES:
        return None
    spans = np.stack([samples.t_s[before], samples.t_s[before + 1]], axis=1)
    t_s = np.concatenate([samples.t_s, *(fill_instants(a, b, period_s) for a, b in spans.tolist())])
    order = np.argsort(t_s)
    t_s, is_sample = t_s[order], order < len(samples.t_s)
    try:
        gyro, R, acc_camera, is_seen = _by_optics(
            optical, _camera_ns(alignment, samples.epoch_ns, t_s), lever_arm_m
        )
    except TrackingError:  # it turns too far to be smoothed without samples
        return None
    spans = spans[[bool(is_seen[_within(t_s, span[None])].all()) for span in spans]]
    compared = is_sample & is_seen
    if not len(spans) or compared.sum() < _MIN_COMPARED:
        return None
    gyro_felt, acc_felt = samples.gyro_radps[order[compared]], samples.acc_mps2[order[compared]]
    gyro += np.median(gyro_felt - gyro[compared], axis=0)
    acc = _as_felt(t_s, R, acc_camera, compared, acc_felt)
    beside = _within(t_s[compared], spans + np.array([-_BESIDE_S, _BESIDE_S]))
    n_mean = max(round(float(np.median(np.diff(optical.t_ns))) * 1e-9 / period_s), 1)
    density_s = _COUNTED_TWICE * n_mean * period_s
    wanted = _within(t_s, spans)
    return Fill(
        t_s=t_s[wanted],
        gyro_radps=gyro[wanted],
        acc_mps2=acc[wanted],
        spans_s=spans,
        gyro_density=_mean_square(gyro_felt - gyro[compared], n_mean, beside) * density_s,
        acc_density=_mean_square(acc_felt - acc[compared], n_mean, beside) * density_s,
    )


def _within(t_s: FloatArray, spans_s: FloatArray) -> BoolArray:
    """Return which instants lie in one of the spans, their ends left out."""
    return np.asarray(((t_s > spans_s[:, :1]) & (t_s < spans_s[:, 1:])).any(axis=0))


def _camera_ns(alignment: TimeAlignment, epoch_ns: int, t_s: FloatArray) -> IntArray:
    """Return camera time of seconds of the samples; what the offset changes over itself is below 1 ns."""
    t_ns = epoch_ns + np.round(t_s * 1e9).astype(np.int64)
    return np.asarray(2 * t_ns - alignment.imu_time_ns(t_ns))


def _mean_square(error: FloatArray, n_mean: int, beside: BoolArray) -> float:
    """Return the mean square, an axis, of running means of an error: of the run, or near the gaps if more."""
    square = (uniform_filter1d(error, n_mean, axis=0) ** 2).mean(axis=1)
    return max(float(square.mean()), float(square[beside].mean()) if beside.any() else 0.0)


def _by_optics(
    optical: OpticalTrack, t_ns: IntArray, lever_arm_m: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Return angular rate, attitude, acceleration of the IMU in camera axes, and when the camera saw it."""
    n = len(t_ns)
    around = np.concatenate([t_ns, t_ns - _ASIDE_NS, t_ns + _ASIDE_NS])
    track = smooth_optical(optical, around)
    v_mps = _imu_velocity(track, lever_arm_m)
    acc = (v_mps[2 * n :] - v_mps[n : 2 * n]) / (2e-9 * _ASIDE_NS)
    is_seen = ((track.flags & _UNSEEN) == 0).reshape(3, n).all(axis=0)
    return track.omega_brick_radps[:n].copy(), track.R_camera_brick[:n], acc, is_seen


def _imu_velocity(track: FusedTrack, lever_arm_m: FloatArray) -> FloatArray:
    aside = np.cross(track.omega_brick_radps, lever_arm_m)
    v_mps = 1e-3 * track.v_camera_mmps + np.einsum("nij,nj->ni", track.R_camera_brick, aside)
    return np.asarray(v_mps)


def _as_felt(
    t_s: FloatArray, R: FloatArray, acc_camera_mps2: FloatArray, compared: BoolArray, acc_seen: FloatArray
) -> FloatArray:
    """Return the specific force of a motion as the accelerometer gives it: its axes, bias and lag."""
    R_back = np.swapaxes(R, 1, 2)
    moving = np.einsum("nij,nj->ni", R_back, acc_camera_mps2)
    against = np.median(np.einsum("nij,nj->ni", R[compared], acc_seen - moving[compared]), axis=0)
    force = moving + R_back @ against
    force += np.median(acc_seen - force[compared], axis=0)
    rate = np.nan_to_num(np.gradient(force, t_s, axis=0))  # unknown beside what the camera did not see
    size = float((rate[compared] ** 2).sum())
    lag_s = float((rate[compared] * (acc_seen - force[compared])).sum()) / size if size > 0 else 0.0
    return np.asarray(force + lag_s * rate)
