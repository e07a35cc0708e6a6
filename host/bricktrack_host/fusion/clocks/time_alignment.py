"""One time base for camera and IMU: offset and skew from the rotations that both saw.

Convention (DESIGN 8.2): a frame stamped ``t_o`` by the camera lies at IMU time
``t_o + offset + skew * (t_o - t_mid)``. The offset holds the gyroscope's low-pass lag too.
"""

import logging
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray, as_float_array
from bricktrack_common.errors import ConfigError, TrackingError
from bricktrack_host.fusion.clocks.posed_frames import MIN_POSES, PosedFrames
from bricktrack_host.fusion.clocks.rate_correlation import GRID_S, correlate
from bricktrack_host.fusion.clocks.rotation_fit import Fit, RotationFit, as_likely
from bricktrack_host.fusion.clocks.sample_clock import RATE_SD, SampleClock, find_sample_clock
from bricktrack_host.fusion.inertial.imu_samples import seconds_since
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal
from bricktrack_host.tracks import ImuTrack, OpticalTrack

logger = logging.getLogger(__name__)

_MIN_VECTOR_CORRELATION = 0.4  # noise alone stays below 0.2 over 400 frames
_CLEAR_SPEED_CORRELATION = 0.8
_UNKNOWN_BIAS_RADPS = 0.02  # BNO055 data sheet: zero-rate offset at most 3 deg/s, typically 1
_FILTER_ROUNDS = 2
_FILTER_SIGMA = 2.5
_OWN_REACH_S = 0.03  # from a correlation's maximum: half a period of 16 Hz
MIN_ROTATION_SD_RAD = 1e-5  # a covariance below this is not believed


@dataclass(frozen=True, slots=True, eq=False)
class TimeAlignment:
    """How camera time maps to IMU time, and how well that is known.

    Attributes
    ----------
    offset_ns, offset_sd_ns : float, ns
        IMU time less camera time at ``t_mid_ns``.
    skew, skew_sd : float
        IMU seconds more per camera second.
    t_mid_ns : int, camera time
    gyro_bias_radps, gyro_bias_sd_radps : ndarray, shape (3,), rad/s
    correlation : float
        Of the two angular speeds at the offset; NaN where it could not be formed.
    rotation_residual_sd : float
        Robust sd of optical attitude about the integrated gyro, in units of what the optical covariance says:
        1 where all is as stated; NaN as above.
    source : "data" or "stamps"
        Where offset and skew come from: the motion, or the stamps as configured.
    is_trusted : bool
        Whether offset and skew were measured from the motion, without ambiguity.
    disagrees_with_stamps : bool
        The motion says an offset that the stamps' prior does not allow (beyond four sd).
    reason : str
        Why it is not trusted, or how it disagrees; empty when all is well.
    gyro_filter_s : float, s
        Time constant of the gyroscope's low-pass, were it of second order and critically damped: what the
        optical attitudes say of its amplitudes. Zero where they find none.
    sample_clock : SampleClock or None
        When the sensor truly took its samples, where the stamps of its reads do not say. The IMU time above
        is then that of the samples.
    """

    offset_ns: float
    offset_sd_ns: float
    skew: float
    skew_sd: float
    t_mid_ns: int
    gyro_bias_radps: FloatArray
    gyro_bias_sd_radps: FloatArray
    correlation: float
    rotation_residual_sd: float
    source: Literal["data", "stamps"]
    is_trusted: bool
    disagrees_with_stamps: bool
    reason: str
    gyro_filter_s: float = 0.0
    sample_clock: SampleClock | None = None

    def imu_time_ns(self, t_ns: IntArray) -> IntArray:
        """Return the IMU's time of instants given in camera time."""
        shift = self.offset_ns + self.skew * (t_ns - self.t_mid_ns).astype(np.float64)
        return np.asarray(t_ns + np.round(shift).astype(np.int64))

    def camera_time_ns(self, t_ns: IntArray) -> IntArray:
        """Return camera time of instants given in the IMU's time."""
        since_ns = (t_ns - self.t_mid_ns).astype(np.float64) - self.offset_ns
        return np.asarray(self.t_mid_ns + np.round(since_ns / (1 + self.skew)).astype(np.int64))

    def restamped(self, imu: ImuTrack) -> ImuTrack:
        """Return the samples by the sensor's own clock, in IMU time; as they are where none was found."""
        return imu if self.sample_clock is None else self.sample_clock.restamp(imu)

    def sampled_ns(self, imu: ImuTrack) -> IntArray:
        """Return when each sample was taken, in camera time: a read finds a sample that may be a slot old."""
        return self.camera_time_ns(self.restamped(imu).t_ns)


