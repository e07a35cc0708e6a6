"""Inertial samples as continuous signals: splines, how far to trust them, and motion between instants.

Times inside are seconds after `ImuSignal.epoch_ns` on the clock of the samples. "Roughness" is what a sample
differs from the polynomial through its neighbours: noise, or motion faster than the samples can follow.
"""

from dataclasses import dataclass
from math import comb
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline, PPoly
from scipy.ndimage import maximum_filter1d

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray, as_float_array
from bricktrack_common.errors import ShapeError
from bricktrack_common.imu_records import UNUSABLE, ImuFlag
from bricktrack_host.compiled import compiled
from bricktrack_host.fusion.running_median import running_median
from bricktrack_host.fusion.signal_kernel import SignalPieces, integrate_steps
from bricktrack_host.fusion.vibration import mend_vibration
from bricktrack_host.tracks import ImuTrack

MIN_SAMPLES = 20
_GAP_PERIODS = 1.5  # an interval longer than this holds a missing sample
_BRIDGE_PERIODS = 3.5  # up to here the cubic may bridge it; beyond, a straight line
# sd of (sample - polynomial through eight neighbours) over sd of one sample, white noise
_PREDICTION_GAIN = comb(16, 8) ** 0.5 / comb(8, 4)
_STEADY_SAMPLES = 25
_IMPACT_SIGMA = 5.0
_VIBRATION_MPS2 = 0.3  # of the median sample off its neighbours: a steady vibration, which can be predicted
_CLIP_SHARE = 0.98  # of the range: filters inside the chip round a clipped peak off a little


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


def seconds_since(t_ns: IntArray, epoch_ns: int) -> FloatArray:
    """Return int64 ns as float seconds after an epoch: subtracted first, so that no digit is lost."""
    return np.asarray((t_ns - epoch_ns) * 1e-9, dtype=np.float64)


def usable_samples(imu: ImuTrack) -> BoolArray:
    """Return which samples are whole and new."""
    bad = UNUSABLE | ImuFlag.REPEAT  # a repeat is an old measurement under a new stamp
    whole = np.isfinite(imu.acc_mps2).all(axis=1) & np.isfinite(imu.gyro_radps).all(axis=1)
    return np.asarray(whole & ((imu.flags & int(bad)) == 0))


