"""Inertial samples as continuous signals: splines, how far to trust them, and motion between instants.

Times inside are seconds after `ImuSignal.epoch_ns` on the clock of the samples.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline, PPoly

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_host.compiled import compiled
from bricktrack_host.fusion.inertial.imu_samples import (
    BRIDGE_PERIODS,
    CleanSamples,
    bridge_error,
    clean_samples,
    fill_instants,
    roughness,
)
from bricktrack_host.fusion.inertial.signal_kernel import GyroPieces, SignalPieces, integrate_steps
from bricktrack_host.tracks import ImuTrack

_GAP_PERIODS = 1.5  # an interval longer than this holds a missing sample


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


def _second_and_third(t_s: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives of samples by five points, shape (n, 3) each."""
    step = float(np.median(np.diff(t_s)))
    at = CubicSpline(t_s, values)
    far_before, before, after, far_after = (
        at(np.clip(t_s + k * step, t_s[0], t_s[-1])) for k in (-2, -1, 1, 2)
    )
    second = (16 * (before + after) - 30 * values - far_before - far_after) / (12 * step**2)
    third = (far_after - far_before - 2 * (after - before)) / (2 * step**3)
    return second, third


def _spline(
    t_s: FloatArray, values: FloatArray, period_s: float, fill: tuple[FloatArray, FloatArray] | None
) -> CubicSpline[Any]:
    """Return the cubic through samples and the fill's instants and values, shape (m,) and (m, 3).

    In a long gap without a fill, points on the chord keep it from swinging across.
    """
    knots, at_knots = t_s, values
    for i in np.flatnonzero(np.diff(t_s) > BRIDGE_PERIODS * period_s)[::-1]:
        between, at = fill_instants(t_s[i], t_s[i + 1], period_s), None
        if fill is not None:
            inside = (fill[0] > t_s[i]) & (fill[0] < t_s[i + 1])
            between, at = (fill[0][inside], fill[1][inside]) if inside.any() else (between, None)
        if at is None:
            share = (between[:, None] - t_s[i]) / (t_s[i + 1] - t_s[i])
            at = values[i] + share * (values[i + 1] - values[i])
        knots = np.insert(knots, i + 1, between)
        at_knots = np.insert(at_knots, i + 1, at, axis=0)
    return CubicSpline(knots, at_knots)


@dataclass(frozen=True, eq=False)
class SampledVector:
    """A vector as a continuous signal; what is asked of it is made when first asked for, and kept.

    Attributes
    ----------
    t_s, values : ndarray, shape (n,), (n, 3)
    period_s : float
    fill : (ndarray, ndarray) or None
        Instants and values, shape (m,) and (m, 3), that stand for samples missing in long gaps.
    parts : tuple of (ndarray, SampledVector)
        Vectors, each with a matrix, shape (3, 3), of which it is the sum: so are then its splines. None: it
        was sampled itself.
    turned_from : SampledVector or None
        That of which it is the only part; next to equal, it is as rough.
    """

    t_s: FloatArray
    values: FloatArray
    period_s: float
    fill: tuple[FloatArray, FloatArray] | None
    parts: tuple[tuple[FloatArray, "SampledVector"], ...] = ()
    turned_from: "SampledVector | None" = None

    @cached_property
    def _roughness(self) -> tuple[FloatArray, FloatArray]:
        return roughness(self.values) if self.turned_from is None else self.turned_from._roughness

    @property
    def steady(self) -> FloatArray:
        """Return what of it is steadily faster than the samples, shape (n,), see `roughness`."""
        return self._roughness[0]

    @cached_property
    def impacts(self) -> FloatArray:
        """Return the pulses, shape (n,), see `roughness`; across a gap the spline stands for neighbours."""
        if self.turned_from is not None:
            return self.turned_from.impacts
        t_s = self.t_s
        missing = np.flatnonzero(np.diff(t_s) > _GAP_PERIODS * self.period_s)
        if not missing.size:
            return self._roughness[1]
        gaps = zip(t_s[missing], t_s[missing + 1], strict=True)
        even_s = np.concatenate([t_s, *(fill_instants(*gap, self.period_s) for gap in gaps)])
        order = np.argsort(even_s)
        return np.asarray(roughness(self.spline(even_s[order]))[1][order < len(t_s)])

    @cached_property
    def bridge_error(self) -> FloatArray:
        """Return the error of the cubic where one sample is missing, shape (n,)."""
        return bridge_error(self.values) if self.turned_from is None else self.turned_from.bridge_error

    @cached_property
    def spline(self) -> PPoly[Any]:
        """Return the signal."""
        if self.parts:
            return self._sum([part.spline for _, part in self.parts])
        return _spline(self.t_s, self.values, self.period_s, self.fill)

    @cached_property
    def once(self) -> PPoly[Any]:
        """Return its integral."""
        if self.parts:
            return self._sum([part.once for _, part in self.parts])
        return self.spline.antiderivative()

    @cached_property
    def twice(self) -> PPoly[Any]:
        """Return its double integral."""
        if self.parts:
            return self._sum([part.twice for _, part in self.parts])
        return self.spline.antiderivative(2)

    def _sum(self, of_parts: list[PPoly[Any]]) -> PPoly[Any]:
        turns = [turn.T for turn, _ in self.parts]
        c = np.sum([piece.c @ turn for turn, piece in zip(turns, of_parts, strict=True)], axis=0)
        return PPoly(c, of_parts[0].x)

    @cached_property
    def _second_and_third(self) -> tuple["SampledVector", "SampledVector"]:
        """Return the derivatives by five points; what fills a gap stays as it is."""
        fill = None if self.fill is None else (self.fill[0], np.zeros_like(self.fill[1]))
        second, third = _second_and_third(self.t_s, self.values)
        return (
            SampledVector(self.t_s, second, self.period_s, fill),
            SampledVector(self.t_s, third, self.period_s, fill),
        )

    def turned(self, turn: FloatArray) -> "SampledVector":
        """Return the vector times a matrix near to one, shape (3, 3), in place of any other."""
        if self.turned_from is not None:
            return self.turned_from.turned(turn)
        fill = None if self.fill is None else (self.fill[0], self.fill[1] @ turn.T)
        return replace(self, values=self.values @ turn.T, fill=fill, parts=((turn, self),), turned_from=self)

    def sharpened(self, filter_s: float) -> "SampledVector":
        """Return the vector with the amplitudes that a low-pass took from it, at the times where it put them.

        The low-pass is of second order and critically damped, ``1 / (1 + s filter_s)^2``: mean delay
        ``2 filter_s``, -3 dB at ``0.102 / filter_s`` Hz. Without its delay its inverse is
        ``1 - u^2 + 2/3 u^3 + O(u^5)`` with ``u = s filter_s``, whose derivatives are those of five points.
        Nothing is done at zero.
        """
        if filter_s <= 0:
            return self
        if self.turned_from is not None:
            return self.turned_from.sharpened(filter_s).turned(self.parts[0][0])
        second, third = self._second_and_third
        of_second, of_third = -(filter_s**2), 2 / 3 * filter_s**3
        values = self.values + of_second * second.values + of_third * third.values
        eye = np.eye(3)
        parts = (eye, self), (of_second * eye, second), (of_third * eye, third)
        return replace(self, values=values, parts=parts)


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
        missing = np.flatnonzero(interval > _GAP_PERIODS * period_s)
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

    def gyro_rate_at(self, t_s: FloatArray) -> FloatArray:
        """Return how fast the measured angular rate changes, rad/s^2."""
        return np.asarray(self._gyro.spline(self._held(t_s), 1))

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