def has_pose(optical: OpticalTrack) -> BoolArray:
    """Return which frames have a whole pose with a usable covariance."""
    R = as_float_array("R_camera_brick", optical.R_camera_brick, (len(optical.t_ns), 3, 3))
    t = as_float_array("t_camera_brick_mm", optical.t_camera_brick_mm, (len(optical.t_ns), 3))
    cov = as_float_array("covariance", optical.covariance, (len(optical.t_ns), 6, 6))
    diagonal = np.diagonal(cov, axis1=1, axis2=2)
    return np.asarray(
        np.isfinite(R).all(axis=(1, 2))
        & np.isfinite(t).all(axis=1)
        & np.isfinite(cov).all(axis=(1, 2))
        & (diagonal >= 0).all(axis=1)
    )


def posed_frames(optical: OpticalTrack, seen: BoolArray, t_s: FloatArray) -> PosedFrames:
    """Return some frames, all with a pose, for the fits; their times ``t_s`` after the samples' epoch."""
    sd_rad = np.sqrt(np.trace(optical.covariance[seen][:, :3, :3], axis1=1, axis2=2) / 3)
    return PosedFrames(t_s, optical.R_camera_brick[seen], np.maximum(sd_rad, MIN_ROTATION_SD_RAD))


def align_times(
    optical: OpticalTrack,
    imu: ImuTrack,
    *,
    max_offset_s: float = 0.25,
    prior_offset_ns: float = 0.0,
    prior_sd_ns: float = 5e6,
    skew_prior_sd: float = 1e-4,
    max_sd_ns: float = 1e6,
    _is_restamped: bool = False,
) -> TimeAlignment:
    """Return how camera time maps to IMU time, from the rotations that both saw.

    Coarse by correlation of angular rates, then by robust least squares of the optical attitudes against
    the integrated gyro. A motion with too little rotation, or one so periodic that several offsets fit,
    gives back the stamps' prior and says why. A sensor whose own clock beats with the reads has its samples
    put in their place first (`sample_clock`).

    Parameters
    ----------
    optical : OpticalTrack
        Frames without pose (NaN) are passed over.
    imu : ImuTrack
        In brick axes; missing samples NaN.
    max_offset_s : float
        How far from the prior to look.
    prior_offset_ns, prior_sd_ns : float, ns
        What the stamps promise. The prior is only compared with the result, and used where there is none.
    skew_prior_sd : float
        Of the relative rate of the two clocks; crystals hold 1e-4.
    max_sd_ns : float, ns
        A fitted offset less sure than this is not used.

    Returns
    -------
    TimeAlignment

    Raises
    ------
    ConfigError
        If a prior or limit is not positive.
    TrackingError
        If there is no optical pose at all.
    """
    for name, value in (
        ("max_offset_s", max_offset_s),
        ("prior_sd_ns", prior_sd_ns),
        ("skew_prior_sd", skew_prior_sd),
        ("max_sd_ns", max_sd_ns),
    ):
        if not (np.isfinite(value) and value > 0):
            raise ConfigError(f"{name} is {value}; expected a positive number")
    seen = has_pose(optical)
    if not seen.any():
        raise TrackingError(f"none of {seen.size} frames has a pose: there is nothing to align the IMU with")
    t_ns = optical.t_ns[seen]
    t_mid_ns = int(t_ns[0]) + (int(t_ns[-1]) - int(t_ns[0])) // 2
    signal = ImuSignal.from_track(imu)

    def from_stamps(reason: str, fit: Fit | None = None, correlation: float = np.nan) -> TimeAlignment:
        logger.warning("time offset taken from the stamps: %s", reason)
        return TimeAlignment(
            offset_ns=prior_offset_ns,
            offset_sd_ns=prior_sd_ns,
            skew=0.0,
            skew_sd=skew_prior_sd,
            t_mid_ns=t_mid_ns,
            gyro_bias_radps=np.zeros(3) if fit is None else fit.bias_radps,
            gyro_bias_sd_radps=np.full(3, _UNKNOWN_BIAS_RADPS) if fit is None else fit.bias_sd_radps,
            correlation=correlation,
            rotation_residual_sd=np.nan if fit is None else fit.residual_sd,
            source="stamps",
            is_trusted=False,
            disagrees_with_stamps=False,
            reason=reason,
        )

    if seen.sum() < MIN_POSES:
        return from_stamps(f"only {seen.sum()} frames have a pose; {MIN_POSES} are needed")
    # Seconds after the IMU's first sample, frames in camera time: the offset is what lies between.
    frames = posed_frames(optical, seen, seconds_since(t_ns, signal.epoch_ns))
    prior_s = prior_offset_ns * 1e-9
    correlation = correlate(frames.t_s, frames.R, signal, centre_s=prior_s, max_offset_s=max_offset_s)
    solver = RotationFit(frames, signal, skew_prior_sd=skew_prior_sd)
    fits: list[Fit] = []
    for lag in correlation.candidates_s():
        # The first may go where it likes; another that leaves its own maximum comes to one found before.
        if (fit := solver.solve(lag, reach_s=_OWN_REACH_S if fits else np.inf)) is not None:
            fits.append(fit)
    fits = [fit for fit in fits if abs(fit.offset_s - prior_s) <= max_offset_s + GRID_S]
    if not fits:
        return from_stamps("no offset within reach lets the angular rates agree")
    fits.sort(key=lambda fit: fit.residual_sd)
    best = fits[0]
    own = None
    if not _is_restamped:
        own = find_sample_clock(frames, signal, imu, as_read=best)
    if own is not None:
        found = align_times(
            optical,
            own.restamp(imu),
            max_offset_s=max_offset_s,
            prior_offset_ns=prior_offset_ns,
            prior_sd_ns=prior_sd_ns,
            skew_prior_sd=max(skew_prior_sd, RATE_SD),
            max_sd_ns=max_sd_ns,
            _is_restamped=True,
        )
        if found.source == "data":
            return replace(found, sample_clock=own)
    speed, vector = correlation.at(best.offset_s)
    if vector < _MIN_VECTOR_CORRELATION and np.nanmax(correlation.speed) > _CLEAR_SPEED_CORRELATION:
        return from_stamps(
            "the angular speeds agree, their directions do not: the IMU's axes are not the layout file's",
            None,
            float(np.nanmax(correlation.speed)),
        )
    if best.offset_sd_s * 1e9 > max_sd_ns:
        return from_stamps(
            f"too little rotation: the motion tells the offset to {best.offset_sd_s * 1e3:.2g} ms only "
            f"(limit {max_sd_ns * 1e-6:.2g} ms)",
            best,
            speed,
        )
    if vector < _MIN_VECTOR_CORRELATION:
        return from_stamps(
            f"the angular rates do not correlate (speed {speed:.2f}, vector {vector:.2f})", None, speed
        )
    rivals = [f for f in fits[1:] if abs(f.offset_s - best.offset_s) > 0.005 and as_likely(f, best)]
    reason = ""
    if rivals:
        near = [f for f in [best, *rivals] if abs(f.offset_s - prior_s) * 1e9 <= 4 * prior_sd_ns]
        if len(near) != 1:
            told = ", ".join(f"{f.offset_s * 1e3:.1f}" for f in [best, *rivals])
            return from_stamps(f"the motion repeats: offsets of {told} ms fit equally well", None, speed)
        best = near[0]
        reason = "the motion repeats; of the offsets that fit, the one that the stamps allow was taken"
    gyro_filter_s = 0.0
    for _ in range(_FILTER_ROUNDS):
        # Only what stands out of its uncertainty: a filter that is not there shall cost nothing.
        loss_s2 = gyro_filter_s**2 + best.loss_s2
        if loss_s2 < _FILTER_SIGMA * np.sqrt(best.covariance[2, 2]):
            break
        filter_s = float(np.sqrt(loss_s2))
        sharp = ImuSignal.from_track(imu, gyro_filter_s=filter_s)
        again = RotationFit(frames, sharp, skew_prior_sd=skew_prior_sd).solve(best.offset_s)
        if again is None:
            break
        best, gyro_filter_s = again, filter_s
    off = best.offset_s * 1e9 - prior_offset_ns
    disagrees = bool(abs(off) > 4 * np.hypot(prior_sd_ns, best.offset_sd_s * 1e9))
    if disagrees:
        reason = (
            f"the motion puts the offset at {best.offset_s * 1e3:.2f} ms, the stamps at "
            f"{prior_s * 1e3:.2f} ± {prior_sd_ns * 1e-6:.2g} ms"
        )
        logger.warning("%s", reason)
    return TimeAlignment(
        offset_ns=float(best.offset_s * 1e9),
        offset_sd_ns=float(best.offset_sd_s * 1e9),
        skew=best.skew,
        skew_sd=float(np.sqrt(best.covariance[1, 1])),
        t_mid_ns=t_mid_ns,
        gyro_bias_radps=best.bias_radps,
        gyro_bias_sd_radps=best.bias_sd_radps,
        correlation=correlation.at(best.offset_s)[0],
        rotation_residual_sd=float(best.residual_sd),
        source="data",
        is_trusted=True,
        disagrees_with_stamps=disagrees,
        reason=reason,
        gyro_filter_s=gyro_filter_s,
    )