def roughness(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return what of a signal is faster than its samples: the steady part, and single impacts.

    Parameters
    ----------
    values : ndarray, shape (n, 3), n >= 9

    Returns
    -------
    steady : ndarray, shape (n,), unit of ``values``
        As the sd of one sample of white noise: from how far samples are off the polynomial through their
        eight neighbours, by the median over a quarter second at 100 Hz, so that an impact does not count; the
        greatest of the axes. A motion of a fifth of the sample rate gives 3 % of its amplitude, about what
        the spline loses of it.
    impact : ndarray, shape (n,), unit of ``values``
        Height of a pulse over the same polynomial, where it stands out of what is usual there, at its sample
        and the two beside it; else 0.
    """
    v = as_float_array("values", values, (None, 3))
    off = _off_neighbours(v, 4)
    usual = _usual(off)
    # A pulse pulls its neighbours' polynomials as well: only the peak counts.
    peak = off >= 0.9 * maximum_filter1d(off, 9, axis=0, mode="nearest")
    impact = np.where(peak & (off > _IMPACT_SIGMA * usual), off, 0.0).max(axis=1)
    steady = usual.max(axis=1) / _PREDICTION_GAIN
    return np.asarray(steady), np.asarray(maximum_filter1d(impact, 3, mode="nearest"))


def _off_neighbours(values: FloatArray, n_side: int) -> FloatArray:
    """Return the distance of samples from the polynomial through ``n_side`` neighbours on each side."""
    off = np.abs(np.diff(values, 2 * n_side, axis=0)) / comb(2 * n_side, n_side)
    return np.pad(off, ((n_side, n_side), (0, 0)), mode="edge")


def _usual(off: FloatArray) -> FloatArray:
    """Return the sd by the running median of absolute values."""
    return running_median(off, _STEADY_SAMPLES) / 0.6745


def _bridge_clipped(t_s: FloatArray, acc: FloatArray, limit: float) -> tuple[FloatArray, FloatArray]:
    """Return samples with clipped peaks completed by the cubic of the others, and how unsure they are."""
    done, sd = acc.copy(), np.zeros(len(acc))
    for axis in range(3):
        clipped = np.abs(acc[:, axis]) >= _CLIP_SHARE * limit
        if not clipped.any() or (~clipped).sum() < 4:
            sd[clipped] = limit
            continue
        bridge = CubicSpline(t_s[~clipped], acc[~clipped, axis])(t_s[clipped])
        sign = np.sign(acc[clipped, axis])
        # The truth lies beyond the limit; a cubic over a long clipped stretch can fly off, so it is bounded.
        excess = np.clip(sign * bridge - limit, 0.0, limit)
        done[clipped, axis] = sign * (limit + excess)
        sd[clipped] = np.maximum(sd[clipped], 0.1 * limit + 0.5 * excess)
    return done, np.asarray(maximum_filter1d(sd, 3, mode="nearest"))


def sharpened(t_s: FloatArray, values: FloatArray, filter_s: float) -> FloatArray:
    """Return samples with the amplitudes that a low-pass took from them, at the times where it put them.

    The low-pass is of second order and critically damped, ``1 / (1 + s filter_s)^2``: mean delay
    ``2 filter_s``, -3 dB at ``0.102 / filter_s`` Hz. Without its delay its inverse is
    ``1 - u^2 + 2/3 u^3 + O(u^5)`` with ``u = s filter_s``, whose derivatives are those of five points.

    Parameters
    ----------
    t_s : ndarray, shape (n,)
    values : ndarray, shape (n, 3)
    filter_s : float, s
        Nothing is done at zero.
    """
    if filter_s <= 0:
        return values
    step = float(np.median(np.diff(t_s)))
    at = CubicSpline(t_s, values)
    far_before, before, after, far_after = (
        at(np.clip(t_s + k * step, t_s[0], t_s[-1])) for k in (-2, -1, 1, 2)
    )
    second = (16 * (before + after) - 30 * values - far_before - far_after) / (12 * step**2)
    third = (far_after - far_before - 2 * (after - before)) / (2 * step**3)
    return np.asarray(values - filter_s**2 * second + 2 / 3 * filter_s**3 * third)


@dataclass(frozen=True, slots=True, eq=False)
class ImuSignal:
    """Angular rate and specific force of one run as cubic splines of time.

    Attributes
    ----------
    epoch_ns : int
        Zero of the seconds below, on the samples' clock.
    period_s : float
        Median sample interval.
    t_s : ndarray, shape (n,)
        Instants of the samples that are used.
    gyro_radps, acc_mps2 : ndarray, shape (n, 3)
        Those samples; clipped accelerations completed by the cubic of their neighbours.
    gyro_roughness_radps, acc_roughness_mps2 : ndarray, shape (n,)
        The steady part, see `roughness`.
    gyro_impact_radps, acc_impact_mps2 : ndarray, shape (n,)
        The pulses, see there.
    gyro_bridge_radps, acc_bridge_mps2 : ndarray, shape (n,)
        Error of the cubic where one sample is missing.
    clip_sd_mps2 : ndarray, shape (n,)
        Above zero where a sample was clipped or stands beside one.
    gaps_s : ndarray, shape (n_gaps, 2)
        From the last sample before to the first after each interval with missing samples.
    """

    epoch_ns: int
    period_s: float
    t_s: FloatArray
    gyro_radps: FloatArray
    acc_mps2: FloatArray
    gyro_roughness_radps: FloatArray
    acc_roughness_mps2: FloatArray
    gyro_impact_radps: FloatArray
    acc_impact_mps2: FloatArray
    gyro_bridge_radps: FloatArray
    acc_bridge_mps2: FloatArray
    clip_sd_mps2: FloatArray
    gaps_s: FloatArray
    _gyro: CubicSpline[Any]
    _acc: CubicSpline[Any]
    _gyro_integral: PPoly[Any]
    _acc_integral: PPoly[Any]
    _acc_double: PPoly[Any]

    @classmethod
    def from_track(
        cls,
        imu: ImuTrack,
        *,
        gyro_filter_s: float = 0.0,
        acc_filter_s: float = 0.0,
        gyro_gain: FloatArray | None = None,
        acc_gain: FloatArray | None = None,
    ) -> "ImuSignal":
        """Return the signals of a track; samples that are NaN, gaps or repeats are bridged.

        The low-passes of the sensors are undone, but for their delays, see `sharpened`, and so are the gains
        that the samples have over the truth, matrices of shape (3, 3).

        Raises
        ------
        ShapeError
            If fewer than `MIN_SAMPLES` samples can be used, or their stamps do not increase.
        """
        as_float_array("acc_mps2", imu.acc_mps2, (len(imu.t_ns), 3))
        as_float_array("gyro_radps", imu.gyro_radps, (len(imu.t_ns), 3))
        use = usable_samples(imu)
        if use.sum() < MIN_SAMPLES:
            raise ShapeError(
                f"only {use.sum()} of {use.size} inertial samples are whole; at least {MIN_SAMPLES} are "
                "needed. Process the run with the camera alone."
            )
        t_ns = imu.t_ns[use]
        if (np.diff(t_ns) <= 0).any():
            i = int(np.argmax(np.diff(t_ns) <= 0))
            raise ShapeError(
                f"inertial stamps do not increase: {t_ns[i]} ns is followed by {t_ns[i + 1]} ns; "
                "sort the samples"
            )
        epoch_ns = int(t_ns[0])
        t_s = seconds_since(t_ns, epoch_ns)
        period_s = float(np.median(np.diff(t_s)))
        clip_limit = imu.acc_range_mps2 if imu.acc_range_mps2 > 0 else np.inf
        acc, clip_sd = _bridge_clipped(t_s, imu.acc_mps2[use], clip_limit)
        gyro, filled_sd = imu.gyro_radps[use], np.zeros(len(t_s))
        shaking = roughness(acc)[0]
        if np.median(shaking) > _VIBRATION_MPS2:
            mended = mend_vibration(gyro, acc, shaking)
            gyro, acc, filled_sd = mended.gyro_radps, mended.acc_mps2, mended.acc_sd_mps2
        if gyro_gain is not None:
            gyro = as_float_array("gyro_radps", np.linalg.solve(gyro_gain, gyro.T).T, (None, 3))
        if acc_gain is not None:
            acc = as_float_array("acc_mps2", np.linalg.solve(acc_gain, acc.T).T, (None, 3))
        # Steady roughness before sharpening: what that adds to noise lies high, and is gone once integrated.
        (gyro_steady, gyro_impact), (acc_steady, acc_impact) = roughness(gyro), roughness(acc)
        if gyro_filter_s > 0:
            gyro = sharpened(t_s, gyro, gyro_filter_s)
            gyro_impact = roughness(gyro)[1]
        if acc_filter_s > 0:
            acc = sharpened(t_s, acc, acc_filter_s)
            acc_impact = roughness(acc)[1]
        acc_impact = np.maximum(acc_impact, filled_sd)

        interval = np.diff(t_s)
        missing = np.flatnonzero(interval > _GAP_PERIODS * period_s)
        knots, knot_gyro, knot_acc = t_s, gyro, acc
        for i in missing[interval[missing] > _BRIDGE_PERIODS * period_s][::-1]:
            # Points on the chord keep the cubic from swinging across a long gap.
            n_fill = int(np.ceil(interval[i] / period_s)) - 1
            share = np.arange(1, n_fill + 1)[:, None] / (n_fill + 1)
            knots = np.insert(knots, i + 1, t_s[i] + share[:, 0] * interval[i])
            knot_gyro = np.insert(knot_gyro, i + 1, gyro[i] + share * (gyro[i + 1] - gyro[i]), axis=0)
            knot_acc = np.insert(knot_acc, i + 1, acc[i] + share * (acc[i + 1] - acc[i]), axis=0)
        gyro_spline, acc_spline = CubicSpline(knots, knot_gyro), CubicSpline(knots, knot_acc)
        return cls(
            epoch_ns=epoch_ns,
            period_s=period_s,
            t_s=t_s,
            gyro_radps=gyro,
            acc_mps2=acc,
            gyro_roughness_radps=gyro_steady,
            acc_roughness_mps2=acc_steady,
            gyro_impact_radps=gyro_impact,
            acc_impact_mps2=acc_impact,
            gyro_bridge_radps=_usual(_off_neighbours(gyro, 2)).max(axis=1),
            acc_bridge_mps2=_usual(_off_neighbours(acc, 2)).max(axis=1),
            clip_sd_mps2=clip_sd,
            gaps_s=np.stack([t_s[missing], t_s[missing + 1]], axis=1),
            _gyro=gyro_spline,
            _acc=acc_spline,
            _gyro_integral=gyro_spline.antiderivative(),
            _acc_integral=acc_spline.antiderivative(),
            _acc_double=acc_spline.antiderivative(2),
        )

    def _held(self, t_s: FloatArray) -> FloatArray:
        return np.clip(t_s, self.t_s[0], self.t_s[-1])

    def gyro_at(self, t_s: FloatArray) -> FloatArray:
        """Return the measured angular rate, rad/s; held beyond the first and last sample."""
        return np.asarray(self._gyro(self._held(t_s)))

    def acc_at(self, t_s: FloatArray) -> FloatArray:
        """Return the measured specific force, m/s^2; held beyond the first and last sample."""
        return np.asarray(self._acc(self._held(t_s)))

    def _integral(self, integral: PPoly[Any], spline: CubicSpline[Any], t_s: FloatArray) -> FloatArray:
        held = self._held(t_s)
        return np.asarray(integral(held) + spline(held) * (t_s - held)[..., None])

    def gyro_rate_at(self, t_s: FloatArray) -> FloatArray:
        """Return how fast the measured angular rate changes, rad/s^2."""
        return np.asarray(self._gyro(self._held(t_s), 1))

    def angle_at(self, t_s: FloatArray) -> FloatArray:
        """Return the integral of the measured angular rate, component by component, rad."""
        return self._integral(self._gyro_integral, self._gyro, t_s)

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

    def pieces(self) -> SignalPieces:
        """Return the splines for compiled loops."""
        return SignalPieces(
            knots_s=self._gyro.x,
            span_s=(float(self.t_s[0]), float(self.t_s[-1])),
            angle=self._gyro_integral.c,
            gyro=self._gyro.c,
            acc_twice=self._acc_double.c,
            acc_once=self._acc_integral.c,
            acc=self._acc.c,
        )


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
