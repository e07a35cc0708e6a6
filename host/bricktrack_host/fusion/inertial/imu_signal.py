"""Inertial samples as continuous signals: splines, how far to trust them, and motion between instants.

Times inside are seconds after `ImuSignal.epoch_ns` on the clock of the samples.
"""

from dataclasses import dataclass, replace

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_host.compiled import compiled
from bricktrack_host.fusion.inertial.imu_samples import CleanSamples, clean_samples
from bricktrack_host.fusion.inertial.sampled_vector import GAP_PERIODS, SampledVector
from bricktrack_host.fusion.inertial.signal_kernel import GyroPieces, SignalPieces, integrate_steps
from bricktrack_host.tracks import ImuTrack


@dataclass(frozen=True, slots=True, eq=False)
class Increments:
    """What the samples say of the motion from one instant to another, in body axes at the first.

    Attributes
    ----------
    R : ndarray, shape (n, 3, 3)
        Body at the end seen from body at the start.
    dv_mps, dp_m : ndarray, shape (n, 3)
        Integral, and double integral, of the specific force.
    R_half : ndarray, shape (n, 3, 3)
        Body half-way seen from body at the start.
    f_rate_mps3, f_curve_mps4 : ndarray, shape (n, 3)
        Mean first and second derivative of the specific force, as measured.
    """

    R: FloatArray
    dv_mps: FloatArray
    dp_m: FloatArray
    R_half: FloatArray
    f_rate_mps3: FloatArray
    f_curve_mps4: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ImuSignal:
    """Angular rate and specific force of one run as cubic splines of time.

    Attributes
    ----------
    samples : CleanSamples
        What it was made of.
    period_s : float
        Median sample interval.
    gaps_s : ndarray, shape (n_gaps, 2)
        From the last sample before to the first after each interval with missing samples.
    """

    samples: CleanSamples
    period_s: float
    gaps_s: FloatArray
    _gyro_as_read: SampledVector
    _acc_as_read: SampledVector
    _gyro: SampledVector
    _acc: SampledVector

    @classmethod
    def from_track(
        cls, imu: ImuTrack, *, gyro_filter_s: float = 0.0, acc_filter_s: float = 0.0
    ) -> "ImuSignal":
        """Return the signals of a track; samples that are NaN, gaps or repeats are bridged.

        The low-passes of the sensors are undone, but for their delays, see `SampledVector.sharpened`.

        Raises
        ------
        ShapeError
            If fewer than `MIN_SAMPLES` samples can be used, or their stamps do not increase.
        """
        return cls.from_samples(clean_samples(imu), gyro_filter_s=gyro_filter_s, acc_filter_s=acc_filter_s)

    @classmethod
    def from_samples(
        cls, samples: CleanSamples, *, gyro_filter_s: float = 0.0, acc_filter_s: float = 0.0
    ) -> "ImuSignal":
        """Return the signals of samples that are clean; see `from_track`."""
        t_s, fill = samples.t_s, samples.fill
        interval = np.diff(t_s)
        period_s = float(np.median(interval))
        missing = np.flatnonzero(interval > GAP_PERIODS * period_s)
        gyro, acc = (
            SampledVector(t_s, values, period_s, filled)
            for values, filled in (
                (samples.gyro_radps, None if fill is None else (fill.t_s, fill.gyro_radps)),
                (samples.acc_mps2, None if fill is None else (fill.t_s, fill.acc_mps2)),
            )
        )
        return cls(
            samples=samples,
            period_s=period_s,
            gaps_s=np.stack([t_s[missing], t_s[missing + 1]], axis=1),
            _gyro_as_read=gyro,
            _acc_as_read=acc,
            _gyro=gyro.sharpened(gyro_filter_s),
            _acc=acc.sharpened(acc_filter_s),
        )

    def with_acc_filter(self, acc_filter_s: float) -> "ImuSignal":
        """Return the signals with this low-pass of the accelerometer undone, in place of any other."""
        return replace(self, _acc=self._acc_as_read.sharpened(acc_filter_s))

    def with_gyro_filter(self, gyro_filter_s: float) -> "ImuSignal":
        """Return the signals with this low-pass of the gyro undone, in place of nearly the same one."""
        return replace(self, _gyro=self._gyro_as_read.sharpened(gyro_filter_s, like=self._gyro))

    def without_gains(self, gyro_gain: FloatArray, acc_gain: FloatArray) -> "ImuSignal":
        """Return the signals with these gains of the samples taken out, shape (3, 3), in place of any others.

        No low-pass of the accelerometer is undone.
        """
        turn_gyro, turn_acc = (np.asarray(np.linalg.inv(g), dtype=np.float64) for g in (gyro_gain, acc_gain))
        acc = self._acc_as_read.turned(turn_acc)
        return replace(
            self, _gyro_as_read=self._gyro_as_read.turned(turn_gyro), _gyro=self._gyro.turned(turn_gyro),
            _acc_as_read=acc, _acc=acc,
        )  # fmt: skip

    @property
    def gyro_radps(self) -> FloatArray:
        """Return the samples of the angular rate with the low-pass undone, shape (n, 3)."""
        return self._gyro.values

    @property
    def acc_mps2(self) -> FloatArray:
        """Return the samples of the specific force with the low-pass undone, shape (n, 3)."""
        return self._acc.values

    # Steady roughness before sharpening: what that adds to noise lies high, and is gone once integrated.

    @property
    def gyro_roughness_radps(self) -> FloatArray:
        """Return the steady part of what is faster than the samples, shape (n,), see `roughness`."""
        return self._gyro_as_read.steady

    @property
    def acc_roughness_mps2(self) -> FloatArray:
        """Return the same of the specific force."""
        return self._acc_as_read.steady

    @property
    def gyro_impact_radps(self) -> FloatArray:
        """Return the pulses, shape (n,), see `roughness`."""
        return self._gyro.impacts

    @property
    def acc_impact_mps2(self) -> FloatArray:
        """Return the pulses of the specific force, or how unsure samples are that were filled."""
        return np.maximum(self._acc.impacts, self.samples.filled_sd_mps2)

    @property
    def gyro_bridge_radps(self) -> FloatArray:
        """Return the error of the cubic where one sample is missing, shape (n,)."""
        return self._gyro.bridge_error

    @property
    def acc_bridge_mps2(self) -> FloatArray:
        """Return the same of the specific force."""
        return self._acc.bridge_error

    @property
    def slow_gyro_radps(self) -> FloatArray:
        """Return the angular rate without what is faster than bricks move, shape (n, 3)."""
        return self._gyro.slow

    @property
    def gyro_change_radps2(self) -> FloatArray:
        """Return the size of its change, shape (n,)."""
        return self._gyro.slow_change

    @property
    def force_change_mps2(self) -> FloatArray:
        """Return what of the slow force is not constant in the body: that is the bias state's; shape (n,)."""
        return self._acc.slow_aside

    @property
    def epoch_ns(self) -> int:
        """Zero of the seconds below, on the samples' clock."""
        return self.samples.epoch_ns

    @property
    def t_s(self) -> FloatArray:
        """Instants of the samples that are used, shape (n,)."""
        return self.samples.t_s

    @property
    def clip_sd_mps2(self) -> FloatArray:
        """Above zero where a sample was clipped or stands beside one, shape (n,)."""
        return self.samples.clip_sd_mps2

    def _held(self, t_s: FloatArray) -> FloatArray:
        return np.clip(t_s, self.t_s[0], self.t_s[-1])

    def gyro_at(self, t_s: FloatArray) -> FloatArray:
        """Return the measured angular rate, rad/s; held beyond the first and last sample."""
        return np.asarray(self._gyro.spline(self._held(t_s)))

    def acc_at(self, t_s: FloatArray) -> FloatArray:
        """Return the measured specific force, m/s^2; held beyond the first and last sample."""
        return np.asarray(self._acc.spline(self._held(t_s)))

    def gyro_derivatives_at(self, t_s: FloatArray) -> FloatArray:
        """Return the first and second derivative of the measured angular rate, rad/s^2 and rad/s^3."""
        held = self._held(t_s)
        return np.stack([self._gyro.spline(held, order) for order in (1, 2)])

    def angle_at(self, t_s: FloatArray) -> FloatArray:
        """Return the integral of the measured angular rate, component by component, rad."""
        held = self._held(t_s)
        angle, beyond = self._gyro.once(held), t_s != held
        if beyond.any():
            angle[beyond] += self._gyro.spline(held[beyond]) * (t_s - held)[beyond][..., None]
        return np.asarray(angle)

    def in_gap(self, t_s: FloatArray, *, least_periods: float = 0.0) -> BoolArray:
        """Return which instants lie where samples are missing for so long, or beyond the samples."""
        outside = (t_s < self.t_s[0] - self.period_s) | (t_s > self.t_s[-1] + self.period_s)
        gaps = self.gaps_s[np.diff(self.gaps_s, axis=1)[:, 0] > least_periods * self.period_s]
        if len(gaps):
            i = np.searchsorted(gaps[:, 0], t_s, side="left") - 1
            outside |= (i >= 0) & (t_s < gaps[np.maximum(i, 0), 1])
        return np.asarray(outside)

    def increments(
        self,
        start_s: FloatArray,
        end_s: FloatArray,
        *,
        gyro_bias_radps: FloatArray,
        acc_bias_mps2: FloatArray,
        acc_lag_s: float,
    ) -> Increments:
        """Return the motion between pairs of instants, by integrals of the splines over sub-steps.

        Parameters
        ----------
        start_s, end_s : ndarray, shape (n,)
            Any pairs a sample interval or less apart (longer ones lose accuracy).
        gyro_bias_radps, acc_bias_mps2 : ndarray, shape (3,) or (n, 3)
        acc_lag_s : float
            Specific force at t is the sample stamped t + this (DESIGN 8.2).
        """
        n = len(start_s)
        out = Increments(
            R=np.empty((n, 3, 3)),
            dv_mps=np.empty((n, 3)),
            dp_m=np.empty((n, 3)),
            R_half=np.empty((n, 3, 3)),
            f_rate_mps3=np.empty((n, 3)),
            f_curve_mps4=np.empty((n, 3)),
        )
        integrate_steps(
            self.pieces(),
            np.ascontiguousarray(start_s),
            np.ascontiguousarray(end_s),
            np.ascontiguousarray(np.broadcast_to(gyro_bias_radps, (n, 3))),
            np.ascontiguousarray(np.broadcast_to(acc_bias_mps2, (n, 3))),
            float(acc_lag_s),
            out.R, out.dv_mps, out.dp_m, out.R_half, out.f_rate_mps3, out.f_curve_mps4,
        )  # fmt: skip
        return out

    def gyro_pieces(self) -> GyroPieces:
        """Return the angular rate's spline and integral for compiled loops."""
        span_s = (float(self.t_s[0]), float(self.t_s[-1]))
        return GyroPieces(self._gyro.spline.x, span_s, angle=self._gyro.once.c, gyro=self._gyro.spline.c)

    def pieces(self) -> SignalPieces:
        """Return the splines for compiled loops."""
        acc = self._acc
        return SignalPieces(*self.gyro_pieces(), acc_twice=acc.twice.c, acc_once=acc.once.c, acc=acc.spline.c)


@compiled
def chain_rotations(steps: FloatArray) -> FloatArray:
    """Return the running products ``steps[0] @ ... @ steps[i]``, shape (n, 3, 3)."""
    out = np.empty_like(steps)
    if len(steps):
        out[0] = steps[0]
    for k in range(1, len(steps)):
        before, step = out[k - 1], steps[k]
        for i in range(3):
            for j in range(3):
                out[k, i, j] = (
                    before[i, 0] * step[0, j] + before[i, 1] * step[1, j] + before[i, 2] * step[2, j]
                )
    return out
