"""By how much the offset of IMU and camera changes within a run, by the rotations that both saw."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_host.fusion.clocks.posed_frames import MIN_POSES, PosedFrames
from bricktrack_host.fusion.clocks.rotation_errors import RotationErrors
from bricktrack_host.fusion.clocks.rotation_fit import Fit, RotationFit
from bricktrack_host.fusion.clocks.time_alignment import TimeAlignment, has_pose, posed_frames
from bricktrack_host.fusion.inertial.imu_samples import seconds_since
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal
from bricktrack_host.tracks import ImuTrack, OpticalTrack

CLOCK_RATE_SD = 1e-4  # of two crystals against each other
SIGMA = 4.0
_FREE_RATE_SD = 5e-3  # of a sensor's own clock, which a step may have falsified
_FLOOR_S = 0.3e-3  # to which two fits of one offset agree, with all that their sd leave out
_UNKNOWN_S = 0.1
_WANDER_KNOT_S = 0.25
_WANDER_STRETCH_S = 60.0  # looked at by itself: all knots of a run at once would take its length cubed
_WANDER_SD_S = 0.02  # before the run speaks: most of an exposure
_TELLING_S = 1e-3  # a stretch that turns too little to tell the offset as well is left out of the size
_WANDERS_CHI2 = 12.0
"""Over degrees of freedom. In 30 recordings by another renderer it was 8 at most (LEDs a tenth of a
millimetre beside their places), and 18 and 29 where exposures wandered by milliseconds (simulated)."""


@dataclass(frozen=True, slots=True)
class OffsetChange:
    """By how much the offset of IMU and camera differs between two stretches of a run, s, by rotations."""

    change_s: float
    sd_s: float

    @property
    def is_sure(self) -> bool:
        """Whether it is more than chance."""
        return abs(self.change_s) > SIGMA * self.sd_s


def offset_change(
    optical: OpticalTrack,
    imu: ImuTrack,
    alignment: TimeAlignment,
    *,
    split_ns: int,
    from_ns: int,
    to_ns: int,
) -> OffsetChange | None:
    """Return by how much the offset of IMU and camera changes at an instant, by the rotations on both sides.

    Parameters
    ----------
    optical : OpticalTrack
    imu : ImuTrack
        In brick axes.
    alignment : TimeAlignment
        Of the whole run.
    split_ns, from_ns, to_ns : int, ns, camera time
        The instant, and what to look at around it.

    Returns
    -------
    change : OffsetChange or None
        Later less earlier, s; None where the run has no offset by its motion, or one side turns too little.
    """
    if alignment.source != "data":
        return None
    # The skew of the whole run has taken up most of any step: each side begins without.
    alignment = replace(alignment, skew=0.0)
    clock, signal = alignment.sample_clock, signal_of(imu, alignment)
    seen = has_pose(optical) & (optical.t_ns >= from_ns) & (optical.t_ns <= to_ns)
    is_after = optical.t_ns >= split_ns
    rate_sd = CLOCK_RATE_SD if clock is None else _FREE_RATE_SD
    earlier = _offset(optical, alignment, signal, seen & ~is_after, rate_sd)
    later = _offset(optical, alignment, signal, seen & is_after, rate_sd)
    if earlier is None or later is None:
        return None
    change_s, variance_s2 = 0.0, _FLOOR_S**2
    split_s = float(seconds_since(alignment.imu_time_ns(np.array([split_ns])), signal.epoch_ns)[0])
    for sign, (fit, mid_s) in ((-1.0, earlier), (1.0, later)):
        # Each side's own rate carries it to the split.
        at_split = np.array([1.0, split_s - mid_s])
        change_s += sign * float(at_split @ [fit.offset_s, fit.skew])
        variance_s2 += float(at_split @ fit.covariance[:2, :2] @ at_split)
    return OffsetChange(change_s, float(np.sqrt(variance_s2)))


def change_of_halves(errors: RotationErrors) -> OffsetChange | None:
    """Return by how much the offset changes half-way, where either half may have a rate of its own.

    A gyro whose scale or axes are off by a per cent looks like it, where the brick turns far to one side:
    they are free here. ``errors``: of the run, see `errors_of`. None where one half turns too little.
    """
    t_s = errors.frames.t_s
    since_s = t_s - t_s[len(t_s) // 2]
    is_later = (since_s >= 0).astype(np.float64)
    found = errors.time_errors(
        np.stack([np.ones(len(t_s)), since_s, is_later, is_later * since_s], axis=1),
        np.array([_UNKNOWN_S, _FREE_RATE_SD, _UNKNOWN_S, _FREE_RATE_SD]),
    )
    if found is None or found[1][2, 2] > (0.5 * _UNKNOWN_S) ** 2:
        return None
    return OffsetChange(float(found[0][2]), float(np.sqrt(found[1][2, 2] + _FLOOR_S**2)))


@dataclass(frozen=True, slots=True, eq=False)
class OffsetWander:
    """How the offset of IMU and camera wanders over a run.

    Attributes
    ----------
    rms_s : float
        Of what is beside a steady rate, where the motion tells.
    sd_s : ndarray, shape (n_frames,)
        How unsure the instant of each frame is by it.
    """

    rms_s: float
    sd_s: FloatArray


class _Wander(NamedTuple):
    """How far the offset is beside a steady rate at the knots of a stretch, and the chi-square of all."""

    knots_s: FloatArray
    off_s: FloatArray
    variance_s2: FloatArray
    chi2: float


def offset_wander(
    optical: OpticalTrack, alignment: TimeAlignment, errors: RotationErrors
) -> OffsetWander | None:
    """Return how the offset wanders, by the rotations that both saw; None where it does not, or none tells.

    Frames are timed by mid-exposure: an exposure that changes and is not the one stated shifts them by half
    of what it changes by. ``errors``: of the run, see `errors_of`.
    """
    since_ns = optical.t_ns - optical.t_ns[0]
    n_stretches = max(1, round(int(since_ns[-1]) * 1e-9 / _WANDER_STRETCH_S))
    stretch = (since_ns * n_stretches // (since_ns[-1] + 1))[has_pose(optical)]
    rate_sd = CLOCK_RATE_SD if alignment.sample_clock is None else _FREE_RATE_SD
    found = [_wander_of(errors.some(stretch == k), rate_sd) for k in range(n_stretches)]
    told = [one for one in found if one is not None]
    if not told:
        return None
    knots_s, off = np.concatenate([one.knots_s for one in told]), np.concatenate([one.off_s for one in told])
    own = np.concatenate([one.variance_s2 for one in told])
    telling = own < _TELLING_S**2
    freedom = len(knots_s) - len(told)
    if sum(one.chi2 for one in told) < _WANDERS_CHI2 * freedom or not telling.any():
        return None
    rms_s = float(np.sqrt(np.average(off[telling] ** 2, weights=1 / own[telling])))
    sd_s = np.where(telling, np.hypot(off, np.sqrt(own)), rms_s)
    imu_s = seconds_since(alignment.imu_time_ns(optical.t_ns), errors.epoch_ns)
    return OffsetWander(rms_s, np.interp(imu_s, knots_s, sd_s))


def _wander_of(errors: RotationErrors, rate_sd: float) -> _Wander | None:
    """Return how the offset wanders over a stretch of frames; ``rate_sd``: of a steady rate beside it."""
    t_s = errors.frames.t_s
    if len(t_s) < MIN_POSES:
        return None
    n = max(4, round((t_s[-1] - t_s[0]) / _WANDER_KNOT_S) + 1)
    knots_s = np.linspace(t_s[0], t_s[-1], n)
    hats = np.maximum(0.0, 1 - np.abs(t_s[:, None] - knots_s) / (knots_s[1] - knots_s[0]))
    found = errors.time_errors(hats, np.full(n, _WANDER_SD_S))
    if found is None:
        return None
    error, covariance = found
    line = np.stack([np.ones(n), knots_s - knots_s.mean()], axis=1)
    steady = line @ np.diag([_UNKNOWN_S**2, rate_sd**2]) @ line.T
    beside = np.linalg.solve(covariance + steady, error)
    return _Wander(knots_s, error - steady @ beside, np.diagonal(covariance), float(error @ beside))


def signal_of(imu: ImuTrack, alignment: TimeAlignment) -> ImuSignal:
    """Return the samples as a signal, by the sensor's clock and low-pass as they were found."""
    return ImuSignal.from_track(alignment.restamped(imu), gyro_filter_s=alignment.gyro_filter_s)


def errors_of(optical: OpticalTrack, imu: ImuTrack, alignment: TimeAlignment) -> RotationErrors | None:
    """Return the errors of a run's frames against the gyro; None where the motion tells no offset."""
    if alignment.source != "data":
        return None
    signal = signal_of(imu, alignment)
    frames = _in_imu_time(optical, alignment, signal, has_pose(optical))
    clock = alignment.sample_clock
    unsure_ns = imu.t_ns[:0] if clock is None else imu.t_ns[clock.is_between_samples(imu)]
    unsure_s = seconds_since(unsure_ns, signal.epoch_ns)
    return RotationErrors(frames, signal, alignment.gyro_bias_radps, unsure_s)


def _in_imu_time(
    optical: OpticalTrack, alignment: TimeAlignment, signal: ImuSignal, frames: BoolArray
) -> PosedFrames:
    """Return some frames at the IMU's time by the alignment."""
    t_s = seconds_since(alignment.imu_time_ns(optical.t_ns[frames]), signal.epoch_ns)
    return posed_frames(optical, frames, t_s)


def _offset(
    optical: OpticalTrack, alignment: TimeAlignment, signal: ImuSignal, frames: BoolArray, rate_sd: float
) -> tuple[Fit, float] | None:
    """Return what some frames say of the offset beyond the alignment's, and the middle of their times."""
    if not frames.any():
        return None
    # In IMU time by the alignment: what is left to find is zero where it holds.
    posed = _in_imu_time(optical, alignment, signal, frames)
    fit = RotationFit(posed, signal, skew_prior_sd=rate_sd).solve(0.0)
    return None if fit is None else (fit, float(0.5 * (posed.t_s[0] + posed.t_s[-1])))
